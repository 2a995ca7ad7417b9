"""Adaptive robust control of one joint, a baseline.

The paper cites this law; its text was not available. This is the standard form with a regressor of four terms.
"""

from __future__ import annotations

from math import tanh
from typing import Any, NamedTuple

from softrig_core import param

from ..joints import JointGains, PerJoint


class ArscGains(JointGains):
    """Moderate preset; the stronger one is in the scenario files."""

    k1: PerJoint = param((4.0,), "rate of the sliding variable", "1/s", live=True)
    k2: PerJoint = param((5.0,), "gain of the sliding variable", "V s/rad", live=True)
    h: PerJoint = param((0.2,), "amplitude of the robust term", "V", live=True)
    gamma1: PerJoint = param((0.4,), "adaptation gain of the inertia term", live=True)
    gamma2: PerJoint = param((20.0,), "adaptation gain of the damping term", live=True)
    gamma3: PerJoint = param((2.0,), "adaptation gain of the friction term", live=True)
    gamma4: PerJoint = param((20.0,), "adaptation gain of the constant term", live=True)


LOWEST = (0.02, 2.0, 0.0, -8.0)
HIGHEST = (0.6, 8.0, 1.0, 8.0)
EDGE = 0.05  # rad/s; smooths both signs


class ArscState(NamedTuple):
    """Estimates theta-hat of inertia (V s^2/rad), damping (V s/rad), friction and a constant (V)."""

    theta1: float = 0.1
    theta2: float = 4.592
    theta3: float = 0.0
    theta4: float = 0.0


class Arsc:
    r"""Voltage of one motor.

    .. math::
        z = \dot q - \dot q_r + k_1 (q - q_r), \quad
        \varphi = (\ddot q_r - k_1 (\dot q - \dot q_r), \dot q, \tanh(\dot q/0.05), 1), \\
        V = \varphi^T \hat\theta - k_2 z - h \tanh(z/0.05), \quad
        \dot{\hat\theta} = \mathrm{Proj}(-\Gamma \varphi z)

    A change of gains does not change the estimates; the terms that the gains multiply jump.

    Parameters
    ----------
    g : of one joint
        Gains, see `ArscGains.of_joint`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit, V.
    """

    UNITS = {"theta1": "V s^2/rad", "theta2": "V s/rad", "theta3": "V", "theta4": "V"}

    def __init__(self, g: Any, *, T: float, v_max: float) -> None:
        self._k1, self._k2, self._h = g.k1, g.k2, g.h
        self._gamma = tuple(T * gamma for gamma in (g.gamma1, g.gamma2, g.gamma3, g.gamma4))
        self._v_max = v_max

    def first(self) -> ArscState:
        """Begin with the first estimates."""
        return ArscState()

    def __call__(
        self, x: ArscState, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float
    ) -> tuple[ArscState, float]:
        """Return the voltage for joint state and reference."""
        ed = qd - ref_d
        z = ed + self._k1 * (q - ref)
        phi = (ref_dd - self._k1 * ed, qd, tanh(qd / EDGE), 1.0)
        v = -self._k2 * z - self._h * tanh(z / EDGE)
        for p, th in zip(phi, x, strict=True):
            v += p * th
        theta = ArscState._make(
            min(max(th - g * p * z, low), high)
            for th, g, p, low, high in zip(x, self._gamma, phi, LOWEST, HIGHEST, strict=True)
        )
        return theta, min(max(v, -self._v_max), self._v_max)
