"""What measurements tell of a characteristic on which the current never rises with the voltage."""

from __future__ import annotations

from bisect import bisect
from collections import deque

from .search import Point

SMALL = 1e-6  # V, A: less is none


class FallingCurve:
    """Measurements (v, i) of one source, settled or not, that prove when the source has become another one.

    The curve passes above every corner (least v, least i) and below every corner (largest v, largest i) of some
    measurements in a row: noise and what a fast transient leaves between two of them are inside. A corner of the first
    kind above one of the second proves a change; of each kind only the outermost are kept.

    Parameters
    ----------
    n : int
        Measurements to a corner.
    """

    def __init__(self, n: int) -> None:
        self._v: deque[float] = deque(maxlen=n)
        self._i: deque[float] = deque(maxlen=n)
        self._below: list[Corner] = []
        self._above: list[Corner] = []  # reciprocal, so that the outermost are the largest again

    def take(self, sample: Point) -> float:
        """Take a measurement (v in V, i in A, ...); give the share by which it proves the power to have changed."""
        v, i = self._v, self._i
        v.append(max(sample[0], SMALL))
        i.append(max(sample[1], SMALL))
        if len(v) != v.maxlen:
            return 0.0
        low, high, over = (min(v), min(i)), (max(v), max(i)), (1.0 / max(v), 1.0 / max(i))
        change = max(_rise(self._below, *high), _rise(self._above, 1.0 / low[0], 1.0 / low[1]), 1.0)
        _keep(self._below, *low)
        _keep(self._above, *over)
        return change * change - 1.0


Corner = tuple[float, float, float]  # x / y, by which they are ordered, x, y; x grows and y falls along the list


def _rise(corners: list[Corner], x: float, y: float) -> float:
    """Give the most by which a corner exceeds (x, y) in both at once: one next to the line from 0 through it."""
    k = bisect(corners, (x / y,))
    return max((min(a / x, b / y) for _, a, b in corners[max(k - 1, 0) : k + 1]), default=0.0)


def _keep(corners: list[Corner], x: float, y: float) -> None:
    """Put a corner in unless another one is beyond it, and take those out that are within it."""
    k = bisect(corners, (x / y,))
    if any(a >= x and b >= y for _, a, b in corners[max(k - 1, 0) : k + 1]):
        return
    first = last = k
    while first and corners[first - 1][2] <= y:
        first -= 1
    while last < len(corners) and corners[last][1] <= x:
        last += 1
    corners[first:last] = [(x / y, x, y)]
