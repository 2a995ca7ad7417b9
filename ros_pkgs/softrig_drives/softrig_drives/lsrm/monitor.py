"""Figures of the motion while it runs."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

from softrig_core.model.block import Observer
from softrig_core.model.params import BlockParams, param
from softrig_core.node import executable

from .ports import FORCE_CMD, JOINT_STATES, LOAD, PHASE_CURRENTS, PHASE_VOLTAGE, REFERENCE


class MotionMonitorParams(BlockParams):
    """What counts as arrived, and the window of the force."""

    period: float = param(1e-3, "sampling period", "s", gt=0.0, le=0.1)
    v_d: float = param(0.5, "cruise speed that the figures refer to", "m/s", gt=0.0, le=10.0)
    band: float = param(0.02, "half width of the band around v_d as a part of it", gt=0.0, lt=0.9)
    force_window: float = param(5e-3, "the peak force is that of a mean over this time", "s", gt=0.0, le=1.0)


class MotionMonitor(Observer):
    """Overshoot, rise and settling time, IAE, ITAE, peak error, peak force; after a load its dip and recovery.

    In constant memory, at the monitor's own period; the figures of a scenario see every sample. An observer also gets
    the plant's last outputs beside an older reference: the error counts once the next sample is here.
    """

    Params = MotionMonitorParams
    INPUTS = (JOINT_STATES, PHASE_CURRENTS, PHASE_VOLTAGE, FORCE_CMD, REFERENCE, LOAD)

    def start(self) -> None:
        """Nothing seen."""
        self._largest = 0.0
        self._low: float | None = None
        self._high: float | None = None
        self._inside: float | None = None
        self._iae = self._itae = self._peak_error = 0.0
        self._pending: tuple[float, float] | None = None
        self._forces: deque[float] = deque(maxlen=max(1, round(self.p.force_window / self.p.period)))
        self._peak_force = self._peak_current = self._peak_voltage = self._peak_command = 0.0
        self._load: tuple[float, ...] = (0.0, 0.0)
        self._loaded: float | None = None
        self._least = 0.0
        self._position = 0.0

    def update(
        self, t: int, *, joint_states: tuple[float, ...], phase_currents: tuple[float, ...],
        phase_voltage: tuple[float, ...], force_cmd: tuple[float, ...], reference: tuple[float, ...],
        load: tuple[float, ...] | None,
    ) -> Mapping[str, Any]:  # fmt: skip
        """Take one sample in."""
        seconds = t / 1e9
        self._position, v, F = joint_states
        if load is not None and load != self._load:
            self._load, self._loaded, self._least = load, seconds, v
        self._speed(seconds, v / self.p.v_d)
        self._least = min(self._least, v)
        if self._pending is not None:
            before, error = self._pending
            self._iae += abs(error) * (seconds - before)
            self._itae += before * abs(error) * (seconds - before)
            self._peak_error = max(self._peak_error, abs(error))
        self._pending = (seconds, reference[1] - v)
        self._forces.append(F)
        if len(self._forces) == self._forces.maxlen:
            self._peak_force = max(self._peak_force, sum(self._forces) / len(self._forces))
        self._peak_current = max(self._peak_current, *phase_currents)
        self._peak_voltage = max(self._peak_voltage, *map(abs, phase_voltage))
        self._peak_command = max(self._peak_command, abs(force_cmd[0]))
        return {}

    def _speed(self, seconds: float, z: float) -> None:
        if self._low is None and z >= 0.1:
            self._low = seconds
        if self._high is None and z >= 0.9:
            self._high = seconds
        if abs(z - 1.0) > self.p.band:
            self._inside = None
        elif self._inside is None:
            self._inside = seconds
        self._largest = max(self._largest, z)

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Give the figures that are known so far."""
        if self._pending is None:
            return {}
        v_d = self.p.v_d
        figures = {
            "overshoot": (100.0 * (self._largest - 1.0), "%"),
            "iae": (self._iae, "m"),
            "itae": (self._itae, "m s"),
            "peak_error": (self._peak_error, "m/s"),
            "peak_force": (self._peak_force, "N"),
            "peak_current": (self._peak_current, "A"),
            "peak_voltage": (self._peak_voltage, "V"),
            "peak_command": (self._peak_command, "N"),
            "position": (self._position, "m"),
        }
        if self._low is not None and self._high is not None:
            figures["rise_time"] = (self._high - self._low, "s")
        if self._inside is not None and self._loaded is None:
            figures["settling_time"] = (self._inside, "s")
        if self._loaded is not None:
            figures["dip"] = (100.0 * (1.0 - self._least / v_d), "%")
            if self._inside is not None:
                figures["recovery"] = (max(0.0, self._inside - self._loaded), "s")
        return figures


main = executable(MotionMonitor)
