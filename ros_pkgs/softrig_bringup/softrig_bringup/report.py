"""Runs as one self-contained HTML page: nothing to fetch, no script, for the screen and for paper."""

from __future__ import annotations

import base64
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, tostring

from pydantic import BaseModel, ConfigDict, ValidationError
from softrig_core.errors import ScenarioError
from softrig_core.rig.figures import Result
from softrig_core.rig.scenario import PlotEntry

from .plots import OVERVIEW, plot_name, pretty_unit

NONE = "–"


class Run(BaseModel):
    """What the report needs of ``metrics.json``."""

    model_config = ConfigDict(frozen=True)

    scenario: str
    title: str
    system: str
    source: str
    mode: str
    seed: int
    duration_s: float
    ticks: int
    wall_s: float
    error: str = ""
    command: str
    metrics: tuple[Result, ...]
    plots: tuple[PlotEntry, ...] = ()
    parameters: dict[str, dict[str, Any]]
    units: dict[str, dict[str, str]] = {}
    versions: dict[str, str]
    nodes: dict[str, dict[str, Any]] = {}

    @property
    def judged(self) -> list[Result]:
        """The metrics that can pass or miss."""
        return [m for m in self.metrics if m.judged]

    @property
    def missed(self) -> list[Result]:
        """The metrics that missed."""
        return [m for m in self.metrics if not m.passed]


def read_run(directory: Path) -> Run:
    """Read ``metrics.json`` of a run directory.

    Raises
    ------
    ScenarioError
        No such file, not JSON, or a key is missing or of the wrong type; names file and key.
    """
    path = directory / "metrics.json"
    try:
        return Run.model_validate(json.loads(path.read_text()))
    except OSError:
        raise ScenarioError(f"{directory}: no metrics.json in it, expected the directory of a run") from None
    except ValidationError as error:
        first = error.errors()[0]
        raise ScenarioError(f"{path}: {'.'.join(map(str, first['loc']))}: {first['msg'].lower()}") from None
    except ValueError as error:
        raise ScenarioError(f"{path}: not valid JSON: {error}") from None


def write_report(directories: Sequence[Path], output: Path) -> None:
    """Write one page about one or more runs.

    Parameters
    ----------
    directories : sequence of Path
        Run directories: ``metrics.json`` and the pictures of `softrig_bringup.plots.plot_run`, if there are any.
    output : Path
        The HTML file; appears complete or not at all.

    Raises
    ------
    ScenarioError
        A directory is not that of a run.
    """
    runs = [(directory, read_run(directory)) for directory in directories]
    if len(runs) == 1:
        title = runs[0][1].title
        body = [_run(*runs[0], heading="h1", anchor="run-1")]
    else:
        title = f"{len(runs)} runs"
        body = [_e("header", _e("h1", title), _index([run for _, run in runs])), *_side_by_side([r for _, r in runs])]
        body += [_run(directory, run, "h2", f"run-{i}") for i, (directory, run) in enumerate(runs, 1)]
    page = _e(
        "html",
        _e(
            "head",
            _e("meta", charset="utf-8"),
            _e("meta", name="viewport", content="width=device-width, initial-scale=1"),
            _e("meta", name="color-scheme", content="light dark"),
            _e("title", f"{title} · softrig"),
            _e("style", _STYLE),
        ),
        _e("body", _e("main", *body)),
        lang="en",
    )
    temporary = output.with_name(output.name + ".part")
    temporary.write_text("<!DOCTYPE html>\n" + tostring(page, "unicode", "html"), encoding="utf-8")
    os.replace(temporary, output)


def _e(tag: str, *content: Element | str, **attributes: str) -> Element:
    """Make an element; text is escaped when the tree is written. ``class_`` stands for class."""
    element = Element(tag, {name.rstrip("_"): value for name, value in attributes.items() if value})
    for item in content:
        if isinstance(item, Element):
            element.append(item)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + item
        else:
            element.text = (element.text or "") + item
    return element


def _table(header: Sequence[str], rows: Sequence[Sequence[Element | str]], numbers: str = "") -> Element:
    """Make a table that scrolls by itself; `numbers` has an ``n`` for each column of numbers, right-aligned."""
    kinds = [kind.replace("n", "number").strip() for kind in numbers.ljust(len(header))]
    head = _e("tr", *(_e("th", text, scope="col", class_=kind) for text, kind in zip(header, kinds, strict=True)))
    body = [_e("tr", *(_e("td", cell, class_=kind) for cell, kind in zip(row, kinds, strict=True))) for row in rows]
    return _e("div", _e("table", _e("thead", head), _e("tbody", *body)), class_="scroll")


