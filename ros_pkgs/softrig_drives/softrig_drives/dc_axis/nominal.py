"""The loop as designed: what the axis would do without delay, encoder steps and friction."""

from __future__ import annotations

from softrig_control.discretise import Matrix
from softrig_control.state_feedback import StateFeedback

from .motor import MotorParams


class NominalAxis:
    """State feedback on the motor model itself, the source of the model signals (the paper's PLC object).

    Parameters
    ----------
    motor : MotorParams
    phi, gamma : nested tuples
        Motor sampled with its period.
    law : StateFeedback
        Its own instance, with the gains and limits of the real loop.
    """

    def __init__(self, motor: MotorParams, phi: Matrix, gamma: Matrix, law: StateFeedback) -> None:
        self._motor = motor
        self._gain = motor.b[0]
        ((self._vv, self._vy), (self._yv, self._yy)), ((self._vu,), (self._yu,)) = phi, gamma
        self._law = law
        self.start(0.0)

    def start(self, y: float) -> None:
        """Rest at y (mm)."""
        self._v, self._y = 0.0, y
        self._acceleration = 0.0
        self._law.settle((0.0, y), y)
        self.signals = (y, 0.0, 0.0, 0.0, 0.0)

    def take(self, law: StateFeedback) -> None:
        """Go on with another law, without a bump."""
        law.go_on(self._law, (self._v, self._y))
        self._law = law

    def step(self, r: float) -> None:
        """Compute the signals of this period, (position, velocity, acceleration, deceleration, jerk), and move on.

        The velocity given is clipped at the speed limit; the jerk is the difference quotient of the acceleration.
        """
        motor, v, y = self._motor, self._v, self._y
        u = self._law.step(r, (v, y), y)
        acceleration = self._gain * u - motor.pole * v
        jerk = (acceleration - self._acceleration) / motor.period
        self.signals = (y, min(max(v, -motor.vmax), motor.vmax), acceleration, -acceleration, jerk)
        self._acceleration = acceleration
        self._v = self._vv * v + self._vy * y + self._vu * u
        self._y = self._yv * v + self._yy * y + self._yu * u
