"""One run as a section of a page: figures, pictures, block diagram, parameters, sources."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree.ElementTree import Element

from softrig_bags.errors import BagError
from softrig_core import ScenarioError
from softrig_core.judge.units import pretty_unit
from softrig_core.verdict.result import Result

from ..options.repeat import for_reader
from ..page.citations import sources
from ..page.diagram import SMALLEST, draw_diagram
from ..page.html import NONE, e, mark, picture, table
from ..page.wording import NEVER, accepted, difference, measured, number
from ..plots.named import OVERVIEW, plot_name
from .record import RunRecord

PHONE = 360  # px of a page on a narrow screen
ELSEWHERE = (
    "For a machine that lacks the scenario or its packages, softrig pack makes one file of this run's folder; "
    "softrig run --like FILE repeats it there."
)


def run_section(directory: Path, run: RunRecord, title: str, heading: str, anchor: str) -> Element:
    """Create the section about a run.

    Parameters
    ----------
    directory : Path
        With its pictures.
    heading : {"h1", "h2"}
    """
    below = f"h{int(heading[1]) + 1}"
    about = [run.title] if title != run.title else []
    subject = ", ".join([run.scenario, *run.changed])
    broken = [e("p", f"The run broke: {run.error}", class_="broken")] if run.error else []
    broken += [e("p", f"Contradiction: {contradiction}", class_="broken") for contradiction in run.contradictions]
    sections = [
        ("Figures", [metrics(run)]),
        ("Signals", list(_pictures(directory, run))),
        ("Block diagram", list(_rig(run))),
        ("Repeat this run", [e("pre", for_reader(run.command)), e("p", ELSEWHERE, class_="note")]),
        ("Parameters", list(_parameters(run))),
        ("Changed while it ran", list(_changes(run))),
        ("Nodes", list(_nodes(run))),
        ("Sources", list(sources(run.citations))),
        ("Versions", [_pairs(run.versions)]),
    ]
    return e(
        "section",
        e(
            "header",
            e(heading, title),
            *(e("p", text, class_="what") for text in about),
            e("p", f"{run.system} · ", e("code", subject), class_="what"),
            *([e("p", run.source, class_="what")] if run.source else []),
            _facts(run),
            *broken,
        ),
        *(element for name, content in sections if content for element in (e(below, name), *content)),
        id=anchor,
        class_="run",
    )


def _facts(run: RunRecord) -> Element:
    """The line of figures below the title: verdict, mode, time, speed."""
    facts: list[tuple[str, Element | str]] = [
        ("metrics", verdict(run)),
        ("mode", run.mode),
        ("seed", str(run.seed)),
        (
            "duration",
            f"{run.simulated_s:.6g} of {run.duration_s:g} s" if run.stopped or run.error else f"{run.duration_s:g} s",
        ),
        ("ticks", f"{run.ticks:_}".replace("_", "\u202f")),
        ("wall time", f"{run.wall_s:.3g} s"),
    ]
    if run.wall_s > 0.0 and run.simulated_s > 0.0 and not run.error:
        facts.append(("speed", f"{run.simulated_s / run.wall_s:.3g} × real time"))
    return e("dl", *(e("div", e("dt", name), e("dd", value)) for name, value in facts), class_="facts")


def verdict(run: RunRecord) -> Element:
    """Describe in a few words how a run did."""
    if run.error:
        return mark(False, "broke")
    unjudged = sum(bool(m.published_for) for m in run.metrics)
    if run.stopped or (unjudged and not run.judged):
        return e("span", "compared, not judged")
    if not run.judged:
        return e("span", NONE)
    text = f"{len(run.judged) - len(run.missed)} of {len(run.judged)} pass"
    return mark(not run.missed, f"{text}, {unjudged} not judged" if unjudged else text)


def metrics(run: RunRecord) -> Element:
    """Create the table of figures, without empty columns."""
    if not run.metrics:
        return e("p", "No metrics." if run.error else "This scenario has no metrics.", class_="note")
    columns: dict[str, tuple[str, Callable[[Result], Element | str]]] = {
        "Figure": ("", lambda m: m.name.replace("_", " ")),
        "Published": ("n", lambda m: number(m.published)),
        "Measured": ("n", measured),
        "Unit": ("", lambda m: pretty_unit(m.unit)),
        "Against published": ("n", lambda m: difference(m.value, m.published)),
        "Accepted": ("n", lambda m: accepted(m) or NONE),
        "In tolerance": ("", _gauge),
        "Result": ("", lambda m: "" if run.stopped else _result(m)),
    }
    cells = {head: [cell(m) for m in run.metrics] for head, (_, cell) in columns.items()}
    shown = [head for head, column in cells.items() if any(c not in ("", NONE) for c in column)]
    rows = list(zip(*(cells[head] for head in shown), strict=True))
    notes = {
        "Published": "Published: the number of the source.",
        "Accepted": "Accepted: what this scenario asks of the run.",
    }
    note = " ".join(text for head, text in notes.items() if head in shown)
    result = table(shown, rows, "".join(columns[head][0] or " " for head in shown))
    return e("div", result, *([e("p", note, class_="note")] if note else []), class_="judged")


def _result(metric: Result) -> Element | str:
    if metric.published_for:
        cell = e("span", "not judged", title=f"published for {metric.published_for}")
    elif not metric.judged:
        return NONE
    else:
        cell = mark(metric.passed, "pass" if metric.passed else "miss")
    return e("div", cell, e("div", metric.error, class_="note")) if metric.error not in ("", NEVER) else cell


def _gauge(metric: Result) -> Element | str:
    """Draw the measured value as a dot in its tolerance bar; a dot outside of the bar is a miss."""
    if metric.value is None or metric.expected is None or not metric.tolerance:
        return ""
    deviation = (metric.value - metric.expected) / metric.tolerance
    dot = 40.0 + 26.0 * max(-1.4, min(1.4, deviation))
    kind = "" if metric.published_for else "pass" if metric.passed else "miss"
    return e(
        "svg",
        e("title", f"{100.0 * deviation:+.0f} % of the tolerance".replace("-", "−")),
        e("rect", x="14", y="5", width="52", height="4", rx="2", class_="band"),
        e("line", x1="40", x2="40", y1="2", y2="12", class_="centre"),
        e("circle", cx=f"{dot:.1f}", cy="7", r="3.5", class_=kind),
        width="80",
        height="14",
        viewBox="0 0 80 14",
        role="img",
        class_="gauge",
    )


def _pictures(directory: Path, run: RunRecord) -> Iterator[Element]:
    wanted = [(plot_name(i, p.title), p.title, ", ".join(p.signals)) for i, p in enumerate(run.plots, 1)]
    wanted.append((OVERVIEW, "Every recorded signal", ""))
    files = [
        (path, title, text)
        for name, title, text in wanted
        for path in (directory / name, (directory / name).with_suffix(".png"))  # files of an older run
    ]
    results = [entry for entry in files if entry[0].is_file()]
    if not results and (directory / "bag").is_dir():
        from .run_rig import draw_missing  # a page of a run with pictures needs no rig

        # The scenario or the bag may be missing.
        with TemporaryDirectory() as folder, suppress(ScenarioError, BagError):
            for path in draw_missing(directory, Path(folder)):
                title, text = next(((t, x) for name, t, x in wanted if name == path.name), (path.stem, ""))
                yield e("figure", picture(path.read_bytes(), title), *([e("figcaption", text)] if text else []))
            return
    if not results:
        yield e("p", "This run has no pictures.", class_="note")
    for path, title, text in results:
        yield e("figure", picture(path.read_bytes(), title), *([e("figcaption", text)] if text else []))


def _rig(run: RunRecord) -> Iterator[Element]:
    """The block diagram."""
    wiring = run.wiring
    if wiring.nodes:
        diagram = draw_diagram(wiring)
        least = float(diagram.attrib["viewBox"].split()[2]) * SMALLEST
        yield e("div", diagram, class_="scroll wide" if least > PHONE else "scroll")
        notes = [
            "The plant, shaded, owns time.",
            "Dashed: a node outside, its parameters unknown.",
            "A ring ends a topic that no node of the rig reads.",
        ]
        present = [
            any(n.plant for n in wiring.nodes.values()),
            any(n.outside for n in wiring.nodes.values()),
            any(not w.readers for w in wiring.wires),
        ]
        yield e("p", " ".join(note for note, is_there in zip(notes, present, strict=True) if is_there), class_="note")


def _parameters(run: RunRecord) -> Iterator[Element]:
    for node, values in run.parameters.items():
        units = run.units.get(node, {})
        count = f"{len(values)} parameter{'' if len(values) == 1 else 's'}"
        summary = e("summary", e("code", node), e("span", f" {count}", class_="note"))
        shown = {name: _value(value, units.get(name, "")) for name, value in values.items()}
        yield e("details", summary, _pairs(shown))


def _changes(run: RunRecord) -> Iterator[Element]:
    """Return the changes during the run; the parameters above are those of the start."""
    rows: list[list[Element | str]] = [
        [
            f"{change.at_s:.9g}",
            e("code", f"{change.node}.{name}"),
            _value(value, run.units.get(change.node, {}).get(name, "")),
        ]
        for change in run.changes
        for name, value in change.set.items()
    ]
    if rows:
        yield table(["From t, s", "Parameter", "Value"], rows, "n  ")


def _value(value: Any, unit: str) -> str:
    if value is None:
        return NONE
    text = value if isinstance(value, str) else json.dumps(value)
    return f"{text} {pretty_unit(unit)}".rstrip()


def _pairs(values: Mapping[str, str]) -> Element:
    """Names and values, as many columns as fit."""
    items = (e("div", e("dt", name), e("dd", value)) for name, value in values.items())
    return e("dl", *items, class_="pairs")


def _nodes(run: RunRecord) -> Iterator[Element]:
    """Create the run statistics: one row per node and one column per figure, then the nodes' reports."""
    rows = {
        node: {"refused": sum(count for count, _ in status.get("refused", {}).values())} | _plain(status)
        for node, status in run.nodes.items()
        if "state" in status  # only a node with a process of its own has a state
    }
    if rows:
        columns = list(dict.fromkeys(name for row in rows.values() for name in row))
        body: list[list[Element | str]] = [
            [e("code", node), *(_figure(row.get(name)) for name in columns)] for node, row in rows.items()
        ]
        yield table(("Node", *map(_heading, columns)), body, " " + "n" * len(columns))
    for node, status in run.nodes.items():
        messages = [f"{text} ({count} ×)" for _, text, count in status.get("reports", {}).values()]
        messages += [
            f"{n} messages refused on {topic}: {text}" for topic, (n, text) in status.get("refused", {}).items()
        ]
        if status.get("error"):
            messages.append(status["error"])
        yield from (e("p", e("code", node), f": {text}") for text in messages)
    native = {node: status["native"] for node, status in run.nodes.items() if "native" in status}
    if any(ticks for ticks, _ in native.values()):
        items = [
            node + (f" {ticks} ticks" if ticks else " none") + (f" ({why})" if why else "")
            for node, (ticks, why) in native.items()
        ]
        yield e("p", f"Answered by native code: {', '.join(items)}", class_="note")


def _plain(status: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a node's status that fit a cell."""
    return {name: value for name, value in status.items() if isinstance(value, (int, float)) and name != "t"}


def _heading(name: str) -> str:
    """Return the heading of a column: ``cpu_s`` becomes "cpu (s)"."""
    quantity, _, last = name.rpartition("_")
    unit = {"s": "s", "ms": "ms", "mb": "MB"}.get(last)
    return f"{quantity} ({unit})".replace("_", " ") if unit else name.replace("_", " ")


def _figure(value: float | None) -> str:
    if value is None:
        return NONE
    return str(value) if isinstance(value, int) else f"{value:.3g}"
