"""Steps a second of a rig as an environment of an agent, beside gym-electric-motor's and one in JAX."""

from __future__ import annotations

import os
import sys

import numpy as np
from softrig_core import RigEnv, RigVectorEnv, run_inprocess

from .console import console
from .induction import drive, peer, switching
from .induction_peers import LEGS
from .timing import least

SECONDS = 0.5
MANY = 256


def rates(seconds: float = SECONDS) -> dict[str, float]:
    """Measure steps a CPU second: the drive by itself, and with an agent that plays its switching back.

    Parameters
    ----------
    seconds : float
        Simulated, s; the fastest of five.
    """
    actions = [np.array(LEGS[v], dtype=float) for v in switching(seconds)[0]]
    legs = [f"switches/{leg}/effort" for leg in ("Sa", "Sb", "Sc")]
    rig = drive(seconds)
    environment = RigEnv(rig, "dtc_controller", act=dict.fromkeys(legs, (0.0, 1.0)), reward=lambda now: 0.0)

    def episode() -> None:
        environment.reset(seed=1)
        for action in actions[:-1]:  # the law does not publish at the end
            environment.step(action)

    many = RigVectorEnv(
        rig,
        "dtc_controller",
        act=dict.fromkeys(legs, (0.0, 1.0)),
        num_envs=MANY,
        reward=lambda now: -abs(now["joint_states/shaft/velocity"]),
    )
    many.reset(seed=1)
    begin = iter([np.broadcast_to(action, (MANY, 3)) for action in actions])
    moves = len(actions) // 6 - 1

    def all_move() -> None:
        for _ in range(moves):
            many.step(next(begin))

    run = least(lambda: run_inprocess(rig, 1))
    return {
        "rig in process, with its law": len(actions) / run,
        "RigEnv, an agent in its place": len(actions) / least(episode),
        f"RigVectorEnv, {MANY} of them": MANY * moves / least(all_move),
    }


def print_table() -> None:
    """Steps a second of the induction drive as an environment, beside gym-electric-motor's and JAX where installed.

    ``SOFTRIG_PEERS`` in the environment: an interpreter that has them.
    """
    results: dict[str, float | None] = {**rates()}
    vectors, _ = switching(SECONDS)
    for name, title, times in (
        ("gym-electric-motor", "gym-electric-motor, Finite-SC-SCIM-v0, Euler", 1),
        ("jax", f"JAX, the same plants written for it, {MANY} of them", MANY),
    ):
        theirs = peer(name, vectors, os.environ.get("SOFTRIG_PEERS", sys.executable))
        results[title] = None if theirs is None else times * len(vectors) / theirs["cpu_s"]
    for name, rate in results.items():
        console.print(f"{name:52} " + ("not installed" if rate is None else f"{rate:10,.0f} steps/s"))
