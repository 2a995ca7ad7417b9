"""The outcome of a search: in words, as data, and its runs as scenario files that can be run again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from softrig_core import Run, Scenario, figures_of, load_scenario, rig_of
from softrig_core.guard import replace
from softrig_core.scenario.scenario_file import find
from softrig_core.scenario.yaml_file import write_yaml
from softrig_nodes.processes.placement import Placement

from ..folder import ResultsFolder
from ..report.report import write_report
from ..run.run import checked, execute, illustrate, save, summary
from ..terminal.console import console as make_console, styled
from ..terminal.tables import print_columns
from .definition import Falsification
from .engine import Outcome
from .page import lead
from .picture import draw_worst
from .shrink import Case
from .words import number, shown

PICTURE = "worst.svg"


def write(task: Falsification, outcome: Outcome, out: Path, plots: bool, also: str) -> dict[str, Path]:
    """Write the most important runs, their scenario files and the page; return the files."""
    files: dict[str, Path] = {}
    nominal = outcome.space.scenario.having(faults=_own_faults(outcome))
    runs = {"nominal": _record(task, nominal, out / "nominal", plots, also)}
    for name, case in (("worst", outcome.case), ("small", outcome.small)):
        if case is not None:
            file = out / f"{task.name}_{name}.yaml"
            text = scenario_file(task, name, case, outcome)
            runs[name] = _record(task, _standing_alone(text, file), out / name, plots, also)
            replace(file, text)
            files[name] = file
    if plots:
        head = lead(task, outcome, _units(outcome), files)
        write_report([out / name for name in runs], out / "report.html", list(runs), head=head)
    if plots and "worst" in runs and not runs["worst"].error:
        asked = (outcome.violated or list(outcome.names))[0]
        pair = {"as it is": runs["nominal"], "worst found": runs["worst"]}
        draw_worst(pair, asked, out / PICTURE, task.title or task.name, also)
    replace(out / "outcome.json", json.dumps(content(task, outcome), indent=1) + "\n")
    return files


def _standing_alone(text: str, file: Path) -> Scenario:
    """Load a scenario file before it is moved into place: one that cannot run by itself is never placed there."""
    with TemporaryDirectory() as folder:
        draft = Path(folder) / file.name
        draft.write_text(text)
        return load_scenario(str(draft))


def _own_faults(outcome: Outcome) -> dict[str, Any]:
    """Return the scenario's own faults, without the profiles that the search adds."""
    added = {
        t.partition(".")[0] for t, o in zip(outcome.space.targets, outcome.space.overs, strict=True) if o.on_signal
    }
    return {n: f.model_dump() for n, f in outcome.space.scenario.faults.items() if n not in added}


def _record(task: Falsification, scenario: Scenario, folder: Path, plots: bool, also: str) -> Run:
    """Run a case once more and write its bag, figures, pictures and page."""
    results = ResultsFolder(folder)
    results.clear()
    done = execute(checked(scenario), Placement("inprocess"), folder / "log")
    figures = [] if done.error else done.results
    save(done, summary(done, figures, f"scripts/softrig falsify {task.name}"), results)
    if plots:
        illustrate(done, results, also)
    return done


