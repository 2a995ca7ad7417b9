"""Differential evolution."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from .search import Moves, Population, points


@dataclass(eq=False, repr=False, kw_only=True)
class DifferentialEvolution(Population):
    r"""Differential evolution (DE), rand/1/bin or best/1/bin.

    .. math::
        v_i = x_a + F (x_b - x_c)

    with x_a random or the best, b and c random, all different and none of them i; F uniform in [f_min, f_max] for each
    mutant. Each variable is taken from v_i with probability CR and one of them always; the trial replaces x_i
    immediately if it is not worse, so that the next mutant may already use it.

    Parameters
    ----------
    variant : {"rand1", "best1"}
        [1] does not state which variant it used. Both draw three other candidates, so n_pop is at least 4.
    f_min, f_max, cr : float
        0.2, 0.8, 0.3 in [1]; CR has no effect on a single variable.
    **options
        Those of `Population` and `Search`.

    References
    ----------
    [1] J. Farzaneh, A. Karsaz, 2020 (table II). R. Storn, K. Price, Differential evolution, 1997.
    """

    variant: Literal["rand1", "best1"] = "rand1"
    f_min: float = 0.2
    f_max: float = 0.8
    cr: float = 0.3

    SMALLEST = 4

    def moves(self) -> Moves:  # noqa: D102
        n, rng = self.lower.size, self.rng
        x = self.spread()
        costs = yield points(x)
        for _ in self.iterations():
            for i in range(self.n_pop):
                # Three are drawn for both variants, though best1 needs two, so that they differ in the base only.
                a, b, c = rng.choice([k for k in range(self.n_pop) if k != i], 3, replace=False)
                base = x[a] if self.variant == "rand1" else x[np.argmin(costs)]
                mutant = base + rng.uniform(self.f_min, self.f_max) * (x[b] - x[c])
                accept = rng.random(n) < self.cr
                # One variable always comes from the mutant: without it a trial could be a copy and waste an evaluation.
                accept[rng.integers(n)] = True
                trial = self.clip(np.where(accept, mutant, x[i]))
                (cost,) = yield points(trial[None])
                # An equal cost replaces too, as in Storn and Price, so that the population can drift over a plateau.
                if cost <= costs[i]:
                    x[i], costs[i] = trial, cost
