"""The loop as designed: the motion of the axis without delay, encoder steps and friction."""

from __future__ import annotations

from typing import NamedTuple

from softrig_control.discretise import Matrix
from softrig_control.state_feedback import StateFeedback

from .motor import MotorParams

Signals = tuple[float, float, float, float, float]


class Nominal(NamedTuple):
    """Speed (mm/s), position (mm), acceleration of the period before (mm/s^2), integral; the signals of the newest."""

    v: float
    y: float
    acceleration: float
    xi: float
    signals: Signals


class NominalAxis:
    """State feedback on the motor model itself, the source of the model signals (the paper's PLC object).

    Parameters
    ----------
    phi, gamma : nested tuples
        Motor sampled with its period.
    law : StateFeedback
        With the gains and limits of the real loop.
    """

    def __init__(self, motor: MotorParams, phi: Matrix, gamma: Matrix, law: StateFeedback) -> None:
        self._motor = motor
        self._gain = motor.b[0]
        ((self._vv, self._vy), (self._yv, self._yy)), ((self._vu,), (self._yu,)) = phi, gamma
        self._law = law

    def rest(self, y: float) -> Nominal:
        """Rest at y (mm)."""
        return Nominal(0.0, y, 0.0, self._law.settle((0.0, y), y), (y, 0.0, 0.0, 0.0, 0.0))

    def go_on(self, x: Nominal, before: StateFeedback) -> Nominal:
        """Follow another law, without a bump."""
        return x._replace(xi=self._law.go_on(x.xi, before, (x.v, x.y)))

    def __call__(self, x: Nominal, r: float) -> Nominal:
        """Compute the signals of this period, (position, velocity, acceleration, deceleration, jerk), and move on.

        The returned velocity is clipped at the speed limit; the jerk is the difference quotient of the acceleration.
        """
        motor, (v, y, last, xi, _) = self._motor, x
        xi, u = self._law(xi, r, (v, y), y)
        acceleration = self._gain * u - motor.pole * v
        jerk = (acceleration - last) / motor.period
        signals = (y, min(max(v, -motor.vmax), motor.vmax), acceleration, -acceleration, jerk)
        return Nominal(
            self._vv * v + self._vy * y + self._vu * u,
            self._yv * v + self._yy * y + self._yu * u,
            acceleration,
            xi,
            signals,
        )
