"""Figures of a step response while it runs, in constant memory."""

from __future__ import annotations

import math
from collections.abc import Mapping


class StepFigures:
    """Rise time, settling time and overshoot of one step, defined as in `softrig_core.rig.metrics`.

    Parameters
    ----------
    t : float
        Time of the step, s.
    initial, final : float
        What counts as 0 % and 100 %; they differ.
    band : float
        Settling band as a fraction of the step.
    """

    def __init__(self, t: float, initial: float, final: float, band: float) -> None:
        self._start = t
        self._initial = initial
        self._size = final - initial
        self._band = band
        self._low: float | None = None
        self._high: float | None = None
        self._settled: float | None = None
        self._largest = 0.0
        self._last = (t, 0.0)

    def add(self, t: float, x: float) -> None:
        """Take one sample in."""
        z = (x - self._initial) / self._size
        before, z_before = self._last
        slope = (t - before) / (z - z_before) if z != z_before else 0.0
        if self._low is None and z >= 0.1:
            self._low = before + (0.1 - z_before) * slope
        if self._high is None and z >= 0.9:
            self._high = before + (0.9 - z_before) * slope
        if abs(z - 1.0) > self._band:
            self._settled = None
        elif self._settled is None:
            edge = 1.0 + math.copysign(self._band, z_before - 1.0)
            self._settled = before + (edge - z_before) * slope - self._start
        self._largest = max(self._largest, z)
        self._last = (t, z)

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures known so far."""
        figures = {"overshoot": (max(0.0, 100.0 * (self._largest - 1.0)), "%")}
        if self._low is not None and self._high is not None:
            figures["rise_time"] = (self._high - self._low, "s")
        if self._settled is not None:
            figures["settling_time"] = (self._settled, "s")
        return figures
