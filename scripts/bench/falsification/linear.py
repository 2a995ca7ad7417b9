"""The ideal motor under PID, which is linear: its worst load is known, and a bound 1 % below it must be violated."""

from __future__ import annotations

import numpy as np
from softrig_bringup.falsify.search import Point
from softrig_bringup.falsify.space import parse, space_of
from softrig_bringup.study.work import run, trial
from softrig_core import Scenario, simulate

from .methods import Problem

PIECES, LOAD = 20, 1e-3
SHARE = 0.99  # of the worst deviation


def linear_loop(times: list[float], torques: list[float], bound: float = 0.0) -> Scenario:
    """Create the motor with a load torque in steps; bounded speed is required."""
    plant = {"period": 0.01, "load_times": times, "load_torques": torques}
    gains = {"period": 0.01, "kp": 1.0, "ki": 10.0, "kd": 0.0}
    nodes = {
        "plant": {"package": "softrig_drives", "executable": "dc_motor_plant", "parameters": plant},
        "reference": {
            "package": "softrig_control",
            "executable": "reference_source",
            "parameters": {"period": 0.1, "velocities": [0.0]},
            "remap": {"reference": "motor/reference"},
        },
        "pid": {"package": "softrig_drives", "executable": "dc_motor_pid", "parameters": gains},
    }
    return Scenario.model_validate(
        {
            "name": "linear_loop",
            "title": "",
            "system": "dc_motor",
            "source": "",
            "duration": 0.1 * PIECES,
            "nodes": nodes,
            "shared": {"speed": "motor/state/shaft/velocity"},
            "requirements": {"deviation": f"always abs(speed) <= {bound!r}"},
        }
    )


def worst_linear_loop() -> Problem:
    """Return the loop with its bound; the worst load is the sign of the response, piece by piece, from the end."""
    times = [0.1 * k for k in range(PIECES)]
    response = simulate(linear_loop([0.0, 0.1], [LOAD, 0.0])).signals["motor/state/shaft/velocity"].x
    bound = max(float(np.abs(response[k::10]).sum()) for k in range(10))  # the load can change every 0.1 s
    space = space_of(
        linear_loop(times, [0.0] * PIECES, SHARE * bound), [parse("plant.load_torques", f"{-LOAD}..{LOAD}*{PIECES}")]
    )

    def margin(point: Point) -> float:
        row = run(trial(space.scenario, space.overrides(point), ("deviation",)))
        return float(row["figures"]["deviation"])

    return Problem("linear", margin, (PIECES,))
