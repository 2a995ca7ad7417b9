"""Dynamic sliding mode control of one joint: equation (30) of the paper, corrected."""

from __future__ import annotations

from typing import Any, NamedTuple

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


class DsmcState(NamedTuple):
    """Voltage (V), both surfaces (rad/s, rad/s^2), integrals of e and s; q_d'' and e' of the period before."""

    v: float = 0.0
    s: float = 0.0
    sigma: float = 0.0
    e_int: float = 0.0
    s_int: float = 0.0
    before: tuple[float, float] | None = None

    @property
    def f_hat(self) -> float:
        """Return zero: this controller has no estimate."""
        return 0.0


class Dsmc:
    r"""Voltage of one motor.

    .. math::
        \dot v = q_d^{(3)} + \mu_1 \Upsilon + \mu_2 \dot e + \mu_3 e + \mu_4 \int e + \rho\, \mathrm{sgn}\, \sigma

    sigma needs the second derivative of the error: the backward difference of its rate. The voltage itself is
    integrated, so a change of gains causes no jump.

    Parameters
    ----------
    g : of one joint
        Gains, see `DsmcGains.of_joint`.
    printed_mu1 : bool
        See `Coefficients.of`.
    T : float
        Sampling period, s.
    v_max : float
        Voltage limit; the integration continues from the limited value.
    """

    def __init__(self, g: Any, *, printed_mu1: bool, T: float, v_max: float) -> None:
        self._a1, self._a2, self._b1, self._b2, self._rho = g.a1, g.a2, g.b1, g.b2, g.rho
        self._mu = Coefficients.of(g.a1, g.a2, g.b1, g.b2, printed_mu1)
        self._T, self._v_max = T, v_max

    def first(self) -> DsmcState:
        """Return the state without a past."""
        return DsmcState()

    def go_on(self, x: DsmcState) -> DsmcState:
        """Return the state with which these gains follow others."""
        return x

    def __call__(self, x: DsmcState, qdd_d: float, e: float, ed: float) -> tuple[DsmcState, float]:
        """Return the voltage for the desired acceleration, the error and its rate (rad, s)."""
        T = self._T
        v, _, sigma, e_int, s_int, before = x
        s = ed + self._a1 * e + self._a2 * e_int
        if before is not None:
            qdd_before, ed_before = before
            s_rate = (ed - ed_before) / T + self._a1 * ed + self._a2 * e
            sigma = s_rate + self._b1 * s + self._b2 * s_int
            mu1, mu2, mu3, mu4 = self._mu
            v += (
                qdd_d
                - qdd_before
                + T * (mu1 * (qdd_d - v) + mu2 * ed + mu3 * e + mu4 * e_int + self._rho * switching(sigma))
            )
            v = min(max(v, -self._v_max), self._v_max)
        return DsmcState(v, s, sigma, e_int + T * e, s_int + T * s, (qdd_d, ed)), v
