"""What the method is measured against: the convex relaxation without ripples, and swarms with balance repair."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import numpy as np
from softrig_core import Array
from softrig_optim.algorithms import AlgorithmParams
from softrig_optim.search import run

from ..baselines.algorithms import make
from .units import Units, balanced

Baseline = Literal["issa", "ssa", "pso", "de_rand1", "de_best1", "gwo", "woa", "ga"]
BASELINES: tuple[str, ...] = get_args(Baseline)


def lambda_iteration(units: Units, demand: float) -> Array:
    """Dispatch by equal incremental cost, the ripples left out (e = 0): every unit where 2 a P + b meets lambda.

    Its cost without ripples is a lower bound of every dispatch's cost.

    Parameters
    ----------
    demand : float
        MW, feasible.

    Returns
    -------
    ndarray, shape (n,)
        MW.
    """
    p_min, p_max, a, b = units.table.T[:4]

    def outputs(price: float) -> Array:
        with np.errstate(divide="ignore"):
            wanted = np.where(a > 0.0, (price - b) / (2.0 * a), np.where(price > b, np.inf, -np.inf))
        return np.clip(wanted, p_min, p_max)

    low, high = float(np.min(b + 2.0 * a * p_min)) - 1.0, float(np.max(b + 2.0 * a * p_max)) + 1.0
    if p_max.sum() - p_min.sum() <= 0.0:
        return p_min.copy()
    # Imported here, because the process of the dispatch starts with each run and does not need it.
    from scipy.optimize import brentq

    price = brentq(lambda x: float(outputs(x).sum()) - demand, low, high, xtol=1e-13)
    return balanced(units, outputs(price), demand)


def without_ripples(units: Units) -> Units:
    """Return the same units with e = 0."""
    table = units.table.copy()
    table[:, 5] = 0.0
    return Units(units.ids, table)


def repaired(units: Units, P: Array, demand: float) -> Array:
    """Distribute the missing demand over all units in proportion to their remaining range."""
    P = np.clip(P, units.p_min, units.p_max)
    remaining = demand - float(P.sum())
    room = units.p_max - P if remaining > 0.0 else P - units.p_min
    total = float(room.sum())
    return P + remaining * room / total if total > 0.0 else P


def swarm(
    units: Units, demand: float, algorithm: Baseline, seed: int | Sequence[int], n_pop: int, n_iter: int
) -> Array:
    """Dispatch by a metaheuristic of `softrig_optim`, each candidate repaired onto the balance.

    Parameters
    ----------
    demand : float
        MW, feasible.
    algorithm : str
        One of `BASELINES`.
    seed : int or sequence of int
    n_pop, n_iter : int
        Population and iterations.

    Returns
    -------
    ndarray, shape (n,)
        The best found, MW.
    """
    free = units.p_max > units.p_min  # a search needs a range

    def dispatch(x: tuple[float, ...]) -> Array:
        P = units.p_min.copy()
        P[free] = x
        return repaired(units, P, demand)

    if not free.any():
        return units.p_min.copy()
    settings = AlgorithmParams(n_pop=n_pop, n_iter=n_iter)
    rng = np.random.default_rng(seed)
    search = make(algorithm, units.p_min[free].tolist(), units.p_max[free].tolist(), rng, settings, maximise=False)
    best = run(search, lambda x: units.total(dispatch(x)))
    return balanced(units, dispatch(best.x), demand)
