"""Computations of the systems outside their rigs: plants alone, controller steps, searches, proofs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from rich.table import Table

from .console import console
from .gupfc import steady
from .timing import cpu

ROUNDS = 3
LONG = 2.0  # s of CPU time, above which a measurement is not repeated


class Work(NamedTuple):
    """A computation whose time is of interest.

    Parameters
    ----------
    system : str
        The system it belongs to.
    what : str
        What is computed.
    call : callable
        Does it `calls` times.
    calls : int
        How many of it one call does.
    simulated : float
        Simulated s of all of them; 0 when no time is simulated.
    """

    system: str
    what: str
    call: Callable[[], object]
    calls: int = 1
    simulated: float = 0.0


def print_table() -> None:
    """Plants alone, controller steps, searches and proofs: CPU time to real time and to a fixed piece of Python."""
    base = min(cpu(yardstick) for _ in range(5))
    table = Table("system", "work", "CPU ms", "x real time", "of yardstick", box=None, pad_edge=False)
    for work in works():
        work.call()  # the first call compiles
        spent = cpu(work.call)
        if spent < LONG:
            spent = min(spent, *(cpu(work.call) for _ in range(ROUNDS - 1)))
        each = spent / work.calls
        ratio = f"{work.simulated / spent:.1f}" if work.simulated else ""
        table.add_row(work.system, work.what, f"{1e3 * each:.3f}", ratio, f"{each / base:.4g}")
    console.print(table)
    console.print(f"yardstick: a million additions in a Python loop, {1e3 * base:.1f} ms")


def yardstick() -> float:
    """Run a fixed piece of work for comparing machines: a million additions in a Python loop."""
    x = 0.0
    for _ in range(1_000_000):
        x += 1.0
    return x


def works() -> Iterator[Work]:
    """Yield the works of all systems, one after the other."""
    yield from _core()
    yield from _rectifier()
    yield from _gupfc()
    yield from _dispatch()
    yield from _tcp()
    yield from _pwa()
    yield from _optimal()


def _core() -> Iterator[Work]:
    from softrig_core import list_scenarios, load_scenario

    names = list(list_scenarios())
    yield Work("core", "a scenario resolved", lambda: [load_scenario(n) for n in names], len(names))


def _rectifier() -> Iterator[Work]:
    import math

    from softrig_core import ByHand
    from softrig_power.rectifier.controller import RectifierGpc
    from softrig_power.rectifier.parameters import RectifierConstants
    from softrig_power.rectifier.plant import RectifierPlant

    period, steps = 830_000, 1500  # ns
    measured = [(400.0 + 8.0 * math.sin(0.3 * k), 25.0) for k in range(steps)]  # keeps the constraints active

    def control(law: ByHand) -> None:
        for k, y in enumerate(measured):
            law.update(k * period, measured=y, reference=None)

    free, bounded = ByHand(RectifierGpc()), ByHand(RectifierGpc(solver="daqp", du_max=2.0))
    yield Work("rectifier", "control step, closed form", lambda: control(free), steps)
    yield Work("rectifier", "control step, constrained", lambda: control(bounded), steps)
    plant, drop, periods = ByHand(RectifierPlant(model="switched")), RectifierConstants().drop, 361

    def switched() -> None:
        plant.reset(0)
        for k in range(periods):
            plant.outputs(k * period)
            plant.advance(k * period, command=(drop,), events=None)

    yield Work("rectifier", "switched plant alone", switched, 1, periods * period * 1e-9)


def _gupfc() -> Iterator[Work]:
    for waveform in ("average", "pulse"):
        yield Work("gupfc", f"plant alone, {waveform}", steady(waveform), 1, 1.5)


def _dispatch() -> Iterator[Work]:
    from softrig_power.dispatch.certify import Optimiser
    from softrig_power.dispatch.units import Units

    for table, demand in (("units_3", 850.0), ("units_13", 1800.0)):
        units = Units.read(table)
        yield Work("dispatch", f"{table}, proven", lambda u=units, d=demand: Optimiser(u).certified(d))  # type: ignore[misc]


def _tcp() -> Iterator[Work]:
    from softrig_core import ByHand
    from softrig_systems.tcp_aqm.controller import AqmController
    from softrig_systems.tcp_aqm.fluid_plant import TcpFluid
    from softrig_systems.tcp_aqm.packets_plant import TcpPackets

    def loop(plant: TcpFluid | TcpPackets, controller: AqmController, seconds: float) -> Callable[[], None]:
        every = round(controller.p.period / plant.p.period)

        def run() -> None:
            held, law = ByHand(plant), ByHand(controller)
            command: Any = (0.0,)
            for k in range(round(seconds / plant.p.period)):
                t = round(k * plant.p.period * 1e9)
                state = held.outputs(t)["state"]
                if k % every == 0:
                    command = law.update(t, state=state, reference=None)["command"]
                held.advance(t, command=command)

        return run

    fluid = TcpFluid(input_delay=True)
    seconds = 20_000 * fluid.p.period
    yield Work("tcp_aqm", "fluid, PI", loop(fluid, AqmController(law="pi"), seconds), 1, seconds)
    yield Work("tcp_aqm", "packets, PI", loop(TcpPackets(), AqmController(law="pi", period=0.01), 30.0), 1, 30.0)


def _pwa() -> Iterator[Work]:
    from softrig_systems.pwa_delay.proof.certify import certified_margin, certify
    from softrig_systems.pwa_delay.search import pwa_margin
    from softrig_systems.pwa_delay.system import switched

    system = switched()
    yield Work("pwa_delay", "certificate of theorem 1", lambda: certify(system, 0.0192))
    yield Work("pwa_delay", "largest certified delay", lambda: certified_margin(system, low=0.018, high=0.021))
    yield Work("pwa_delay", "largest simulated delay", lambda: pwa_margin(system, 0.0195, 0.021, (-2.0, 0.0), 60.0))


def _optimal() -> Iterator[Work]:
    from softrig_systems.optimal_control.method import collocation
    from softrig_systems.optimal_control.method.mvim import solve
    from softrig_systems.optimal_control.problems import find

    problem = find("spacecraft")
    yield Work("optimal", "series of order 8", lambda: solve(problem, 8))
    cold = collocation.solve(problem)
    guess = collocation.sampled(cold.rows, 100.0, 90.0, 3)
    later = problem.changed(x0=cold.rows[:3, 10].tolist(), horizon=90.0)
    yield Work("optimal", "collocation, warm", lambda: collocation.solve(later, guess=guess))
