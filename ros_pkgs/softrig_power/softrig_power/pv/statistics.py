"""Many runs of the trackers: hits, efficiency, times. A tool, not a node.

``softrig node softrig_power mppt_statistics --pattern pattern2 --runs 40`` repeats the paper's count of 40 runs.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from softrig_core.errors import ScenarioError
from softrig_core.rig.metrics import settling_time
from softrig_core.rig.scenario import load_scenario
from softrig_core.rig.simulate import simulate
from softrig_optim.sweep import sweep

from . import figures
from .array import IRRADIANCE

PATTERNS = {"pattern1": (1000.0, 800.0, 600.0, 400.0), "pattern2": (1000.0, 800.0, 500.0, 300.0)}
KINDS = (*PATTERNS, "draws_pattern1", "draws_pattern2", "draws_random")
ALGORITHMS = ("issa", "ssa", "pso", "fa", "fa_all_pairs", "de_rand1", "de_best1", "gwo", "woa",
              "certified", "certified_transients", "ramp")  # fmt: skip
PUBLISHED_HITS = {"issa": 24, "ssa": 24, "pso": 23, "fa_all_pairs": 22, "de_best1": 15}  # of 40, pattern 2
PERIOD = 0.04  # s: search times are counted in it, and the final efficiency is the mean over the last one
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
    signals = simulate(scenario, seed=case.seed).signals
    t, phase = signals["mppt/status/phase/position"]
    holds = np.flatnonzero(phase == 2.0)
    return Outcome(
        hit=figures.in_global_basin(signals) == 1.0,
        efficiency=figures.efficiency(signals, start=scenario.duration - PERIOD) / 100.0,
        energy_share=figures.efficiency(signals) / 100.0,
        settling_time=settling_time(signals, figures.POWER, at="sample"),
        search_time=float(t[holds[0]]) if holds.size else float("inf"),
        restarts=int(signals["mppt/status/restarts/position"].x[-1]),
    )


def conditions(irradiance: Sequence[float], temperature: Sequence[float]) -> dict[str, Any]:
    """Give the overrides that put plant and source into these conditions."""
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
            nominal = (np.array(PATTERNS[kind]), np.full(4, 25.0))
            g, t = (x * (1.0 + SPREAD * rng.uniform(-1.0, 1.0, 4)) for x in nominal)
        load = {"pv_plant.converter.R_L": LOADS[k % len(LOADS)]}
        found.append(conditions(np.minimum(g, IRRADIANCE[1]).tolist(), t.tolist()) | load)
    return found


class Summary(NamedTuple):
    """Many outcomes of one algorithm: counts, and means of efficiency and energy share (1) and times (s)."""

    runs: int
    hits: int
    above_99: int
    above_999: int
    lowest: float
    energy_share: float
    settling_time: float
    search_periods: float
    most_periods: float
    restarts: int


def summarise(outcomes: Sequence[Outcome]) -> Summary:
    """Count and average."""
    efficiency = np.array([o.efficiency for o in outcomes])
    periods = [o.search_time / PERIOD for o in outcomes]
    return Summary(
        runs=len(outcomes),
        hits=sum(o.hit for o in outcomes),
        above_99=int((efficiency > 0.99).sum()),
        above_999=int((efficiency > 0.999).sum()),
        lowest=float(efficiency.min()),
        energy_share=float(np.mean([o.energy_share for o in outcomes])),
        settling_time=float(np.mean([o.settling_time for o in outcomes])),
        search_periods=float(np.mean(periods)),
        most_periods=max(periods),
        restarts=sum(o.restarts for o in outcomes),
    )


def cases(algorithm: str, kind: str, count: int, seed: int, overrides: Mapping[str, Any]) -> list[Case]:
    """Give the cases of one algorithm: `count` seeds of one pattern, or of `count` draws (see `KINDS`)."""
    mine = {"mppt_optimizer.algorithm": algorithm, **overrides}
    scenario = "pv_mppt_fa" if algorithm == "fa_all_pairs" else "pv_mppt"  # it needs more than 3 s
    if kind in PATTERNS:
        return [Case(scenario, conditions(PATTERNS[kind], [25.0] * 4) | mine, seed + k) for k in range(count)]
    drawn = draws(kind.removeprefix("draws_"), count, seed)
    return [Case(scenario, found | mine, seed + k) for k, found in enumerate(drawn)]


def main(args: Sequence[str] | None = None) -> int:
    """Print one line an algorithm."""
    parser = argparse.ArgumentParser(prog="mppt_statistics", description=main.__doc__)
    parser.add_argument("--pattern", choices=KINDS, default="pattern2", help="one pattern, or draws round it or random")
    parser.add_argument("--algorithms", nargs="+", choices=ALGORITHMS, default=ALGORITHMS, metavar="NAME")
    parser.add_argument("--runs", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first run and of the draws")
    parser.add_argument("--set", action="append", default=[], metavar="NODE.PARAMETER=VALUE", dest="overrides")
    parser.add_argument("--workers", type=int, help="processes on this machine; all cores when absent")
    parser.add_argument("--scheduler", default="", help="address of a Dask scheduler instead")
    given = parser.parse_args(args)
    try:
        overrides = dict(_override(text) for text in given.overrides)
        everything = [c for a in given.algorithms for c in cases(a, given.pattern, given.runs, given.seed, overrides)]
        outcomes = sweep(run_case, everything, title="runs", workers=given.workers, scheduler=given.scheduler)
    except (ScenarioError, ImportError) as error:
        print(f"mppt_statistics: {error}", file=sys.stderr)
        return 2
    titles = ("hits", "published", ">99 %", ">99.9 %", "lowest %", "energy %", "settling s", "periods", "most")
    print(f"{'algorithm':22}" + "".join(f"{title:>11}" for title in titles))
    for k, algorithm in enumerate(given.algorithms):
        s = summarise(outcomes[k * given.runs : (k + 1) * given.runs])
        known = given.pattern == "pattern2" and given.runs == 40
        published = PUBLISHED_HITS.get(algorithm, "") if known else ""
        print(f"{algorithm:22}{s.hits:11}{published:>11}{s.above_99:11}{s.above_999:11}{100 * s.lowest:11.3f}", end="")
        print(f"{100 * s.energy_share:11.2f}{s.settling_time:11.3f}{s.search_periods:11.1f}{s.most_periods:11.1f}")
    return 0


def _override(text: str) -> tuple[str, Any]:
    """Read one ``node.parameter=value``; the value is YAML."""
    from ruamel.yaml import YAML

    name, equals, value = text.partition("=")
    if not equals:
        raise ScenarioError(f"--set {text}: expected node.parameter=value")
    return name, YAML(typ="safe", pure=True).load(value)


if __name__ == "__main__":
    sys.exit(main())
