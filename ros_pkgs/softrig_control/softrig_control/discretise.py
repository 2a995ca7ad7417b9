"""Exact sampling of linear systems.

Written without BLAS on purpose: its kernels differ between processors in the last bit, and these matrices decide
every number of a run.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from functools import lru_cache

from softrig_core.kit import exact

Matrix = tuple[tuple[float, ...], ...]
# Largest error of an entry, relative to the largest entry and to itself. Floats that meet both are kept although the
# nearest float64 is known, because the bits of golden bags are those of the series.
OF_LARGEST, OF_ITSELF = 2.0**-48, 2.0**-46


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
    """Compute the exponential of a small matrix.

    Plain floats are used where they are right to the last few bits, as integers show, else the nearest float64.

    Parameters
    ----------
    a : (n, n) nested sequence
        Of any scale: stiff, badly scaled and defective ones are no harder.

    Raises
    ------
    ValueError
        A number is not finite, or the result is beyond the range of float64.
    """
    return _exponential(tuple(map(tuple, a)), 1.0)


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

    Raises
    ------
    ValueError
        As `expm`.
    """
    n = len(a)
    sampled = _exponential(augmented(a, b), period)[:n]
    return tuple(row[:n] for row in sampled), tuple(row[n:] for row in sampled)


def augmented(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]]) -> Matrix:
    """Return [[A, B], [0, 0]], whose exponential has both matrices of the sampled system.

    Parameters
    ----------
    a : (n, n) nested sequence
    b : (n, m) nested sequence
    """
    n, m = len(a), len(b[0])
    return tuple([(*ra, *rb) for ra, rb in zip(a, b, strict=True)] + [(0.0,) * (n + m)] * m)


@lru_cache(maxsize=64)  # runs of a study often share their plant
def _exponential(a: Matrix, period: float) -> Matrix:
    entries = exact.exponentials(exact.fractions(a, period))
    quick = _series([[x * period for x in row] for row in a])
    # Nearly always a single evaluation shows that the floats are right: it could confirm wrong ones only if its
    # truncation error equalled their rounding error in each entry. The bits of golden bags are those of the series.
    with suppress(ArithmeticError):
        if _near(quick, entries(exact.BITS[0])):
            return quick
    try:
        right = exact.settled(entries)
    except ArithmeticError as error:
        raise ValueError(
            f"a matrix of {len(a)} rows cannot be sampled with a period of {period:g} s: {error}"
        ) from None
    return quick if _near(quick, right) else right


def _near(quick: Matrix, right: Matrix) -> bool:
    """Return whether floats are as good as the right ones."""
    largest = OF_LARGEST * max(abs(x) for row in right for x in row)
    return all(
        abs(x - y) <= min(largest, OF_ITSELF * abs(y)) for u, v in zip(quick, right, strict=True) for x, y in zip(u, v)
    )


def _series(a: Sequence[Sequence[float]]) -> Matrix:
    """Return the exponential in floats, good where squaring loses no digits: largest row sum below 1, then Taylor."""
    n = range(len(a))
    norm = max(_dot(map(abs, row), (1.0,) * len(row)) for row in a)
    squarings = max(0, math.frexp(norm)[1])
    scaled = [[x / 2**squarings for x in row] for row in a]
    identity: Matrix = tuple(tuple(float(i == j) for j in n) for i in n)
    result = identity
    # Horner's scheme: I + A/1 (I + A/2 (I + ...)). With a row sum below 1 the terms left out, 1/19! and on, are below
    # rounding.
    for k in range(18, 0, -1):
        product = matmul(scaled, result)
        result = tuple(tuple(identity[i][j] + product[i][j] / k for j in n) for i in n)
    for _ in range(squarings):
        result = matmul(result, result)
    return result


def _dot(a, b) -> float:  # type: ignore[no-untyped-def]
    result = 0.0
    for x, y in zip(a, b, strict=True):
        result += x * y
    return result
