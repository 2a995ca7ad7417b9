"""Parameters that several nodes share: which system, and how its delay varies."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Literal, NamedTuple

from softrig_core import Block, Jobs, Level, Params, Solver, SolverParams, param
from typing_extensions import TypeVar

from .profiles import Kind, Profile, profile
from .system import PwaSystem, continuous_tank, from_lines, linear, pendulum, switched, tank

SystemName = Literal["switched", "tank", "continuous_tank", "pendulum", "benchmark", "scalar", "user"]
BENCHMARK = ([[-2.0, 0.0], [0.0, -0.9]], [[-1.0, 0.0], [-1.0, -1.0]])


class SystemParams(Params):
    """A published system by name, or your own by its matrices, row after row, cell after cell."""

    system: SystemName = param("switched", "published example, or user: the matrices below")
    n: int = param(1, "user: number of states", ge=1, le=12)
    A: tuple[float, ...] = param((0.0,), "user: A_i of every cell", "1/s")
    Ad: tuple[float, ...] = param((-1.0,), "user: Ad_i of every cell", "1/s")
    lines: tuple[float, ...] = param((), "user: switching lines c of c'x = 0; the first one's sign changes slowest")
    lines_delayed: tuple[float, ...] = param((), "user: switching lines c of c'x_d = 0, after those on x")
    offsets: tuple[float, ...] = param((), "user: a_i of every cell; none")
    k_negative: float = param(1.0, "pendulum: gain k while theta <= 0", ge=0.0, le=1e3)
    k_positive: float = param(5.0, "pendulum: gain k while theta > 0", ge=0.0, le=1e3)

    def _check(self) -> None:
        if self.system == "user":
            self.build()

    def build(self) -> PwaSystem:
        """Create the system.

        Raises
        ------
        ValueError
            The matrices do not fit; names cell and face.
        """
        if self.system == "pendulum":
            return pendulum(self.k_negative, self.k_positive)
        return _build(self.system, self.n, self.A, self.Ad, self.lines, self.lines_delayed, self.offsets)

    def agreed(self) -> dict[str, Any]:
        """Return the quantities on which all nodes that use this system must agree."""
        quantities = {"pwa/system": self.system}
        if self.system == "pendulum":
            gains = {"pendulum/k_negative": self.k_negative, "pendulum/k_positive": self.k_positive}
            return {**quantities, **gains, "pendulum/model": "pwa"}
        if self.system != "user":
            return quantities
        return quantities | {
            f"pwa/{name}": getattr(self, name) for name in ("n", "A", "Ad", "lines", "lines_delayed", "offsets")
        }

    @property
    def states(self) -> int:
        """Number of states."""
        sizes = {"switched": 2, "tank": 1, "continuous_tank": 1, "pendulum": 2, "benchmark": 2, "scalar": 1}
        return sizes.get(self.system, self.n)


@lru_cache(maxsize=32)
def _build(
    name: str,
    n: int,
    A: tuple[float, ...],
    Ad: tuple[float, ...],
    lines: tuple[float, ...],
    lines_delayed: tuple[float, ...],
    offsets: tuple[float, ...],
) -> PwaSystem:
    published = {"switched": switched, "tank": tank, "continuous_tank": continuous_tank}
    if name in published:
        return published[name]()
    if name == "benchmark":
        return linear(*BENCHMARK)
    if name == "scalar":
        return linear(0.0, -1.0)
    for label, values, unit in (
        ("A", A, n * n),
        ("Ad", Ad, n * n),
        ("lines", lines, n),
        ("lines_delayed", lines_delayed, n),
        ("offsets", offsets, n),
    ):
        if len(values) % unit:
            raise ValueError(f"{label} has {len(values)} values, expected a multiple of {unit} for {n} states")

    def rows(values: tuple[float, ...]) -> list[tuple[float, ...]]:
        return [values[k : k + n] for k in range(0, len(values), n)]

    def squares(values: tuple[float, ...]) -> list[list[tuple[float, ...]]]:
        every = rows(values)
        return [every[k : k + n] for k in range(0, len(every), n)]

    return from_lines(squares(A), squares(Ad), rows(lines), rows(lines_delayed), rows(offsets) or None)


def law_of_the_tank(switch: float, k_low: float, k_high: float) -> dict[str, Any]:
    """Return the quantities on which all nodes that use the tank's controller must agree."""
    return {"tank/switch": switch, "tank/k_low": k_low, "tank/k_high": k_high}


class AskedState(NamedTuple):
    """State of an `AskedSolver` from tick to tick."""

    down: bool = False
    """Whether the button is."""

    asked: bool = False
    """Whether it has been asked since the start."""

    jobs: Jobs = Jobs()


S = TypeVar("S", bound=SolverParams, default=Any)


class AskedSolver(Solver[S]):
    """Base of solvers that work when their button, the only input, is pressed, and with `at_start` at the start."""

    STATE = AskedState

    def request(self, x: AskedState, t: int, **inputs: tuple[float, ...] | None) -> tuple[AskedState, Any]:
        """Request the work of the parameters at the start and when the button is pressed."""
        p: Any = self.p
        button = next(iter(inputs.values()), None)
        down = button is not None and button[0] != 0.0
        wanted = (down and not x.down) or (p.at_start and not x.asked)
        return AskedState(down, True, x.jobs), p if wanted else None


class DelayParams(Params):
    """Parameters of a delay: its variation over time, and its bound."""

    delay: float = param(0.02, "largest delay h", "s", ge=0.0, le=1000.0, live=True)
    max_delay: float = param(1000.0, "longest delay that is allowed; beyond it is clamped", "s", gt=0.0, le=1000.0)
    profile: Kind = param("constant", "constant, sine of rate mu, or telegraph: jumps between 0 and h at random times")
    mu: float = param(0.0, "bound of the rate of a sine", ge=0.0, le=100.0)
    seed: int = param(0, "of the telegraph, added to the seed of the run", ge=0, le=2**31 - 1)
    horizon: float = param(1000.0, "time for which a telegraph has jumps", "s", gt=0.0, le=1e6)

    @property
    def reach(self) -> float:
        """Longest delay (s) that may be set while it runs: twice that of the start, at most `max_delay`."""
        return min(2.0 * self.delay, self.max_delay)

    def bounded_profile(self, block: Block, longest: float | None = None) -> Profile:
        """Return the delay over time; `block` reports when its bound is more than is allowed, or is remembered."""
        most, name = (self.max_delay, "max_delay") if longest is None else (longest, "what is remembered")
        h = min(self.delay, most)
        if self.delay > most:
            block.report(Level.WARN, "delay", f"delay {self.delay:g} s clamped to {name} = {most:g} s")
        drawn = int(block.generator().integers(2**32)) if self.profile == "telegraph" else 0
        return profile(self.profile, h, self.mu, seed=[self.seed, drawn], horizon=self.horizon)
