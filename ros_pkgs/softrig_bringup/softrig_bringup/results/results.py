"""`softrig check --claims`: every claim of the papers compared with present measurements."""

from __future__ import annotations

import argparse
import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from softrig_core import (
    Rig,
    RunError,
    Scenario,
    ScenarioError,
    list_scenarios,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.guard import is_quiet, print_line, replace
from softrig_core.kit.file_format import json_of
from softrig_core.verdict.findings import Finding, findings, needed, values
from softrig_optim.sweep import sweep

from ..folder import STUDY, ResultsFolder, alone_in
from ..page.junit import Case, Suite, write_reports
from ..run.run import illustrate, save, summary, versions
from ..study.definition import list_studies, load_study
from ..study.engine import OtherContentError, made_of, run_study
from ..study.table import claims, results, without_signals
from .page import command, counts, html, markdown

RESULTS = Path("runs/results")


class Measured(NamedTuple):
    """Figures of one scenario: values, units, missed expectations, or the reason of its failure."""

    name: str
    figures: dict[str, float]
    units: dict[str, str]
    missed: list[str]
    error: str
    kept: bool = False  # whether an earlier call with the same code and scenario has measured it
    seconds: float = 0.0  # wall-clock time of the run


def measure(work: tuple[str, Path | None]) -> Measured:
    """Run a scenario in this process and measure its figures, or return the stored result of such a run.

    Parameters
    ----------
    work : (str, Path or None)
        Its name, and the folder in which runs are kept by name: the run with pictures and report, and its figures.
    """
    name, folder = work
    try:
        rig = rig_of(name)
        target, key = (None, "") if folder is None else (folder / name, _key(rig))
        if target and (stored := _stored(target, key)):
            return stored
        run = simulate(rig, thorough=True)
    except (RunError, ScenarioError) as error:
        return Measured(name, {}, {}, [], str(error))
    results = run.results
    result = Measured(
        name, values(results), {r.name: r.unit for r in results}, [r.name for r in run.missed], "", seconds=run.wall_s
    )
    if target:
        cleared = _cleared(target)
        save(run, summary(run, results, command(name)), cleared, record=False)
        illustrate(run, cleared)
        replace(_figures(target), json.dumps({"key": key, "measured": result._asdict()}) + "\n")
    return result


def _cleared(path: Path) -> ResultsFolder:
    folder = ResultsFolder(path)
    folder.clear()
    return folder


def _figures(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.json")  # beside the folder of the run, which lists all files in it


def _key(rig: Rig) -> str:
    """Return a key of everything a run depends on: scenario, code, files that blocks read, libraries, machine."""
    code = made_of({}, [rig])
    libraries = {k: v for k, v in versions().items() if k != "commit"}
    text = json.dumps([rig.scenario.model_dump(mode="json"), code, libraries], sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


def _stored(folder: Path, key: str) -> Measured | None:
    try:
        content = json_of(_figures(folder).read_text())
        if content["key"] != key or not (folder / "report.html").is_file():
            return None
        return Measured(**content["measured"])._replace(kept=True)
    except (OSError, ValueError, KeyError, TypeError):
        return None


def claiming(systems: Sequence[str] = ()) -> list[Scenario]:
    """Return the scenarios with claims, all or those of some systems.

    Parameters
    ----------
    systems : sequence of str
        Names of systems as in scenarios, or beginnings of scenario names.

    Raises
    ------
    ScenarioError
        Nothing has such a name.
    """
    scenarios = [load_scenario(name) for name in list_scenarios()]
    for system in systems:
        if not any(_belongs(s, system) for s in scenarios):
            if Path(system).suffix in (".yaml", ".yml"):
                raise ScenarioError(f"--claims {system}: expected a system; `check {system}` judges a file's claims")
            known = sorted({s.system for s in scenarios})
            raise ScenarioError(f"no system {system!r}; there are {', '.join(known)}")
    return [s for s in scenarios if s.claims and (not systems or any(_belongs(s, system) for system in systems))]


def _belongs(scenario: Scenario, system: str) -> bool:
    return scenario.system == system or scenario.name == system or scenario.name.startswith(f"{system}_")


def gather(
    scenarios: Iterable[Scenario], workers: int | None = None, keep: Path | None = None
) -> tuple[list[Finding], dict[str, Measured]]:
    """Run the scenarios that the claims need, on all cores, and compare each claim with the result.

    Parameters
    ----------
    workers : int, optional
        All cores when absent.
    keep : Path, optional
        See `measure`.

    Returns
    -------
    findings : list of Finding
        In the order of the scenarios and of the claims in them.
    measured : dict of str to Measured
        By scenario, what was run.
    """
    scenarios = list(scenarios)
    names = sorted(set().union(*(needed(s) for s in scenarios)))
    if not is_quiet():
        print_line(f"{len(names)} scenarios are run, or read from the cache if nothing has changed")
    runs = sweep(measure, [(name, keep) for name in names], title="scenarios", workers=workers)
    measured = {result.name: result for result in runs}

    def figures(name: str) -> dict[str, float] | None:
        result = measured.get(name)
        return None if result is None or result.error else result.figures

    rows = [f for s in scenarios for f in findings(s, figures, measured[s.name].units)]
    return rows, measured


def study_findings(
    systems: Sequence[str], out: Path, workers: int | None = None
) -> tuple[list[Scenario], list[Finding]]:
    """Run the studies with claims, or resume them, and compare their claims.

    Returns
    -------
    scenarios : list of Scenario
        Each study's scenario under the name of the study.
    """
    scenarios, rows = [], []
    for study in map(load_study, list_studies()):
        scenario = load_scenario(study.scenario)
        if not study.claims or (systems and not any(_belongs(scenario, system) for system in systems)):
            continue
        try:
            log = run_study(study, out / study.name, workers=workers)
        except OtherContentError:
            # They are of another scenario or other code, and can be computed again.
            ResultsFolder(out / study.name, STUDY).clear()
            log = run_study(study, out / study.name, workers=workers)
        done = without_signals(log.rows())
        rows += claims(study, results(study, done, {}))
        scenarios.append(scenario.model_copy(update={"name": study.name, "source": study.source or scenario.source}))
    return scenarios, rows


def suites(rows: Sequence[Finding], measured: Mapping[str, Measured]) -> list[Suite]:
    """Return each scenario's claims as a suite of cases."""
    gathered: dict[str, list[Case]] = {}
    for row in rows:
        case = Case(
            f"claim {row.key}", "" if row.holds else row.false, f"{row.verdict}: {row.measured_text} {row.unit}"
        )
        gathered.setdefault(row.scenario, []).append(case)
    broken = {name: m.error for name, m in measured.items() if m.error}
    return [
        Suite(name, measured[name].seconds if name in measured else 0.0, gathered.get(name, ()), broken.get(name, ""))
        for name in dict.fromkeys([*gathered, *broken])
    ]


def left_out(systems: Sequence[str]) -> str:
    """Describe which claims are checked only with `--studies`; empty for none."""
    gathered = [s for s in map(load_study, list_studies()) if s.claims]
    gathered = [
        s for s in gathered if not systems or any(_belongs(load_scenario(s.scenario), name) for name in systems)
    ]
    more = sum(len(s.claims) for s in gathered)
    names = ", ".join(s.name for s in gathered)
    return f"{more} more claims are of studies ({names}): hundreds of runs, with --studies" if more else ""


def main(options: argparse.Namespace) -> int:
    """Write results.html and results.md into a directory; 1 when a verdict is false or cannot be checked."""
    systems, out = options.scenarios, options.out or RESULTS
    name = "_".join(["results", *systems])  # a page of some systems is written beside the page of all
    scenarios = claiming(systems)
    if not scenarios:
        raise ScenarioError("no scenario has claims")
    with alone_in(out):
        if not os.access(out, os.W_OK | os.X_OK):  # reported before the runs, not after them
            raise ScenarioError(f"{out}: cannot be written into; choose another --out")
        rows, measured = gather(scenarios, options.workers, out / "runs")
        without = "" if options.studies else left_out(systems)
        if options.studies:
            more, judged = study_findings(systems, out / "studies", options.workers)
            scenarios, rows = scenarios + more, rows + judged
        replace(out / f"{name}.html", html(scenarios, rows, without, out))
        replace(out / f"{name}.md", markdown(scenarios, rows, without))
    write_reports(options.junit, suites(rows, measured), options.json, [row.plain() for row in rows])
    unchanged = sum(m.kept for m in measured.values())
    if unchanged:
        print(f"{unchanged} of {len(measured)} runs are kept: neither code nor scenario has changed")
    print(counts(rows) + (f"; {without}" if without else ""))
    status = 0
    for result in measured.values():
        if result.error or result.missed:
            print_line(f"{result.name}: {result.error or 'missed: ' + ', '.join(result.missed)}")
            status = 3 if result.error else max(status, 1)
    for row in rows:
        if not row.holds:
            print_line(f"{row.scenario}: claim {row.key}: {row.false}")
            status = max(status, 1)
    print(f"wrote {out / f'{name}.html'} and {out / f'{name}.md'}")
    return status
