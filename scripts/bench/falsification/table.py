"""The table: median runs to a violation over twenty seeds, for each problem and method."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import median

import numpy as np
from softrig_bringup.falsify.search import Point
from softrig_core.judge.formula import read
from softrig_core.judge.robustness import Record
from softrig_core.timebase import SECOND

from . import cars, f16, steam, transmission
from .linear import worst_linear_loop
from .methods import METHODS, Problem, runs_to_violation

BUDGET = 300
SEEDS = range(200, 220)  # seeds 0 to 9 were used to choose the search
SCALE = {"rpm": 100.0}  # scale of rpm, so that its margins are comparable with those in mph


def problems() -> list[Problem]:
    """Return all problems, from the own linear loop to the public ones."""
    result = [worst_linear_loop()]
    for model in (transmission, cars, steam, f16):
        low, high = (np.concatenate([np.full(i[3], i[k]) for i in model.INPUTS]) for k in (1, 2))
        groups = tuple(i[3] for i in model.INPUTS)
        names = model.signals(low)
        times = np.rint(np.arange(len(next(iter(names.values())))) * model.PERIOD * SECOND)
        for name, formula in model.REQUIREMENTS.items():
            for unit, size in SCALE.items():
                formula = formula.replace(f"{unit} <", f"{unit} / {size:g} < 1 / {size:g} *")
            tree = read(formula, dict.fromkeys(names))[0]

            def margin(point: Point, model=model, tree=tree, low=low, high=high, times=times) -> float:  # type: ignore[no-untyped-def]
                return Record(times, model.signals(low + np.array(point) * (high - low))).margin(tree).value

            result.append(Problem(name, margin, groups))
    return result


def print_table(wanted: tuple[str, ...] = (), budget: int = BUDGET, seeds: Sequence[int] = SEEDS) -> None:
    """Runs until falsify violates public problems (ARCH-COMP), beside other searches, median of twenty seeds."""
    print(f"at most {budget} runs, median of {len(seeds)} seeds (found in how many of them)")
    print(f"  {'':8}" + "".join(f"{method:>16}" for method in METHODS), flush=True)
    for problem in problems():
        if wanted and problem.name not in wanted:
            continue
        cells = []
        for method in METHODS:
            runs = [runs_to_violation(problem, method, budget, seed) for seed in seeds]
            middle = median(runs)
            cells.append(
                f"{'> ' + str(budget) if math.isinf(middle) else f'{middle:g}'} ({len(runs) - runs.count(math.inf)})"
            )
        print(f"  {problem.name:8}" + "".join(f"{cell:>16}" for cell in cells), flush=True)
