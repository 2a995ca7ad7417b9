"""Sample transfer functions, and check the result with exact integers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from softrig_core.kit import exact
from softrig_core.kit.exact import Integers, Rows, product

from .discretise import Matrix, augmented, matmul, zero_order_hold

ACCURACY = 1e-9  # share of the largest value of a step response: the required accuracy of a sampled model
CHECKED = 256  # periods over which it is checked
CONVERGED = 1e-14  # share of the same value: allowed difference between two numbers of bits
# An unstable response is followed up to this power of two; float64 ends at 1024.
GROWN = 900
# Bits that the largest value must still have; with fewer, the response is computed again with more bits.
DIGITS = 64


class Sampled(NamedTuple):
    """x(t+1) = A x(t) + B u(t), y = C x."""

    a: Matrix
    b: Matrix
    c: tuple[float, ...]

    def step_response(self, samples: int) -> list[float]:
        """Compute y(1), y(2), ... after u = 1 from t = 0 on, from rest, as a plant steps."""
        x, result = [0.0] * len(self.a), []
        for _ in range(samples):
            moved = matmul(self.a, [(v,) for v in x])
            x = [v[0] + b[0] for v, b in zip(moved, self.b, strict=True)]
            result.append(matmul((self.c,), [(v,) for v in x])[0][0])
        return result


@dataclass(frozen=True)
class Exact:
    """A sampled system without rounding.

    Parameters
    ----------
    matrices : callable
        Returns (A, B), shapes (n, n) and (n, 1), in units of 2^-bits.
    c : sequence of Fraction
        Row of the output.
    """

    matrices: Callable[[int], tuple[Integers, Integers]]
    c: Sequence[Fraction]

    @classmethod
    def continuous(cls, rows: Rows, c: Sequence[Fraction]) -> Exact:
        """Sample a system.

        Parameters
        ----------
        rows : (n + 1, n + 1) nested sequence of Fraction
            [[A, B], [0, 0]] times the period.
        c : (n,) sequence of Fraction
        """
        balanced, exponents = exact.balance(rows)

        def matrices(bits: int) -> tuple[Integers, Integers]:
            matrix = exact.exponential(balanced, bits)
            return matrix[:-1, :-1], matrix[:-1, -1:]

        scaled = [x * Fraction(2) ** (e - exponents[-1]) for x, e in zip(c, exponents[:-1], strict=True)]
        return cls(lru_cache(maxsize=4)(matrices), scaled)

    @classmethod
    def discrete(cls, a: Matrix, b: Matrix, c: Sequence[float]) -> Exact:
        """Use the matrices of a sampled system as they are.

        Parameters
        ----------
        a : (n, n) nested sequence
        b : (n, 1) nested sequence
        c : (n,) sequence of float
        """
        rows, column, (row,) = exact.fractions(a), exact.fractions(b), exact.fractions((c,))
        return cls(lambda bits: (exact.integers(rows, bits), exact.integers(column, bits)), row)

    def step_response(self) -> list[float]:
        """Compute y(1), y(2), ... after u = 1 from t = 0 on, from rest: `CHECKED` samples, fewer where they explode."""

        def response(bits: int) -> list[float]:
            a, b = self.matrices(bits)
            both = np.vstack([a, self._row(bits)])
            x = b
            results: list[Integers] = []
            while len(results) < CHECKED and max(map(abs, x.flat)).bit_length() < bits + GROWN:
                moved = product(both, x, bits)
                x = moved[:-1] + b
                results.append(moved[-1:])
            if max(y[0, 0].bit_length() for y in results) < DIGITS:
                raise exact.UnsettledError("too little is left of the response")
            return [exact.floats(y, bits)[0][0] for y in results]

        return exact.settled(response, lambda results, wanted: off(results, wanted) < CONVERGED)

    def polynomials(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Compute A(z) and B(z) of A(z) y(t) = B(z) u(t-1), coefficients of z^0, z^-1, ...

        A(z) is the characteristic polynomial, B(z) = A(z) times the Markov parameters C A^k B.
        """

        def both(bits: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
            a, x = self.matrices(bits)
            n, row, markov = len(a), self._row(bits), []
            characteristic = exact.recursion(a, bits)
            for _ in range(n):
                markov.append(product(row, x, bits)[0, 0])
                x = product(a, x, bits)
            b = [sum(characteristic[i] * markov[k - i] for i in range(k + 1)) >> bits for k in range(n)]
            result = exact.floats(np.array([characteristic, [*b, 0]], dtype=object), bits)
            return result[0], result[1][:n]

        return exact.settled(both)

    def _row(self, bits: int) -> Integers:
        return exact.integers((self.c,), bits)


def off(values: Sequence[float], wanted: Sequence[float]) -> float:
    """Compute the largest difference of two responses, relative to the largest value of the second."""
    largest = max(map(abs, wanted))
    return max(abs(x - y) for x, y in zip(values, wanted, strict=True)) / largest if largest else 0.0


def sample_transfer_function(num: Sequence[float], den: Sequence[float], period: float) -> Sampled:
    """Sample a strictly proper transfer function num(s)/den(s) with u held over each period.

    In controllable form: each state is the derivative of the next. The result has been compared with the response of
    the same system without rounding.

    Parameters
    ----------
    num, den : sequence of float
        Coefficients in s, highest power first.
    period : float
        s.

    Raises
    ------
    ValueError
        `den` is empty or begins with zero; `num` is not of lower degree, so that u(t) would act on y(t) directly; a
        number is not finite; the step response is off by more than 1e-9, or beyond the range of float64.
    """
    return sampled_exactly(tuple(num), tuple(den), period)[0]


@lru_cache(maxsize=64)  # cached, because a rig samples a plant to check its parameters and again to run
def sampled_exactly(num: tuple[float, ...], den: tuple[float, ...], period: float) -> tuple[Sampled, Exact]:
    """Sample as `sample_transfer_function`; return the system in floats, and without rounding."""
    if not den or den[0] == 0.0:
        raise ValueError(f"den = {list(den)}: expected a first coefficient other than zero")
    if not all(map(math.isfinite, (*num, *den))):
        raise ValueError(f"num = {list(num)}, den = {list(den)}: expected finite numbers")
    n = len(den) - 1
    num = num[next((i for i, x in enumerate(num) if x), len(num)) :]
    if not 0 < len(num) <= n:
        raise ValueError(
            f"num = {list(num)}: expected a degree below the {n} of den, and a coefficient other than zero"
        )
    below = [tuple(float(j == i) for j in range(n)) for i in range(n - 1)]
    a = (tuple(-x / den[0] for x in den[1:]), *below)
    b = tuple((float(i == 0),) for i in range(n))
    c = (0.0,) * (n - len(num)) + tuple(x / den[0] for x in num)
    (top,), (row,) = exact.fractions((den,)), exact.fractions(((0.0,) * (n - len(num)) + num,))
    rows = list(exact.fractions(augmented(a, b), period))
    # The exact system is made of the given coefficients and not of `a`, whose divisions are rounded.
    rows[0] = (*(-x / top[0] * Fraction(period) for x in top[1:]), Fraction(period))
    cannot = f"the transfer function of order {n} cannot be sampled with a period of {period:g} s"
    right = Exact.continuous(rows, [x / top[0] for x in row])
    try:
        wanted = right.step_response()
    except ArithmeticError as reason:
        raise ValueError(f"{cannot}: {reason}; split it into plants of lower order") from None
    sampled = Sampled(*zero_order_hold(a, b, period), c)
    error = off(sampled.step_response(len(wanted)), wanted)
    if not error <= ACCURACY:
        raise ValueError(
            f"{cannot}: its step response would be off by {error:.1g} of its largest value, expected at most "
            f"{ACCURACY:g}; split it into plants of lower order"
        )
    return sampled, right