def _run(directory: Path, run: Run, heading: str, anchor: str) -> Element:
    below = f"h{int(heading[1]) + 1}"
    broken = [_e("p", f"The run broke: {run.error}", class_="broken")] if run.error else []
    nodes = list(_nodes(run))
    return _e(
        "section",
        _e("header", _e(heading, run.title), _e("p", f"{run.system} · ", _e("code", run.scenario), class_="what"),
           _e("p", run.source, class_="what"), _facts(run), *broken),
        _e(below, "Published and measured"), _metrics(run),
        _e(below, "Signals"), *_pictures(directory, run),
        _e(below, "Repeat this run"), _e("pre", run.command),
        _e(below, "Parameters"), *_parameters(run),
        *([_e(below, "Nodes")] if nodes else []), *nodes,
        _e(below, "Versions"), _pairs(run.versions),
        id=anchor, class_="run",
    )  # fmt: skip


def _facts(run: Run) -> Element:
    """The line of figures below the title: verdict, mode, time, speed."""
    facts: list[tuple[str, Element | str]] = [
        ("metrics", _verdict(run)),
        ("mode", run.mode),
        ("seed", str(run.seed)),
        ("duration", f"{run.duration_s:g} s"),
        ("ticks", f"{run.ticks:_}".replace("_", "\u202f")),
        ("wall time", f"{run.wall_s:.3g} s"),
    ]
    if run.wall_s > 0.0 and not run.error:
        facts.append(("speed", f"{run.duration_s / run.wall_s:.3g} × real time"))
    return _e("dl", *(_e("div", _e("dt", name), _e("dd", value)) for name, value in facts), class_="facts")


def _verdict(run: Run) -> Element:
    if run.error:
        return _mark(False, "broke")
    if not run.judged:
        return _e("span", NONE)
    text = f"{len(run.judged) - len(run.missed)} of {len(run.judged)} pass"
    return _mark(not run.missed, text)


def _mark(passed: bool, text: str) -> Element:
    """A verdict that does not depend on colour."""
    return _e("span", "✓ " if passed else "✗ ", text, class_="pass" if passed else "miss")


def _metrics(run: Run) -> Element:
    if not run.metrics:
        return _e("p", "No metrics." if run.error else "This scenario has no metrics.", class_="note")
    header = ("Figure", "Published", "Measured", "Unit", "Against published", "Accepted", "In tolerance", "Result")
    rows = [
        (
            m.name.replace("_", " "),
            _number(m.published),
            _measured(m),
            pretty_unit(m.unit),
            _difference(m.value, m.published),
            accepted(m) or NONE,
            _gauge(m),
            _result(m),
        )
        for m in run.metrics
    ]
    note = "Published: the number of the source. Accepted: what this scenario asks of the run."
    return _e("div", _table(header, rows, " nn nn "), _e("p", note, class_="note"))


def _result(metric: Result) -> Element:
    if not metric.judged:
        return _e("span", NONE)
    mark = _mark(metric.passed, "pass" if metric.passed else "miss")
    return _e("div", mark, _e("div", metric.error, class_="note")) if metric.error else mark


def _number(value: float | None) -> str:
    """A number that somebody wrote down, with all its digits."""
    return NONE if value is None else f"{value:.10g}".replace("-", "−")


def _measured(metric: Result) -> str:
    """The measured value, to a hundredth of its tolerance."""
    if metric.value is None:
        return NONE
    if not metric.tolerance:
        return f"{metric.value:.6g}".replace("-", "−")
    decimals = max(0, 2 - math.floor(math.log10(metric.tolerance)))
    return f"{metric.value:.{decimals}f}".replace("-", "−")


def _difference(value: float | None, published: float | None) -> str:
    if value is None or published is None:
        return NONE
    if published == 0.0:
        return f"{value:+.3g}".replace("-", "−")
    return f"{100.0 * (value - published) / abs(published):+.2f} %".replace("-", "−")


def accepted(metric: Result) -> str:
    """Write the interval that passes; empty when nothing was asked."""
    parts = []
    if metric.expected is not None:
        parts.append(f"{_number(metric.expected)} ± {_number(metric.tolerance or 0.0)}")
    if metric.at_least is not None:
        parts.append(f"≥ {_number(metric.at_least)}")
    if metric.at_most is not None:
        parts.append(f"≤ {_number(metric.at_most)}")
    return ", ".join(parts)


def _gauge(metric: Result) -> Element | str:
    """The measured value (dot) in its band of tolerance (bar); off the bar means a miss."""
    if metric.value is None or metric.expected is None or not metric.tolerance:
        return ""
    place = (metric.value - metric.expected) / metric.tolerance
    dot = 40.0 + 26.0 * max(-1.4, min(1.4, place))
    return _e(
        "svg",
        _e("title", f"{100.0 * place:+.0f} % of the tolerance".replace("-", "−")),
        _e("rect", x="14", y="5", width="52", height="4", rx="2", class_="band"),
        _e("line", x1="40", x2="40", y1="2", y2="12", class_="centre"),
        _e("circle", cx=f"{dot:.1f}", cy="7", r="3.5", class_="pass" if metric.passed else "miss"),
        width="80", height="14", viewBox="0 0 80 14", role="img", class_="gauge",
    )  # fmt: skip


