"""Several runs on one page: told apart by what was changed, in tables and as signals laid over each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

from softrig_bags.errors import BagError
from softrig_bags.read import signals
from softrig_core import Signals
from softrig_core.rig.figures import Result

from .html import e, mark, picture, table
from .plots.overlay import Overlay, draw_overlay
from .plots.style import pretty_unit
from .run_page import verdict
from .run_record import RunRecord
from .wording import measured


def labels(runs: Sequence[RunRecord]) -> list[str]:
    """Tell runs apart: by scenario, by what was changed of it, by mode and seed, as far as these differ.

    Parameters
    ----------
    runs : sequence of RunRecord

    Returns
    -------
    list of str
        One for each; a run by itself has its scenario and its changes.
    """
    found = []
    for run, group in zip(runs, groups(runs), strict=True):
        seeds = {other.seed for other, name in zip(runs, groups(runs), strict=True) if name == group}
        seed = f"seed {run.seed}" if len(seeds) > 1 or f"seed {run.seed}" in run.changed else ""
        found.append(", ".join(filter(None, (group, seed))))
    return found


def groups(runs: Sequence[RunRecord]) -> list[str]:
    """Label runs by all that differs but the seed: runs with one label are draws of the same."""
    scenarios, modes = {r.scenario for r in runs}, {r.mode for r in runs}
    changed = [tuple(c for c in r.changed if not c.startswith("seed ")) for r in runs]
    return [
        ", ".join(filter(None, (
            r.scenario if len(scenarios) > 1 or len(runs) == 1 or len({*changed}) == 1 else "",
            *own,
            "as it is" if len(scenarios) == 1 and len({*changed}) > 1 and not own else "",
            r.mode if len(modes) > 1 else "",
        )))
        for r, own in zip(runs, changed, strict=True)
    ]  # fmt: skip


def index(runs: Sequence[RunRecord], names: Sequence[str]) -> Element:
    """List the runs, each linked to its section."""
    rows = [
        (
            e("a", names[i - 1], href=f"#run-{i}"),
            run.title,
            run.mode,
            str(run.seed),
            f"{run.duration_s:g} s",
            f"{run.wall_s:.3g} s",
            verdict(run),
            run.error or ", ".join(m.name.replace("_", " ") for m in run.missed),
        )
        for i, run in enumerate(runs, 1)
    ]
    header = ("Run", "Title", "Mode", "Seed", "Simulated", "Wall time", "Metrics", "Missed or different")
    return table(header, rows, "   nnn  ")


def side_by_side(runs: Sequence[RunRecord], names: Sequence[str]) -> Iterator[Element]:
    """For each system with several runs: the metrics that at least two of them have, one row a run."""
    for system in dict.fromkeys(run.system for run in runs):
        group = [(i, run) for i, run in enumerate(runs, 1) if run.system == system and run.metrics]
        measures = [(m.name, m.unit) for _, run in group for m in run.metrics]
        columns = [key for key in dict.fromkeys(measures) if measures.count(key) > 1]
        if not columns:
            continue
        rows: list[list[Element | str]] = []
        for i, run in group:
            have = {(m.name, m.unit): m for m in run.metrics}
            cells = [_cell(have.get(key), run.compared) for key in columns]
            rows.append([e("a", names[i - 1], href=f"#run-{i}"), run.mode, *cells])
        header = [f"{name.replace('_', ' ')} ({pretty_unit(unit)})" if unit else name.replace("_", " ")
                  for name, unit in columns]  # fmt: skip
        yield e("h2", f"{system}: side by side")
        yield table(("Run", "Mode", *header), rows, "  " + "n" * len(columns))


def _cell(metric: Result | None, compared: bool) -> Element | str:
    if metric is None:
        return ""
    text = measured(metric)
    return text if metric.passed or compared else mark(False, text)


def overlaid(runs: Sequence[tuple[Path, RunRecord]], names: Sequence[str]) -> Iterator[Element]:
    """For each system: the signals of the runs' plots laid over each other, with bands where only the seeds differ."""
    records = [run for _, run in runs]
    same = groups(records)
    for system in dict.fromkeys(run.system for run in records):
        mine = [k for k, run in enumerate(records) if run.system == system]
        found = {k: opened for k in mine if (opened := _signals(runs[k][0] / "bag")) is not None}
        drawn = list(draw_overlay([Overlay(names[k], same[k], records[k].plots, records[k].signals, found[k])
                                   for k in mine if k in found]))  # fmt: skip
        if drawn:
            yield e("h2", f"{system}: signals")
        for title, data in drawn:
            yield e("figure", picture(data, title))
        lost = [names[k] for k in mine if k not in found]
        if drawn and lost:
            yield e("p", f"Not drawn, for want of a bag: {'; '.join(lost)}", class_="note")


def _signals(bag: Path) -> Signals | None:
    try:
        return signals(bag) if bag.is_dir() else None
    except BagError:
        return None
