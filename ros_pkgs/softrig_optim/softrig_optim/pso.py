"""Particle swarm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .search import Moves, Population, points


@dataclass(eq=False, repr=False, kw_only=True)
class ParticleSwarm(Population):
    r"""Particle swarm optimisation (PSO) with inertia weight.

    .. math::
        v_i &= w v_i + C_1 r_1 (p_i - x_i) + C_2 r_2 (g - x_i) \\
        x_i &= x_i + v_i

    with p_i the best position of the particle, g of the swarm, r_1 and r_2 uniform in [0, 1] for each variable,
    v_i = 0 at the start. The whole swarm moves, then all particles are evaluated.

    Parameters
    ----------
    w, c1, c2 : float
        Inertia and the two accelerations; 0.4, 1.2, 1.6 in [1].
    **options
        Those of `Population` and `Search`.

    References
    ----------
    [1] J. Farzaneh, A. Karsaz, 2020 (table II). Y. Shi, R. Eberhart, A modified particle swarm optimizer, 1998.
    """

    w: float = 0.4
    c1: float = 1.2
    c2: float = 1.6

    def moves(self) -> Moves:  # noqa: D102
        x = self.spread()
        v = np.zeros_like(x)
        costs = np.array((yield points(x)))
        p, p_costs = x, costs
        for _ in self.iterations():
            g = p[np.argmin(p_costs)]
            r1, r2 = self.rng.random((2, *x.shape))
            v = self.w * v + self.c1 * r1 * (p - x) + self.c2 * r2 * (g - x)
            x = self.clip(x + v)
            costs = np.array((yield points(x)))
            better = costs < p_costs
            p = np.where(better[:, None], x, p)
            p_costs = np.where(better, costs, p_costs)
