"""Phase-locked loop on a space vector."""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

from softrig_core import Params, param


class PllParams(Params):
    """Gains of `PhaseLockedLoop`."""

    kp: float = param(60.0, "proportional gain of the phase error", "1/s", ge=0.0, le=1e4, live=True)
    ki: float = param(1400.0, "integral gain of the phase error", "1/s^2", ge=0.0, le=1e7, live=True)
    least: float = param(
        0.1, "magnitude below which the frequency is frozen, same unit as the vector", ge=0.0, le=1e6, live=True
    )


class Locked(NamedTuple):
    """Angle at the next sample (rad), angular frequency and its integral part (rad/s)."""

    theta: float
    omega: float
    integral: float = 0.0


class PhaseLockedLoop:
    r"""Angle and frequency of a rotating vector u; its state is a `Locked`.

    .. math::
        z_k = u_k e^{-j\theta_k}, \quad e_k = \arg z_k, \quad
        \omega_k = \omega_0 + K_p e_k + K_i T \sum_{i \le k} e_i, \quad \theta_{k+1} = \theta_k + T \omega_k

    Below the magnitude `least` the phase of u is meaningless, so the frequency stays. The integral is kept in rad/s, so
    the frequency does not jump when Ki changes.

    Parameters
    ----------
    omega : float
        Nominal angular frequency omega_0, rad/s.
    period : float
        T, s.
    """

    def __init__(self, gains: PllParams, omega: float, period: float) -> None:
        self._gains = gains
        self._nominal = omega
        self._period = period

    def first(self, theta: float) -> Locked:
        """Begin with an angle, rad, at the nominal frequency."""
        return Locked(theta, self._nominal)

    def __call__(self, x: Locked, u: complex, lost: int = 0) -> tuple[Locked, float]:
        """Process the vector; return the state, and theta, the angle of the frame at this sample, from -pi to pi.

        `lost` samples before it are missing: the frame has turned in the meantime.
        """
        theta, omega, integral = x
        if lost:
            theta = math.remainder(theta + lost * self._period * omega, math.tau)
        if abs(u) >= self._gains.least:
            error = cmath.phase(u * cmath.rect(1.0, -theta))
            integral += self._gains.ki * self._period * error
            omega = self._nominal + self._gains.kp * error + integral
        return Locked(math.remainder(theta + self._period * omega, math.tau), omega, integral), theta
