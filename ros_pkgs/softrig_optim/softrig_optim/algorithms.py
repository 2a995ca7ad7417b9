"""The general algorithms by name, as the parameters of a node ask for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, assert_never

import numpy as np
from softrig_core import Params, param

from .de import DifferentialEvolution
from .genetic import Genetic
from .perturb import PerturbObserve
from .pso import ParticleSwarm
from .scan import Scan
from .search import Search

Algorithm = Literal["pso", "de_rand1", "de_best1", "ga", "perturb_observe", "scan"]


class AlgorithmParams(Params):
    """Settings of the algorithms; each reads only its own."""

    n_pop: int = param(4, "population", ge=1, le=1000)
    n_iter: int | None = param(None, "iterations; the published number when absent: 10, of fa 6", ge=1, le=100000)
    step: float = param(0.005, "perturb_observe: step of the command", gt=0.0)
    initial: float | None = param(None, "perturb_observe: first command; the lower bound when absent")
    n_grid: int = param(20, "scan: points of the grid", ge=3, le=10000)
    tolerance: float = param(1e-3, "scan: tolerance of the command after the grid; 0 = the grid only", ge=0.0)
    budget: int | None = param(None, "most evaluations; the algorithm's own number when absent", ge=1, le=1000000)


def populated(p: AlgorithmParams, *, maximise: bool) -> dict[str, Any]:
    """Return the settings of a search with a population."""
    iterations = {} if p.n_iter is None else {"n_iter": p.n_iter}
    return {"maximise": maximise, "budget": p.budget, "n_pop": p.n_pop, **iterations}


def make(
    algorithm: Algorithm,
    lower: Sequence[float],
    upper: Sequence[float],
    seed: int | np.random.Generator,
    p: AlgorithmParams,
    *,
    maximise: bool,
) -> Search:
    """Create a search.

    Raises
    ------
    ValueError
        A setting that the algorithm cannot work with; the text names it.
    """
    options: dict[str, Any] = {"maximise": maximise, "budget": p.budget}
    grown = populated(p, maximise=maximise)
    match algorithm:
        case "pso":
            return ParticleSwarm(lower, upper, seed, **grown)
        case "de_rand1":
            return DifferentialEvolution(lower, upper, seed, variant="rand1", **grown)
        case "de_best1":
            return DifferentialEvolution(lower, upper, seed, variant="best1", **grown)
        case "ga":
            return Genetic(lower, upper, seed, **grown)
        case "perturb_observe":
            return PerturbObserve(lower, upper, seed, step=p.step, initial=p.initial, **options)
        case "scan":
            return Scan(lower, upper, seed, n_grid=p.n_grid, tolerance=p.tolerance, **options)
    assert_never(algorithm)
