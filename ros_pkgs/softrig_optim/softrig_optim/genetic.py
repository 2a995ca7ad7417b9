"""Genetic algorithm with real-valued genes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from softrig_core import Array

from .search import Moves, Population, Seed, points


@dataclass(eq=False, repr=False, kw_only=True)
class Genetic(Population):
    """Genetic algorithm (GA): tournaments of two, blend crossover, Gaussian mutation, the best survive.

    A child takes each gene uniformly from the interval of its parents' genes, widened by `blend` of its length on
    both sides (BLX-alpha). With probability `mutation` a gene gets a normal step with a deviation of `step` of the
    variable's range. The `elite` best go on unchanged and are not evaluated again, so there are
    n_pop + n_iter (n_pop - elite) evaluations. Each generation can be evaluated in parallel.

    Parameters
    ----------
    elite : int
        At least 1 and less than n_pop.
    **options
        Those of `Population` and `Search`.

    References
    ----------
    L. J. Eshelman, J. D. Schaffer, Real-coded genetic algorithms and interval schemata, 1993 (BLX-alpha).
    """

    n_pop: int = 20
    blend: float = 0.5
    mutation: float = 0.1
    step: float = 0.1
    elite: int = 1

    SMALLEST = 2

    def __post_init__(self, seed: Seed) -> None:
        if not 1 <= self.elite < self.n_pop:
            raise ValueError(f"elite is {self.elite}, expected at least 1 and less than n_pop = {self.n_pop}")
        super().__post_init__(seed)

    def moves(self) -> Moves:  # noqa: D102
        x = self.spread()
        costs = np.array((yield points(x)))
        for _ in self.iterations():
            # A stable sort keeps the order of equal costs, which another sort leaves to the CPU.
            order = np.argsort(costs, kind="stable")[: self.elite]
            children = self._children(x, costs, self.n_pop - self.elite)
            child_costs = yield points(children)
            x = np.vstack([x[order], children])
            costs = np.concatenate([costs[order], child_costs])

    def _children(self, x: Array, costs: Array, count: int) -> Array:
        rng = self.rng
        rivals = rng.integers(len(x), size=(2, count, 2))
        winners = np.where(costs[rivals[..., 0]] <= costs[rivals[..., 1]], rivals[..., 0], rivals[..., 1])
        mother, father = x[winners[0]], x[winners[1]]
        share = rng.uniform(-self.blend, 1.0 + self.blend, mother.shape)
        child = mother + share * (father - mother)
        mutate = rng.random(child.shape) < self.mutation
        jump = self.step * (self.upper - self.lower) * rng.standard_normal(child.shape)
        return self.clip(np.where(mutate, child + jump, child))
