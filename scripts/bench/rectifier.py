"""Time of the rectifier's control step and plant."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from softrig_control.predictive.qp import MoveSolver
from softrig_core import ByHand
from softrig_power.rectifier.controller import RectifierGpc
from softrig_power.rectifier.parameters import RectifierConstants
from softrig_power.rectifier.plant import RectifierPlant

from .timing import cpu

NS = 830_000
LAWS: dict[str, dict[str, Any]] = {
    "closed form": {},
    "DAQP": {"solver": "daqp", "du_max": 2.0},
}
PLANTS: dict[str, dict[str, Any]] = {
    "averaged dq": {"model": "averaged_dq"},
    "averaged abc": {"model": "averaged_abc"},
    "switched, 10 kHz": {"model": "switched"},
    "switched, 20 kHz": {"model": "switched", "carrier_hz": 2e4},
}


def percentiles(call: Callable[[int], object], n: int) -> tuple[float, float]:
    """Return median and 99th percentile of the time of a call in us."""
    times = []
    for k in range(n):
        begin = time.perf_counter()
        call(k)
        times.append(time.perf_counter() - begin)
    median, high = np.percentile(times, [50, 99]) * 1e6
    return float(median), float(high)


def control_step(values: dict[str, Any], n: int) -> tuple[float, float]:
    """Time the block's step on a voltage that keeps its bounds busy; us."""
    law = ByHand(RectifierGpc(**values))
    y = [(400.0 + 8.0 * math.sin(0.3 * k), 25.0) for k in range(n)]
    return percentiles(lambda k: law.update(k * NS, measured=y[k], reference=None), n)


def programme(n: int) -> tuple[float, float]:
    """Time the solver alone on random programmes, 9 of 10 with an active bound; us."""
    solver = MoveSolver(RectifierGpc().law.hessian, 2.0)
    rng = np.random.default_rng(1)
    q, u = rng.normal(0.0, 8000.0, (n, 2)).tolist(), rng.uniform(-30.0, 80.0, n).tolist()
    return percentiles(lambda k: solver.solve(q[k], -40.0 - u[k], 90.0 - u[k]), n)


def plant(values: dict[str, Any], periods: int) -> float:
    """CPU time in s for one simulated second."""
    block, drop = ByHand(RectifierPlant(**values)), RectifierConstants().drop
    block.advance(0, command=(drop,), events=None)

    def run() -> None:
        for k in range(1, periods):
            block.outputs(k * NS)
            block.advance(k * NS, command=(drop,), events=None)

    return cpu(run) / ((periods - 1) * NS * 1e-9)


def print_table(steps: int = 3000) -> None:
    """A step of the rectifier's laws and of their solvers alone; one simulated second of its plants.

    Parameters
    ----------
    steps : int
        How many steps are timed.
    """
    print(f"{'control step of the block':30}{'median us':>12}{'99 % us':>12}")
    for name, values in LAWS.items():
        print("{:30}{:12.1f}{:12.1f}".format(name, *control_step(values, steps)))
    print(f"{'programme alone, 2 moves':30}{'median us':>12}{'99 % us':>12}")
    print("{:30}{:12.1f}{:12.1f}".format("DAQP", *programme(steps)))
    print(f"{'plant':30}{'CPU s per simulated s':>24}")
    for name, values in PLANTS.items():
        print(f"{name:30}{plant(values, max(2, steps // 5)):24.3f}")