def _pictures(directory: Path, run: Run) -> Iterator[Element]:
    wanted = [(plot_name(i, p.title), p.title, ", ".join(p.signals)) for i, p in enumerate(run.plots, 1)]
    wanted.append((OVERVIEW, "Every recorded signal", ""))
    found = [(directory / name, title, text) for name, title, text in wanted if (directory / name).is_file()]
    if not found:
        yield _e("p", "This run has no pictures.", class_="note")
    for path, title, text in found:
        data = path.read_bytes()
        width, height = struct.unpack(">II", data[16:24])
        source = f"data:image/png;base64,{base64.b64encode(data).decode()}"
        image = _e("img", src=source, alt=title, width=str(width), height=str(height))
        yield _e("figure", image, *([_e("figcaption", text)] if text else []))


def _parameters(run: Run) -> Iterator[Element]:
    for node, values in run.parameters.items():
        units = run.units.get(node, {})
        count = f"{len(values)} parameter{'' if len(values) == 1 else 's'}"
        summary = _e("summary", _e("code", node), _e("span", f" {count}", class_="note"))
        shown = {name: _value(value, units.get(name, "")) for name, value in values.items()}
        yield _e("details", summary, _pairs(shown))


def _value(value: Any, unit: str) -> str:
    if value is None:
        return NONE
    text = value if isinstance(value, str) else json.dumps(value)
    return f"{text} {pretty_unit(unit)}".rstrip()


def _pairs(values: Mapping[str, str]) -> Element:
    """Names and values, as many columns as fit."""
    items = (_e("div", _e("dt", name), _e("dd", value)) for name, value in values.items())
    return _e("dl", *items, class_="pairs")


def _nodes(run: Run) -> Iterator[Element]:
    """Run statistics: one row a node, one column a figure that any node has; then what the nodes had to say."""
    rows = {
        node: {"refused": sum(count for count, _ in status.get("refused", {}).values())} | _plain(status)
        for node, status in run.nodes.items()
        if "state" in status  # a process of its own
    }
    if rows:
        columns = list(dict.fromkeys(name for row in rows.values() for name in row))
        body: list[list[Element | str]] = [
            [_e("code", node), *(_figure(row.get(name)) for name in columns)] for node, row in rows.items()
        ]
        yield _table(("Node", *map(_heading, columns)), body, " " + "n" * len(columns))
    for node, status in run.nodes.items():
        said = [f"{text} ({count} ×)" for _, text, count in status.get("reports", {}).values()]
        said += [f"{n} messages refused on {topic}: {text}" for topic, (n, text) in status.get("refused", {}).items()]
        if status.get("error"):
            said.append(status["error"])
        yield from (_e("p", _e("code", node), f": {text}") for text in said)


def _plain(status: Mapping[str, Any]) -> dict[str, Any]:
    """The figures of a node's status that fit a cell."""
    return {name: value for name, value in status.items() if isinstance(value, (int, float)) and name != "t"}


def _heading(name: str) -> str:
    """``cpu_s`` as "cpu (s)"."""
    words, _, last = name.rpartition("_")
    unit = {"s": "s", "ms": "ms", "mb": "MB"}.get(last)
    return f"{words} ({unit})".replace("_", " ") if unit else name.replace("_", " ")


def _figure(value: float | None) -> str:
    if value is None:
        return NONE
    return str(value) if isinstance(value, int) else f"{value:.3g}"


def _index(runs: Sequence[Run]) -> Element:
    rows = [
        (
            _e("a", run.scenario, href=f"#run-{i}"),
            run.title,
            run.mode,
            str(run.seed),
            f"{run.duration_s:g} s",
            f"{run.wall_s:.3g} s",
            _verdict(run),
            run.error or ", ".join(m.name.replace("_", " ") for m in run.missed),
        )
        for i, run in enumerate(runs, 1)
    ]
    header = ("Scenario", "Title", "Mode", "Seed", "Simulated", "Wall time", "Metrics", "Missed")
    return _table(header, rows, "   nnn  ")