def scenario_file(task: Falsification, kind: str, case: Case, outcome: Outcome) -> str:
    """Write a case as a scenario file: its changes if it extends a scenario, or all of it.

    Parameters
    ----------
    kind : str
        ``worst`` or ``small``.
    """
    scenario, overrides = case
    changed = scenario.changed(overrides=overrides)
    title = f"{changed.title}: {', '.join(outcome.violated) or 'least margin'}, {kind} case found"
    if find(task.scenario) is not None:
        nodes: dict[str, Any] = {}
        for target, value in overrides.items():
            node, _, parameter = target.partition(".")
            if node in changed.nodes:
                nodes.setdefault(node, {"parameters": {}})["parameters"][parameter] = value
        faults: dict[str, Any] = {n: f.model_dump() for n, f in changed.faults.items()}
        before = outcome.space.scenario.faults
        faults |= dict.fromkeys(n for n in before if n not in faults and n in _own_faults(outcome))
        content: dict[str, Any] = {"extends": task.scenario, "title": title, "seed": changed.seed}
        content |= {"duration": changed.duration} | ({"nodes": nodes} if nodes else {})
        content |= {"faults": faults} if faults else {}
        if changed.plots != outcome.space.scenario.plots:  # plots lack the signals of faults that were removed
            content["plots"] = [plot.model_dump(mode="json", exclude_defaults=True) for plot in changed.plots]
        asked = {
            n: changed.requirements[n].model_dump(exclude_defaults=True)
            for n in outcome.names
            if n in changed.requirements
        }
        bounds = {n: changed.expect[n].model_dump(exclude_defaults=True) for n in outcome.names if n not in asked}
        content |= ({"requirements": asked} if asked else {}) | ({"expect": bounds} if bounds else {})
    else:
        content = changed.model_dump(mode="json", exclude_defaults=True, exclude={"name", "expect", "claims"})
        content["title"] = title
    head = f"# Found by: softrig falsify {task.name}; {len(outcome.search.trace)} runs, seed {task.seed}.\n"
    return head + write_yaml(content)


def content(task: Falsification, outcome: Outcome) -> dict[str, Any]:
    """Return the outcome as data."""
    return {
        "falsification": task.name,
        "scenario": task.scenario,
        "seed": task.seed,
        "sampler": task.sampler,
        "over": task.over,
        "requirements": list(outcome.names),
        "not_judged": list(outcome.not_judged),
        "published_for": outcome.machine if outcome.published or outcome.not_judged else "",
        "runs": outcome.search.runs,
        "least": outcome.search.least,
        "least_at_corners": outcome.search.corners,
        "violated": outcome.violated,
        "nominal": outcome.nominal,
        "worst": outcome.worst,
        "small": outcome.small_margins,
        "changes": outcome.case[1] if outcome.case else {},
        "small_changes": outcome.small[1] if outcome.small else {},
        "broken": [{"changes": c, "error": e} for c, e in outcome.broken],
        "trace": outcome.search.trace,
    }


def _units(outcome: Outcome) -> dict[str, str]:
    return {f.name: f.unit for f in figures_of(rig_of(outcome.space.scenario))}


def print_outcome(task: Falsification, outcome: Outcome, out: Path, files: dict[str, Path]) -> None:
    """Print the margins, the changes of the worst case, and the files."""
    console = make_console()
    rig_units = _units(outcome)
    console.print(styled((f"{task.name}: {outcome.search.runs} runs", "italic")))
    rows = []
    for name in outcome.names:
        small = number(outcome.small_margins.get(name)) if outcome.small else ""
        rows.append([name, number(outcome.nominal[name]), number(outcome.worst.get(name)), small, rig_units[name]])
    print_columns(console, ("requirement", "nominal margin", "worst", "made small", "unit"), rows)
    say = [verdict(outcome)]
    if outcome.case is not None:
        say += [f"  {k} = {shown(v)}" for k, v in (outcome.small or outcome.case)[1].items()]
    say += outcome.bounds
    if outcome.broken:
        say.append(f"{len(outcome.broken)} runs broke, the first: {outcome.broken[0][1]}")
    say += [f"{name} case: {path}" for name, path in files.items()] + [f"results in {out}"]
    for line in say:
        console.print(line, markup=False)


def verdict(outcome: Outcome) -> str:
    """Describe the result in words."""
    runs, result = outcome.search.runs, outcome.search
    if outcome.case is None:
        return f"none of {runs} runs could be judged"
    first = f"corners alone: {number(result.corners)}" if result.corners < math.inf else "no corners asked"
    if outcome.violated:
        effort = f"made small in {outcome.shrinking} more runs"
        return f"violated: {', '.join(outcome.violated)}, least margin {number(result.least)} ({first}); {effort}"
    return f"no violation in {runs} runs; least margin {number(result.least)} ({first}), at"
