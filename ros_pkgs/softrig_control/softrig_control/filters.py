"""Sampled filters of a real signal or a space vector (complex)."""

from __future__ import annotations

from typing import Generic, TypeVar

T = TypeVar("T", float, complex)


class SecondOrderFilter(Generic[T]):
    r"""Low pass of second order, semi-implicit Euler.

    .. math:: \ddot y = \omega_n^2 (x - y) - 2 \zeta \omega_n \dot y

    Parameters
    ----------
    omega : float
        Natural frequency omega_n, rad/s; omega period must be below about 1.
    damping : float
        zeta.
    period : float
        Sampling period, s.
    start : float or complex
        Output at the start, at rest there.

    Raises
    ------
    ValueError
        The sampled filter is not stable.
    """

    def __init__(self, omega: float, damping: float, period: float, start: T) -> None:
        self.retune(omega, damping, period)
        self.y: T = start
        self._rate: T = start - start

    def retune(self, omega: float, damping: float, period: float) -> None:
        """Take another frequency and damping; the output and its rate stay."""
        step = omega * period
        if not (step > 0.0 and damping > 0.0 and step * step + 4.0 * damping * step < 4.0):
            raise ValueError(
                f"omega = {omega:g} rad/s with damping {damping:g} and a period of {period:g} s: not stable"
            )
        self._stiffness = omega * omega * period
        self._decay = 2.0 * damping * omega * period
        self._period = period

    def __call__(self, x: T) -> T:
        """Take the sample x in; gives y."""
        self._rate += self._stiffness * (x - self.y) - self._decay * self._rate
        self.y += self._period * self._rate
        return self.y
