"""The quadratic programme of constrained GPC, by DAQP.

::

    min 1/2 U' H U + q' U
    s.t. low <= U_1 + ... + U_i <= high,  |U_i| <= most      for every move i

`low` and `high` are the distances of the present command from its bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple


class Answer(NamedTuple):
    """The result of the solver.

    Attributes
    ----------
    moves : tuple of float, or None
        U; None when there is no solution.
    status : str
        ``optimal``, or the solver's own description of the failure.
    """

    moves: tuple[float, ...] | None
    status: str


class MoveSolver:
    """Dual active set, exact to rounding, for the programme above with H and `most` fixed.

    Parameters
    ----------
    hessian : (Nc, Nc)
        H, positive definite.
    most : float
        Largest move.
    """

    WORDS = {-1: "infeasible", -2: "cycling", -3: "unbounded", -4: "iteration limit", -5: "not convex"}

    SCRATCH = frozenset({"_q", "_lower", "_upper", "_sense"})  # each call writes all of them before it reads

    def __init__(self, hessian: Sequence[Sequence[float]], most: float) -> None:
        import numpy as np
        from daqp import solve

        n = len(hessian)
        self._n, self._solve = n, solve
        self._h, self._q, self._sums = np.array(hessian, dtype=float), np.zeros(n), np.tril(np.ones((n, n)))
        # The first n rows bound the moves and never change. The others bound their partial sums, and each programme
        # sets them.
        self._lower, self._upper = np.full(2 * n, -most), np.full(2 * n, most)
        self._sense = np.zeros(2 * n, dtype=np.int32)

    def solve(self, q: Sequence[float], low: float, high: float) -> Answer:
        """Solve for a linear term and the bounds of the accumulated moves; never raises.

        Each call solves from the beginning: with two moves a warm start saves no time, and the result has no memory.
        """
        self._q[:] = q
        self._lower[self._n :] = low
        self._upper[self._n :] = high
        self._sense[:] = 0
        x, _, flag, _ = self._solve(self._h, self._q, self._sums, self._upper, self._lower, self._sense)
        if flag != 1:
            return Answer(None, self.WORDS.get(flag, f"exit flag {flag}"))
        return Answer(tuple(x.tolist()), "optimal")
