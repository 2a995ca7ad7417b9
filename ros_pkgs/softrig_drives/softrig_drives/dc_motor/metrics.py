"""Figures of merit of the speed loop while it runs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.node import executable

from ..step_figures import StepFigures
from .ports import COMMAND, REFERENCE, SENSORS, SPEED


class DcMotorMetricsParams(BlockParams):
    """Settling band and late window."""

    band: float = param(0.02, "settling band as a fraction of the step", gt=0.0)
    late: float = param(3.0, "steady figures are taken from this time after a step on", "s", ge=0.0)


class DcMotorMetrics(Observer):
    """Step response and chattering figures of the newest step of the reference, in constant memory.

    The definitions are those of `softrig_core.rig.metrics`, which sees the whole recording. On the rig, remap
    ``motor/state`` to ``motor/true_state`` and ``motor/command`` to ``motor/applied`` for the true figures.
    """

    Params = DcMotorMetricsParams
    INPUTS = (SPEED, SENSORS, COMMAND, REFERENCE)

    def start(self) -> None:
        """No step yet."""
        self._r: float | None = None
        self._step: StepFigures | None = None
        self._late: _LateFigures | None = None

    def update(
        self, t: int, *, state: tuple[float, ...], sensors: tuple[float, ...], command: tuple[float, ...],
        reference: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        if reference is None:
            return {}
        seconds, w, r = t / 1e9, state[0], reference[0]
        if r != self._r:
            self._r, self._from, self._current = r, seconds, 0.0
            self._step = StepFigures(seconds, w, r, self.p.band) if r != w else None
            self._late = None
        if self._step is not None:
            self._step.add(seconds, w)
        self._current = max(self._current, abs(sensors[1]))
        if self._late is not None:
            self._late.add(seconds, r - w, command[0])
        elif seconds - self._from >= self.p.late:
            self._late = _LateFigures(seconds, r - w, command[0])
        return {}

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures that are known so far."""
        if self._r is None:
            return {}
        step = self._step.status() if self._step is not None else {}
        late = self._late.status() if self._late is not None else {}
        return {**step, **late, "peak_current": (self._current, "A")}


class _LateFigures:
    """Figures of the speed error e and the voltage v once the step is over; the first sample makes one."""

    def __init__(self, t: float, e: float, v: float) -> None:
        self._first = self._last = t
        self._n, self._sum, self._squares = 1, e, e * e
        self._least = self._most = e
        self._v, self._variation = v, 0.0

    def add(self, t: float, e: float, v: float) -> None:
        self._n += 1
        self._sum += e
        self._squares += e * e
        self._least, self._most = min(self._least, e), max(self._most, e)
        self._variation += abs(v - self._v)
        self._last, self._v = t, v

    def status(self) -> Mapping[str, tuple[float, str]]:
        figures = {
            "mean_error": (self._sum / self._n, "rad/s"),
            "rms_error": (math.sqrt(self._squares / self._n), "rad/s"),
            "peak_to_peak": (self._most - self._least, "rad/s"),
        }
        if self._last > self._first:
            figures["total_variation"] = (self._variation / (self._last - self._first), "V/s")
        return figures


main = executable(DcMotorMetrics)
