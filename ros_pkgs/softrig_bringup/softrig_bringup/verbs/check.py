"""`softrig check`: figures, requirements and claims of many scenarios, for continuous integration."""

from __future__ import annotations

import argparse
import time
from typing import Any

from softrig_core import Run, RunError, ScenarioError, figures_of, load_scenario, rig_of, simulate
from softrig_core.guard import say
from softrig_core.verdict.figures import Result
from softrig_core.verdict.findings import Finding
from softrig_optim.sweep import sweep

from ..page.junit import Case, Suite, write_reports
from ..page.wording import NEVER, accepted, spans


def main(options: argparse.Namespace) -> int:
    """Run scenarios in process and judge them; 1 when something does not hold, 3 when a run broke."""
    names = options.scenarios
    for name in names:  # bad input of any of them is said before the first run
        figures_of(rig_of(load_scenario(name)))
    for path in (options.junit, options.json):
        if path is not None and not path.absolute().parent.is_dir():
            raise ScenarioError(f"{path}: there is no folder {path.absolute().parent}")
    outcomes = sweep(judge, names, title="check", workers=options.workers)
    suites = [suite_of(outcome) for outcome in outcomes]
    for suite in suites:
        bad = len(suite.failures)
        verdict = f"broke: {suite.error}" if suite.error else f"{len(suite.cases) - bad} hold, {bad} do not"
        print(f"{suite.name}: {verdict}")
        for case in suite.failures:
            print(f"  {case.name}: {case.failure}")
    write_reports(options.junit, suites, options.json, outcomes)
    if any(suite.error for suite in suites):
        say("a run broke")
        return 3
    return 1 if any(suite.failures for suite in suites) else 0


def judge(name: str) -> dict[str, Any]:
    """Run one scenario in this process and give what is to be said of it, as plain data."""
    started = time.perf_counter()
    try:
        return outcome_of(simulate(name, thorough=True), time.perf_counter() - started)
    except RunError as error:
        return {
            "scenario": load_scenario(name).name,
            "wall_s": time.perf_counter() - started,
            "metrics": [],
            "claims": [],
            "error": str(error),
        }


def outcome_of(run: Run, wall_s: float) -> dict[str, Any]:
    """Give what is to be said of a run, as plain data."""
    return {
        "scenario": run.rig.scenario.name,
        "wall_s": round(wall_s, 3),
        "error": run.error,
        "metrics": [] if run.error else [r.model_dump(by_alias=True) for r in run.results],
        "claims": [] if run.error else [_claim(c) for c in run.claims],
    }


def _claim(finding: Finding) -> dict[str, Any]:
    return finding.model_dump() | {"false": finding.false if finding.holds is False else ""}


def suite_of(outcome: dict[str, Any]) -> Suite:
    """Give an outcome as a suite of cases: what is judged, and the claims whose verdict was held against the run."""
    results = [Result.model_validate(r) for r in outcome["metrics"]]
    cases = [Case(r.name, "" if r.passed else _missed(r), _measured(r)) for r in results if r.judged]
    cases += [
        Case(f"claim {c['key']}", c["false"], c["measured_text"]) for c in outcome["claims"] if c["holds"] is not None
    ]
    return Suite(outcome["scenario"], outcome["wall_s"], cases, outcome["error"])


def _measured(result: Result) -> str:
    value = result.error or f"{result.value:.10g}"
    return f"{value} {result.unit}".rstrip()


def _missed(result: Result) -> str:
    where = f"; violated {spans(result.violated_s)}" if result.violated_s else ""
    value = "never" if result.error == NEVER else _measured(result)
    return f"{value}, expected {accepted(result)} {result.unit}".rstrip() + where
