"""Matrix arithmetic in Python's integers: results correct to the last bit of a float64, the same on every CPU.

A float64 is an integer times a power of two, so matrices are held as integers in units of 2^-bits. Sums are exact;
products are cut off at the last bit carried. `settled` carries more bits until 64 more of them change no result.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Rows = Sequence[Sequence[Fraction]]
Integers = NDArray[Any]  # array of Python's integers, in units of 2^-bits
Result = TypeVar("Result")

# Numbers of bits to try. The fourth holds all that float64 does, of any matrix of moderate norm.
BITS = (128, 320, 768, 1600, 3200, 6400)
MORE = 64
# The Taylor series is of a matrix with a norm of at most 2^-SMALL, so that each term adds eight bits or more.
SMALL = 8
# The most rounds of balancing, and the ratio above which a round is no gain (0.95, as Parlett and Reinsch).
SWEEPS, ENOUGH = 50, (95, 100)
# A power of two beyond the largest float64.
LARGEST = 1100


class UnsettledError(ArithmeticError):
    """Too few bits are carried for a result, or no number of them is enough."""


def settled(function: Callable[[int], Result], same: Callable[[Result, Result], bool] = operator.eq) -> Result:
    """Evaluate with more and more bits until 64 further bits no longer change the result.

    Parameters
    ----------
    function : callable
        Called with the number of bits to carry; an `UnsettledError` asks for more.
    same : callable
        Returns whether two results are sufficiently equal.

    Raises
    ------
    UnsettledError
        The largest number of bits is not enough.
    """
    for bits in BITS:
        try:
            result = function(bits)
            if same(result, function(bits + MORE)):
                return result
        except UnsettledError:
            continue
    raise UnsettledError(f"the result is not settled with {BITS[-1]} bits")


def fractions(rows: Sequence[Sequence[float]], factor: float = 1.0) -> Rows:
    """Return a matrix of floats, times a factor, without rounding.

    Raises
    ------
    ValueError
        A number is not finite.
    """
    try:
        scale = Fraction(factor)
        return tuple([tuple([Fraction(x) * scale for x in row]) for row in rows])
    except (OverflowError, ValueError):
        raise ValueError("a matrix has numbers that are not finite; expected finite ones") from None


def balance(rows: Rows) -> tuple[Rows, list[int]]:
    """Scale a matrix so that each row is about as large as its column, which loses fewer bits.

    Parameters
    ----------
    rows : (n, n) nested sequence of Fraction

    Returns
    -------
    balanced : (n, n) nested sequence of Fraction
        D^-1 A D with D = diag(2^exponents).
    exponents : list of int

    References
    ----------
    B. N. Parlett, C. Reinsch, Balancing a matrix for calculation of eigenvalues and eigenvectors, Numerische Mathematik
    13, 1969.
    """
    n = len(rows)
    # The sums are of integers in units of 1/unit, because sums of fractions need ten times as long.
    unit = math.lcm(*(x.denominator for row in rows for x in row))
    sizes = [[abs(x.numerator) * (unit // x.denominator) for x in row] for row in rows]
    exponents = [0] * n
    changed, sweeps = True, 0
    while changed and sweeps < SWEEPS:
        changed, sweeps = False, sweeps + 1
        for i in range(n):
            # Both are in units of 2^-(up + down) / unit, so that no shift cuts off a bit.
            up, down = max(exponents) - exponents[i], exponents[i] - min(exponents)
            of_row = sum(sizes[i][j] << e - exponents[i] + down for j, e in enumerate(exponents) if j != i) << up
            of_column = sum(sizes[j][i] << exponents[i] - e + up for j, e in enumerate(exponents) if j != i) << down
            low = up + down + unit.bit_length()
            shift = (of_row.bit_length() - low if of_row else 0) - (of_column.bit_length() - low if of_column else 0)
            # Else an input is a row of zeros; there is no balance, so its column is scaled to about 1.
            if of_row and of_column:
                shift //= 2
                after = (of_column << max(0, 2 * shift)) + (of_row << max(0, -2 * shift))
                if ENOUGH[1] * after >= ENOUGH[0] * ((of_column + of_row) << abs(shift)):
                    continue
            if shift:
                changed = True
                exponents[i] += shift
    return [
        [_scaled(x, exponents[j] - exponents[i]) for j, x in enumerate(row)] for i, row in enumerate(rows)
    ], exponents


def _scaled(x: Fraction, shift: int) -> Fraction:
    """Return x 2^shift."""
    return Fraction(x.numerator << max(0, shift), x.denominator << max(0, -shift)) if shift else x


def integers(rows: Rows, bits: int) -> Integers:
    """Return a matrix in units of 2^-bits, cut off below."""
    result = np.empty((len(rows), len(rows[0])), dtype=object)
    for i, row in enumerate(rows):
        result[i] = [(x.numerator << bits) // x.denominator for x in row]
    return result


def floats(x: Integers, bits: int) -> tuple[tuple[float, ...], ...]:
    """Return the float64 nearest to each of some integers in units of 2^-bits.

    Raises
    ------
    OverflowError
        One is beyond float64.
    """
    return tuple([tuple([nearest(v, bits) for v in row]) for row in x.tolist()])


def nearest(x: int, bits: int) -> float:
    """Return the float64 nearest to x 2^-bits; / of integers rounds once."""
    return x / (1 << bits) + 0.0 if bits >= 0 else float(x << -bits)


def product(a: Integers, b: Integers, bits: int) -> Integers:
    """Multiply two matrices in units of 2^-bits."""
    result: Integers = (a @ b) >> bits
    return result


def exponential(rows: Rows, bits: int) -> Integers:
    """Return exp of a matrix in units of 2^-bits, by scaling, Taylor series and squaring.

    Parameters
    ----------
    rows : (n, n) nested sequence of Fraction

    Raises
    ------
    OverflowError
        An entry grows beyond float64.
    """
    unit = math.lcm(*(x.denominator for row in rows for x in row))
    norm = max(sum(abs(x.numerator) * (unit // x.denominator) for x in row) for row in rows)
    squarings = max(0, norm.bit_length() - unit.bit_length() + 1 + SMALL) if norm else 0
    # Each squaring doubles the truncation error, so it needs one more bit.
    wide = bits + squarings + 2 * SMALL
    scaled = integers(rows, wide - squarings)
    identity = np.empty_like(scaled)
    identity.fill(0)
    np.fill_diagonal(identity, 1 << wide)
    result, term, k = identity + scaled, scaled, 1
    # Cutting off rounds downwards, so a negative term never becomes 0 but stays at -1.
    while max(map(abs, term.flat)) > 1:
        k += 1
        term = product(term, scaled, wide) // k
        result = result + term
    for _ in range(squarings):
        result = product(result, result, wide)
        if max(map(abs, result.flat)).bit_length() > wide + LARGEST:
            raise OverflowError("the matrix exponential is beyond the range of float64")
    rounded: Integers = result >> (wide - bits)
    return rounded


def exponentials(rows: Rows) -> Callable[[int], tuple[tuple[float, ...], ...]]:
    """Return a function that computes the entries of exp of a matrix with a number of bits, for `settled`.

    An entry beyond float64 raises an OverflowError; one with some thousand zeros before its first digit is not settled.
    """
    balanced, exponents = balance(rows)
    reached = _reached(rows)
    # With so many bits, an entry that is still 0 is 0 in float64 too.
    smallest = LARGEST + max(exponents) - min(exponents)

    def entries(bits: int) -> tuple[tuple[float, ...], ...]:
        result = exponential(balanced, bits)
        if bits < smallest and ((result == 0) | (result == -1))[reached].any():
            raise UnsettledError("an entry is below the last bit that is carried")
        return tuple(
            [
                tuple([nearest(v, bits - of_row + of_column) for v, of_column in zip(row, exponents, strict=True)])
                for row, of_row in zip(result.tolist(), exponents, strict=True)
            ]
        )

    return entries


def characteristic(rows: Rows) -> tuple[float, ...]:
    """Return the coefficients of det(s - A), highest power first, nearest to the right ones.

    Parameters
    ----------
    rows : (n, n) nested sequence of Fraction

    Raises
    ------
    OverflowError
        A coefficient is beyond float64.
    """
    balanced, _ = balance(rows)
    return settled(lambda bits: tuple(nearest(v, bits) for v in recursion(integers(balanced, bits), bits)))


def recursion(a: Integers, bits: int) -> list[int]:
    """Compute the characteristic polynomial by the recursion of Faddeev and LeVerrier, in units of 2^-bits.

    Parameters
    ----------
    a : (n, n) array of int
    """
    identity = np.array([[int(i == j) for j in range(len(a))] for i in range(len(a))], dtype=object)
    result, m = [1 << bits], identity << bits
    for k in range(1, len(a) + 1):
        m = product(a, m, bits)
        result.append(-(sum(m.diagonal().tolist()) // k))
        m = m + identity * result[k]
    return result


def _reached(rows: Rows) -> NDArray[np.bool_]:
    """Return the entries that may be nonzero in some power of a matrix; its exponential is exactly zero elsewhere."""
    result = np.array([[bool(x) for x in row] for row in rows]) | np.eye(len(rows), dtype=bool)
    for k in range(len(rows)):
        result |= np.outer(result[:, k], result[k])
    return result
