"""Runs as one self-contained HTML page: nothing to fetch, no script, for the screen and for paper."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from pydantic import BaseModel, ConfigDict, ValidationError
from softrig_core.errors import ScenarioError
from softrig_core.rig.figures import Result
from softrig_core.rig.scenario import PlotEntry

from .html import e, mark, table, write_page
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
    stopped: str = ""
    changed: tuple[str, ...] = ()
    command: str
    metrics: tuple[Result, ...]
    plots: tuple[PlotEntry, ...] = ()
    parameters: dict[str, dict[str, Any]]
    units: dict[str, dict[str, str]] = {}
    versions: dict[str, str]
    nodes: dict[str, dict[str, Any]] = {}

    @property
    def label(self) -> str:
        """Its scenario and what was changed of it: tells runs apart."""
        return ", ".join([self.scenario, *self.changed])

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
    runs, without = [], []
    for directory in directories:
        if directory.is_dir() and not (directory / "metrics.json").exists():
            without.append(str(directory))
        else:
            runs.append((directory, read_run(directory)))
    if not runs:
        raise ScenarioError(f"{', '.join(without)}: no metrics.json there, expected directories of runs")
    if len(runs) == 1:
        title = runs[0][1].title
        body = [_run(*runs[0], heading="h1", anchor="run-1")]
    else:
        title = f"{len(runs)} runs"
        body = [e("header", e("h1", title), _index([run for _, run in runs])), *_side_by_side([r for _, r in runs])]
        body += [_run(directory, run, "h2", f"run-{i}") for i, (directory, run) in enumerate(runs, 1)]
    if without:
        body.append(e("p", f"Left out, for want of a metrics.json: {', '.join(without)}", class_="note"))
    write_page(output, title, body)


def _run(directory: Path, run: Run, heading: str, anchor: str) -> Element:
    below = f"h{int(heading[1]) + 1}"
    broken = [e("p", f"The run broke: {run.error}", class_="broken")] if run.error else []
    nodes = list(_nodes(run))
    return e(
        "section",
        e("header", e(heading, run.title), e("p", f"{run.system} · ", e("code", run.label), class_="what"),
           e("p", run.source, class_="what"), _facts(run), *broken),
        e(below, "Published and measured"), _metrics(run),
        e(below, "Signals"), *_pictures(directory, run),
        e(below, "Repeat this run"), e("pre", run.command),
        e(below, "Parameters"), *_parameters(run),
        *([e(below, "Nodes")] if nodes else []), *nodes,
        e(below, "Versions"), _pairs(run.versions),
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
    return e("dl", *(e("div", e("dt", name), e("dd", value)) for name, value in facts), class_="facts")


def _verdict(run: Run) -> Element:
    if run.error:
        return mark(False, "broke")
    if not run.judged:
        return e("span", NONE)
    if run.changed or run.stopped:
        return e("span", "compared, not judged")
    text = f"{len(run.judged) - len(run.missed)} of {len(run.judged)} pass"
    return mark(not run.missed, text)


def _metrics(run: Run) -> Element:
    if not run.metrics:
        return e("p", "No metrics." if run.error else "This scenario has no metrics.", class_="note")
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
    return e("div", table(header, rows, " nn nn "), e("p", note, class_="note"))


def _result(metric: Result) -> Element:
    if not metric.judged:
        return e("span", NONE)
    verdict = mark(metric.passed, "pass" if metric.passed else "miss")
    return e("div", verdict, e("div", metric.error, class_="note")) if metric.error else verdict


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
    return e(
        "svg",
        e("title", f"{100.0 * place:+.0f} % of the tolerance".replace("-", "−")),
        e("rect", x="14", y="5", width="52", height="4", rx="2", class_="band"),
        e("line", x1="40", x2="40", y1="2", y2="12", class_="centre"),
        e("circle", cx=f"{dot:.1f}", cy="7", r="3.5", class_="pass" if metric.passed else "miss"),
        width="80", height="14", viewBox="0 0 80 14", role="img", class_="gauge",
    )  # fmt: skip


def _pictures(directory: Path, run: Run) -> Iterator[Element]:
    wanted = [(plot_name(i, p.title), p.title, ", ".join(p.signals)) for i, p in enumerate(run.plots, 1)]
    wanted.append((OVERVIEW, "Every recorded signal", ""))
    found = [(directory / name, title, text) for name, title, text in wanted if (directory / name).is_file()]
    if not found:
        yield e("p", "This run has no pictures.", class_="note")
    for path, title, text in found:
        data = path.read_bytes()
        width, height = struct.unpack(">II", data[16:24])
        source = f"data:image/png;base64,{base64.b64encode(data).decode()}"
        image = e("img", src=source, alt=title, width=str(width), height=str(height))
        yield e("figure", image, *([e("figcaption", text)] if text else []))


def _parameters(run: Run) -> Iterator[Element]:
    for node, values in run.parameters.items():
        units = run.units.get(node, {})
        count = f"{len(values)} parameter{'' if len(values) == 1 else 's'}"
        summary = e("summary", e("code", node), e("span", f" {count}", class_="note"))
        shown = {name: _value(value, units.get(name, "")) for name, value in values.items()}
        yield e("details", summary, _pairs(shown))


def _value(value: Any, unit: str) -> str:
    if value is None:
        return NONE
    text = value if isinstance(value, str) else json.dumps(value)
    return f"{text} {pretty_unit(unit)}".rstrip()


def _pairs(values: Mapping[str, str]) -> Element:
    """Names and values, as many columns as fit."""
    items = (e("div", e("dt", name), e("dd", value)) for name, value in values.items())
    return e("dl", *items, class_="pairs")


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
            [e("code", node), *(_figure(row.get(name)) for name in columns)] for node, row in rows.items()
        ]
        yield table(("Node", *map(_heading, columns)), body, " " + "n" * len(columns))
    for node, status in run.nodes.items():
        said = [f"{text} ({count} ×)" for _, text, count in status.get("reports", {}).values()]
        said += [f"{n} messages refused on {topic}: {text}" for topic, (n, text) in status.get("refused", {}).items()]
        if status.get("error"):
            said.append(status["error"])
        yield from (e("p", e("code", node), f": {text}") for text in said)


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
            e("a", run.label, href=f"#run-{i}"),
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
    return table(header, rows, "   nnn  ")


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
            rows.append([e("a", run.label, href=f"#run-{i}"), run.mode, *cells])
        header = [f"{name.replace('_', ' ')} ({pretty_unit(unit)})" if unit else name.replace("_", " ")
                  for name, unit in columns]  # fmt: skip
        yield e("h2", f"{system}: side by side")
        yield table(("Scenario", "Mode", *header), rows, "  " + "n" * len(columns))


def _cell(metric: Result | None) -> Element | str:
    if metric is None:
        return ""
    text = _measured(metric)
    return text if metric.passed else mark(False, text)
