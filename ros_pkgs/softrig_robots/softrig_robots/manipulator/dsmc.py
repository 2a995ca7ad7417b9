"""Dynamic sliding mode control of one joint: equation (30) of the paper, corrected."""

from __future__ import annotations

from softrig_control.sliding_mode import switching
from softrig_core import param

from ..joints import PerJoint
from .surfaces import Coefficients, SurfaceGains


class DsmcGains(SurfaceGains):
    """The paper's second set of gains, with which the law tracks."""

    a1: PerJoint = param((100.0,), "proportional gain of the first surface", "1/s", live=True)
    a2: PerJoint = param((400.0,), "integral gain of the first surface", "1/s^2", live=True)
    b1: PerJoint = param((200.0,), "proportional gain of the second surface", "1/s", live=True)
    b2: PerJoint = param((600.0,), "integral gain of the second surface", "1/s^2", live=True)
    rho: PerJoint = param((20.0,), "switching gain rho", "V/s", live=True)


class Dsmc:
    r"""Voltage of one motor.

    .. math::
        \dot v = q_d^{(3)} + \mu_1 \Upsilon + \mu_2 \dot e + \mu_3 e + \mu_4 \int e + \rho\, \mathrm{sgn}\, \sigma

    sigma needs the second derivative of the error: the backward difference of its rate. The voltage is what is
    integrated, so other gains bring no jump.

    Parameters
    ----------
    a1, a2, b1, b2, rho : float
        Gains, see `DsmcGains`.
    printed_mu1 : bool
        See `Coefficients.of`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit; the limited value is what the integration goes on from.
    """

    f_hat = 0.0  # this law estimates nothing

    def __init__(self, *, a1: float, a2: float, b1: float, b2: float, rho: float, printed_mu1: bool, T: float,
                 v_max: float) -> None:  # fmt: skip
        self._a1, self._a2, self._b1, self._b2, self._rho = a1, a2, b1, b2, rho
        self._mu = Coefficients.of(a1, a2, b1, b2, printed_mu1)
        self._T, self._v_max = T, v_max
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.v = self.s = self.sigma = 0.0
        self._e_int = self._s_int = 0.0
        self._before: tuple[float, float] | None = None

    def go_on(self, before: Dsmc) -> None:
        """Take the place of a law with other gains."""
        self.v, self.s, self.sigma = before.v, before.s, before.sigma
        self._e_int, self._s_int, self._before = before._e_int, before._s_int, before._before

    def __call__(self, qdd_d: float, e: float, ed: float) -> float:
        """Give the voltage for the desired acceleration, the error and its rate (rad, s)."""
        T = self._T
        e_int = self._e_int
        self.s = s = ed + self._a1 * e + self._a2 * e_int
        if self._before is not None:
            qdd_before, ed_before = self._before
            s_rate = (ed - ed_before) / T + self._a1 * ed + self._a2 * e
            self.sigma = sigma = s_rate + self._b1 * s + self._b2 * self._s_int
            mu1, mu2, mu3, mu4 = self._mu
            v = self.v
            v += qdd_d - qdd_before + T * (
                mu1 * (qdd_d - v) + mu2 * ed + mu3 * e + mu4 * e_int + self._rho * switching(sigma)
            )  # fmt: skip
            self.v = min(max(v, -self._v_max), self._v_max)
        self._before = (qdd_d, ed)
        self._s_int += T * s
        self._e_int = e_int + T * e
        return self.v
