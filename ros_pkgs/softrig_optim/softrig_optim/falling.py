"""What measurements tell of a characteristic on which the current never rises with the voltage."""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass

from .search import Point

SMALL = 1e-6  # V, A: less is none
Corner = tuple[float, float, float]  # x / y, by which they are ordered, x, y; x grows and y falls along the row


@dataclass(slots=True)
class FallingCurve:
    """Measurements (v, i) of one source, settled or not, that prove when the source has become another one; a value.

    The curve passes above every corner (least v, least i) and below every corner (largest v, largest i) of some
    measurements in a row: noise and what a fast transient leaves between two of them are inside. A corner of the first
    kind above one of the second proves a change; of each kind only the outermost are kept.

    Parameters
    ----------
    n : int
        Measurements to a corner.
    v, i : tuple of float
        The last measurements, up to n, V and A.
    below, above : tuple of Corner
        Those of `above` are reciprocal, so that the outermost are the largest again.
    """

    n: int
    v: tuple[float, ...] = ()
    i: tuple[float, ...] = ()
    below: tuple[Corner, ...] = ()
    above: tuple[Corner, ...] = ()

    def take(self, sample: Point) -> tuple[float, FallingCurve]:
        """Take a measurement (v in V, i in A, ...).

        Returns
        -------
        float
            The share by which it proves the power to have changed.
        FallingCurve
            With the measurement.
        """
        n = self.n
        v, i = (*self.v, max(sample[0], SMALL))[-n:], (*self.i, max(sample[1], SMALL))[-n:]
        if len(v) < n:
            return 0.0, FallingCurve(n, v, i)
        least_v, least_i, most_v, most_i = min(v), min(i), max(v), max(i)
        change = max(_rise(self.below, most_v, most_i), _rise(self.above, 1.0 / least_v, 1.0 / least_i), 1.0)
        below, above = _kept(self.below, least_v, least_i), _kept(self.above, 1.0 / most_v, 1.0 / most_i)
        return change * change - 1.0, FallingCurve(n, v, i, below, above)


def _rise(corners: tuple[Corner, ...], x: float, y: float) -> float:
    """Give the most by which a corner exceeds (x, y) in both at once: one next to the line from 0 through it."""
    k = bisect(corners, (x / y,))
    most = 0.0
    for _, a, b in corners[max(k - 1, 0) : k + 1]:
        most = max(most, min(a / x, b / y))
    return most


def _kept(corners: tuple[Corner, ...], x: float, y: float) -> tuple[Corner, ...]:
    """Put a corner in unless another one is beyond it, and take those out that are within it."""
    k = bisect(corners, (x / y,))
    for _, a, b in corners[max(k - 1, 0) : k + 1]:
        if a >= x and b >= y:
            return corners
    first = last = k
    while first and corners[first - 1][2] <= y:
        first -= 1
    while last < len(corners) and corners[last][1] <= x:
        last += 1
    return (*corners[:first], (x / y, x, y), *corners[last:])
