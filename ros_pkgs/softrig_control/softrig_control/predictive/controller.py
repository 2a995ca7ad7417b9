"""GPC as a block: closed form or constrained, for any plant of one command and one measured signal."""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

from softrig_core import Block, BlockParams, Level, Port, Values, param, scalars
from typing_extensions import TypeVar

from ..limit_cycle import Swinging, limit_cycle
from ..nodes.signal_name import signal_port, split
from .carima import Carima
from .gpc import Gpc, GpcState, Tuning
from .qp import MoveSolver

UNBOUNDED = 1e12
PATIENCE = 3  # bad samples in a row before the trip
# Relative distance from a bound that counts as on it, because a solver reaches a bound only to its tolerance.
ON_BOUND = 1e-7

# health/state
FOLLOWING, BOUNDED, HOLDING, TRIPPED = 0.0, 1.0, 2.0, 3.0


class GpcLawParams(BlockParams):
    """Horizons, weight, bounds and solver."""

    N1: int = param(1, "first predicted sample that counts", ge=1, le=1000)
    Np: int = param(11, "prediction horizon", ge=1, le=1000)
    Nc: int = param(2, "control horizon, number of moves", ge=1, le=50)
    lam: float = param(1.0, "weight lambda of the moves", ge=0.0, le=1e12, live=True)
    u_min: float = param(-UNBOUNDED, "smallest command", ge=-UNBOUNDED, le=UNBOUNDED, live=True)
    u_max: float = param(UNBOUNDED, "largest command", ge=-UNBOUNDED, le=UNBOUNDED, live=True)
    du_max: float = param(
        UNBOUNDED, "largest move in one period; for DAQP, the closed form knows none", gt=0.0, le=UNBOUNDED, live=True
    )
    solver: Literal["closed_form", "daqp"] = param(
        "closed_form", "closed form, clipped to u_min and u_max, or DAQP, which keeps all bounds for all moves"
    )
    set_point: float = param(0.0, "reference until one arrives", ge=-UNBOUNDED, le=UNBOUNDED, live=True)
    u_start: float = param(0.0, "command that was applied before the start", ge=-UNBOUNDED, le=UNBOUNDED)
    u_safe: float = param(0.0, "command after a trip", ge=-UNBOUNDED, le=UNBOUNDED, live=True)
    trip_low: float = param(
        -UNBOUNDED, "measured value at or below which the law trips", ge=-UNBOUNDED, le=UNBOUNDED, live=True
    )
    trip_high: float = param(
        UNBOUNDED, "measured value above which the law trips", ge=-UNBOUNDED, le=UNBOUNDED, live=True
    )
    measured: str = param("output/v_dc/position", "signal under control, topic/channel/field")
    measured_also: tuple[str, ...] = param((), "channels that come in the same message as the measured signal")
    measured_unit: str = param("V", "its unit, and that of the reference")
    reference: str = param("reference/v_dc/position", "signal to be followed, topic/channel/field")
    command: str = param("command/u/effort", "signal that is commanded, topic/channel/field")
    command_unit: str = param("V", "its unit")

    def _check(self) -> None:
        if not self.u_min < self.u_max:
            raise ValueError(f"u_min = {self.u_min:g}, u_max = {self.u_max:g}: expected u_min < u_max")
        if not self.trip_low < self.trip_high:
            raise ValueError(f"trip_low = {self.trip_low:g}, trip_high = {self.trip_high:g}: expected trip_low below")
        if self.solver == "closed_form" and self.du_max < UNBOUNDED:
            raise ValueError(f"du_max = {self.du_max:g} needs a solver, solver = closed_form has none")
        for signal in (self.measured, self.reference, self.command):
            split(signal)
        Gpc(self.carima(), self.tuning())

    def tuning(self) -> Tuning:
        """Return horizons and weight."""
        return Tuning(self.N1, self.Np, self.Nc, self.lam)

    def carima(self) -> Carima:
        """Return the model for prediction."""
        raise NotImplementedError

    @property
    def u_first(self) -> float:
        """Command that was applied before the start."""
        return self.u_start


class GpcControllerParams(GpcLawParams):
    """The model: a transfer function in s, or A(z) and B(z)."""

    num: tuple[float, ...] = param((2.8286, 2.8286 * 175100.0), "numerator, highest power of s first", max_length=50)
    den: tuple[float, ...] = param(
        (1.0, 51.17 + 125.7, 51.17 * 125.7), "denominator, highest power of s first", max_length=50
    )
    a: tuple[float, ...] = param((), "instead: A(z) = 1 + a1 z^-1 + ..., beginning with the 1", max_length=200)
    b: tuple[float, ...] = param((), "instead: B(z) = b0 + b1 z^-1 + ..., b0 being that of u(t-1)", max_length=200)

    def carima(self) -> Carima:
        """Return A(z), B(z), or the transfer function sampled with zero-order hold."""
        if self.a or self.b:
            return Carima(self.a, self.b)
        return Carima.from_continuous(self.num, self.den, self.period)


P = TypeVar("P", bound=GpcLawParams, default=GpcControllerParams)


class State(NamedTuple):
    """The controller's past and the status beside it; values in the units of the signals."""

    law: GpcState
    w: float
    """Reference."""

    y: float | None = None
    """Measured last; None before the first sample."""

    bad: int = 0
    """Samples refused in a row."""

    failures: int = 0
    """Of the solver."""

    tripped: bool = False
    cycle: Swinging = Swinging()


