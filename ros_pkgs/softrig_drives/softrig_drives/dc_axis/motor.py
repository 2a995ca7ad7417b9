"""The motor of the axis: parameters that plant and controller share, and its exact motion under a constant input."""

from __future__ import annotations

import math

from softrig_core import BlockParams, param


class MotorParams(BlockParams):
    """Motor with its limits, in the paper's unit: a command u_m of 1 mm corresponds to 1 mm of position error.

    y' = v, v' = -pole v + gain u_m, u_m = mm_per_volt u_V.
    """

    pole: float = param(5.26, "speed pole of the motor, eq. (1)", "1/s", gt=0.0)
    gain: float = param(2.2862, "acceleration per mm of command, eq. (1): 2 x 1.1431", "1/s^2", gt=0.0)
    mm_per_volt: float = param(140.0 / 12.0, "command in mm of set point per volt at the motor", "mm/V", gt=0.0)
    u_limit_v: float = param(12.0, "largest voltage, either way", "V", gt=0.0)
    vmax: float = param(565.5, "speed limit", "mm/s", gt=0.0)

    @property
    def a(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """State matrix for x = (v, y)."""
        return (-self.pole, 0.0), (1.0, 0.0)

    @property
    def b(self) -> tuple[float, float]:
        """Input vector for x = (v, y) and u in volts."""
        return self.gain * self.mm_per_volt, 0.0


class Motion:
    """Exact motion y' = v, v' = -pole v + f over one step of length h (s) with f (mm/s^2) constant."""

    def __init__(self, pole: float, h: float) -> None:
        self.pole = pole
        self.h = h
        self._decay, self._from_v, self._from_f = _coefficients(pole, h)

    def step(self, y: float, v: float, f: float) -> tuple[float, float]:
        """Return (y, v) after h."""
        return y + self._from_v * v + self._from_f * f, self._decay * v + self._from_v * f

    def stop(self, y: float, v: float, f: float, level: float) -> float:
        """Return y after h when the speed stays at `level` (0 or the speed limit) once it has reached it.

        `level` lies between v and the speed after h, so the speed reaches it inside the step.
        """
        terminal = f / self.pole
        until = math.log((v - terminal) / (level - terminal)) / self.pole
        _, from_v, from_f = _coefficients(self.pole, until)
        return y + from_v * v + from_f * f + level * (self.h - until)


def _coefficients(pole: float, h: float) -> tuple[float, float, float]:
    from_v = -math.expm1(-pole * h) / pole
    return math.exp(-pole * h), from_v, (h - from_v) / pole
