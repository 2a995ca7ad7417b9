"""Sampled filters of a real signal or a space vector (complex)."""

from __future__ import annotations

from typing import Generic, NamedTuple, TypeVar

T = TypeVar("T", float, complex)


class Filtered(NamedTuple, Generic[T]):
    """Output of the filter, and its rate (1/s)."""

    y: T
    rate: T


class SecondOrderFilter:
    r"""Low pass of second order, semi-implicit Euler; its state is a `Filtered`.

    .. math:: \ddot y = \omega_n^2 (x - y) - 2 \zeta \omega_n \dot y

    Parameters
    ----------
    omega : float
        Natural frequency omega_n, rad/s; omega period must be below about 1.
    damping : float
        zeta.
    period : float
        Sampling period, s.

    Raises
    ------
    ValueError
        The sampled filter is not stable.
    """

    def __init__(self, omega: float, damping: float, period: float) -> None:
        step = omega * period
        # Jury's criterion: the poles of the sampled filter have the product 1 - 2 damping step and the sum 2 - step^2 -
        # 2 damping step.
        if not (step > 0.0 and damping > 0.0 and step * step + 4.0 * damping * step < 4.0):
            raise ValueError(
                f"omega = {omega:g} rad/s with damping {damping:g} and a period of {period:g} s: not stable"
            )
        self._stiffness = omega * omega * period
        self._decay = 2.0 * damping * omega * period
        self._period = period

    @staticmethod
    def first(start: T) -> Filtered[T]:
        """Return the state of rest at `start`."""
        return Filtered(start, start - start)

    def __call__(self, x: Filtered[T], sample: T) -> tuple[Filtered[T], T]:
        """Process a sample; return the state, and y."""
        y, rate = x
        rate = rate + (self._stiffness * (sample - y) - self._decay * rate)
        y = y + self._period * rate
        return Filtered(y, rate), y
