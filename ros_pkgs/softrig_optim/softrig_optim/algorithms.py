"""The general algorithms by name, as the parameters of a node ask for them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, assert_never

import numpy as np
from softrig_core import Params, param

from .de import DifferentialEvolution
from .firefly import Firefly
from .genetic import Genetic
from .perturb import PerturbObserve
from .pso import ParticleSwarm
from .salp import ImprovedSalpSwarm, SalpSwarm
from .scan import Scan
from .search import Options, PopulationOptions, Search
from .whale import Whale
from .wolf import GreyWolf

Algorithm = Literal[
    "issa", "ssa", "pso", "de_rand1", "de_best1", "fa", "fa_all_pairs", "gwo", "woa", "ga", "perturb_observe", "scan"
]


class AlgorithmParams(Params):
    """Settings of the algorithms; each reads only its own."""

    n_pop: int = param(4, "population", ge=1, le=1000)
    n_iter: int | None = param(None, "iterations; the published number when absent: 10, of fa 6", ge=1, le=100000)
    c3_threshold: float = param(0.5, "issa, ssa: the leader goes up if c3 is not below; misprint 0", ge=0.0, le=1.0)
    step: float = param(0.005, "perturb_observe: step of the command", gt=0.0)
    initial: float | None = param(None, "perturb_observe: first command; the lower bound when absent")
    n_grid: int = param(20, "scan: points of the grid", ge=3, le=10000)
    tolerance: float = param(1e-3, "scan: tolerance of the command after the grid; 0 = the grid only", ge=0.0)
    budget: int | None = param(None, "most evaluations; the algorithm's own number when absent", ge=1, le=1000000)


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
    options: Options = {"maximise": maximise, "budget": p.budget}
    grown: PopulationOptions = {"maximise": maximise, "budget": p.budget, "n_pop": p.n_pop}
    if p.n_iter is not None:
        grown["n_iter"] = p.n_iter
    match algorithm:
        case "issa":
            return ImprovedSalpSwarm(lower, upper, seed, c3_threshold=p.c3_threshold, **grown)
        case "ssa":
            return SalpSwarm(lower, upper, seed, c3_threshold=p.c3_threshold, **grown)
        case "pso":
            return ParticleSwarm(lower, upper, seed, **grown)
        case "de_rand1":
            return DifferentialEvolution(lower, upper, seed, variant="rand1", **grown)
        case "de_best1":
            return DifferentialEvolution(lower, upper, seed, variant="best1", **grown)
        case "fa" | "fa_all_pairs":
            return Firefly(lower, upper, seed, all_pairs=algorithm == "fa_all_pairs", **grown)
        case "gwo":
            return GreyWolf(lower, upper, seed, **grown)
        case "woa":
            return Whale(lower, upper, seed, **grown)
        case "ga":
            return Genetic(lower, upper, seed, **grown)
        case "perturb_observe":
            return PerturbObserve(lower, upper, seed, step=p.step, initial=p.initial, **options)
        case "scan":
            return Scan(lower, upper, seed, n_grid=p.n_grid, tolerance=p.tolerance, **options)
    assert_never(algorithm)
