"""`softrig results`: every claim of the papers held against what is measured now."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from softrig_core import RunError, Scenario, ScenarioError, list_scenarios, load_scenario, simulate
from softrig_core.guard import say
from softrig_core.rig.findings import Finding, findings, needed, values
from softrig_optim.sweep import progress, stream

from .folder import replace


class Measured(NamedTuple):
    """Figures of one scenario in process: values, units, which missed what the scenario expects, or why it broke."""

    name: str
    figures: dict[str, float]
    units: dict[str, str]
    missed: list[str]
    error: str


def measure(name: str) -> Measured:
    """Run a scenario in this process and measure its figures."""
    try:
        run = simulate(name)
    except (RunError, ScenarioError) as error:
        return Measured(name, {}, {}, [], str(error))
    results = run.results
    units = {r.name: r.unit for r in results}
    return Measured(name, values(results), units, [r.name for r in results if not r.passed], "")


def claiming(systems: Sequence[str] = ()) -> list[Scenario]:
    """Give the scenarios with claims, all or those of some systems.

    Parameters
    ----------
    systems : sequence of str
        Names of systems as scenarios give them, or beginnings of scenario names.

    Raises
    ------
    ScenarioError
        Nothing is called so.
    """
    scenarios = [load_scenario(name) for name in list_scenarios()]
    for system in systems:
        if not any(_belongs(s, system) for s in scenarios):
            known = sorted({s.system for s in scenarios})
            raise ScenarioError(f"no system {system!r}; there are {', '.join(known)}")
    return [s for s in scenarios if s.claims and (not systems or any(_belongs(s, system) for system in systems))]


def _belongs(scenario: Scenario, system: str) -> bool:
    return scenario.system == system or scenario.name == system or scenario.name.startswith(f"{system}_")


def gather(scenarios: Iterable[Scenario], workers: int | None = None) -> tuple[list[Finding], dict[str, Measured]]:
    """Run what the claims of some scenarios need, on all cores, and hold each claim against it.

    Returns
    -------
    findings : list of Finding
        In the order of the scenarios and of the claims in them.
    measured : dict of str to Measured
        By scenario, what was run.
    """
    scenarios = list(scenarios)
    names = sorted(set().union(*(needed(s) for s in scenarios)))
    measured: dict[str, Measured] = {}
    with progress("scenarios", len(names)) as advance:
        for _, found in stream(measure, names, workers=workers):
            measured[found.name] = found
            advance()

    def figures(name: str) -> dict[str, float] | None:
        found = measured.get(name)
        return None if found is None or found.error else found.figures

    rows = [f for s in scenarios for f in findings(s, figures, measured[s.name].units)]
    return rows, measured


def study_findings(
    systems: Sequence[str], out: Path, workers: int | None = None
) -> tuple[list[Scenario], list[Finding]]:
    """Run the studies with claims, or go on with them, and hold their claims.

    Returns
    -------
    scenarios : list of Scenario
        Each study's scenario under the name of the study.
    findings : list of Finding
    """
    from .study.definition import list_studies, load_study
    from .study.engine import run_study
    from .study.table import claims, results, without_signals

    scenarios, rows = [], []
    for study in map(load_study, list_studies()):
        scenario = load_scenario(study.scenario)
        if not study.claims or (systems and not any(_belongs(scenario, system) for system in systems)):
            continue
        done = without_signals(run_study(study, out / study.name, workers=workers).rows())
        rows += claims(study, results(study, done))
        scenarios.append(scenario.model_copy(update={"name": study.name, "source": study.source or scenario.source}))
    return scenarios, rows


def main(systems: Sequence[str], out: Path, workers: int | None = None, *, studies: bool = False) -> int:
    """Write results.html and results.md into a directory; 1 when a verdict is false or cannot be checked."""
    from .results_page import counts, html, markdown

    scenarios = claiming(systems)
    if not scenarios:
        raise ScenarioError("no scenario has claims")
    out.mkdir(parents=True, exist_ok=True)
    if not os.access(out, os.W_OK | os.X_OK):  # said before the runs, not after them
        raise ScenarioError(f"{out}: cannot be written into; choose another --out")
    rows, measured = gather(scenarios, workers)
    if studies:
        more, held = study_findings(systems, out / "studies", workers)
        scenarios, rows = scenarios + more, rows + held
    replace(out / "results.html", html(scenarios, rows))
    replace(out / "results.md", markdown(scenarios, rows))
    print(counts(rows))
    status = 0
    for found in measured.values():
        if found.error or found.missed:
            say(f"{found.name}: {found.error or 'missed: ' + ', '.join(found.missed)}")
            status = 3 if found.error else max(status, 1)
    for row in rows:
        if not row.holds:
            say(f"{row.scenario}: claim {row.key}: {row.false}")
            status = max(status, 1)
    print(f"wrote {out / 'results.html'} and {out / 'results.md'}")
    return status
