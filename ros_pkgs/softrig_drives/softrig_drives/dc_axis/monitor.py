"""Figures of merit of the axis while it runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from softrig_core import Figure, Watch, WatchParams, executable, param
from softrig_core.rig import measures

from .ports import COMMAND, CONTROLLER_STATE, TRUE_STATE

Y, V = "axis/true_state/axis/position", "axis/true_state/axis/velocity"
SET_POINT = "axis/controller_state/set_point/position"


class AxisMonitorParams(WatchParams):
    """Settling band."""

    band: float = param(0.02, "settling band as a fraction of the step", gt=0.0)


class AxisMonitor(Watch[AxisMonitorParams]):
    """Step response of the true position to the newest change of the set point."""

    INPUTS = (TRUE_STATE, COMMAND, CONTROLLER_STATE)

    def start(self) -> None:
        """No step yet."""
        super().start()
        self._step: tuple[float, float, float] | None = None  # time, position before, set point

    def update(self, t: int, **inputs: Any) -> Mapping[str, Any]:
        """Take one sample in."""
        set_point = inputs["controller_state"][0]
        if self._step is None or set_point != self._step[2]:
            self._step = t / 1e9, inputs["true_state"][0], set_point
        return super().update(t, **inputs)

    def figures(self) -> Iterator[Figure]:
        """Figures of the step under way."""
        if self._step is None:
            return
        at, before, set_point = self._step
        step = {"signal": Y, "start": at, "initial": before, "final": set_point}
        yield self.figure("rise_time", measures.rise_time, step)
        yield self.figure("settling_time", measures.settling_time, step | {"band": self.p.band})
        yield self.figure("overshoot", measures.overshoot, step)
        yield self.figure("set_point", measures.final_value, {"signal": SET_POINT})
        now = self.now / 1e9
        yield self.figure("error", measures.mean_error, {"signal": Y, "reference": set_point, "start": now})
        yield self.figure("peak_voltage", measures.peak, {"signal": "axis/command/armature/effort", "start": at})
        yield self.figure("peak_speed", measures.peak, {"signal": V, "start": at})


main = executable(AxisMonitor)
