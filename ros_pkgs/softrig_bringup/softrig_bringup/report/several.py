"""Several runs on one page: what differs between them, their figures in tables, their signals laid over each other."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element

from softrig_bags.errors import BagError
from softrig_core.judge.units import pretty_unit
from softrig_core.verdict.result import Result

from ..page.html import NONE, e, mark, picture, table
from ..page.wording import measured
from ..plots.named import LEAST
from .apart import differing, machine
from .record import RunRecord
from .run_page import verdict

if TYPE_CHECKING:
    from softrig_core import Signals

COLUMNS = 8  # figures that fit beside each other in a table on a page 1,100 pixels wide
MOST = 40  # rows of the table of differences
APART = 4.0  # ratio of the lengths of two runs above which they have no common picture


def groups(runs: Sequence[RunRecord], named: Sequence[str]) -> list[str]:
    """Return the group of each run: runs of equal code, parameters and machine that differ only in their seed.

    Parameters
    ----------
    named : sequence of str
        From `names`.

    Returns
    -------
    list of str
        For `LEAST` or more such runs of different seeds: the common part of their names. For any other run: its name.
    """
    keys = [_draws(run) for run in runs]
    result = list(named)
    for key in dict.fromkeys(keys):
        members = [k for k, same in enumerate(keys) if same == key]
        if key and LEAST <= len(members) == len({runs[k].seed for k in members}):
            letters = zip(*(named[k] for k in members), strict=False)
            shared = "".join(c[0] for c in takewhile(lambda c: len({*c}) == 1, letters))
            shared = shared.rstrip(" -_=,/([").removesuffix("seed").rstrip(" -_")
            shared = shared or runs[members[0]].scenario
            label = shared if result.count(shared) <= (shared in [named[k] for k in members]) else ""
            for k in members:
                result[k] = label or f"{named[members[0]]} and others"
    return result


def _draws(run: RunRecord) -> str:
    """Return the common part of runs that differ only in their seed; empty for a run without random draws."""
    if run.error or run.stopped or not run.code or any(node.outside for node in run.wiring.nodes.values()):
        return ""
    same = (run.scenario, run.mode, run.duration_s, run.code, run.parameters, machine(run), run.wiring.plain())
    return json.dumps(same, sort_keys=True)


def differences(runs: Sequence[RunRecord], named: Sequence[str]) -> Iterator[Element]:
    """For each system with several runs: one row for each thing that differs between them."""
    for system in dict.fromkeys(run.system for run in runs):
        members = [(run, name) for run, name in zip(runs, named, strict=True) if run.system == system]
        if len(members) < 2:
            continue
        changed, follows = differing([run for run, _ in members])
        yield e("h2", f"{system}: what differs")
        if not changed:
            yield e("p", "Nothing: equal code, parameters, seed and machine.", class_="note")
            continue
        yield from _differing(changed, [name for _, name in members])
        if follows:
            count = f"{len(follows)} parameter{'s that differ' if len(follows) > 1 else ' that differs'} because of it"
            yield e("details", e("summary", count), *_differing(follows, [name for _, name in members]))


def _differing(result: Mapping[str, Sequence[str]], named: Sequence[str]) -> Iterator[Element]:
    rows = []
    for item, values in list(result.items())[:MOST]:
        runs_of = {v: [name for name, text in zip(named, values, strict=True) if text == v] for v in values}
        rows.append(
            (item, e("div", *(e("div", e("b", v or NONE), f" in {_listed(runs)}") for v, runs in runs_of.items())))
        )
    yield table(("What", "In which run"), rows)
    if len(result) > MOST:
        yield e("p", f"And {len(result) - MOST} more.", class_="note")


def _listed(words: Sequence[str]) -> str:
    return ", ".join(words[:6]) + (f" and {len(words) - 6} more" if len(words) > 6 else "")


def index(runs: Sequence[RunRecord], named: Sequence[str]) -> Element:
    """List the runs, each linked to its section."""
    rows = [
        (
            e("a", named[i - 1], href=f"#run-{i}"),
            ", ".join([run.scenario, *run.changed]),
            run.mode,
            str(run.seed),
            f"{run.simulated_s:.6g} s",
            f"{run.wall_s:.3g} s",
            verdict(run),
            run.error or ", ".join(m.name.replace("_", " ") for m in run.missed),
        )
        for i, run in enumerate(runs, 1)
    ]
    header = ("Run", "Scenario", "Mode", "Seed", "Simulated", "Wall time", "Metrics", "Missed or different")
    return table(header, rows, "   nnn  ")


def side_by_side(runs: Sequence[RunRecord], named: Sequence[str]) -> Iterator[Element]:
    """Create tables for each system with several runs: metrics that at least two of them have, one row per run.

    With more than `COLUMNS` metrics, a table of few runs has one row per metric instead; many runs get several tables.
    """
    for system in dict.fromkeys(run.system for run in runs):
        group = [(i, run) for i, run in enumerate(runs, 1) if run.system == system and run.metrics]
        measures = [(m.name, m.unit) for _, run in group for m in run.metrics]
        columns = [key for key in dict.fromkeys(measures) if measures.count(key) > 1]
        if not columns:
            continue
        yield e("h2", f"{system}: side by side")
        have = [{(m.name, m.unit): m for m in run.metrics} for _, run in group]
        if len(group) <= COLUMNS < len(columns):
            rows: list[list[Element | str]] = [[_heading(key), *(_cell(h.get(key)) for h in have)] for key in columns]
            yield table(("Figure", *(named[i - 1] for i, _ in group)), rows, " " + "n" * len(group))
            continue
        for some in (columns[k : k + COLUMNS] for k in range(0, len(columns), COLUMNS)):
            rows = [
                [e("a", named[i - 1], href=f"#run-{i}"), *(_cell(h.get(key)) for key in some)]
                for (i, _), h in zip(group, have, strict=True)
            ]
            yield table(("Run", *map(_heading, some)), rows, " " + "n" * len(some))


def _heading(measure: tuple[str, str]) -> str:
    name, unit = measure[0].replace("_", " "), pretty_unit(measure[1])
    return f"{name} ({unit})" if unit else name


def _cell(metric: Result | None) -> Element | str:
    if metric is None:
        return ""
    text = measured(metric)
    return text if metric.passed else mark(False, text)


def overlaid(runs: Sequence[tuple[Path, RunRecord]], named: Sequence[str]) -> Iterator[Element]:
    """For each system: the signals of the runs' plots laid over each other, with bands where only the seeds differ.

    Runs whose lengths differ too much for one axis have separate pictures (`APART`).
    """
    # A page of one run draws none.
    from softrig_core.scenario.plot_entry import PlotEntry

    from ..plots.overlay import Overlay, draw_overlay

    records = [run for _, run in runs]
    same = groups(records, named)
    plots = [tuple([PlotEntry(**plot.plain()) for plot in run.plots]) for run in records]
    for system in dict.fromkeys(run.system for run in records):
        members = [k for k, run in enumerate(records) if run.system == system]
        results = {k: opened for k in members if (opened := _signals(*runs[k])) is not None}
        drawn: list[tuple[str, str]] = []
        alone: list[str] = []
        for group in _lengths({k: records[k].simulated_s for k in results}):
            ends = max(records[k].simulated_s for k in group)
            pictures = list(
                draw_overlay(
                    [Overlay(named[k], same[k], plots[k], records[k].signals, results[k]) for k in group],
                    "" if len(group) == len(results) else f", runs of up to {ends:g} s",
                )
            )
            drawn += pictures
            alone += [] if pictures else [named[k] for k in group]
        if drawn:
            yield e("h2", f"{system}: signals")
        yield from (e("figure", picture(data, title)) for title, data in drawn)
        lost = [named[k] for k in members if k not in results]
        for text, missing in (
            ("for want of a bag", lost),
            ("no other run of about their length has their plots", alone),
        ):
            if drawn and missing:
                yield e("p", f"Not drawn here, {text}: {', '.join(missing)}", class_="note")


def _lengths(ends: dict[int, float]) -> list[list[int]]:
    """Group runs by length, the longest first, so that a picture shows each run completely."""
    result: list[list[int]] = []
    for k in sorted(ends, key=lambda k: -ends[k]):
        if result and ends[result[-1][0]] <= APART * ends[k]:
            result[-1].append(k)
        else:
            result.append([k])
    return [sorted(group) for group in result]


def _signals(directory: Path, run: RunRecord) -> Signals | None:
    from softrig_bags.read import signals

    bag = directory / "bag"
    try:
        return signals(bag, on_disk=True).known_as(run.also) if bag.is_dir() else None
    except BagError:
        return None
