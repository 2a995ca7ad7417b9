"""Searches for the minimum of F(x): grid and bounded Brent, swarms, whole samples."""

from __future__ import annotations

from typing import Literal

import numpy as np

from .equations import objectives_integer
from .objective import Objective


def brent(work: Objective, mode: int) -> tuple[float, float]:
    """Search on a grid, then by bounded Brent in the two cells beside its lowest point; return x (km) and F (V)."""
    from scipy.optimize import minimize_scalar

    curve = work.curve(mode)
    k = int(np.argmin(curve))
    low, high = work.grid[max(k - 1, 0)], work.grid[min(k + 1, curve.size - 1)]
    result = minimize_scalar(
        lambda x: float(work.f(np.array([x]), mode)[0]),
        bounds=(low, high),
        method="bounded",
        options={"xatol": work.p.tolerance},
    )
    # Brent's method never evaluates the ends of its interval, where the minimum may be.
    if curve[k] < result.fun:
        return float(work.grid[k]), float(curve[k])
    return float(result.x), float(result.fun)


def swarm(work: Objective, mode: int) -> tuple[float, float]:
    """Whale or grey wolf search on [0, L], a generation at a time (Mirjalili and Lewis 2016, Mirjalili et al. 2014)."""
    from softrig_optim.algorithms import AlgorithmParams

    from ...baselines.algorithms import make

    p = work.p
    algorithm: Literal["woa", "gwo"] = "woa" if p.algorithm == "woa" else "gwo"
    settings = AlgorithmParams(n_pop=p.n_pop, n_iter=p.n_iter)
    search = make(algorithm, [0.0], [work.section.length], work.rng, settings, maximise=False)
    while not search.done:
        for value in work.f(np.array(search.pending)[:, 0], mode).tolist():
            search.tell(value)
    return float(search.result[0]), float(search.expected)


def integer_grid(work: Objective, mode: int) -> tuple[float, float]:
    """Whole-sample delays n = 0 ... T rate (15): x is a multiple of v/rate."""
    out = np.empty(int(work.travel) + 1)
    objectives_integer(work.model, work.ends(mode), work.record.rate, work.first, work.count, out)
    work.evaluations += out.size
    n = int(np.argmin(out))
    return n * work.model.v / work.record.rate, float(out[n])