class GpcController(Block[P]):
    """Generalised predictive control; `Gpc` has the control law, `qp` the quadratic programme with bounds.

    The controller starts from the first sample as if the plant had rested there forever with `u_start` applied.
    ``NAME/health`` has the state (0 following, 1 on a bound, 2 holding the last command, 3 tripped), the number of
    active bounds over all moves, and the number of solver failures.

    If the programme has no solution or an input is bad, the last command is held. The third bad sample in a row, or a
    measured value outside `trip_low`, `trip_high`, trips the controller: it publishes `u_safe` permanently. A loop that
    oscillates without end, as with the gains of another plant, is reported as a warning.

    Changed weights and bounds affect the next move but not the command that it starts from, so the command does not
    jump. A changed `set_point` applies until a reference arrives. A trip is permanent, with the `u_safe` that applied
    when it tripped.
    """

    @classmethod
    def ports(cls, params: GpcLawParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Ports named by the parameters."""
        return (
            signal_port("measured", params.measured, params.measured_unit, also=params.measured_also),
            signal_port("reference", params.reference, params.measured_unit, held=True, safe=(params.set_point,)),
        ), (
            signal_port("command", params.command, params.command_unit),
            scalars("health", "health", {"state": "", "active": "", "failures": ""}),
        )

    def setup(self) -> None:
        """Build the law, its solver if it has one."""
        p = self.p
        self.law = Gpc(p.carima(), p.tuning())
        self._solver = MoveSolver(self.law.hessian, p.du_max) if p.solver == "daqp" else None

    def first(self) -> State:
        """Return the initial state without measurements."""
        return State(self.law.first(0.0, self.p.u_first), self.p.set_point)

    def go_on(self, x: State, before: P) -> State:
        """Continue with another weight, bounds or set point; the command and past measurements stay."""
        return x if self.p.set_point == before.set_point else x._replace(w=self.p.set_point)

    def update(
        self, x: State, t: int, *, measured: tuple[float, ...], reference: tuple[float, ...] | None
    ) -> tuple[State, Values]:
        """Return the command for a sample."""
        p, y, gpc = self.p, measured[0], self.law
        law, w, last, _, failures, tripped, cycle = x
        if reference is not None:
            w = reference[0]
        if not tripped and not p.trip_low < y <= p.trip_high:
            law = self._trip(law, f"measured {y:g} {p.measured_unit} is outside {p.trip_low:g} to {p.trip_high:g}")
            tripped = True
        if tripped:
            return State(law, w, last, 0, failures, True, cycle), answer(law, TRIPPED, 0, failures)
        if last is None:
            law = gpc.first(y, p.u_first)
        cycle, swing = limit_cycle(cycle, y, w)
        if swing:
            name = split(p.measured)[1]
            self.report(
                Level.WARN,
                "limit_cycle",
                f"the loop does not settle: {name} swings by {swing:.3g} "
                f"{p.measured_unit} about {w:g} {p.measured_unit}",
            )
        law = gpc.measure(law, y)
        if self._solver is None:
            u = law.u + gpc.move(law, w)
            bounded = min(max(u, p.u_min), p.u_max)
            law = gpc.applied(law, bounded)
            state, active = FOLLOWING if bounded == u else BOUNDED, int(bounded != u)
        else:
            law, state, active = self._constrained(self._solver, law, w)
            failures += state == HOLDING
        return State(law, w, y, 0, failures, False, cycle), answer(law, state, active, failures)

    def _constrained(self, solver: MoveSolver, law: GpcState, w: float) -> tuple[GpcState, float, int]:
        """Return the control law after its move, the state for ``health``, and the number of active bounds."""
        p = self.p
        moves, status = solver.solve(self.law.gradient(law, w), p.u_min - law.u, p.u_max - law.u)
        if moves is None or not all(map(math.isfinite, moves)):
            self.report(Level.WARN, "no_solution", f"{p.solver}: {status}; the last command is held")
            return self.law.applied(law, law.u), HOLDING, 0
        active = self._active(law.u, moves)
        # The solver keeps a bound only to its tolerance, but the command must keep it exactly.
        law = self.law.applied(law, min(max(law.u + moves[0], p.u_min), p.u_max))
        return law, BOUNDED if active else FOLLOWING, active

    def _active(self, u: float, moves: tuple[float, ...]) -> int:
        """Count the bounds that hold with equality, over all moves from u."""
        p, count = self.p, 0
        near_move, near = ON_BOUND * p.du_max, ON_BOUND * max(abs(p.u_min), abs(p.u_max), 1.0)
        for move in moves:
            u += move
            count += p.du_max < UNBOUNDED and p.du_max - abs(move) <= near_move
            count += p.u_max < UNBOUNDED and p.u_max - u <= near
            count += p.u_min > -UNBOUNDED and u - p.u_min <= near
        return count

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Hold the last command; trip at the third bad sample in a row."""
        law, w, last, bad, failures, tripped, cycle = x
        bad += 1
        self.report(Level.ERROR, "bad_input", "a measurement or reference was refused; the last command is held")
        if bad >= PATIENCE and not tripped:
            law, tripped = self._trip(law, f"{PATIENCE} bad samples in a row"), True
        if not tripped:
            # The plant continues under the held command, so the law goes on with the last good sample.
            if last is not None:
                law = self.law.measure(law, last)
            law = self.law.applied(law, law.u)
        x = State(law, w, last, bad, failures, tripped, cycle)
        return x, answer(law, TRIPPED if tripped else HOLDING, 0, failures)

    def _trip(self, law: GpcState, reason: str) -> GpcState:
        self.report(Level.ERROR, "trip", f"{reason}: tripped to {self.p.u_safe:g} {self.p.command_unit} for good")
        return self.law.applied(law, self.p.u_safe)


def answer(law: GpcState, state: float, active: int, failures: int) -> Values:
    """Return the outputs of the node."""
    return {"command": (law.u,), "health": (state, float(active), float(failures))}
