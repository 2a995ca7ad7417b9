"""Statistics of a study as tables of words, for the terminal and the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..page.html import NONE
from ..page.paper_table import Column
from ..page.wording import NEVER
from .estimate import Estimate
from .statistics import Statistics
from .table import ALL

DIGITS = 2  # digits of the width of an interval


class Tabled(NamedTuple):
    """A table; its first `keys` columns identify a row. `answers` marks the table with the study's result."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    keys: int
    answers: bool = False


def tables(statistics: Statistics) -> list[Tabled]:
    """Write statistics as tables, those that have rows."""
    written = [
        Tabled(
            "Statistics, 95 % intervals",
            ("case", "figure", "unit", "n", "mean", "deviation", "5 %", "median", "95 %"),
            [
                (x.group, x.figure, x.unit, str(x.n) + (f", {x.lost}" if x.lost else ""), *map(written_estimate, x[5:]))
                for x in statistics.lines
            ],
            2,
        ),
        Tabled(
            "How often requirements hold, 95 % intervals",
            ("case", "requirement", "held", "n", "share"),
            [(x.group, x.requirement, str(x.held), str(x.n), written_estimate(x.share)) for x in statistics.shares],
            2,
        ),
        Tabled(
            "Differences at the same draws and seeds, 95 % intervals",
            ("case", "less", "figure", "unit", "pairs", "mean difference", "smaller in", "effect d", "p (Holm)"),
            [
                (
                    *(x.group, x.base, x.figure, x.unit, str(x.n)),
                    *(written_estimate(x.difference), written_estimate(x.smaller), _short(x.effect)),
                    NONE if math.isnan(x.p) else f"{x.p:.2g}" if x.p >= 1e-4 else "<0.0001",
                )
                for x in statistics.differences
            ],
            3,
            True,
        ),
        Tabled(
            "Sensitivity: share of the variance, 95 % intervals",
            ("case", "figure", "parameter", "alone", "with others"),
            [
                (x.group, x.figure, x.parameter, written_estimate(x.first), written_estimate(x.total))
                for x in statistics.indices
            ],
            3,
        ),
    ]
    return [_without_case(table) for table in written if table.rows]


def for_paper(statistics: Statistics) -> tuple[list[str], list[Column]]:
    """Return means and half widths of their intervals, one row for each case and one column for each figure."""
    groups, figures = (
        [*dict.fromkeys(key)] for key in ([x.group for x in statistics.lines], [x.figure for x in statistics.lines])
    )
    lines = {(x.group, x.figure): x for x in statistics.lines}
    units = {x.figure: x.unit for x in statistics.lines}
    none = Estimate(math.nan)
    columns = []
    for figure in figures:
        means = [lines[g, figure].mean if (g, figure) in lines else none for g in groups]
        columns.append(Column(figure, units[figure], [m.value for m in means], [m.high - m.value for m in means]))
    return groups, columns


def _without_case(table: Tabled) -> Tabled:
    """Remove the column of cases if there is only one case."""
    if any(row[0] != ALL for row in table.rows):
        return table
    return Tabled(table.title, table.heads[1:], [row[1:] for row in table.rows], table.keys - 1, table.answers)


def written_estimate(estimate: Estimate) -> str:
    """Write a number and its interval, no finer than two digits of the interval's half width."""
    if math.isinf(estimate.value):
        return NEVER
    if math.isnan(estimate.value):
        return NONE
    ends = [end for end in estimate[1:] if math.isfinite(end)]
    half = max((abs(end - estimate.value) for end in ends), default=0.0)
    decimals = DIGITS - 1 - math.floor(math.log10(half)) if half else None
    value = _rounded(estimate.value, decimals)
    if math.isnan(estimate.low) and math.isnan(estimate.high):
        return value
    low, high = (
        NEVER if math.isinf(end) else NONE if math.isnan(end) else _rounded(end, decimals) for end in estimate[1:]
    )
    return f"{value} [{low}, {high}]"


def _rounded(value: float, decimals: int | None) -> str:
    if decimals is None:
        return _short(value)
    if not -2 <= decimals <= 6:  # much smaller or larger numbers are printed with a power of ten
        return f"{value:.{max(0, decimals + _exponent(value))}e}" if value else "0"
    return f"{round(value, decimals):.{max(0, decimals)}f}"


def _exponent(value: float) -> int:
    return math.floor(math.log10(abs(value)))


def _short(value: float) -> str:
    return NONE if math.isnan(value) else f"{value:.3g}"
