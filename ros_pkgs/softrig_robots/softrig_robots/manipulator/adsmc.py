"""Adaptive dynamic sliding mode control of one joint: equations (20), (25) and (27) of the paper, corrected."""

from __future__ import annotations

from softrig_core import param

from ..joints import PerJoint
from .surfaces import Coefficients, SurfaceGains


class AdsmcGains(SurfaceGains):
    """Published gains."""

    gamma: PerJoint = param((3000.0,), "adaptation gain", "1/s^2", live=True)
    k: PerJoint = param((10.0,), "gain of sigma", "1/s", live=True)


class Adsmc:
    r"""Voltage of one motor.

    .. math::
        \dot v = q_d^{(3)} + \mu_1 \Upsilon + \mu_2 \dot e + \mu_3 e + \mu_4 \int e + \hat f + k \sigma, \quad
        \dot{\hat f} = \gamma \sigma, \quad \Upsilon = \ddot q_d - v

    Written with :math:`\Sigma = \int \sigma = s + b_1 \int s + b_2 \iint s` no acceleration is measured and no
    velocity differentiated: :math:`k \sigma` and :math:`\gamma \sigma` are increments of Sigma. The voltage is what is
    integrated, so other gains bring no jump: Sigma before them is what they would have made of the same errors.

    Parameters
    ----------
    a1, a2, b1, b2, gamma, k : float
        Gains, see `AdsmcGains`.
    printed_mu1 : bool
        See `Coefficients.of`.
    adapt_at_limit : bool
        Take increments of f-hat that push further into the voltage limit too, as the paper's law does. With
        high gains f-hat then winds up and the joint runs away.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit; the limited value is what the integration goes on from.
    """

    def __init__(self, *, a1: float, a2: float, b1: float, b2: float, gamma: float, k: float, printed_mu1: bool,
                 adapt_at_limit: bool, T: float, v_max: float) -> None:  # fmt: skip
        self._a1, self._a2, self._b1, self._b2, self._gamma, self._k = a1, a2, b1, b2, gamma, k
        self._mu = Coefficients.of(a1, a2, b1, b2, printed_mu1)
        self._adapt_at_limit = adapt_at_limit
        self._T, self._v_max = T, v_max
        self.start()

    def start(self) -> None:
        """Forget everything."""
        self.v = self.s = self.sigma = self.f_hat = 0.0
        self._e_int = self._s_int = self._s_int2 = 0.0
        self._before: tuple[float, float] | None = None
        self._last = (0.0,) * 5  # what Sigma of `_before` was made of

    def go_on(self, before: Adsmc) -> None:
        """Take the place of a law with other gains."""
        self.v, self.s, self.sigma, self.f_hat = before.v, before.s, before.sigma, before.f_hat
        self._e_int, self._s_int, self._s_int2 = before._e_int, before._s_int, before._s_int2
        self._last = ed, e, e_int, s_int, s_int2 = before._last
        if before._before is not None:
            s = ed + self._a1 * e + self._a2 * e_int
            self._before = before._before[0], s + self._b1 * s_int + self._b2 * s_int2

    def __call__(self, qdd_d: float, e: float, ed: float) -> float:
        """Give the voltage for the desired acceleration, the error and its rate (rad, s)."""
        T = self._T
        e_int = self._e_int
        self.s = s = ed + self._a1 * e + self._a2 * e_int
        big_sigma = s + self._b1 * self._s_int + self._b2 * self._s_int2
        if self._before is not None:
            qdd_before, sigma_before = self._before
            step = big_sigma - sigma_before
            f_hat = self.f_hat + self._gamma * step
            mu1, mu2, mu3, mu4 = self._mu
            v = self.v
            v += qdd_d - qdd_before + self._k * step + T * (
                mu1 * (qdd_d - v) + mu2 * ed + mu3 * e + mu4 * e_int + f_hat
            )  # fmt: skip
            top = self._v_max
            if -top <= v <= top or step * v <= 0.0 or self._adapt_at_limit:
                self.f_hat = f_hat
            self.v = min(max(v, -top), top)
            self.sigma = step / T
        self._before = (qdd_d, big_sigma)
        self._last = (ed, e, e_int, self._s_int, self._s_int2)
        self._s_int2 += T * self._s_int
        self._s_int += T * s
        self._e_int = e_int + T * e
        return self.v
