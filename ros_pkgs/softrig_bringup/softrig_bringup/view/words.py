"""Text and tables of a page: HTML of figures, node health and user actions."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping
from typing import Any

from softrig_core.judge.units import pretty_unit
from softrig_core.verdict.result import Result

from ..page.wording import NEVER, accepted, in_words, measured_here
from .control import Control, Entry
from .sources import Source

COUNTS = {
    "missed_deadlines": "missed",
    "incomplete_ticks": "incomplete",
    "dropped_ticks": "dropped",
    "late_messages": "late",
    "overdue_messages": "overdue",
    "lost_arrays": "lost",
    "skipped_periods": "skipped",
}


def head(source: Source, how: str, control: Control) -> str:
    """Describe the run, its progress, and the newest line of the log."""
    scenario = source.rig.scenario
    state, style = f"{source.end:.6g} s, {source.outcome}", "soft"
    if source.outcome and source.live:
        after = "its knobs act no more" if not control.goes_back else "go back and turn a knob"
        state, style = f"the run is over: {state}; {after}", "over wrong" if source.outcome[:5] == "broke" else "over"
    elif not source.outcome:
        state = f"{source.end:.6g} of {scenario.duration:g} s, {_progress(source, control)}"
    note = "; older samples are reduced to their extremes" if source.thinned else ""
    text = "".join(
        f'<p class="{"wrong" if s.wrong else "soft"}">{html.escape(f"{s.author}: {s.text}")}</p>'
        for s in list(control.entries)[-1:]
    )
    return (
        f"<h1>{html.escape(scenario.name)}</h1><p>{html.escape(scenario.title)}</p>"
        f'<p class="{style}">{html.escape(how)}: {html.escape(state + note)}</p>{text}'
    )


def _progress(source: Source, control: Control) -> str:
    """Describe the awaited nodes, or whether the rig runs, at which pace, and whether the machine keeps up."""
    if names := source.awaited:
        return f"starting for {source.waited:.0f} s, waits for {', '.join(names)}"
    if control.held:
        return "paused"
    if control.held is None or control.pace is None:
        return "running"
    if not control.pace:
        return "running as fast as possible"
    late = f", of which this machine reaches {source.speed:.2g}" if 0 < source.speed < 0.8 * control.pace else ""
    return f"running at {f'{control.pace:g} of ' if control.pace != 1 else ''}the wall's pace{late}"


def figures(results: Iterable[Result], so_far: bool) -> str:
    """Return the table of figures and of the margins of requirements."""
    rows = []
    for f in results:
        value = "-" if f.value is None else f"{f.value:.5g}"
        unit = pretty_unit(f.unit)
        text = unit if f.value is not None or (so_far and not measured_here(f)) else in_words(f)
        text = "not yet" if so_far and text == NEVER else text
        style = 'class="u"' if text == unit else ""
        rows.append(
            f'<tr><td>{_broken(f.name)}</td><td class="n">{value}</td><td {style}>{html.escape(text)}</td>'
            f'<td>{html.escape(accepted(f))}</td><td class="n">{_mark(f, so_far)}</td></tr>'
        )
    first = '<tr><th>name</th><th class="n">value</th><th></th><th>expected</th><th></th></tr>'
    return _section("Figures and margins" + (", so far" if so_far else ""), first, rows)


def _mark(f: Result, so_far: bool) -> str:
    """Return the verdict on a figure; without colour if later data may change it."""
    if f.published_for:
        return f'<span title="published for {html.escape(f.published_for)}">not judged</span>'
    if not f.judged or (so_far and not measured_here(f)):
        return ""
    if so_far and not f.settled:
        return f'<span class="soft">{"inside" if f.passed else "outside"}</span>'
    return '<span class="good">pass</span>' if f.passed else '<span class="wrong">miss</span>'


def health(status: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the table of the nodes: state, missed, rejected and reported counts."""
    rows = []
    for name, s in status.items():
        counts = [f"{s[key]} {word}" for key, word in COUNTS.items() if s.get(key)]
        counts += [f"{n} refused on {topic}: {text}" for topic, (n, text) in s.get("refused", {}).items()]
        counts += [f"{text} ({n} x)" for level, text, n in s.get("reports", {}).values() if level]
        counts += [s["error"]] if s.get("error") else []
        counts += [f"waits: {text}" for text in s.get("lacking", [])]
        message = f'<span class="wrong">{html.escape("; ".join(counts))}</span>' if counts else "well"
        state = "starting" if not s else str(s.get("state", ""))
        rows.append(
            f"<tr><td>{html.escape(name)}</td><td>{html.escape(state)}</td>"
            f'<td class="n">{s.get("ticks", "")}</td><td>{message}</td></tr>'
        )
    return _section("Nodes", "<tr><th>node</th><th>state</th><th>ticks</th><th>health</th></tr>", rows)


def log(lines: Iterable[Entry]) -> str:
    """Format the log of actions and reports, newest first."""
    rows = [
        f'<tr><td class="n">{s.t:.6g} s</td><td>{html.escape(s.author)}</td>'
        f'<td class="{"wrong" if s.wrong else ""}">{html.escape(s.text)}</td></tr>'
        for s in reversed(list(lines))
    ]
    return _section("What was done", "", rows) if rows else _section("What was done", "", ["<tr><td>nothing</td></tr>"])


def values(names: Mapping[str, tuple[float | None, str]], t: float) -> str:
    """Return the table of the values at a time (s): value and unit by label."""
    rows = [
        f'<tr><td>{html.escape(label)}</td><td class="n">{"-" if v is None or math.isnan(v) else f"{v:.6g}"}</td>'
        f"<td>{html.escape(pretty_unit(unit))}</td></tr>"
        for label, (v, unit) in names.items()
    ]
    return _section(f"At {t:.6g} s", "", rows)


def _broken(name: str) -> str:
    """Return a name as HTML that a narrow table breaks between its words."""
    return html.escape(name).replace("_", "_<wbr>")


def _section(title: str, first: str, rows: Iterable[str]) -> str:
    return f"<h2>{html.escape(title)}</h2><table>{first}{''.join(rows)}</table>"
