"""The search methods of the papers by name, beside those of softrig_optim."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from softrig_optim import algorithms
from softrig_optim.algorithms import AlgorithmParams, populated
from softrig_optim.search import Search

from .firefly import Firefly
from .salp import ImprovedSalpSwarm, SalpSwarm
from .whale import Whale
from .wolf import GreyWolf

Algorithm = Literal["issa", "ssa", "fa", "fa_all_pairs", "gwo", "woa"] | algorithms.Algorithm


def make(
    algorithm: Algorithm,
    lower: Sequence[float],
    upper: Sequence[float],
    seed: int | np.random.Generator,
    p: AlgorithmParams,
    *,
    maximise: bool,
    c3_threshold: float = 0.5,
) -> Search:
    """Create a search; see `softrig_optim.algorithms.make`.

    Parameters
    ----------
    c3_threshold : float
        Of the salp swarms: the leader goes up if c3 is not below.
    """
    options = populated(p, maximise=maximise)
    match algorithm:
        case "issa":
            return ImprovedSalpSwarm(lower, upper, seed, c3_threshold=c3_threshold, **options)
        case "ssa":
            return SalpSwarm(lower, upper, seed, c3_threshold=c3_threshold, **options)
        case "fa" | "fa_all_pairs":
            return Firefly(lower, upper, seed, all_pairs=algorithm == "fa_all_pairs", **options)
        case "gwo":
            return GreyWolf(lower, upper, seed, **options)
        case "woa":
            return Whale(lower, upper, seed, **options)
    return algorithms.make(algorithm, lower, upper, seed, p, maximise=maximise)
