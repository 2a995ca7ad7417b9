"""Where the frequency response of a loop crosses the unit circle and the negative real axis.

Crossings are found on the response itself, never between the points of a fitted curve: a light resonance has no shape
that a spline through some points would have.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array

Response = Callable[[Array], NDArray[np.complex128]]

# Two neighbouring points may differ by this angle (rad) and this factor, so that no crossing is between them unseen.
TURN, RATIO = 0.2, 1.3
# A jump through a pole never becomes small, so narrower intervals, relative to the frequency, are not halved any more.
NARROW = 1e-11
ROUNDS = 40
# A sign also changes where the response jumps through a pole, but there it is not near the circle or the axis.
ON_AXIS = 1e-6


def resolved(response: Response, omega: Array) -> tuple[Array, NDArray[np.complex128]]:
    """Add frequencies until L and 1 + L change little in angle and magnitude from each frequency to the next.

    Parameters
    ----------
    response : callable
        L at frequencies.
    omega : array, shape (n,)
        Ascending, rad/s.

    Returns
    -------
    omega : array, shape (m,)
    L : complex array, shape (m,)
    """
    L = response(omega)
    for _ in range(ROUNDS):
        # 1 + L is looked at as well, because the disk margin is read from the points nearest to -1.
        wide = (_apart(L) | _apart(1.0 + L)) & (np.diff(omega) > NARROW * omega[1:])
        if not wide.any():
            break
        between = (0.5 * (omega[:-1] + omega[1:]))[wide]
        indices = np.flatnonzero(wide) + 1
        omega, L = np.insert(omega, indices, between), np.insert(L, indices, response(between))
    return omega, L


def _apart(z: NDArray[np.complex128]) -> NDArray[np.bool_]:
    size = np.abs(z)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = size[1:] / size[:-1]
        turn = np.abs(np.angle(z[1:] / z[:-1]))
    # The negated comparisons also count NaN, from a point at which z is zero or infinite, as apart.
    return ~((turn < TURN) & (ratio < RATIO) & (ratio > 1.0 / RATIO))


def gain_crossings(response: Response, omega: Array, L: NDArray[np.complex128]) -> Array:
    """Find the frequencies at which the magnitude of L is one, rad/s.

    Parameters
    ----------
    response : callable
        L at frequencies.
    omega, L : array, shape (n,)
        As `resolved` returns them.
    """
    result = _roots(lambda w: np.log(np.abs(response(w))), omega, np.log(np.abs(L)))
    return result[np.abs(np.abs(response(result)) - 1.0) < ON_AXIS]


def phase_crossings(response: Response, omega: Array, L: NDArray[np.complex128]) -> Array:
    """Find the frequencies at which L is real and negative, rad/s.

    Parameters
    ----------
    response : callable
        L at frequencies.
    omega, L : array, shape (n,)
        As `resolved` returns them.
    """
    result = _roots(lambda w: response(w).imag, omega, L.imag)
    values = response(result)
    return result[(values.real < 0.0) & (np.abs(values.imag) < ON_AXIS * np.abs(values))]


def _roots(function: Callable[[Array], Array], omega: Array, values: Array) -> Array:
    """Find roots by bisection of all intervals with different signs at their ends, in parallel."""
    k = np.flatnonzero(np.signbit(values[1:]) != np.signbit(values[:-1]))
    low, high, below = omega[k], omega[k + 1], np.signbit(values[k])
    # 60 halvings leave none of the 53 bits of a float open in an interval that is no wider than its ends are large.
    for _ in range(60 if k.size else 0):
        middle = 0.5 * (low + high)
        same = np.signbit(function(middle)) == below
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return np.asarray(0.5 * (low + high))
