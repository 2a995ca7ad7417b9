"""Adaptive dynamic sliding mode control of one joint: equations (20), (25) and (27) of the paper, corrected."""

from __future__ import annotations

from typing import Any, NamedTuple

from softrig_core import param

from ..joints import PerJoint
from .surfaces import Coefficients, SurfaceGains


class AdsmcGains(SurfaceGains):
    """Published gains."""

    gamma: PerJoint = param((3000.0,), "adaptation gain", "1/s^2", live=True)
    k: PerJoint = param((10.0,), "gain of sigma", "1/s", live=True)


class AdsmcState(NamedTuple):
    """Voltage (V), both surfaces (rad/s, rad/s^2), estimate f-hat (V/s), integrals of e and s.

    Desired acceleration and Sigma of the previous period, None at the start, and the terms of which that Sigma
    consisted.
    """

    v: float = 0.0
    s: float = 0.0
    sigma: float = 0.0
    f_hat: float = 0.0
    e_int: float = 0.0
    s_int: float = 0.0
    s_int2: float = 0.0
    before: tuple[float, float] | None = None
    last: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)


class Adsmc:
    r"""Voltage of one motor.

    .. math::
        \dot v = q_d^{(3)} + \mu_1 \Upsilon + \mu_2 \dot e + \mu_3 e + \mu_4 \int e + \hat f + k \sigma, \quad
        \dot{\hat f} = \gamma \sigma, \quad \Upsilon = \ddot q_d - v

    Written with :math:`\Sigma = \int \sigma = s + b_1 \int s + b_2 \iint s` no acceleration is measured and no velocity
    differentiated: :math:`k \sigma` and :math:`\gamma \sigma` are increments of Sigma. The voltage itself is
    integrated, so a change of gains causes no jump: the previous Sigma is computed again from the same errors with the
    new gains.

    Parameters
    ----------
    g : of one joint
        Gains, see `AdsmcGains.of_joint`.
    printed_mu1 : bool
        See `Coefficients.of`.
    adapt_at_limit : bool
        Take increments of f-hat that push further into the voltage limit too, as the paper's law does. With
        high gains f-hat then winds up and the joint runs away.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit; the integration continues from the limited value.
    """

    def __init__(self, g: Any, *, printed_mu1: bool, adapt_at_limit: bool, T: float, v_max: float) -> None:
        self._a1, self._a2, self._b1, self._b2, self._gamma, self._k = g.a1, g.a2, g.b1, g.b2, g.gamma, g.k
        self._mu = Coefficients.of(g.a1, g.a2, g.b1, g.b2, printed_mu1)
        self._adapt_at_limit = adapt_at_limit
        self._T, self._v_max = T, v_max

    def first(self) -> AdsmcState:
        """Return the state without a past."""
        return AdsmcState()

    def go_on(self, x: AdsmcState) -> AdsmcState:
        """Return the state with which these gains follow others."""
        if x.before is None:
            return x
        ed, e, e_int, s_int, s_int2 = x.last
        s = ed + self._a1 * e + self._a2 * e_int
        return x._replace(before=(x.before[0], s + self._b1 * s_int + self._b2 * s_int2))

    def __call__(self, x: AdsmcState, qdd_d: float, e: float, ed: float) -> tuple[AdsmcState, float]:
        """Return the voltage for the desired acceleration, the error and its rate (rad, s)."""
        T = self._T
        v, _, sigma, f_hat, e_int, s_int, s_int2, before, _ = x
        s = ed + self._a1 * e + self._a2 * e_int
        big_sigma = s + self._b1 * s_int + self._b2 * s_int2
        if before is not None:
            qdd_before, sigma_before = before
            step = big_sigma - sigma_before
            new = f_hat + self._gamma * step
            mu1, mu2, mu3, mu4 = self._mu
            v += qdd_d - qdd_before + self._k * step + T * (mu1 * (qdd_d - v) + mu2 * ed + mu3 * e + mu4 * e_int + new)
            top = self._v_max
            if -top <= v <= top or step * v <= 0.0 or self._adapt_at_limit:
                f_hat = new
            v = min(max(v, -top), top)
            sigma = step / T
        return AdsmcState(
            v,
            s,
            sigma,
            f_hat,
            e_int + T * e,
            s_int + T * s,
            s_int2 + T * s_int,
            (qdd_d, big_sigma),
            (ed, e, e_int, s_int, s_int2),
        ), v
