"""Takagi-Sugeno surface of two inputs."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import Literal

And = Literal["product", "min"]


def sum_rules(terms: int) -> list[list[int]]:
    """Rule table of a fuzzy PI or PD controller: output index i + j, clipped to the outermost terms.

    Parameters
    ----------
    terms : int
        Number of terms of each variable, odd; their indices run from -(terms - 1)/2 to (terms - 1)/2.

    Returns
    -------
    list of list of int
        A row for each term of the first input.
    """
    last = terms // 2
    indices = range(-last, last + 1)
    return [[min(max(i + j, -last), last) for j in indices] for i in indices]


class TakagiSugeno:
    """Zero-order Takagi-Sugeno system of two inputs with triangular terms.

    A term is 1 at its peak and falls to 0 at the peaks beside it, so that at most two terms of an input are active and
    their memberships add up to 1. Inputs beyond the outermost peaks count as those peaks. With w the conjunction of the
    memberships of the two terms and c the rule's constant::

        y = sum of w c/sum of w       over the four active rules

    Memberships and sums are formed symmetrically: peaks and rules that are odd give an exactly odd surface.

    Parameters
    ----------
    peaks : pair of sequences of float
        Peaks of the terms of each input, increasing, at least two.
    rules : sequence of sequences of float
        Constant of each rule: a row for each term of the first input, a column for each of the second.
    conjunction : {"product", "min"}
        AND of a rule's two premises.

    Raises
    ------
    ValueError
        Peaks that do not increase, a table of another size.

    References
    ----------
    T. Takagi and M. Sugeno, "Fuzzy identification of systems and its applications to modeling and control", IEEE
    Transactions on Systems, Man, and Cybernetics SMC-15, 1985.
    """

    def __init__(
        self,
        peaks: tuple[Sequence[float], Sequence[float]],
        rules: Sequence[Sequence[float]],
        conjunction: And = "product",
    ) -> None:
        for row in peaks:
            if len(row) < 2 or any(b <= a for a, b in pairwise(row)):
                raise ValueError(f"peaks {list(row)}: expected at least two increasing numbers")
        rows, columns = len(peaks[0]), len(peaks[1])
        if len(rules) != rows or any(len(row) != columns for row in rules):
            raise ValueError(f"rules: expected {rows} rows of {columns} constants")
        self._first, self._second = (tuple(map(float, row)) for row in peaks)
        self._rules = tuple(tuple(map(float, row)) for row in rules)
        self._product = conjunction == "product"

    def __call__(self, x: float, y: float) -> float:
        """Return the output for two inputs."""
        i, x_low, x_high = _terms(self._first, x)
        j, y_low, y_high = _terms(self._second, y)
        if self._product:
            w_00, w_01, w_10, w_11 = x_low * y_low, x_low * y_high, x_high * y_low, x_high * y_high
        else:
            w_00, w_01, w_10, w_11 = min(x_low, y_low), min(x_low, y_high), min(x_high, y_low), min(x_high, y_high)
        low, high = self._rules[i], self._rules[i + 1]
        c_00, c_01, c_10, c_11 = low[j], low[j + 1], high[j], high[j + 1]
        # The outer and the inner pair change places when both inputs change sign: the sums stay the same to the bit.
        weighted = (w_00 * c_00 + w_11 * c_11) + (w_01 * c_01 + w_10 * c_10)
        return weighted / ((w_00 + w_11) + (w_01 + w_10))


def _terms(peaks: tuple[float, ...], x: float) -> tuple[int, float, float]:
    """Return the index of the lower active term and the memberships of the lower and the upper one."""
    x = min(max(x, peaks[0]), peaks[-1])
    i = min(bisect_right(peaks, x), len(peaks) - 1) - 1
    low, high = peaks[i], peaks[i + 1]
    width = high - low
    return i, (high - x) / width, (x - low) / width
