"""Figures of merit of the axis while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.node import executable

from ..step_figures import StepFigures
from .ports import COMMAND, CONTROLLER_STATE, TRUE_STATE


class AxisMetricsParams(BlockParams):
    """Settling band."""

    band: float = param(0.02, "settling band as a fraction of the step", gt=0.0)


class AxisMetrics(Observer):
    """Step response of the true position to the newest change of the set point."""

    Params = AxisMetricsParams
    INPUTS = (TRUE_STATE, COMMAND, CONTROLLER_STATE)

    def start(self) -> None:
        """No step yet."""
        self._set_point: float | None = None
        self._step: StepFigures | None = None
        self._peaks = (0.0, 0.0)
        self._error = 0.0

    def update(
        self, t: int, *, true_state: tuple[float, float], command: tuple[float], controller_state: tuple[float, ...]
    ) -> Mapping[str, Any]:
        """Take one sample in."""
        position, velocity = true_state
        set_point = controller_state[0]
        if set_point != self._set_point:
            self._set_point = set_point
            self._step = StepFigures(t / 1e9, position, set_point, self.p.band) if set_point != position else None
            self._peaks = (0.0, 0.0)
        if self._step is not None:
            self._step.add(t / 1e9, position)
        self._peaks = max(self._peaks[0], abs(command[0])), max(self._peaks[1], abs(velocity))
        self._error = set_point - position
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures known so far."""
        if self._set_point is None:
            return {}
        return {
            **(self._step.status() if self._step is not None else {}),
            "set_point": (self._set_point, "mm"),
            "error": (self._error, "mm"),
            "peak_voltage": (self._peaks[0], "V"),
            "peak_speed": (self._peaks[1], "mm/s"),
        }


main = executable(AxisMetrics)
