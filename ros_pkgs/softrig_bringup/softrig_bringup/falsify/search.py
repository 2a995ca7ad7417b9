"""The search: corners, then constant profiles, an optimiser, and coordinate searches until the budget ends."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np

Point = tuple[float, ...]
Measure = Callable[[Sequence[Point]], list[float]]  # margins of a batch; NaN where a margin could not be measured
Sampler = Literal["cmaes", "tpe", "random"]

MANY = 1000  # number of drawn corners
# Points asked for at a time. It is fixed, so that the result does not depend on the number of cores.
BATCH = 4
CORNERS, HELD, POLISH = 0.1, 0.1, 0.25  # shares of the budget for each kind of candidate
FEW = 2 * BATCH  # least number of corners
# Reported for a point that could not be measured, because samplers accept no NaN.
WORST = 1e300


@dataclass
class SearchResult:
    """Results of a search so far.

    Parameters
    ----------
    least : float
        Least margin; infinite before the first.
    point : tuple of float
        Where.
    runs : int
        Number of points measured.
    corners : float
        Least margin of the corners, which are run first; infinite if the sampler is ``random``.
    trace : list of float
        Least margin so far after each run.
    """

    least: float = math.inf
    point: Point = ()
    runs: int = 0
    corners: float = math.inf
    trace: list[float] = field(default_factory=list)

    def see(self, point: Point, margin: float) -> None:
        """Count a run."""
        self.runs += 1
        if margin < self.least:
            self.least, self.point = margin, point
        self.trace.append(self.least)


def needs(sampler: Sampler, size: int) -> str:
    """Name the package that a sampler needs."""
    return "cmaes" if sampler == "cmaes" and size > 1 else "optuna" if sampler != "random" else ""


def search(
    groups: Sequence[int],
    measure: Measure,
    budget: int,
    *,
    seed: int = 0,
    sampler: Sampler = "cmaes",
    enough: float = -math.inf,
) -> SearchResult:
    """Look for the least margin in the unit cube.

    The corners are run first, then the sampler. The remaining budget is spent on climbs from corner to corner, first
    from the best point, then from other corners.

    If several quantities are searched and one of them is a list or a profile, CMA-ES runs in between, with one constant
    coordinate for each quantity. Most violations of a system whose past fades need no more. Violations between the
    bounds, which no corner shows, are found sooner with few coordinates than with many. CMA-ES uses most of the
    corners' share of the budget and another tenth.

    Parameters
    ----------
    groups : sequence of int
        Number of coordinates of each searched quantity, which is a number, a list or a profile.
    measure : callable
        Measures a batch of points.
    budget : int
        Number of runs.
    sampler : {"cmaes", "tpe", "random"}
        What follows the corners; ``random`` draws points and nothing else.
    enough : float
        Stop at a margin below this.
    """
    size = sum(groups)
    result = SearchResult()
    known: dict[Point, float] = {}

    def tell(points: Sequence[Point]) -> list[float]:
        points = points[: budget - result.runs]
        margins = measure(points) if points else []
        for point, margin in zip(points, margins, strict=True):
            known[point] = margin
            result.see(point, margin)
        return margins

    def over() -> bool:
        return result.runs >= budget or result.least < enough

    if sampler == "random":
        _sample("random", size, seed, tell, over, result)
        return result
    rng = np.random.default_rng(seed)
    first = max(FEW, round(CORNERS * budget))
    staged = sampler == "cmaes" and 1 < len(groups) < size
    few = FEW if staged else first
    _corners(groups, rng, tell, lambda: over() or result.runs >= few, few)
    result.corners = result.least
    if staged:

        def constant(points: Sequence[Point]) -> list[float]:
            return tell([tuple(np.repeat(point, groups).tolist()) for point in points])

        few = first + round(HELD * budget)
        _cmaes(len(groups), seed, constant, lambda: over() or result.runs >= few, result)
    left = budget - round(POLISH * budget)
    _sample(sampler, size, seed, tell, lambda: over() or result.runs >= left, result)
    start = result.point or (0.0,) * size
    while not over():
        if _climb(start, known, tell, over) == 0 and sum(set(p) <= {0.0, 1.0} for p in known) == 2**size:
            # No corner is left to search from, so the rest of the budget goes to the sampler.
            _sample(sampler, size, seed + 1, tell, over, result)
        start = _corner(size, rng)
    return result


def _sample(
    sampler: Sampler,
    size: int,
    seed: int,
    tell: Callable[[Sequence[Point]], list[float]],
    over: Callable[[], bool],
    result: SearchResult,
) -> None:
    """Ask the sampler for batches until the budget is used or the search is decided."""
    if sampler == "random":
        rng = np.random.default_rng(seed)
        while not over():
            tell([tuple(point) for point in rng.random((BATCH, size)).tolist()])
    # One coordinate has no covariance matrix to adapt.
    elif sampler == "cmaes" and size > 1:
        _cmaes(size, seed, tell, over, result)
    else:
        _tpe(size, seed, tell, over)


def _cmaes(
    size: int, seed: int, tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool], result: SearchResult
) -> None:
    CMA = _cma_class()
    cube = np.array([[0.0, 1.0]] * size)
    # The search starts in the middle, not at the best corner, which may be far from the violations between the bounds.
    mean = np.full(size, 0.5)
    while not over():
        asked = CMA(mean, sigma=0.3, bounds=cube, seed=seed)
        while not over() and not asked.should_stop():
            points = [asked.ask() for _ in range(asked.population_size)]
            margins = tell([tuple(point.tolist()) for point in points])
            # The budget is used up, and CMA-ES accepts whole generations only.
            if len(margins) < len(points):
                return
            asked.tell([(p, m if math.isfinite(m) else WORST) for p, m in zip(points, margins, strict=True)])
        # It has converged, so it starts again from the best point with other random numbers.
        seed += 1
        mean = np.array(result.point) if len(result.point) == size else mean


def _cma_class() -> Any:
    """Return CMA-ES without importing the other optimisers of its package.

    Those look for ``scipy.stats``, half a second of import, and do without where it is not there.
    """
    wanted = "scipy.stats"
    hidden = wanted not in sys.modules
    if hidden:
        sys.modules[wanted] = None  # type: ignore[assignment]
    try:
        from cmaes import CMA
    finally:
        if hidden:
            del sys.modules[wanted]
    return CMA


def _tpe(size: int, seed: int, tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool]) -> None:
    # The import takes a tenth of a second, and a small budget is used up before.
    if over():
        return
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    names = [f"u{i:03}" for i in range(size)]
    study = optuna.create_study(sampler=optuna.samplers.TPESampler(seed=seed, constant_liar=True))
    space: dict[str, Any] = {name: optuna.distributions.FloatDistribution(0.0, 1.0) for name in names}
    while not over():
        trials = [study.ask(space) for _ in range(BATCH)]
        margins = tell([tuple(trial.params[n] for n in names) for trial in trials])
        for trial, margin in zip(trials, margins, strict=False):
            study.tell(trial, margin if math.isfinite(margin) else WORST)


def _corners(
    groups: Sequence[int],
    rng: np.random.Generator,
    tell: Callable[[Sequence[Point]], list[float]],
    over: Callable[[], bool],
    budget: int,
) -> None:
    """Yield corners: all low, all high, each value by itself, each coordinate if the budget allows, then drawn ones."""
    size = sum(groups)

    def alone(spans: Iterable[tuple[int, int]]) -> list[Point]:
        return [tuple(u if a <= k < b else 1.0 - u for k in range(size)) for a, b in spans for u in (1.0, 0.0)]

    listed = [(0.0,) * size, (1.0,) * size, *alone(pairwise(np.cumsum([0, *groups]).tolist()))]
    if len(listed) + 2 * size <= budget:
        listed += alone((k, k + 1) for k in range(size))
    listed += [_corner(size, rng) for _ in range(MANY)]
    # Drawn corners may repeat; each is measured once.
    corners = dict.fromkeys(listed)
    every = list(corners)
    for k in range(0, len(every), BATCH):
        if over():
            break
        tell(every[k : k + BATCH])


def _corner(size: int, rng: np.random.Generator) -> Point:
    return tuple(rng.integers(0, 2, size).astype(float).tolist())


def _climb(
    point: Point, known: Mapping[Point, float], tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool]
) -> int:
    """Try each coordinate of a point at both ends, round after round, until a round finds nothing; return the runs.

    The worst input of a linear loop is at its bounds all the time; so is that of many nonlinear loops.
    """
    runs, better = 0, True
    if point not in known:
        tell([point])
        runs += 1
    best = known.get(point, math.nan)
    while better:
        better = False
        for i in range(len(point)):
            ends = [(*point[:i], u, *point[i + 1 :]) for u in (0.0, 1.0) if point[i] != u]
            fresh = [p for p in ends if p not in known]
            if fresh and over():
                return runs
            tell(fresh)
            runs += len(fresh)
            for neighbour in ends:
                margin = known.get(neighbour, math.nan)
                if margin < best or (math.isnan(best) and not math.isnan(margin)):
                    point, best, better = neighbour, margin, True
    return runs
