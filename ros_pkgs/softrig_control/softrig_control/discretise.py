"""Exact sampling of linear systems in plain floats.

Written without BLAS on purpose: its kernels differ between processors in the last bit, and these matrices decide
every number of a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

from softrig_core.kit.dense import total

Matrix = tuple[tuple[float, ...], ...]


def matmul(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> Matrix:
    """Matrix product, summed from left to right.

    Parameters
    ----------
    a : (n, m) nested sequence
        Left factor.
    b : (m, k) nested sequence
        Right factor.
    """
    columns = tuple(zip(*b, strict=True))
    return tuple(tuple(_dot(row, column) for column in columns) for row in a)


def expm(a: Sequence[Sequence[float]]) -> Matrix:
    """Matrix exponential of a small matrix by scaling, Taylor series and squaring.

    Parameters
    ----------
    a : (n, n) nested sequence
        Scaled until its largest row sum is below 1; the remainder of the series after 18 terms is then below the
        rounding of a float64.
    """
    n = range(len(a))
    norm = max(_dot(map(abs, row), (1.0,) * len(row)) for row in a)
    squarings = max(0, math.frexp(norm)[1])
    scaled = [[x / 2**squarings for x in row] for row in a]
    identity: Matrix = tuple(tuple(float(i == j) for j in n) for i in n)
    result = identity
    for k in range(18, 0, -1):  # Horner's scheme: I + A/1 (I + A/2 (I + ...))
        product = matmul(scaled, result)
        result = tuple(tuple(identity[i][j] + product[i][j] / k for j in n) for i in n)
    for _ in range(squarings):
        result = matmul(result, result)
    return result


def zero_order_hold(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]], period: float) -> tuple[Matrix, Matrix]:
    """Sample x' = A x + B u with u held over the period: x_(k+1) = Ad x_k + Bd u_k.

    Parameters
    ----------
    a : (n, n) nested sequence
    b : (n, m) nested sequence
    period : float
        In s.

    Returns
    -------
    (Ad, Bd)
        From exp([[A, B], [0, 0]] period).
    """
    n, m = len(a), len(b[0])
    whole = [tuple(x * period for x in (*ra, *rb)) for ra, rb in zip(a, b, strict=True)] + [(0.0,) * (n + m)] * m
    sampled = _expm(tuple(whole))[:n]
    return tuple(row[:n] for row in sampled), tuple(row[n:] for row in sampled)


_expm = lru_cache(maxsize=64)(expm)  # runs of a study often share their plant


def _dot(a, b) -> float:  # type: ignore[no-untyped-def]
    return total(x * y for x, y in zip(a, b, strict=True))
