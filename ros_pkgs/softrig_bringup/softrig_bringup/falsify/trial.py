"""One run of a search: what margins it leaves."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from softrig_core import RunError, Scenario, ScenarioError, simulate

LARGE = 1e300  # stands for infinity in rows of JSON


class Trial(NamedTuple):
    """A run of the search; travels to the worker.

    Parameters
    ----------
    number : int
    scenario : Scenario
    overrides : dict
    requirements : tuple of str
        Whose margins are wanted.
    """

    number: int
    scenario: Scenario
    overrides: dict[str, Any]
    requirements: tuple[str, ...]


def run(trial: Trial) -> dict[str, Any]:
    """Run a trial in this process and give its row: the margin of each requirement, or why there is none.

    A run that breaks has margins of None and its error; one whose parameters do not fit each other as well.
    """
    row: dict[str, Any] = {"number": trial.number, "overrides": trial.overrides, "margins": {}, "error": ""}
    try:
        done = simulate(trial.scenario, overrides=trial.overrides)
    except (RunError, ScenarioError) as error:
        return row | {"margins": dict.fromkeys(trial.requirements), "error": str(error)}
    found = {r.name: r for r in done.results}
    for name in trial.requirements:
        result = found[name]
        row["margins"][name] = None if math.isnan(result.number) else max(-LARGE, min(LARGE, result.number))
        if math.isnan(result.number):
            row["error"] = f"{name}: {result.error}"
    return row
