"""Drives of three-phase machines beside motulator on the same duty ratios: distance and speed."""

from __future__ import annotations

import os
import sys
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Recording, Signals, load_scenario, rig_of, run_inprocess

from .peers import MANY, asked
from .timing import cpu

# All shipped sets of constants except saturated machines, for which motulator interpolates by other formulas.
MACHINES = {
    "pmsm_foc": "pmsm_plant",
    "im_foc": "induction_plant",
    **dict.fromkeys(
        ["pmsm_field_weakening", *(f"pmsm_foc_{n}" for n in ("servo", "traction", "pmsyrm", "synrm_gem", "synrm_msl"))],
        "pmsm_plant",
    ),
    **dict.fromkeys(["im_vhz", "im_foc_1kw", "im_foc_4kw", "im_foc_krause"], "induction_plant"),
}
CONSTANTS = {
    "pmsm_plant": ("R_s", "L_d", "L_q", "psi_f", "pole_pairs"),
    "induction_plant": ("R_s", "R_R", "L_sigma", "L_M", "pole_pairs"),
}
ROUNDS = 3
TIGHT = 1e-11  # relative tolerance of motulator's solver in comparisons of trajectories


class Beside(NamedTuple):
    """CPU (s) of a simulated second: ours with control and record, motulator's plant as it is; largest distances."""

    ours: float
    theirs: float
    current: float
    speed: float


def duty_ratios(name: str, seconds: float) -> tuple[dict[str, Any], Signals]:
    """Run a drive; return the inputs of its machine, and its signals."""
    rig = rig_of(load_scenario(name, {f"{MACHINES[name]}.substeps": 8}).model_copy(update={"duration": seconds}))
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, 1, recording)
    signals = Signals(recording)
    applied = np.column_stack([signals[f"applied_duty/{leg}/effort"].x for leg in "abc"])
    when, load = signals["load_torque/shaft/effort"]
    node = MACHINES[name]
    p = next(m.params for m in rig.members if m.name == node)
    begins = p.period * np.arange(len(applied) - 1)
    held = load[np.searchsorted(when, begins + 1e-9, side="right") - 1]
    names = (*CONSTANTS[node], "period", "U_dc", "J", "B")
    given = {"machine": node, "duties": applied[1:].tolist(), "load": held.tolist()}
    return given | {n: getattr(p, n) for n in names}, signals


def peer(given: dict[str, Any], python: str) -> dict[str, Any] | None:
    """Run `machines_peers` with another Python; None when that does not have motulator."""
    result: dict[str, Any] | None = asked("machines_peers", "motulator", given, python)
    return result


def beside(name: str, python: str, seconds: float) -> Beside | None:
    """Hold a drive against motulator; None where that is not installed."""
    given, signals = duty_ratios(name, seconds)
    tight = peer({**given, "rtol": TIGHT}, python)
    plain = peer({**given, "rtol": 0.0}, python)
    if tight is None or plain is None:
        return None
    theirs = np.array(tight["rows"])[: len(given["duties"])]
    results = [signals[s].x[: len(theirs)] for s in ("currents/x", "currents/y", "joint_states/shaft/velocity")]
    apart = np.abs(np.column_stack(results) - theirs).max(axis=0)
    rig = rig_of(load_scenario(name).model_copy(update={"duration": seconds}))
    topics = [(t, p.msgtype) for t, p in rig.topics.items()]
    run_inprocess(rig, 1, Recording(topics), runs=MANY)
    ours = min(cpu(lambda: run_inprocess(rig, 1, Recording(topics), runs=MANY)) for _ in range(ROUNDS))
    return Beside(ours / seconds, plain["cpu_s"] / seconds, float(max(apart[:2])), float(apart[2]))


def print_table() -> None:
    """Field-oriented drives beside motulator on the same duty ratios, where it is installed.

    ``SOFTRIG_PEERS`` in the environment: an interpreter that has it.
    """
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    for name in MACHINES:
        result = beside(name, python, 0.5)
        if result is None:
            print(f"{name:12} motulator is not installed")
            continue
        print(
            f"{name:12} {result.ours:8.4f} s natively with its law and record, motulator's plant "
            f"{result.theirs:7.2f} s, "
            f"{result.theirs / result.ours:6.0f} x; apart by {result.current:.1e} A and {result.speed:.1e} rad/s"
        )
