"""Figures of merit of the speed loop while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from softrig_core.block import Observer
from softrig_core.node import executable
from softrig_core.params import BlockParams, param

from .ports import COMMAND, REFERENCE, SENSORS, SPEED


class DcMotorMetricsParams(BlockParams):
    """Settling band and late window."""

    band: float = param(0.02, "settling band as a fraction of the step", gt=0.0)
    late: float = param(3.0, "steady figures are taken from this time after a step on", "s", ge=0.0)


class DcMotorMetrics(Observer):
    """Step response and chattering figures of the newest step of the reference, in constant memory.

    The definitions are those of `softrig_core.metrics`, which sees the whole recording. On the rig, remap
    ``motor/state`` to ``motor/true_state`` and ``motor/command`` to ``motor/applied`` for the true figures.
    """

    Params = DcMotorMetricsParams
    INPUTS = (SPEED, SENSORS, COMMAND, REFERENCE)

    def start(self) -> None:
        """No step yet."""
        self._r: float | None = None

    def _begin(self, t: float, r: float, w: float) -> None:
        self._r = r
        self._t0, self._w0 = t, w
        self._low: float | None = None
        self._high: float | None = None
        self._settled: float | None = 0.0
        self._z_max = 0.0
        self._current = 0.0
        self._last = (t, 0.0)
        self._late_from: float | None = None

    def update(
        self, t: int, *, state: tuple[float, ...], sensors: tuple[float, ...], command: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        if reference is None:
            return {}
        seconds, w, (r,) = t / 1e9, state[0], reference
        if r != self._r:
            self._begin(seconds, r, w)
        if r != self._w0:
            self._follow_step(seconds, (w - self._w0) / (r - self._w0))
        self._current = max(self._current, abs(sensors[1]))
        if seconds - self._t0 >= self.p.late:
            self._follow_late(seconds, w, command[0])
        return {}

    def _follow_step(self, t: float, z: float) -> None:
        before, z_before = self._last
        slope = (t - before) / (z - z_before) if z != z_before else 0.0
        if self._low is None and z >= 0.1:
            self._low = before + (0.1 - z_before) * slope
        if self._high is None and z >= 0.9:
            self._high = before + (0.9 - z_before) * slope
        band = self.p.band
        if abs(z - 1.0) > band:
            self._settled = None
        elif self._settled is None:
            edge = 1.0 + math.copysign(band, z_before - 1.0)
            self._settled = before + (edge - z_before) * slope - self._t0
        self._z_max = max(self._z_max, z)
        self._last = (t, z)

    def _follow_late(self, t: float, w: float, v: float) -> None:
        if self._late_from is None:
            self._late_from, self._n = t, 0
            self._variation = self._sum = self._squares = 0.0
            self._w_min = self._w_max = w
        else:
            self._variation += abs(v - self._v)
        self._late_to, self._v = t, v
        error = (self._r or 0.0) - w
        self._n += 1
        self._sum += error
        self._squares += error * error
        self._w_min, self._w_max = min(self._w_min, w), max(self._w_max, w)

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures that are known so far."""
        if self._r is None:
            return {}
        figures = {"overshoot": (max(0.0, 100.0 * (self._z_max - 1.0)), "%"), "peak_current": (self._current, "A")}
        if self._low is not None and self._high is not None:
            figures["rise_time"] = (self._high - self._low, "s")
        if self._settled is not None:
            figures["settling_time"] = (self._settled, "s")
        if self._late_from is not None:
            figures["mean_error"] = (self._sum / self._n, "rad/s")
            figures["rms_error"] = (math.sqrt(self._squares / self._n), "rad/s")
            figures["peak_to_peak"] = (self._w_max - self._w_min, "rad/s")
            if self._late_to > self._late_from:
                figures["total_variation"] = (self._variation / (self._late_to - self._late_from), "V/s")
        return figures


main = executable(DcMotorMetrics)
