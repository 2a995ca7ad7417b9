"""The head of a falsification's page: the question, the answer, the meaning of its numbers, and the responsible
change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

from softrig_core.judge.units import pretty_unit

from ..page.html import NONE, e, mark, picture, table
from ..plots import style as look
from ..plots.canvas import Figure
from ..plots.style import axis_title
from ..plots.svg import svg
from ..study.statistics import bound_text
from .definition import Falsification
from .engine import Outcome
from .words import number, shown

MEANING = (
    "The margin of a requirement is the distance of the run from violating it, in the unit of its signals; below 0 it "
    "is violated. If no violation is found, one may still exist."
)


def lead(task: Falsification, outcome: Outcome, units: Mapping[str, str], files: Mapping[str, Path]) -> list[Element]:
    """Create the head of the page: question, answer, what the numbers mean, and the change that causes the violation.

    Parameters
    ----------
    units : mapping
        Of requirements.
    files : mapping
        Scenario files of the worst run and the small one.
    """
    asked = f"Does every run keep {_and(outcome.names)} over {_and(list(task.over))}?"
    fulfilled = not outcome.violated
    answer = f"no violation in {outcome.search.runs} runs" if fulfilled else f"violated: {', '.join(outcome.violated)}"
    already = [name for name in outcome.violated if (nominal := outcome.nominal[name]) is not None and nominal < 0.0]
    answer += f"; without any change already: {', '.join(already)}" if already else ""
    if outcome.case is None:
        answer = f"none of {outcome.search.runs} runs could be judged"
    facts = [
        ("runs", f"{outcome.search.runs} of {task.budget}"),
        ("made small in", f"{outcome.shrinking} runs" if outcome.small else NONE),
        ("sampler", task.sampler),
        ("seed", str(task.seed)),
        ("least margin", number(outcome.search.least) if math.isfinite(outcome.search.least) else NONE),
        ("of the corners", number(outcome.search.corners) if math.isfinite(outcome.search.corners) else NONE),
    ]
    body = [
        e(
            "header",
            e("h1", task.title or task.name),
            e("p", asked, class_="what"),
            e("p", mark(fulfilled and outcome.case is not None, answer)),
            e("dl", *(e("div", e("dt", k), e("dd", v)) for k, v in facts), class_="facts"),
        ),
        e("h2", "Margins"),
        e("p", MEANING, class_="note"),
        _margins(outcome, units),
        *(e("p", f"{note[0].upper()}{note[1:]}.", class_="note") for note in outcome.bounds),
    ]
    if outcome.case is not None:
        worst, small = outcome.case[1], outcome.small[1] if outcome.small else {}
        rows = [(name, task.over.get(name, ""), shown(worst[name]), shown(small[name]) if name in small else NONE)
                for name in worst]  # fmt: skip
        body += [e("h2", "By which change"), table(("What", "Searched", "Worst", "Made small"), rows, "  nn")]
        body += [e("pre", "\n".join(f"softrig run {path}" for path in files.values()))] if files else []
    if outcome.search.trace:
        body += [
            e("h2", "History of the search"),
            e("figure", picture(svg(history(outcome)), "history of the search")),
        ]
    return body


def _margins(outcome: Outcome, units: Mapping[str, str]) -> Element:
    scenario = outcome.space.scenario
    rows = []
    for name in outcome.names:
        asked = (
            scenario.requirements[name].formula
            if name in scenario.requirements
            else bound_text(name, scenario.expect[name])
        )
        worst, small = outcome.worst.get(name), outcome.small_margins.get(name) if outcome.small else None
        cells = [mark(value >= 0.0, number(value)) if value is not None else NONE for value in (worst, small)]
        rows.append((name, e("code", asked), pretty_unit(units.get(name, "")), number(outcome.nominal[name]), *cells))
    return table(("Requirement", "What it asks", "Unit", "As it is", "Worst found", "Made small"), rows, "   nnn")


def _and(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1] if names else "")))


def history(outcome: Outcome) -> Figure:
    """Draw the least margin so far over the runs of a search, and where a violation begins."""
    trace: list[Any] = outcome.search.trace
    runs = range(1, len(trace) + 1)
    figure = Figure(figsize=(look.WIDTH, 3.0), dpi=look.DPI)
    figure.title = "History of the search"
    ax = figure.subplots()
    ax.plot(runs, trace, drawstyle="steps-post")
    ax.axhline(0.0, color=look.VIOLATED, linewidth=1.0)
    style: dict[str, Any] = {"xycoords": ax.get_yaxis_transform(), "textcoords": "offset points", "fontsize": 8}
    ax.annotate("violated below", (1.0, 0.0), (-4, -4), ha="right", va="top", color=look.VIOLATED, **style)
    ax.whole_numbers()
    ax.margins(x=0.02, y=0.1)
    ax.set_xlabel("Run")
    several = len(outcome.names) > 1
    ax.set_ylabel(axis_title("Least margin so far" + (" by its nominal size" if several else ""), ""))
    return figure