def _side_by_side(runs: Sequence[Run]) -> Iterator[Element]:
    """For each system with several runs: the metrics that at least two of them have, one row a run."""
    for system in dict.fromkeys(run.system for run in runs):
        group = [(i, run) for i, run in enumerate(runs, 1) if run.system == system and run.metrics]
        names = [(m.name, m.unit) for _, run in group for m in run.metrics]
        columns = [key for key in dict.fromkeys(names) if names.count(key) > 1]
        if not columns:
            continue
        rows: list[list[Element | str]] = []
        for i, run in group:
            have = {(m.name, m.unit): m for m in run.metrics}
            cells = [_cell(have.get(key)) for key in columns]
            rows.append([_e("a", run.scenario, href=f"#run-{i}"), run.mode, *cells])
        header = [f"{name.replace('_', ' ')} ({pretty_unit(unit)})" if unit else name.replace("_", " ")
                  for name, unit in columns]  # fmt: skip
        yield _e("h2", f"{system}: side by side")
        yield _table(("Scenario", "Mode", *header), rows, "  " + "n" * len(columns))


def _cell(metric: Result | None) -> Element | str:
    if metric is None:
        return ""
    text = _measured(metric)
    return text if metric.passed else _mark(False, text)


_STYLE = """
:root { --ink: #1c2024; --soft: #5b6570; --line: #d9dee3; --panel: #f5f7f9; --paper: #ffffff; --link: #0b5cad;
  --good: #116b3a; --bad: #b3261e; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e4e8ec; --soft: #9aa5b1; --line: #3a424b; --panel: #242628; --paper: #1a1a1a; --link: #7db7f0;
    --good: #5fcf93; --bad: #ff8a80; }
  img { filter: invert(0.9) /* white to #1a1a1a */ hue-rotate(180deg); }
}
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans",
  sans-serif; }
main { max-width: 1100px; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.7rem; line-height: 1.25; margin: 0 0 .25rem; }
h2 { font-size: 1.25rem; margin: 2.2rem 0 .6rem; }
h3 { font-size: 1.05rem; margin: 1.8rem 0 .5rem; }
p { margin: .2rem 0; max-width: 75ch; }
a { color: var(--link); }
code, pre { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .92em; }
pre { background: var(--panel); border: 1px solid var(--line); border-radius: 6px; padding: .7rem .9rem; margin: 0;
  white-space: pre-wrap; overflow-wrap: anywhere; }
.what, .note, figcaption { color: var(--soft); }
.note, figcaption { font-size: .87rem; }
* + .run { border-top: 3px solid var(--line); margin-top: 3rem; padding-top: .5rem; }
dl { margin: 0; }
dt { color: var(--soft); font-size: .82rem; }
dd { margin: 0; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.facts { display: flex; flex-wrap: wrap; gap: .5rem 2.2rem; margin-top: 1rem; padding: .7rem 1rem;
  background: var(--panel); border: 1px solid var(--line); border-radius: 6px; }
.facts dd { font-weight: 600; }
.pairs { columns: 3 18rem; column-gap: 2rem; }
.pairs div { display: flex; justify-content: space-between; gap: 1rem; break-inside: avoid; padding: .12rem 0;
  border-bottom: 1px dotted var(--line); }
.pairs dt { font-size: .9rem; }
.pairs dd { font-size: .9rem; text-align: right; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: .92rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .34rem .9rem .34rem 0; border-bottom: 1px solid var(--line); vertical-align: top; }
th { color: var(--soft); font-weight: 600; font-size: .82rem; border-bottom-width: 2px; vertical-align: bottom; }
.number { text-align: right; }
td.number { white-space: nowrap; }
th:last-child, td:last-child { padding-right: 0; }
.pass { color: var(--good); white-space: nowrap; }
.miss { color: var(--bad); font-weight: 600; white-space: nowrap; }
.broken { color: var(--bad); font-weight: 600; margin-top: .8rem; }
.gauge { vertical-align: -2px; }
.gauge .band { fill: var(--line); }
.gauge .centre { stroke: var(--soft); }
.gauge .pass { fill: var(--good); }
.gauge .miss { fill: var(--bad); }
figure { margin: 0 0 1.4rem; break-inside: avoid; }
img { display: block; max-width: 100%; height: auto; }
details { border-top: 1px solid var(--line); padding: .35rem 0; }
summary { cursor: pointer; }
details .pairs { padding: .3rem 0 .6rem 1.1rem; }
@media print {
  :root { --ink: #000; --soft: #444; --line: #bbb; --panel: #fff; --paper: #fff; --link: #000; --good: #000;
    --bad: #000; }
  @page { margin: 15mm; }
  body { font-size: 9.5pt; }
  main { max-width: none; padding: 0; }
  img { filter: none; max-height: 235mm; width: auto; }
  h2, h3 { break-after: avoid; }
  tr { break-inside: avoid; }
  * + .run { break-before: page; }
  .scroll { overflow: visible; }
  details::details-content { content-visibility: visible; block-size: auto; }
}
"""
