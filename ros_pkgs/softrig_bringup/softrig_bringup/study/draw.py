"""The points of a study: grids, random draws, and draws that fill the space evenly."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, ScenarioError
from softrig_core.scenario.scenario import Draft, read_draft

from . import RUNS
from .definition import Distribution, Draws, Study


class Case(NamedTuple):
    """One run: its number, the scenario and its changes, and the name of its case."""

    number: int
    scenario: str
    case: str
    overrides: dict[str, Any]
    seed: int


def drafts_of(study: Study) -> dict[str, Draft]:
    """Read the scenarios of a study, by their names in the study."""
    names = [study.scenario, *(str(case["scenario"]) for case in study.cases.values() if "scenario" in case)]
    return {name: read_draft(name) for name in dict.fromkeys(names)}


def seeds_of(study: Study, draft: Draft) -> list[int]:
    """Return the seeds of the runs of a scenario."""
    return study.seeds or [draft.filled().seed]


def cases(study: Study, drafts: Mapping[str, Draft] | None = None) -> Iterator[Case]:
    """Yield the runs of a study one by one: cases outermost, then grid, draws, seeds.

    Parameters
    ----------
    drafts : mapping, optional
        Result of `drafts_of`; read from the files by default.
    """
    # A study that is too large is refused before its draws fill the memory.
    count(study)
    drafts = drafts or drafts_of(study)
    number = 0
    points = draw(study.draws) if study.draws else [{}]
    for name, changes in (study.cases or {"": {}}).items():
        overrides = dict(changes)
        scenario = overrides.pop("scenario", study.scenario)
        seeds = seeds_of(study, drafts[scenario])
        for values in itertools.product(*study.grid.values()):
            grid_point = dict(zip(study.grid, values, strict=True))
            for point in points:
                for seed in seeds:
                    yield Case(number, scenario, name, overrides | grid_point | point, seed)
                    number += 1


def count(study: Study) -> int:
    """Return the number of runs."""
    grid = math.prod(len(v) for v in study.grid.values())
    points = max(1, len(study.cases)) * grid * points_of(study)
    number = (study.search.count if study.search else points) * len(study.seeds or [0])
    if number > RUNS:
        raise ScenarioError(f"{study.name}: {number:.4g} runs, expected at most {RUNS}: fewer values, draws or seeds")
    return number


def points_of(study: Study) -> int:
    """Return the number of drawn points."""
    if study.draws is None:
        return 1
    numbers = sum(map(size, study.draws.parameters.values()))
    return study.draws.count * (numbers + 2 if study.draws.method == "sensitivity" else 1)


def draw(draws: Draws) -> list[dict[str, Any]]:
    """Draw the points; the same every time."""
    sizes = {name: size(d) for name, d in draws.parameters.items()}
    unit = _unit(draws, sum(sizes.values()))
    return [_point(draws.parameters, sizes, row) for row in unit]


def _unit(draws: Draws, dimensions: int) -> Array:
    """Draw points of the unit cube, shape (points, dimensions)."""
    rng = np.random.default_rng(draws.seed)
    if draws.method == "random":
        return rng.random((draws.count, dimensions))
    if draws.method == "latin_hypercube":
        # As `scipy.stats.qmc.LatinHypercube` draws, whose import takes a second of each study.
        (rng,) = rng.spawn(1)
        within = rng.uniform(size=(draws.count, dimensions))
        rows = np.tile(np.arange(1, draws.count + 1), (dimensions, 1))
        for row in rows:
            rng.shuffle(row)
        return np.asarray((rows.T - within) / draws.count)
    from scipy.stats import qmc

    if draws.method == "sobol":
        return np.asarray(qmc.Sobol(dimensions, rng=rng).random(draws.count))
    # Two sets from one sequence of twice the dimensions are independent of each other; two sequences need not be.
    first, second = np.hsplit(qmc.Sobol(2 * dimensions, rng=rng).random(draws.count), 2)
    mixed = [np.where(np.arange(dimensions) == k, second, first) for k in range(dimensions)]
    return np.vstack([first, second, *mixed])


def size(d: Distribution) -> int:
    """Number of elements of a drawn parameter."""
    pair = d.uniform or d.log_uniform or d.normal
    return max((len(x) for x in pair if isinstance(x, list)), default=1) if pair else 1


def _point(parameters: Mapping[str, Distribution], sizes: Mapping[str, int], unit: Array) -> dict[str, Any]:
    first, point = 0, {}
    for name, d in parameters.items():
        u = unit[first : first + sizes[name]]
        first += sizes[name]
        values = _values(d, u)
        pair = d.uniform or d.log_uniform or d.normal
        vector = pair is not None and any(isinstance(x, list) for x in pair)
        point[name] = values if vector else values[0]
    return point


def _values(d: Distribution, u: Array) -> list[Any]:
    """Turn numbers in [0, 1) into values by the inverse of the distribution."""
    if d.choice is not None:
        return [d.choice[int(x * len(d.choice))] for x in u]
    if d.integers is not None:
        first, last = d.integers
        return [first + int(x * (last - first + 1)) for x in u]
    if d.normal is not None:
        from scipy.special import ndtri

        mean, deviation = (np.broadcast_to(np.asarray(x, float), u.shape) for x in d.normal)
        # The ends 0 and 1 would be infinite.
        return [float(v) for v in mean + deviation * ndtri(np.clip(u, 1e-12, 1.0 - 1e-12))]
    pair = d.uniform or d.log_uniform
    assert pair is not None
    low, high = (np.broadcast_to(np.asarray(x, float), u.shape) for x in pair)
    if d.uniform is not None:
        return [float(v) for v in low + (high - low) * u]
    return [float(v) for v in low * (high / low) ** u]
