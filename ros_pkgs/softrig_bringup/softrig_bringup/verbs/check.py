"""`softrig check`: expectations of many scenarios, claims of papers and golden bags, for continuous integration."""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from softrig_core import Run, RunError, Scenario, ScenarioError, figures_of, load_scenario, rig_of, simulate
from softrig_core.guard import print_line, replace
from softrig_core.run.purity import HIDDEN
from softrig_core.scenario.scenario_file import find, locate
from softrig_core.verdict.findings import Finding
from softrig_core.verdict.result import Result
from softrig_optim.sweep import sweep

from ..page.checked import checked
from ..page.html import write_page
from ..page.junit import Case, Suite, write_reports
from ..page.wording import NEVER, accepted, spans

# the options of each kind of judging, as they are declared
OWN = {"": ("against", "marks", "html"), "claims": ("out", "studies"), "golden": ("node", "bags")}
KEPT = ("figures", "expect", "claims", "requirements")  # sections that a scenario of --against keeps
COMPARED = ("nodes", "shared", "faults", "changes", "duration", "seed")  # sections that are compared besides them


class Judged(NamedTuple):
    """Scenario that one argument selects: its name in reports, and the scenario whose expectations apply."""

    name: str
    scenario: str
    against: str


def main(options: argparse.Namespace) -> int:
    """Run scenarios in process and judge them; 1 when something does not hold, 2 for bad input, 3 when a run broke."""
    kind = next((name for name in ("claims", "golden") if getattr(options, name)), "")
    for option, names in OWN.items():
        if wrong := [name for name in names if option != kind and getattr(options, name)]:
            subject = f"--{option}" if option else "scenarios"
            raise ScenarioError(f"--{wrong[0].replace('node', 'with')} belongs to `check` of {subject}")
    if kind == "claims":
        from ..results import results

        return results.main(options)
    if kind == "golden":
        from . import golden

        return golden.check(options)
    return _expectations(options)


def _expectations(options: argparse.Namespace) -> int:
    if not options.scenarios:
        raise ScenarioError("check: expected scenarios (names or files), --claims or --golden")
    for path in (options.junit, options.json, options.marks, options.html):
        if path is not None and not path.absolute().parent.is_dir():
            raise ScenarioError(f"{path}: there is no folder {path.absolute().parent}")
    if options.against:  # --against judges all scenarios
        figures_of(rig_of(load_scenario(options.against)))
    works = [Judged(_called(name), name, options.against) for name in options.scenarios]
    outcomes = sweep(judge, works, title="check", workers=options.workers)
    suites = [suite_of(outcome) for outcome in outcomes]
    for suite, outcome in zip(suites, outcomes, strict=True):
        bad = len(suite.failures)
        verdict = f"{outcome['kind']}: {suite.error}" if suite.error else f"{len(suite.cases) - bad} hold, {bad} do not"
        verdict = verdict if suite.cases or suite.error else "nothing is judged: it has no expectations"
        print(f"{suite.name}: {verdict}")
        for case in suite.failures:
            print(f"  {case.name}: {case.failure}")
        for note in outcome.get("notes", ()):
            print(f"  {note}")
        if outcome["differs"]:
            print(f"  differs from {options.against}: {', '.join(outcome['differs'])}")
    write_reports(options.junit, suites, options.json, outcomes)
    if options.marks is not None:
        replace(options.marks, _marks(suites, [o["differs"] for o in outcomes] if options.against else None))
    if options.html is not None:
        write_page(options.html, "check", checked(suites, outcomes, options.against))
    if errors := sorted({outcome["kind"] for outcome in outcomes} - {""}):
        among = f"of {len(outcomes)} scenarios " if len(outcomes) > 1 else ""
        print_line(f"{among}not judged: {', '.join(o['scenario'] for o in outcomes if o['error'])}")
        return 3 if "broke" in errors else 2
    # a status of 0 would pass a job in which nothing was compared
    if not any(suite.cases for suite in suites):
        print_line(
            "nothing is judged; expected at least one entry of expect, requirements or claims, or --against FILE"
        )
        return 2
    return 1 if any(suite.failures for suite in suites) else 0


def _called(name: str) -> str:
    """Name the judged scenario: a file by its path, which distinguishes ``a/task.yaml`` from ``b/task.yaml``."""
    return name if Path(name).suffix in (".yaml", ".yml") else load_name(name)


