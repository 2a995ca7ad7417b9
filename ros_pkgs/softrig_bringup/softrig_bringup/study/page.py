"""A study in words: on the terminal and as a page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from softrig_core import figures_of, load_scenario, rig_of
from softrig_core.block.params import declarations
from softrig_core.judge.units import pretty_unit
from softrig_core.rig.members import signal_units
from softrig_core.verdict.findings import Finding
from softrig_core.verdict.result import Result
from softrig_core.wire.signals import short_name

from ..page.citations import cited, sources
from ..page.html import NONE, e, mark, picture, table
from ..page.wording import NEVER, accepted, short
from ..terminal.console import console as make_console, styled
from ..terminal.tables import Cell, print_columns, print_judged
from .definition import Study
from .engine import beyond
from .pictures import chosen
from .statistics import Statistics, not_judged
from .table import Row, command, in_short, label
from .tabled import Tabled, tables
from .work import absent, value_of

FEW = 20  # runs whose figures are printed where a study has no summaries
MOST = 60  # rows of statistics that are printed
# The most rows on the page; the table files have them all.
LONGEST = 200


def units_of(rows: Sequence[Row]) -> dict[str, str]:
    """Units of figures, parameters (``node.name``) and signals, from the scenarios that the study runs."""
    units: dict[str, str] = {}
    for scenario in dict.fromkeys(row["scenario"] for row in rows):
        rig = rig_of(scenario)
        sig = signal_units(rig)
        units |= {f.name: f.unit for f in figures_of(rig)} | sig | {short_name(n, sig): u for n, u in sig.items()}
        units |= {f"{m.name}.{d.name}": d.unit for m in rig.members for d in declarations(type(m.params))}
    return units


def best(study: Study, rows: Sequence[Row]) -> list[Row]:
    """Return the runs of the best candidate of a search, one a seed: of least (or greatest) mean, within its limits."""
    search = study.search
    if search is None:
        return []
    sign = 1.0 if search.aim == "minimise" else -1.0
    each = len(study.seeds or [0])
    gathered: dict[int, list[Row]] = {}
    for row in rows:
        gathered.setdefault(row["number"] // each, []).append(row)

    def within_limits(row: Row) -> bool:
        within = all(beyond(row, name, limits) <= 0.0 for name, limits in search.subject_to.items())
        return within and row["figures"].get(search.figure) is not None

    sure = [group for group in gathered.values() if len(group) == each and all(map(within_limits, group))]
    return min(sure, key=lambda group: sign * sum(row["figures"][search.figure] for row in group), default=[])


def _figures_of(rows: Sequence[Row], name: str) -> str:
    """Return the mean of each figure over some runs, and the number of runs without it."""
    values = [value_of(row, name) for row in rows]
    present = [v for v in values if math.isfinite(v)]
    if len(rows) == 1:
        return _figure(rows[0], name)
    return ", ".join(filter(None, (f"mean {sum(present) / len(present):.6g}" if present else "", absent(values))))


def _figure(row: Row, name: str) -> str:
    value = value_of(row, name)
    return f"{value:.6g}" if math.isfinite(value) else NEVER if value == math.inf else "" if row["error"] else NONE


def print_study(
    study: Study,
    rows: Sequence[Row],
    gathered: Sequence[Result],
    claims: Sequence[Finding],
    over: Statistics,
    out: Path,
) -> None:
    """Print summaries or figures, statistics, notes, the best run, and what broke."""
    console = make_console()
    console.print(styled((study.title, "italic")))
    cells: list[list[Cell]] = []
    for r in gathered:
        verdict = styled(("pass" if r.judged else "", "green")) if r.passed else styled(("MISS", "red"), f" {r.error}")
        verdict = styled(("not judged", "yellow")) if r.published_for else verdict
        cells.append([r.name, short(r.value), accepted(r), short(r.published), r.unit, verdict])
    if gathered:
        print_judged(console, ("summary", "value", "expected", "published", "unit", ""), cells)
    elif len(rows) <= FEW:
        varied, figures = (list(dict.fromkeys(n for row in rows for n in row[k])) for k in ("overrides", "figures"))
        case = ["case"] if any(row["case"] for row in rows) else []
        for row in rows:
            changed = [*(row[name] for name in case), *(_cell(row["overrides"].get(n)) for n in varied)]
            cells.append([*changed, *(_figure(row, n) for n in figures)])
        print_columns(console, [*case, *varied, *figures], cells, len(case) + len(varied))
    for written in tables(over):
        console.print(styled((written.title, "bold")))
        print_columns(console, written.heads, written.rows[:MOST], written.keys)
        if len(written.rows) > MOST:
            console.print(f"the first {MOST} of {len(written.rows)} rows; summaries.json has them all")
    for note in _notes(study, rows, gathered, over):
        console.print(note, soft_wrap=True)
    for claim in claims:
        if claim.holds is False:
            console.print(styled((f"claim {claim.key}", "red"), f": {claim.false}"))
    winners = best(study, rows)
    if winners:
        console.print("best: " + ", ".join(f"{name} {_figures_of(winners, name)}" for name in winners[0]["figures"]))
        console.print(command(winners[0], study.duration), soft_wrap=True)
    elif study.search:
        console.print(
            f"best: none of {len(rows)} runs has a {study.search.figure}"
            + (" within the limits" if study.search.subject_to else "")
        )
    broken = [row for row in rows if row["error"]]
    for row in broken[:3]:
        console.print(f"run {row['number']} broke: {row['error']}; {command(row, study.duration)}", soft_wrap=True)
    console.print(f"{len(rows)} runs, {len(broken)} broke; results in {out}")


def _notes(study: Study, rows: Sequence[Row], gathered: Sequence[Result], over: Statistics) -> list[str]:
    """Return sentences about the study as a whole."""
    written = any(r.published_for for r in gathered) or (study.claims and study.written)
    judging = f"summaries and claims are not judged: published for {study.written}" if written else ""
    return [*over.notes, *filter(None, (judging, not_judged(rows)))]


def _cell(value: Any) -> str:
    if value is None:  # the case does not change this value
        return NONE
    return short(value) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)


def body_of(
    study: Study,
    rows: Sequence[Row],
    gathered: Sequence[Result],
    claims: Sequence[Finding],
    over: Statistics,
    pictures: Sequence[Path],
    units: dict[str, str],
) -> list[Element]:
    """Return the elements of the page of a study."""
    wall = sum(row["wall_s"] for row in rows)
    facts = [
        ("runs", str(len(rows))),
        ("broken", str(sum(bool(r["error"]) for r in rows))),
        ("scenario", study.scenario),
        ("computing time", f"{wall:.3g} s"),
    ]
    body = [
        e(
            "header",
            e("h1", study.title),
            e("p", asked(study), class_="what"),
            e("p", study.source, class_="what"),
            e("dl", *(e("div", e("dt", k), e("dd", v)) for k, v in facts), class_="facts"),
        ),
    ]
    if gathered:
        lines: list[tuple[Element | str, ...]] = [
            (
                r.name.replace("_", " "),
                short(r.published),
                short(r.value),
                pretty_unit(r.unit),
                accepted(r),
                _verdict(r),
            )
            for r in gathered
        ]
        body += [
            e("h2", "Over all runs"),
            table(("Summary", "Published", "Value", "Unit", "Accepted", ""), lines, " nn n "),
        ]
    if claims:
        lines = [
            (
                c.text,
                c.where,
                short(c.published),
                c.asked,
                c.measured_text,
                e(
                    "div",
                    mark(False, f"{c.verdict}: not borne out") if c.holds is False else _word(study, c),
                    e("div", c.reason, class_="note"),
                ),
            )
            for c in claims
        ]
        body += [
            e("h2", "Claims"),
            table(("Claim", "Where", "Published", "Agrees when", "Measured", "Verdict"), lines, "  n n "),
        ]
    for written in sorted(tables(over), key=lambda t: t.answers, reverse=True):
        body += [e("h2", written.title), _statistics(written)]
    body += [e("p", f"{note[0].upper()}{note[1:]}.", class_="note") for note in _notes(study, rows, gathered, over)]
    winners = best(study, rows)
    if winners:
        about = [
            (name.replace("_", " "), _figures_of(winners, name), pretty_unit(units.get(name, "")))
            for name in winners[0]["figures"]
        ]
        body += [
            e("h2", "Best run" if len(winners) == 1 else f"Best parameters, {len(winners)} seeds"),
            table(("Figure", "Measured", "Unit"), about, " n "),
            e("pre", command(winners[0], study.duration)),
        ]
    body.append(e("h2", "Pictures"))
    for path in pictures:
        body.append(e("figure", picture(path.read_bytes(), path.stem.replace("_", " "))))
    papers = cited(load_scenario(study.scenario).cites)
    names = chosen(study, rows)
    broken = ["Broke"] if any(row["error"] for row in rows) else []
    heads = ("Run", "Changed", "Seed", *(_heading(n, units.get(n, "")) for n in names), *broken)
    lines = [
        (
            str(row["number"]),
            _changes(study, row),
            str(row["seed"]),
            *(_figure(row, n) for n in names),
            *([row["error"]] if broken else []),
        )
        for row in rows[:LONGEST]
    ]
    listed = table(heads, lines, "  n" + "n" * len(names))
    folded = e("details", e("summary", f"{len(lines)} runs"), listed)  # folded, because the results are printed above
    body += [e("h2", "Runs"), listed if len(rows) <= FEW else folded]
    note = "table.parquet and table.csv have every run with the command that repeats it."
    if len(rows) > LONGEST:
        note = f"The first {LONGEST} of {len(rows)} runs. {note}"
    body.append(e("p", note, class_="note"))
    return [*body, *([e("h2", "Sources")] if papers else []), *sources(papers)]


def _verdict(result: Result) -> Element | str:
    if result.published_for:
        return e("span", "not judged", title=f"published for {result.published_for}")
    return mark(result.passed, "pass" if result.passed else "miss") if result.judged else ""


def _word(study: Study, claim: Finding) -> Element:
    """Write the verdict on a claim that is not refuted; for a changed study there is no verdict."""
    if study.written and claim.holds is None:
        return e("span", "not judged", title=f"published for {study.written}")
    return e("b", claim.verdict.replace("_", " "))


def _statistics(written: Tabled) -> Element:
    left_aligned = {k for k, head in enumerate(written.heads) if k < written.keys or head == "unit"}
    lines = [
        [pretty_unit(c) if head == "unit" else _interval(c) for head, c in zip(written.heads, row, strict=True)]
        for row in written.rows[:LONGEST]
    ]
    return table(written.heads, lines, "".join(" " if k in left_aligned else "n" for k in range(len(written.heads))))


def _interval(cell: str) -> Element | str:
    """Put the interval of a number below it, so that a table of them is not wider than the page."""
    value, bracket, remaining = cell.partition(" [")
    return e("span", value, " ", e("small", f"[{remaining}")) if bracket else cell


def asked(study: Study) -> str:
    """Describe what is varied: cases, grid, draws or search, seeds; empty if nothing is."""
    draws = study.draws or study.search
    how = "candidates of a search" if study.search else "draws of"
    spans = [f"{n} {_span(d.model_dump(exclude_none=True))}" for n, d in (draws.parameters if draws else {}).items()]
    parts = [" against ".join(study.cases) if len(study.cases) > 1 else ""]
    parts += [f"{name} at {len(result)} values" for name, result in study.grid.items()]
    parts += [f"{draws.count} {how} {', '.join(spans)}" if draws else ""]
    parts += [f"{len(study.seeds)} seeds" if study.seeds and len(study.seeds) > 1 else ""]
    return "; ".join(filter(None, parts))


def _span(distribution: dict[str, Any]) -> str:
    ((kind, value),) = distribution.items()
    if kind == "choice":
        return f"of {', '.join(map(str, value))}"
    low, high = (in_short(end) for end in value)
    return f"{low} ± {high}" if kind == "normal" else f"{low}..{high}" + (" (log)" if kind == "log_uniform" else "")


def _changes(study: Study, row: Row) -> str:
    """Label of a row by all that was changed in it."""
    if not study.draws and not study.search:
        return label(study, row)
    return ", ".join(
        ([row["case"]] if row["case"] else [])
        + [f"{k.rpartition('.')[2]} {in_short(v)}" for k, v in row["overrides"].items()]
    )


def _heading(name: str, unit: str) -> str:
    return name.replace("_", " ") + (f" ({pretty_unit(unit)})" if unit else "")
