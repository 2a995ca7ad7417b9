"""Conventional sliding mode control of one joint: equation (31) of the paper, corrected."""

from __future__ import annotations

from typing import Any, NamedTuple

from softrig_control.sliding_mode import switching
from softrig_core import param

from ..joints import JointGains, PerJoint


class SmcGains(JointGains):
    """Published gains."""

    a1: PerJoint = param((100.0,), "proportional gain of the surface", "1/s", live=True)
    a2: PerJoint = param((400.0,), "integral gain of the surface", "1/s^2", live=True)
    rho: PerJoint = param((10.0,), "switching gain rho_1", "V", live=True)


class SmcState(NamedTuple):
    """Surface (rad/s), integral of e."""

    s: float = 0.0
    e_int: float = 0.0

    @property
    def sigma(self) -> float:
        """Zero: the law has one surface."""
        return 0.0

    @property
    def f_hat(self) -> float:
        """Return no estimate."""
        return 0.0


class Smc:
    r"""Voltage of one motor.

    .. math::
        v = \ddot q_d + a_1 \dot e + a_2 e + \rho_1\, \mathrm{sgn}\, s, \qquad s = \dot e + a_1 e + a_2 \int e

    Parameters
    ----------
    g : of one joint
        Gains, see `SmcGains.of_joint`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit.
    """

    def __init__(self, g: Any, *, T: float, v_max: float) -> None:
        self._a1, self._a2, self._rho = g.a1, g.a2, g.rho
        self._T, self._v_max = T, v_max

    def first(self) -> SmcState:
        """Return the state without a past."""
        return SmcState()

    def go_on(self, x: SmcState) -> SmcState:
        """Return the state with which these gains follow others: the voltage may jump, as it does at any switching."""
        return x

    def __call__(self, x: SmcState, qdd_d: float, e: float, ed: float) -> tuple[SmcState, float]:
        """Return the voltage for the desired acceleration, the error and its rate (rad, s)."""
        s = ed + self._a1 * e + self._a2 * x.e_int
        v = qdd_d + self._a1 * ed + self._a2 * e + self._rho * switching(s)
        return SmcState(s, x.e_int + self._T * e), min(max(v, -self._v_max), self._v_max)
