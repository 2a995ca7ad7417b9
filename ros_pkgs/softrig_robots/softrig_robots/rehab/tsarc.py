"""Taylor-series adaptive robust control of one joint, a baseline.

The paper cites this law; its text was not available. This is a faithful form of what it describes: the known
part of the voltage, a first-order Taylor series in time with adapted coefficients, and a robust term.
"""

from __future__ import annotations

from math import tanh
from typing import Self

from pydantic import model_validator
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
    rho: PerJoint = param((0.5,), "size of the robust term", "V", live=True)
    phi: PerJoint = param((0.02,), "width of the robust term", "rad", live=True)
    window: PerJoint = param((1.0,), "duration T_w of one series", "s")

    @model_validator(mode="after")
    def _positive(self) -> Self:
        for name in ("alpha_hat", "lam", "phi", "window"):
            require_positive(name, getattr(self, name))
        return self


class Tsarc:
    r"""Voltage of one motor.

    .. math::
        V = \hat\alpha (\dot q_r + \lambda e) + \hat R I + a + b \tau + \rho \tanh(e/\varphi), \quad
        \dot a = \gamma_a e, \quad \dot b = \gamma_b e \tau, \quad \tau = t \bmod T_w

    At the end of each window a becomes a + b T_w. Under other gains a and b, which are voltages, stay; what the error
    and the current give directly jumps. The window is fixed: a series is under way.

    Parameters
    ----------
    alpha_hat, lam, resistance, gamma_a, gamma_b, rho, phi, window : float
        See `TsarcGains`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit, V.
    """

    STATE = {"a": "V", "b": "V/s"}

    def __init__(self, *, alpha_hat: float, lam: float, resistance: float, gamma_a: float, gamma_b: float, rho: float,
                 phi: float, window: float, T: float, v_max: float) -> None:  # fmt: skip
        self._alpha, self._lam, self._R = alpha_hat, lam, resistance
        self._gamma_a, self._gamma_b, self._rho, self._phi = gamma_a, gamma_b, rho, phi
        self._steps = max(1, round(window / T))
        self._T, self._v_max = T, v_max
        self.start()

    def start(self) -> None:
        """No series yet."""
        self._a = self._b = 0.0
        self._k = 0

    def go_on(self, before: Tsarc) -> None:
        """Take the place of a law with other gains."""
        self._a, self._b, self._k = before._a, before._b, before._k

    @property
    def state(self) -> tuple[float, ...]:
        """Values of `STATE`."""
        return (self._a, self._b)

    def __call__(self, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float) -> float:
        """Give the voltage for joint state, current and reference."""
        T = self._T
        tau = self._k * T
        e = ref - q
        v = self._alpha * (ref_d + self._lam * e) + self._R * current + self._a + self._b * tau
        v += self._rho * tanh(e / self._phi)
        self._a += T * self._gamma_a * e
        self._b += T * self._gamma_b * e * tau
        self._k += 1
        if self._k == self._steps:
            self._k = 0
            self._a += self._b * self._steps * T
        return min(max(v, -self._v_max), self._v_max)
