"""Nodes and weights of Gauss and Legendre, worked out without LAPACK: the same bits on every CPU."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from softrig_core import Array


def gauss_legendre(n: int) -> tuple[Array, Array]:
    """Return nodes and weights on [0, 1], exact for polynomials up to degree 2 n - 1.

    The zeros of the Legendre polynomial by Newton's method from Tricomi's approximation; its recursion gives the slope.
    """
    nodes, weights = np.empty(n), np.empty(n)
    for k in range(n):
        x = -math.cos(math.pi * (k + 0.75) / (n + 0.5))
        for _ in range(8):  # quadratic from 1e-4 on; three would do
            before, current = 1.0, x
            for j in range(2, n + 1):
                before, current = current, ((2 * j - 1) * x * current - (j - 1) * before) / j
            slope = n * (x * current - before) / (x * x - 1.0)
            x -= current / slope
        nodes[k], weights[k] = 0.5 * (1.0 + x), 1.0 / ((1.0 - x * x) * slope * slope)
    return nodes, weights
