"""One run of a search: what margins it leaves."""

from __future__ import annotations

import math
import time
from typing import Any, NamedTuple

from softrig_core import RunError, Scenario, ScenarioError, simulate

from ..study.draw import Case

LARGE = 1e300  # stands for infinity in rows of JSON


class Trial(NamedTuple):
    """A run of the search; travels to the worker.

    Parameters
    ----------
    number : int
    scenario : Scenario
    overrides : dict
    requirements : tuple of str
        Whose margins are wanted: requirements, and figures of which a bound is expected.
    runs : int
        So many of its kind are to come, at most.
    """

    number: int
    scenario: Scenario
    overrides: dict[str, Any]
    requirements: tuple[str, ...]
    runs: int = 1

    @property
    def case(self) -> Case:
        """What it is to a log of runs."""
        return Case(self.number, self.scenario.name, "", self.overrides, self.scenario.seed)


def run(trial: Trial) -> dict[str, Any]:
    """Run a trial in this process and give its row, that of a study whose figures are the requirements' margins.

    A run that breaks has margins of None and its error; one whose parameters do not fit each other as well.
    """
    started = time.perf_counter()
    row = trial.case._asdict() | {"figures": dict.fromkeys(trial.requirements), "passed": False, "error": ""}
    try:
        done = simulate(trial.scenario, overrides=trial.overrides, runs=trial.runs)
    except (RunError, ScenarioError) as error:
        return row | {"error": str(error), "wall_s": time.perf_counter() - started}
    found = {r.name: r for r in done.results}
    for name in trial.requirements:
        result, bounds = found[name], trial.scenario.expect.get(name)
        formula = name in trial.scenario.requirements
        margin = result.number if bounds is None or formula else bounds.margin(result.number)
        row["figures"][name] = None if math.isnan(margin) else max(-LARGE, min(LARGE, margin))
        if math.isnan(margin):
            row["error"] = f"{name}: {result.error}"
    row["passed"] = all(m is not None and m >= 0.0 for m in row["figures"].values())
    return row | {"wall_s": time.perf_counter() - started}
