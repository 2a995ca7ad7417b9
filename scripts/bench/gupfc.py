"""Time of the GUPFC's plant, rig and power flow."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from softrig_core import ByHand, rig_of, simulate
from softrig_power.gupfc.flow.power_flow import PowerFlow, References
from softrig_power.gupfc.network import NetworkParams
from softrig_power.gupfc.plant import GupfcPlant
from softrig_power.gupfc.series import SeriesController
from softrig_power.gupfc.shunt import ShuntController

from .timing import cpu

PERIODS = 4320  # 1.5 s


def steady(waveform: str) -> Callable[[], None]:
    """Return a call that simulates 1.5 s of the plant alone under steady commands, compiled already."""
    held = ByHand(GupfcPlant(waveform=waveform))
    shunt, first, second = ShuntController(), SeriesController(circuit=1), SeriesController(circuit=2)
    turn = NetworkParams().omega * held.block.p.period
    commands = [next(iter(ByHand(c).refused(0).values())) for c in (shunt, first, second)]

    def run(periods: int = PERIODS) -> None:
        held.reset(0)
        for k in range(periods):
            held.outputs(0)
            given = [(size, angle + turn * k, omega) for size, angle, omega in commands]
            held.advance(0, **dict(zip(("shunt", "series_1", "series_2"), given, strict=True)))

    run(1)
    return run


def print_table() -> None:
    """1.5 s of the GUPFC's plant and of its rig, and one power flow, CPU time."""
    print("1.5 simulated seconds, 69,120 steps of the circuit, 4,320 control periods")
    for waveform in ("average", "pulse"):
        seconds = cpu(steady(waveform))
        print(
            f"plant alone, {waveform:8}          {seconds:7.3f} CPU s, {1e6 * seconds / (16 * PERIODS):5.2f} us a step"
        )
    for scenario in ("gupfc", "gupfc_s2"):
        seconds = cpu(partial(simulate, rig_of(scenario)))
        print(f"rig in process with recording, {scenario:9}{seconds:5.2f} CPU s")
    solver = PowerFlow(NetworkParams())
    seconds = cpu(lambda: [solver.solve(References()) for _ in range(100)])
    print(f"power flow from a flat start       {10.0 * seconds:7.2f} ms")
