"""Firefly algorithm."""

from __future__ import annotations

import math
from dataclasses import dataclass

from softrig_core.kit import dense
from softrig_optim.search import Moves, Population, points


@dataclass(eq=False, repr=False, kw_only=True)
class Firefly(Population):
    r"""Firefly algorithm (FA).

    .. math::
        x_i = x_i + \beta_0 e^{-\gamma r_{ij}^2} (x_j - x_i) + \alpha (\epsilon - \tfrac12)

    for each brighter firefly j in turn, with r_ij the distance, epsilon uniform in [0, 1] for each variable; firefly
    i is evaluated after each of its moves.

    Parameters
    ----------
    all_pairs : bool
        Evaluate firefly i for every j, also where it does not move: n_pop (n_pop - 1) evaluations an iteration.
    beta0, alpha, gamma : float
        2, 0.6, 1 in [1].
    **options
        Those of `Population` and `Search`.

    References
    ----------
    [1] J. Farzaneh, A. Karsaz, 2020 (table II). X.-S. Yang, Firefly algorithms for multimodal optimization, 2009.
    """

    n_iter: int = 6
    all_pairs: bool = False
    beta0: float = 2.0
    alpha: float = 0.6
    gamma: float = 1.0

    def moves(self) -> Moves:  # noqa: D102
        x = self.spread()
        costs = yield points(x)
        for _ in self.iterations():
            for i in range(self.n_pop):
                for j in range(self.n_pop):
                    if i == j:
                        continue
                    brighter = costs[j] < costs[i]
                    if brighter:
                        difference = x[j] - x[i]
                        beta = self.beta0 * math.exp(-self.gamma * dense.product(difference, difference))
                        wander = self.alpha * (self.rng.random(difference.size) - 0.5)
                        x[i] = self.clip(x[i] + beta * difference + wander)
                    if brighter or self.all_pairs:
                        (costs[i],) = yield points(x[i : i + 1])
