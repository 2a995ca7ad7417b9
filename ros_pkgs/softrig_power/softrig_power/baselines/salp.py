"""Salp swarm: the original and the improved form of Farzaneh and Karsaz (2020)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from softrig_core import Array
from softrig_optim.search import Moves, Population, points


@dataclass(eq=False, repr=False, kw_only=True)
class SalpSwarm(Population):
    r"""Salp swarm algorithm (SSA).

    .. math::
        x_1 &= F \pm c_1 ((ub - lb) c_2 + lb), \quad + \text{ if } c_3 \ge \text{threshold}   \quad (6) \\
        x_i &= (x_i + x_{i-1}) / 2, \quad i \ge 2                                            \quad (7) \\
        c_1 &= 3.2 \exp(-(3.5\, l / L)^2)                                                    \quad (10)

    with F the best position so far (food), c_2 and c_3 uniform in [0, 1], l = 1..L the iteration. The leader is clipped
    to the box first. Then the followers move in order; the salp ahead of each has already moved, so they never leave
    the box. One evaluation for each salp and iteration, after n_pop at the start.

    Parameters
    ----------
    c3_threshold : float
        0.5 in the original algorithm [2]. Eq. (6) as printed in [1] has 0, which is always true: the leader then
        only goes up.
    **options
        Those of `Population` and `Search`.

    References
    ----------
    [1] J. Farzaneh, A. Karsaz, Application of Improved Salp Swarm Algorithm Based on MPPT for PV Systems Under
        Partial Shading Conditions, 2020.
    [2] S. Mirjalili et al., Salp swarm algorithm, Advances in Engineering Software 114, 2017.
    """

    c3_threshold: float = 0.5

    AMPLITUDE, DECAY = 3.2, 3.5

    def follow(self, position: Array, ahead: Array) -> Array:
        """Return the new position of a follower of the salp ahead, eq. (7)."""
        return (position + ahead) / 2.0

    def moves(self) -> Moves:  # noqa: D102
        n = self.lower.size
        x = self.spread()
        costs = yield points(x)
        i = int(np.argmin(costs))
        food, best = x[i].copy(), costs[i]
        for k in self.iterations():
            c1 = self.AMPLITUDE * math.exp(-((self.DECAY * k / self.n_iter) ** 2))
            c2, c3 = self.rng.random((2, n))
            step = c1 * ((self.upper - self.lower) * c2 + self.lower)
            x[0] = self.clip(np.where(c3 >= self.c3_threshold, food + step, food - step))
            for i in range(1, self.n_pop):
                x[i] = self.follow(x[i], x[i - 1])
            costs = yield points(x)
            i = int(np.argmin(costs))
            if costs[i] < best:
                food, best = x[i].copy(), costs[i]


class ImprovedSalpSwarm(SalpSwarm):
    r"""Improved salp swarm algorithm (ISSA): the followers' rule and c_1 of [1].

    .. math::
        x_i &= \tfrac12 \sqrt{x_i^2 + 3 x_{i-1}^2}       \quad (9) \\
        c_1 &= 2.3 \exp(-(3.2\, l / L)^2)                \quad (11)

    Needs positive variables. The weight 3 is on the salp ahead, so the followers contract faster than in SSA.

    References
    ----------
    [1] J. Farzaneh, A. Karsaz, Application of Improved Salp Swarm Algorithm Based on MPPT for PV Systems Under
        Partial Shading Conditions, 2020.
    """

    AMPLITUDE, DECAY = 2.3, 3.2

    def follow(self, position: Array, ahead: Array) -> Array:
        """Return the new position of a follower of the salp ahead, eq. (9)."""
        return 0.5 * np.sqrt(position**2 + 3.0 * ahead**2)

    def moves(self) -> Moves:  # noqa: D102
        # The root in equation (9) loses the sign, so a follower could never reach a negative value.
        if (self.lower <= 0.0).any():
            raise ValueError(f"lower = {self.lower.tolist()}: the improved salp swarm needs positive variables")
        return super().moves()
