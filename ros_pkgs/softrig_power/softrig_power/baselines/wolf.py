"""Grey wolf optimiser."""

from __future__ import annotations

import numpy as np
from softrig_core import Array
from softrig_optim.search import Moves, Population, points


class GreyWolf(Population):
    r"""Grey wolf optimiser (GWO).

    .. math::
        X = \frac13 \sum_{k = \alpha, \beta, \delta} \left( X_k - A_k |C_k X_k - X| \right), \quad
        A_k = 2 a r_1 - a, \quad C_k = 2 r_2                                     \quad (3.1)\text{--}(3.7)

    with alpha, beta, delta the three best positions so far, a falling linearly from 2 to 0, r_1 and r_2 uniform in
    [0, 1] for each wolf, leader and variable. n_pop evaluations an iteration, the first with the random start, so
    n_pop n_iter in all.

    References
    ----------
    S. Mirjalili, S. M. Mirjalili, A. Lewis, Grey wolf optimizer, Advances in Engineering Software 69, 2014.
    """

    SMALLEST = 3

    def moves(self) -> Moves:  # noqa: D102
        x = self.spread()
        leaders: Array = np.empty((0, self.lower.size))
        leader_costs: Array = np.empty(0)
        for k in self.iterations():
            costs = yield points(x)
            leader_costs = np.append(leader_costs, costs)
            # A stable sort prefers the older of two equal leaders, and is the same on every CPU.
            order = np.argsort(leader_costs, kind="stable")[:3]
            leaders, leader_costs = np.vstack([leaders, x])[order], leader_costs[order]
            a = 2.0 - 2.0 * (k - 1) / self.n_iter
            r1, r2 = self.rng.random((2, self.n_pop, *leaders.shape))
            steps = leaders - (2.0 * a * r1 - a) * np.abs(2.0 * r2 * leaders - x[:, None, :])
            x = self.clip(steps.mean(axis=1))
