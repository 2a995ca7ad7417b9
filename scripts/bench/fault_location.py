"""Time of the simulated line and of a location."""

from __future__ import annotations

from softrig_power.fault_location.line.parameters import RATES, RigParams
from softrig_power.fault_location.line.simulation import FaultedLine
from softrig_power.fault_location.method.location import Locator
from softrig_power.fault_location.method.objective import LocatorParams
from softrig_power.fault_location.study import simulate

from .timing import least


def print_table() -> None:
    """A line fault of 60 ms simulated in steps of 1 us, and one record located by each algorithm, CPU time."""
    p = RigParams()
    for profile in ("m20k", "raw1m"):
        rig = p.model_copy(update={"measurement": p.measurement.model_copy(update={"profile": profile})})
        line = FaultedLine(rig)
        steps = (rig.samples - 1) * rig.decimation
        seconds = least(lambda line=line, n=rig.samples: line.run(n))  # type: ignore[misc]
        print(
            f"line, {steps} steps of 1 us, {RATES[profile]:>7} samples/s  {seconds:7.4f} s  "
            f"{1e6 * seconds / steps:5.2f} us a step"
        )
    record = simulate(p)
    for algorithm in ("brent", "woa", "gwo", "integer_grid", "phasor"):
        settings = LocatorParams(algorithm=algorithm)  # type: ignore[arg-type]
        rounds = 1 if algorithm in ("woa", "gwo") else 5
        seconds = least(lambda s=settings: Locator(record, s).locate(), rounds)  # type: ignore[misc]
        print(f"location by {algorithm:<14} {1e3 * seconds:10.2f} ms")
