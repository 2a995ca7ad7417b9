"""Searches for a violation that receive only margins: ours, and those that it is compared with."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from softrig_bringup.falsify.search import WORST, Point, search

Margin = Callable[[Point], float]


class Violated(Exception):
    """Ends a search that has found a violation."""


class Spent(Exception):
    """Ends a search whose budget is used up."""


@dataclass(frozen=True)
class Problem:
    """A margin over the unit cube; `groups` are the coordinates of each input."""

    name: str
    margin: Margin
    groups: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of coordinates."""
        return sum(self.groups)


def ours(problem: Problem, margin: Margin, budget: int, seed: int) -> None:
    """Search as `softrig falsify` does."""
    search(problem.groups, lambda points: [margin(p) for p in points], budget, seed=seed)


def random(problem: Problem, margin: Margin, budget: int, seed: int) -> None:
    """Draw uniformly."""
    for point in np.random.default_rng(seed).random((budget, problem.size)).tolist():
        margin(tuple(point))


def corners(problem: Problem, margin: Margin, budget: int, seed: int) -> None:
    """Yield all low, all high, then corners at random."""
    for u in (0.0, 1.0):
        margin((u,) * problem.size)
    for point in np.random.default_rng(seed).integers(0, 2, (budget - 2, problem.size)).tolist():
        margin(tuple(map(float, point)))


def cmaes(problem: Problem, margin: Margin, budget: int, seed: int) -> None:
    """CMA-ES from the middle, again with other random numbers when it has converged."""
    from cmaes import CMA

    while True:
        asked = CMA(np.full(problem.size, 0.5), 0.3, bounds=np.array([[0.0, 1.0]] * problem.size), seed=seed)
        while not asked.should_stop():
            points = [asked.ask() for _ in range(asked.population_size)]
            results = [margin(tuple(p.tolist())) for p in points]
            asked.tell([(p, m if math.isfinite(m) else WORST) for p, m in zip(points, results, strict=True)])
        seed += 1000


def annealing(problem: Problem, margin: Margin, budget: int, seed: int) -> None:
    """Generalised annealing: the call that psy-taliro 3.2.0 makes (the same points, tried beside numpy 2.4)."""
    from scipy.optimize import dual_annealing

    bounds = [(0.0, 1.0)] * problem.size
    dual_annealing(lambda x: margin(tuple(x.tolist())), bounds, rng=seed, maxfun=budget, no_local_search=True)


METHODS: dict[str, Callable[[Problem, Margin, int, int], None]] = {
    "softrig": ours,
    "random": random,
    "corners": corners,
    "CMA-ES": cmaes,
    "annealing": annealing,
}


def runs_to_violation(problem: Problem, method: str, budget: int, seed: int) -> float:
    """Return the number of runs that a method needs; infinite when the budget is not enough."""
    runs = 0

    def margin(point: Point) -> float:
        nonlocal runs
        if runs == budget:
            raise Spent
        runs += 1
        result = problem.margin(point)
        if result < 0.0:
            raise Violated
        return result

    try:
        METHODS[method](problem, margin, budget, seed)
    except Violated:
        return runs
    except Spent:
        pass
    return math.inf
