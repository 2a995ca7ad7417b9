"""Bounds from measurements of a characteristic on which the current never rises with the voltage."""

from __future__ import annotations

from bisect import bisect
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import jit

from .search import Point

# In V and A. Ratios and reciprocals are formed of both, so zero and negative readings are raised to this.
SMALL = 1e-6
# Native code cannot extend an array, so this is room for corners to come; `_add_corner` raises when it is used up.
ROOM = 256
Corner = tuple[float, float, float]  # x / y, by which they are ordered, x, y; x grows and y falls along the row


@dataclass(slots=True)
class FallingCurve:
    """Measurements (v, i) of one source, settled or not, that prove when the source has become another one; a value.

    The curve passes above every corner (least v, least i) and below every corner (largest v, largest i) of some
    measurements in a row: this covers noise and the effect of a fast transient between two of them. A corner of the
    first kind above one of the second proves a change; of each kind only the outermost are kept.

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

    def with_sample(self, sample: Point) -> tuple[float, FallingCurve]:
        """Process a measurement (v in V, i in A, ...).

        Returns
        -------
        float
            Relative change of the power that the measurement proves.
        FallingCurve
            With the measurement.
        """
        n = self.n
        v, i = (*self.v, max(sample[0], SMALL))[-n:], (*self.i, max(sample[1], SMALL))[-n:]
        # With fewer measurements a corner would not contain the noise and would prove a change that did not happen.
        if len(v) < n:
            return 0.0, FallingCurve(n, v, i)
        least_v, least_i, most_v, most_i = min(v), min(i), max(v), max(i)
        change = max(_rise(self.below, most_v, most_i), _rise(self.above, 1.0 / least_v, 1.0 / least_i), 1.0)
        below, above = _with_corner(self.below, least_v, least_i), _with_corner(self.above, 1.0 / most_v, 1.0 / most_i)
        # Voltage and current both exceed a corner by this factor, so the power does by its square.
        return change * change - 1.0, FallingCurve(n, v, i, below, above)

    def native(self) -> FallingRows:
        """Convert it to its form for native code."""
        counts = np.array([len(self.v), len(self.below), len(self.above)])
        last, corners = np.zeros((self.n, 2)), np.zeros((2, 2 * max(counts[1:]) + ROOM, 3))
        last[: counts[0]] = np.array([self.v, self.i]).T
        for rows, known in zip(corners, (self.below, self.above), strict=True):
            rows[: len(known)] = np.array(known).reshape(-1, 3)
        return FallingRows(counts, last, corners)


def _rise(corners: tuple[Corner, ...], x: float, y: float) -> float:
    """Return the most by which a corner exceeds (x, y) in both: a corner next to the line from 0 through it."""
    k = bisect(corners, (x / y,))
    most = 0.0
    # The corners are ordered by x / y, so only the two beside the line through (x, y) can exceed it the most.
    for _, a, b in corners[max(k - 1, 0) : k + 1]:
        most = max(most, min(a / x, b / y))
    return most


def _with_corner(corners: tuple[Corner, ...], x: float, y: float) -> tuple[Corner, ...]:
    """Add a corner unless another one dominates it, and remove those that it dominates."""
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


class FallingRows(NamedTuple):
    """A `FallingCurve` in native code, which is updated in place: the measurements and corners, and their numbers."""

    counts: NDArray[np.int64]
    last: NDArray[np.float64]
    corners: NDArray[np.float64]

    def with_sample(self, sample: Point) -> tuple[float, FallingRows]:
        """See `FallingCurve.with_sample`."""
        change = _apply_sample(self.counts, self.last, self.corners, max(sample[0], SMALL), max(sample[1], SMALL))
        return change * change - 1.0, self

    def python(self) -> FallingCurve:
        """Return its Python form."""
        count, *sizes = self.counts.tolist()
        v, i = map(tuple, self.last[:count].T.tolist())
        below, above = (tuple(map(tuple, rows[:n].tolist())) for rows, n in zip(self.corners, sizes, strict=True))
        return FallingCurve(len(self.last), v, i, below, above)


@jit
def _apply_sample(
    counts: NDArray[np.int64], last: NDArray[np.float64], corners: NDArray[np.float64], v: float, i: float
) -> float:
    """Process a measurement; return the shares of voltage and current by which it proves a change, 1: by none."""
    if counts[0] == len(last):
        last[:-1] = last[1:]
    else:
        counts[0] += 1
    last[counts[0] - 1, 0], last[counts[0] - 1, 1] = v, i
    if counts[0] < len(last):
        return 1.0
    least_v, least_i, most_v, most_i = v, i, v, i
    for k in range(len(last)):
        least_v, least_i = min(least_v, last[k, 0]), min(least_i, last[k, 1])
        most_v, most_i = max(most_v, last[k, 0]), max(most_i, last[k, 1])
    change = 1.0
    change = max(change, _rise_in(corners[0, : counts[1]], most_v, most_i))
    change = max(change, _rise_in(corners[1, : counts[2]], 1.0 / least_v, 1.0 / least_i))
    counts[1] = _add_corner(corners[0], counts[1], least_v, least_i)
    counts[2] = _add_corner(corners[1], counts[2], 1.0 / most_v, 1.0 / most_i)
    return change


@jit
def _insertion_index(corners: NDArray[np.float64], ratio: float) -> int:
    low, high = 0, len(corners)
    while low < high:
        middle = (low + high) // 2
        if corners[middle, 0] < ratio:
            low = middle + 1
        else:
            high = middle
    return low


@jit
def _rise_in(corners: NDArray[np.float64], x: float, y: float) -> float:
    k = _insertion_index(corners, x / y)
    most = 0.0
    for j in range(max(k - 1, 0), min(k + 1, len(corners))):
        most = max(most, min(corners[j, 1] / x, corners[j, 2] / y))
    return most


@jit
def _add_corner(corners: NDArray[np.float64], size: int, x: float, y: float) -> int:
    """Do as `_with_corner`, in place; return the new number of corners."""
    k = _insertion_index(corners[:size], x / y)
    for j in range(max(k - 1, 0), min(k + 1, size)):
        if corners[j, 1] >= x and corners[j, 2] >= y:
            return size
    first = last = k
    while first and corners[first - 1, 2] <= y:
        first -= 1
    while last < size and corners[last, 1] <= x:
        last += 1
    new = first + 1 + size - last
    if new > len(corners):
        raise IndexError("no room for another corner")
    # Source and destination may overlap.
    moved = corners[last:size].copy()
    corners[first, 0], corners[first, 1], corners[first, 2] = x / y, x, y
    corners[first + 1 : new] = moved
    return new
