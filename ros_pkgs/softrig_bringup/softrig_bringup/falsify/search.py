"""The search: random points first, then a maintained optimiser, then the bounds of each coordinate in turn."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

Point = tuple[float, ...]
Measure = Callable[[Sequence[Point]], list[float]]  # margins of a batch, NaN for what could not be measured
Sampler = Literal["cmaes", "tpe", "random"]

BATCH = 4  # points asked for at a time, whatever the number of cores: the result does not depend on it
RANDOM, POLISH = 0.25, 0.25  # shares of the budget
WORST = 1e300  # told of a point that could not be measured


@dataclass
class Found:
    """What a search has seen so far.

    Parameters
    ----------
    least : float
        Least margin; infinite before the first.
    point : tuple of float
        Where.
    runs : int
        Number of points measured.
    random : float
        Least margin of the random points alone.
    trace : list of float
        Least margin so far after each run.
    """

    least: float = math.inf
    point: Point = ()
    runs: int = 0
    random: float = math.inf
    trace: list[float] = field(default_factory=list)

    def see(self, point: Point, margin: float) -> None:
        """Count a run."""
        self.runs += 1
        if margin < self.least:
            self.least, self.point = margin, point
        self.trace.append(self.least)


def search(
    size: int, measure: Measure, budget: int, *, seed: int = 0, sampler: Sampler = "cmaes", enough: float = -math.inf,
) -> Found:  # fmt: skip
    """Look for the least margin in the unit cube.

    Parameters
    ----------
    size : int
        Number of coordinates.
    measure : callable
        Measures a batch of points.
    budget : int
        Number of runs.
    seed : int
    sampler : {"cmaes", "tpe", "random"}
        What follows the random points; ``random`` goes on with them to the end.
    enough : float
        Stop at a margin below this.
    """
    found = Found()

    def tell(points: Sequence[Point]) -> list[float]:
        points = points[: budget - found.runs]
        margins = measure(points) if points else []
        for point, margin in zip(points, margins, strict=True):
            found.see(point, margin)
        return margins

    def over() -> bool:
        return found.runs >= budget or found.least < enough

    at_random = budget if sampler == "random" else max(min(budget, 2 * BATCH), round(RANDOM * budget))
    _sample("random", size, seed, tell, lambda: over() or found.runs >= at_random, found)
    found.random = found.least
    polish = 0 if sampler == "random" else round(POLISH * budget)
    _sample(sampler, size, seed, tell, lambda: over() or found.runs >= budget - polish, found)
    for points in _bounds(size, found):
        if over():
            break
        tell(points)
    return found


def _sample(
    sampler: Sampler, size: int, seed: int, tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool],
    found: Found,
) -> None:  # fmt: skip
    """Ask for batches until it is over."""
    if sampler == "random":
        rng = np.random.default_rng(seed)
        while not over():
            tell([tuple(point) for point in rng.random((BATCH, size)).tolist()])
    elif sampler == "cmaes" and size > 1:  # one coordinate has no covariance
        _cmaes(size, seed, tell, over, found)
    else:
        _tpe(size, seed, tell, over)


def _cmaes(
    size: int, seed: int, tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool], found: Found
) -> None:
    from cmaes import CMA

    cube = np.array([[0.0, 1.0]] * size)
    while not over():
        mean = np.array(found.point) if found.point else np.full(size, 0.5)
        asked = CMA(mean, sigma=0.3, bounds=cube, seed=seed)
        while not over() and not asked.should_stop():
            points = [asked.ask() for _ in range(asked.population_size)]
            margins = tell([tuple(point.tolist()) for point in points])
            if len(margins) < len(points):  # the budget is used up
                return
            asked.tell([(p, m if math.isfinite(m) else WORST) for p, m in zip(points, margins, strict=True)])
        seed += 1  # it has converged: again from the best point, with other random numbers


def _tpe(size: int, seed: int, tell: Callable[[Sequence[Point]], list[float]], over: Callable[[], bool]) -> None:
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


def _bounds(size: int, found: Found) -> Iterator[list[Point]]:
    """Try each coordinate of the best point at both ends, round after round, until a round finds nothing.

    The worst input of a linear loop is at its bounds all the time, so is that of many that are not linear.
    """
    better = True
    while better and found.point:
        before = found.least
        for i in range(size):
            ends = [u for u in (0.0, 1.0) if found.point[i] != u]
            yield [(*found.point[:i], u, *found.point[i + 1 :]) for u in ends]
        better = found.least < before