def load_name(name: str) -> str:
    """Return the name of a scenario; the word itself if there is none."""
    return locate(name)[0] if find(name) is not None else name


def judge(work: Judged) -> dict[str, Any]:
    """Run one scenario in this process and return its outcome as plain data, in which bad input is also reported."""
    started = time.perf_counter()
    about: dict[str, Any] = {"scenario": work.name, "metrics": [], "claims": [], "kind": "", "differs": []}
    try:
        scenario = load_scenario(work.scenario)
        if work.against:
            reference = load_scenario(work.against)
            about["differs"] = differing(scenario, reference)
            scenario = scenario.having(**{key: getattr(reference, key) for key in KEPT})
        run = simulate(scenario, thorough=True)
        about |= outcome_of(run, time.perf_counter() - started)
        notes = [f"{name}: {b.reports[HIDDEN][1]}" for name, b in run.blocks.items() if HIDDEN in b.reports]
        about |= {"notes": notes} if notes else {}
    except RunError as error:
        about |= {"error": str(error), "kind": "broke"}
    except ScenarioError as error:
        about |= {"error": str(error), "kind": "refused"}
    return about | {"scenario": work.name, "wall_s": round(time.perf_counter() - started, 3)}


def differing(scenario: Scenario, reference: Scenario) -> list[str]:
    """Name the differences of a scenario from another one, except measurements and expectations."""
    a, b = (dict(_leaves("", s.model_dump(mode="json", include={*COMPARED}))) for s in (scenario, reference))
    return sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))


def _leaves(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), item)
    else:
        yield name, value


def _marks(suites: Sequence[Suite], differs: Sequence[Sequence[str]] | None) -> str:
    """Write one row for each scenario: how much holds, measurements, other differences from the reference, the
    error.
    """
    units = {case.name: case.unit for suite in suites for case in suite.cases}
    # Units are in the heads, so the cells remain numbers.
    heads = {name: f"{name} ({unit})" if unit else name for name, unit in units.items()}
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    judged = (cell for name, head in heads.items() for cell in (head, f"{name} holds"))
    writer.writerow(["scenario", "held", "judged", *judged, *([] if differs is None else ["differs"]), "error"])
    for suite, names in zip(suites, differs or [()] * len(suites), strict=True):
        cases = {case.name: case for case in suite.cases}
        holding = [name for name, case in cases.items() if not case.failure]
        cells = [cell for n in heads for cell in ((_cell(cases[n]), int(n in holding)) if n in cases else ("", ""))]
        differing_names = [] if differs is None else [" ".join(names)]
        writer.writerow([suite.name, len(holding), len(cases), *cells, *differing_names, suite.error])
    return text.getvalue()


def _cell(case: Case) -> str:
    return case.text.removesuffix(f" {case.unit}") if case.unit else case.text


def outcome_of(run: Run, wall_s: float) -> dict[str, Any]:
    """Return the outcome of a run as plain data."""
    return {
        "scenario": run.rig.scenario.name,
        "wall_s": round(wall_s, 3),
        "error": run.error,
        "metrics": [] if run.error else [r.plain() for r in run.results],
        "claims": [] if run.error else [_claim(c) for c in run.claims],
    }


def _claim(finding: Finding) -> dict[str, Any]:
    return finding.plain() | {"false": finding.false if finding.holds is False else ""}


def suite_of(outcome: dict[str, Any]) -> Suite:
    """Return an outcome as a suite of cases: the judged values, and the claims whose verdict was compared with
    the run.
    """
    results = [Result.read(r) for r in outcome["metrics"]]
    cases = [Case(r.name, "" if r.passed else _missed(r), _measured(r), r.unit) for r in results if r.judged]
    cases += [
        Case(f"claim {c['key']}", c["false"], c["measured_text"]) for c in outcome["claims"] if c["holds"] is not None
    ]
    return Suite(outcome["scenario"], outcome["wall_s"], cases, outcome["error"])


def _measured(result: Result) -> str:
    return result.error or f"{result.value:.10g} {result.unit}".rstrip()


def _missed(result: Result) -> str:
    intervals = f"; violated {spans(result.violated_s)}" if result.violated_s else ""
    value = "never" if result.error == NEVER else _measured(result)
    return f"{value}, expected {accepted(result)} {result.unit}".rstrip() + intervals
