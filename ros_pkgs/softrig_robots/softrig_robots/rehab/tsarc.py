"""Taylor-series adaptive robust control of one joint, a baseline.

The paper cites this law; its text was not available. This is a faithful form of what it describes: the known
part of the voltage, a first-order Taylor series in time with adapted coefficients, and a robust term.
"""

from __future__ import annotations

from math import tanh
from typing import Any, NamedTuple

from softrig_core import param

from ..joints import JointGains, PerJoint, require_positive


class TsarcGains(JointGains):
    """Moderate preset; the stronger one is in the scenario files."""

    alpha_hat: PerJoint = param((4.592,), "K_b/r", "V s/rad", live=True)
    lam: PerJoint = param((4.0,), "rate lambda of the error", "1/s", live=True)
    resistance: PerJoint = param(
        (3.2,), "compensated resistance: 80 % of R, more would cancel the damping", "Ohm", live=True
    )
    gamma_a: PerJoint = param((20.0,), "adaptation gain of the constant coefficient", "V/(rad s)", live=True)
    gamma_b: PerJoint = param((5.0,), "adaptation gain of the slope", "V/(rad s^3)", live=True)
    rho: PerJoint = param((0.5,), "amplitude of the robust term", "V", live=True)
    phi: PerJoint = param((0.02,), "width of the robust term", "rad", live=True)
    window: PerJoint = param((1.0,), "duration T_w of one series", "s")

    def _check(self) -> None:
        for name in ("alpha_hat", "lam", "phi", "window"):
            require_positive(name, getattr(self, name))


class TsarcState(NamedTuple):
    """Coefficients a (V) and b (V/s) of the present series, and its periods so far."""

    a: float = 0.0
    b: float = 0.0
    k: int = 0


class Tsarc:
    r"""Voltage of one motor.

    .. math::
        V = \hat\alpha (\dot q_r + \lambda e) + \hat R I + a + b \tau + \rho \tanh(e/\varphi), \quad
        \dot a = \gamma_a e, \quad \dot b = \gamma_b e \tau, \quad \tau = t \bmod T_w

    At the end of each window a becomes a + b T_w. A change of gains leaves a and b, which are voltages, as they are;
    the direct terms of error and current jump. The window cannot change, because a series is always under way.

    Parameters
    ----------
    g : of one joint
        Gains, see `TsarcGains.of_joint`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit, V.
    """

    UNITS = {"a": "V", "b": "V/s"}

    def __init__(self, g: Any, *, T: float, v_max: float) -> None:
        self._alpha, self._lam, self._R = g.alpha_hat, g.lam, g.resistance
        self._gamma_a, self._gamma_b, self._rho, self._phi = g.gamma_a, g.gamma_b, g.rho, g.phi
        self._steps = max(1, round(g.window / T))
        self._T, self._v_max = T, v_max

    def first(self) -> TsarcState:
        """No series yet."""
        return TsarcState()

    def __call__(
        self, x: TsarcState, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float
    ) -> tuple[TsarcState, float]:
        """Return the voltage for joint state, current and reference."""
        T = self._T
        a, b, k = x
        tau = k * T
        e = ref - q
        v = self._alpha * (ref_d + self._lam * e) + self._R * current + a + b * tau
        v += self._rho * tanh(e / self._phi)
        a += T * self._gamma_a * e
        b += T * self._gamma_b * e * tau
        k += 1
        if k == self._steps:
            k = 0
            a += b * self._steps * T
        return TsarcState(a, b, k), min(max(v, -self._v_max), self._v_max)
