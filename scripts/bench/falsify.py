"""How many runs a search for a violation takes, beside random search, where the worst case is known."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from statistics import median

import numpy as np
from softrig_bringup.falsify.search import Found, Point, search
from softrig_bringup.falsify.space import Space, parse, space_of
from softrig_bringup.falsify.trial import Trial, run
from softrig_core import Scenario, simulate

PIECES, LOAD, BUDGET, SEEDS = 15, 1e-3, 300, 10


def linear_loop(times: list[float], torques: list[float]) -> Scenario:
    """Make the ideal motor under PID, which is linear, with a load torque in steps; bounded speed is required."""
    plant = {"period": 0.01, "load_times": times, "load_torques": torques}
    gains = {"period": 0.01, "kp": 1.0, "ki": 10.0, "kd": 0.0}
    nodes = {
        "plant": {"package": "softrig_drives", "executable": "dc_motor_plant", "parameters": plant},
        "reference": {"package": "softrig_control", "executable": "reference_source",
                      "parameters": {"period": 0.1, "velocities": [0.0]}, "remap": {"reference": "motor/reference"}},
        "pid": {"package": "softrig_drives", "executable": "dc_motor_pid", "parameters": gains},
    }  # fmt: skip
    return Scenario.model_validate({
        "name": "linear_loop", "title": "", "system": "dc_motor", "source": "", "duration": 0.1 * PIECES,
        "nodes": nodes, "shared": {"speed": "motor/state/shaft/velocity"},
        "requirements": {"deviation": "always abs(speed) <= 0"},
    })  # fmt: skip


def margins(space: Space, points: Sequence[Point]) -> list[float]:
    """Measure a batch of points."""
    return [run(Trial(0, space.scenario, space.overrides(p), ("deviation",)))["figures"]["deviation"] for p in points]


def runs_to(found: Found, deviation: float) -> float:
    """Give the number of runs after which a deviation is reached; infinite if it is not."""
    return next((k + 1 for k, least in enumerate(found.trace) if -least >= deviation), float("inf"))


def print_table() -> None:
    """Runs until 98 % of the worst deviation of a linear loop (the L1 norm) is found, median of ten seeds."""
    response = simulate(linear_loop([0.0, 0.01], [LOAD, 0.0])).signals["motor/state/shaft/velocity"].x
    bound = float(np.abs(response).sum())
    space = space_of(linear_loop([0.1 * k for k in range(PIECES)], [0.0] * PIECES),
                     [parse("plant.load_torques", f"{-LOAD}..{LOAD}*{PIECES}")])  # fmt: skip
    print(f"motor under PID, load torque of at most {LOAD:g} N m in {PIECES} steps, {BUDGET} runs, {SEEDS} seeds")
    for sampler in ("cmaes", "tpe", "random"):
        outcomes = [search(space.size, partial(margins, space), BUDGET, seed=s, sampler=sampler) for s in range(SEEDS)]
        best = [-o.least / bound for o in outcomes]
        needed = median(runs_to(o, 0.98 * bound) for o in outcomes)
        print(
            f"  {sampler:8s} found {min(best):.4f} to {max(best):.4f} of the norm; 98 % after {needed:g} runs (median)"
        )
