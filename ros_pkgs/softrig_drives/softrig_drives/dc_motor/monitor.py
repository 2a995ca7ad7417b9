"""Figures of merit of the speed loop while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from softrig_core import Measure, Watch, WatchParams, executable, param
from softrig_core.rig import measures

from .ports import COMMAND, REFERENCE, SENSORS, SPEED

SPEED_NOW, VOLTAGE = "motor/state/shaft/velocity", "motor/command/armature/effort"
CURRENT = "motor/sensors/current_a/position"


class DcMotorMonitorParams(WatchParams):
    """Settling band and late window."""

    band: float = param(0.02, "settling band as a fraction of the step", gt=0.0)
    late: float = param(3.0, "steady figures are taken from this time after a step on", "s", ge=0.0)


class DcMotorMonitor(Watch[DcMotorMonitorParams]):
    """Step response and chattering figures of the newest step of the reference.

    On the rig, remap ``motor/state`` to ``motor/true_state`` and ``motor/command`` to ``motor/applied`` for the true
    figures.
    """

    INPUTS = (SPEED, SENSORS, COMMAND, REFERENCE)

    def start(self) -> None:
        """No step yet."""
        super().start()
        self._step: tuple[float, float, float] | None = None  # time, speed before, reference

    def update(self, t: int, **inputs: Any) -> Mapping[str, Any]:
        """Take one sample in."""
        reference = inputs["reference"]
        if reference is not None and (self._step is None or reference[0] != self._step[2]):
            self._step = t / 1e9, inputs["state"][0], reference[0]
        return super().update(t, **inputs)

    def measures(self) -> Iterator[Measure]:
        """Figures of the step under way, and late ones once it is over."""
        if self._step is None:
            return
        at, before, r = self._step
        step = {"signal": SPEED_NOW, "start": at, "initial": before, "final": r}
        yield Measure("rise_time", measures.rise_time, step)
        yield Measure("settling_time", measures.settling_time, step | {"band": self.p.band})
        yield Measure("overshoot", measures.overshoot, step)
        yield Measure("peak_current", measures.peak, {"signal": CURRENT, "start": at})
        late = at + self.p.late
        if self.now / 1e9 >= late:
            yield Measure("mean_error", measures.mean_error, {"signal": SPEED_NOW, "reference": r, "start": late})
            yield Measure("rms_error", measures.rms, {"signal": SPEED_NOW, "reference": r, "start": late})
            yield Measure("peak_to_peak", measures.peak_to_peak, {"signal": SPEED_NOW, "start": late})
            yield Measure("total_variation", measures.total_variation, {"signal": VOLTAGE, "start": late})


main = executable(DcMotorMonitor)
