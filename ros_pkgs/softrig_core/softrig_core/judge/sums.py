"""Sums over long columns in one pass of native code, with the bits of numpy's own.

numpy adds in pairs: it halves an array at a multiple of eight numbers until at most 128 remain, and adds these in
eight rows. `pairs` lists this order for native code, which computes each term where it is added instead of storing
whole arrays of terms. A complex number counts as two.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..kit.jit import jit
from ..wire.long import halved

Order = NDArray[np.int64]
LEAF = 128  # numbers that numpy adds without halving
DEPTH = 64  # sums that wait for their other half


@lru_cache(maxsize=64)
def pairs(count: int, each: int = 1) -> Order:
    """Return the order of a sum: the end of each leaf, and how many pairs of sums are added after it.

    Parameters
    ----------
    count : int
        Terms.
    each : int
        Numbers of a term: 2 for complex ones.
    """
    result: list[list[int]] = []

    def add(first: int, last: int) -> None:
        if each * (last - first) <= LEAF:
            result.append([last, 0])
            return
        middle = halved(first, last, each)
        add(first, middle)
        add(middle, last)
        result[-1][1] += 1

    add(0, count)
    order = np.array(result, np.int64)
    order.flags.writeable = False
    return order


def fixed(values: Array) -> Array:
    """Return a read-only view, because numba would compile a second form of a function for arrays that may change."""
    result = values.view()
    result.flags.writeable = False
    return result


@jit
def squares(x: Array, middle: float, order: Order) -> float:
    """Return the sum of ``(x - middle) ** 2``."""
    sums = np.empty(DEPTH)
    have = at = 0
    for k in range(order.shape[0]):
        last = order[k, 0]
        total = -0.0
        if last - at >= 8:
            # The rows are variables, because native code would store those of an array after each addition.
            a = b = c = d = e = f = g = h = -0.0
            while at + 8 <= last:
                a += (x[at] - middle) * (x[at] - middle)
                b += (x[at + 1] - middle) * (x[at + 1] - middle)
                c += (x[at + 2] - middle) * (x[at + 2] - middle)
                d += (x[at + 3] - middle) * (x[at + 3] - middle)
                e += (x[at + 4] - middle) * (x[at + 4] - middle)
                f += (x[at + 5] - middle) * (x[at + 5] - middle)
                g += (x[at + 6] - middle) * (x[at + 6] - middle)
                h += (x[at + 7] - middle) * (x[at + 7] - middle)
                at += 8
            total = ((a + b) + (c + d)) + ((e + f) + (g + h))
        while at < last:
            total += (x[at] - middle) * (x[at] - middle)
            at += 1
        sums[have] = total
        have += 1
        for _ in range(order[k, 1]):
            have -= 1
            sums[have - 1] += sums[have]
    # numpy adds the sum to 0, so that it is never -0.
    return sums[0] + 0.0


@jit
def products(x: Array, y: Array, x_0: float, y_0: float, weights: Array, order: Order) -> tuple[float, float]:
    """Return the sum of the complex ``((x - x_0) + j (y - y_0)) * weights``, in the order of ``pairs(n, 2)``."""
    sums = np.empty((DEPTH, 2))
    have = at = 0
    for k in range(order.shape[0]):
        last = order[k, 0]
        real = imag = -0.0
        if last - at >= 4:
            a = b = c = d = e = f = g = h = -0.0
            while at + 4 <= last:
                a += (x[at] - x_0) * weights[at]
                b += (x[at + 1] - x_0) * weights[at + 1]
                c += (x[at + 2] - x_0) * weights[at + 2]
                d += (x[at + 3] - x_0) * weights[at + 3]
                e += (y[at] - y_0) * weights[at]
                f += (y[at + 1] - y_0) * weights[at + 1]
                g += (y[at + 2] - y_0) * weights[at + 2]
                h += (y[at + 3] - y_0) * weights[at + 3]
                at += 4
            real, imag = (a + b) + (c + d), (e + f) + (g + h)
        while at < last:
            real += (x[at] - x_0) * weights[at]
            imag += (y[at] - y_0) * weights[at]
            at += 1
        sums[have, 0], sums[have, 1] = real, imag
        have += 1
        for _ in range(order[k, 1]):
            have -= 1
            sums[have - 1, 0] += sums[have, 0]
            sums[have - 1, 1] += sums[have, 1]
    return sums[0, 0] + 0.0, sums[0, 1] + 0.0
