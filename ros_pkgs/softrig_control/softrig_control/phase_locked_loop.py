"""Phase-locked loop on a space vector."""

from __future__ import annotations

import cmath
import math

from softrig_core import Params, param


class PllParams(Params):
    """Gains of `PhaseLockedLoop`."""

    kp: float = param(60.0, "proportional gain of the phase error", "1/s", ge=0.0, le=1e4, live=True)
    ki: float = param(1400.0, "integral gain of the phase error", "1/s^2", ge=0.0, le=1e7, live=True)
    least: float = param(
        0.1, "magnitude below which the frequency is frozen, same unit as the vector", ge=0.0, le=1e6, live=True
    )


class PhaseLockedLoop:
    r"""Angle and frequency of a rotating vector u.

    .. math::
        z_k = u_k e^{-j\theta_k}, \quad e_k = \arg z_k, \quad
        \omega_k = \omega_0 + K_p e_k + K_i T \sum_{i \le k} e_i, \quad \theta_{k+1} = \theta_k + T \omega_k

    Below the magnitude `least` the phase of u means nothing: the frequency stays.

    Parameters
    ----------
    gains : PllParams
    omega : float
        Nominal angular frequency omega_0, rad/s.
    period : float
        T, s.
    theta : float
        Angle at the start, rad.
    """

    def __init__(self, gains: PllParams, omega: float, period: float, theta: float = 0.0) -> None:
        self._gains = gains
        self._nominal = omega
        self._period = period
        self._sum = 0.0
        self._theta = self._next = theta
        self.omega = omega

    def retune(self, gains: PllParams) -> None:
        """Take other gains; the integral is kept in rad/s, so another Ki brings no jump of the frequency."""
        self._gains = gains

    @property
    def theta(self) -> float:
        """Angle at the newest sample, rad, from -pi to pi."""
        return self._theta

    def __call__(self, u: complex) -> float:
        """Take the vector in; gives theta, the angle of the frame at this sample."""
        self._theta = self._next
        if abs(u) >= self._gains.least:
            error = cmath.phase(u * cmath.rect(1.0, -self._theta))
            self._sum += self._gains.ki * self._period * error
            self.omega = self._nominal + self._gains.kp * error + self._sum
        self._next = math.remainder(self._theta + self._period * self.omega, math.tau)
        return self._theta
