"""Conventional sliding mode control of one joint: equation (31) of the paper, corrected."""

from __future__ import annotations

from softrig_control.sliding_mode import switching
from softrig_core import param

from ..joints import JointGains, PerJoint


class SmcGains(JointGains):
    """Published gains."""

    a1: PerJoint = param((100.0,), "proportional gain of the surface", "1/s", live=True)
    a2: PerJoint = param((400.0,), "integral gain of the surface", "1/s^2", live=True)
    rho: PerJoint = param((10.0,), "switching gain rho_1", "V", live=True)


class Smc:
    r"""Voltage of one motor.

    .. math::
        v = \ddot q_d + a_1 \dot e + a_2 e + \rho_1\, \mathrm{sgn}\, s, \qquad s = \dot e + a_1 e + a_2 \int e

    Parameters
    ----------
    a1, a2, rho : float
        Gains, see `SmcGains`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit.
    """

    f_hat = 0.0  # this law estimates nothing
    sigma = 0.0  # and has one surface

    def __init__(self, *, a1: float, a2: float, rho: float, T: float, v_max: float) -> None:
        self._a1, self._a2, self._rho = a1, a2, rho
        self._T, self._v_max = T, v_max
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.s = 0.0
        self._e_int = 0.0

    def go_on(self, before: Smc) -> None:
        """Take the place of a law with other gains: the voltage may jump, as it does at any switching."""
        self.s, self._e_int = before.s, before._e_int

    def __call__(self, qdd_d: float, e: float, ed: float) -> float:
        """Give the voltage for the desired acceleration, the error and its rate (rad, s)."""
        self.s = s = ed + self._a1 * e + self._a2 * self._e_int
        self._e_int += self._T * e
        v = qdd_d + self._a1 * ed + self._a2 * e + self._rho * switching(s)
        return min(max(v, -self._v_max), self._v_max)
