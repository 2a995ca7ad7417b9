"""Many runs of the trackers: hits, efficiency, times. A tool, not a node."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from softrig_core.errors import ScenarioError
from softrig_core.inprocess import run_inprocess
from softrig_core.recording import Recording
from softrig_core.rig import Rig
from softrig_core.scenario import load_scenario
from softrig_core.signals import Signals
from softrig_optim.sweep import sweep

from . import metrics
from .array import IRRADIANCE

PATTERNS = {"pattern1": (1000.0, 800.0, 600.0, 400.0), "pattern2": (1000.0, 800.0, 500.0, 300.0)}
ALGORITHMS = ("issa", "ssa", "pso", "fa", "fa_all_pairs", "de_rand1", "de_best1", "gwo", "woa",
              "certified", "certified_transients", "ramp")  # fmt: skip
PERIOD = 0.04  # s, in which search times are counted
LOADS = (25.0, 35.0, 45.0)  # ohm
SPREAD = 0.15


class Case(NamedTuple):
    """One run: scenario, its overrides, seed."""

    scenario: str
    overrides: Mapping[str, Any]
    seed: int


class Outcome(NamedTuple):
    """What one run gave: hit of the global basin, final efficiency and energy share (1), times (s)."""

    hit: bool
    efficiency: float
    energy_share: float
    settling_time: float
    search_time: float
    restarts: int


def run_case(case: Case) -> Outcome:
    """Run one case in this process."""
    scenario = load_scenario(case.scenario, case.overrides)
    rig = Rig.from_scenario(scenario)
    recording = Recording([(topic, port.msgtype) for topic, port in rig.topics.items()])
    run_inprocess(rig, case.seed, recording)
    signals = Signals(recording)
    t, phase = signals["mppt/status/phase/position"]
    holds = np.flatnonzero(phase == 2.0)
    return Outcome(
        hit=metrics.in_global_basin(signals) == 1.0,
        efficiency=metrics.efficiency(signals, start=scenario.duration - PERIOD) / 100.0,
        energy_share=metrics.efficiency(signals) / 100.0,
        settling_time=metrics.settling_time(signals),
        search_time=float(t[holds[0]]) if holds.size else float("inf"),
        restarts=int(signals["mppt/status/restarts/position"].x[-1]),
    )


def conditions(irradiance: Sequence[float], temperature: Sequence[float]) -> dict[str, Any]:
    """Give the overrides that put plant, source and metrics into these conditions."""
    values = {"irradiance": list(irradiance), "temperature": list(temperature)}
    return {f"{node}.{key}": value for node in ("pv_plant", "shading_source") for key, value in values.items()}


def draws(kind: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Draw overrides for `count` cases: conditions, and a load that no tracker knows.

    Parameters
    ----------
    kind : {"pattern1", "pattern2", "random"}
        Irradiance and temperature (25 deg C) of a pattern, each value times 1 + 0.15 u with u uniform in [-1, 1]; or
        irradiance uniform in 100 to 1000 W/m^2 at 25 deg C.
    """
    rng = np.random.default_rng(seed)
    found = []
    for k in range(count):
        if kind == "random":
            g, t = rng.uniform(100.0, 1000.0, 4), np.full(4, 25.0)
        else:
            g, t = (x * (1.0 + SPREAD * rng.uniform(-1.0, 1.0, 4)) for x in (np.array(PATTERNS[kind]), np.full(4, 25.0)))
        load = {"pv_plant.converter.R_L": LOADS[k % len(LOADS)]}
        found.append(conditions(np.minimum(g, IRRADIANCE[1]).tolist(), t.tolist()) | load)
    return found


def cases(algorithm: str, kind: str, count: int, seed: int, overrides: Mapping[str, Any]) -> list[Case]:
    """Give the cases of one algorithm: `count` seeds of one pattern, or `count` draws."""
    mine = {"mppt_optimizer.algorithm": algorithm, **overrides}
    if kind in PATTERNS:
        return [Case("pv_mppt", conditions(PATTERNS[kind], [25.0] * 4) | mine, seed + k) for k in range(count)]
    drawn = draws(kind.removeprefix("draws_"), count, seed)
    return [Case("pv_mppt", found | mine, seed + k) for k, found in enumerate(drawn)]
