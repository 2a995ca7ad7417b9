"""Whale optimisation algorithm."""

from __future__ import annotations

import math

import numpy as np
from softrig_optim.search import Moves, Population, points


class Whale(Population):
    r"""Whale optimisation algorithm (WOA).

    .. math::
        X &= X^* - A |C X^* - X|            && p < 0.5,\ |A| < 1    \quad (2.1)\text{--}(2.2) \\
        X &= X_r - A |C X_r - X|            && p < 0.5,\ |A| \ge 1  \quad (2.7)\text{--}(2.8) \\
        X &= |X^* - X| e^{l} \cos 2 \pi l + X^* && p \ge 0.5        \quad (2.5)

    with X* the best position so far, X_r a random whale, A = 2 a r - a, C = 2 r, a falling linearly from 2 to 0,
    r and p uniform in [0, 1], l in [-1, 1], drawn for each whale. n_pop (n_iter + 1) evaluations.

    References
    ----------
    S. Mirjalili, A. Lewis, The whale optimization algorithm, Advances in Engineering Software 95, 2016.
    """

    def moves(self) -> Moves:  # noqa: D102
        x = self.spread()
        costs = yield points(x)
        i = int(np.argmin(costs))
        star, best = x[i], costs[i]
        for k in self.iterations():
            a = 2.0 - 2.0 * (k - 1) / self.n_iter
            r1, r2, p, u = self.rng.random((4, self.n_pop, 1))
            whale = x[self.rng.integers(self.n_pop, size=self.n_pop)]
            A, C, l = 2.0 * a * r1 - a, 2.0 * r2, 2.0 * u - 1.0  # noqa: E741
            prey = np.where(np.abs(A) < 1.0, star, whale)
            encircle = prey - A * np.abs(C * prey - x)
            # numpy's own exp differs from CPU to CPU, the C library's does not.
            grown = np.array([[math.exp(each)] for each in l[:, 0].tolist()])
            spiral = np.abs(star - x) * grown * np.cos(2.0 * np.pi * l) + star
            x = self.clip(np.where(p < 0.5, encircle, spiral))
            costs = yield points(x)
            i = int(np.argmin(costs))
            if costs[i] < best:
                star, best = x[i], costs[i]
