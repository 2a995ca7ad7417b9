"""Figures as a table of a paper: LaTeX (booktabs) or CSV, with one number of decimals a column."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import NamedTuple

from softrig_core import ScenarioError
from softrig_core.guard import replace
from softrig_core.judge.units import pretty_unit

DIGITS = 4  # significant digits of the largest value in a column without uncertainties
SURE = 2  # significant digits of the largest uncertainty in a column
_SPECIAL = {c: f"\\{c}" for c in "&%$#_{}"} | {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\^{}"}
_UNICODE = {"·": r"$\cdot$", "²": "$^2$", "³": "$^3$", "Ω": r"$\Omega$", "°": r"$^\circ$", "−": "$-$"}


class Column(NamedTuple):
    """Numbers of one figure, one for each row; NaN and infinity for missing ones.

    Parameters
    ----------
    halves : sequence of float
        Half widths of the intervals of 95 %; empty: the numbers have none.
    """

    name: str
    unit: str
    values: Sequence[float]
    halves: Sequence[float] = ()

    @property
    def decimals(self) -> int:
        """Number of decimals of all its values; negative for tens, hundreds."""
        for numbers, digits in ((self.halves, SURE), (self.values, DIGITS)):
            largest = max((abs(x) for x in numbers if math.isfinite(x)), default=0.0)
            if largest:
                return digits - 1 - math.floor(math.log10(float(f"{largest:.{digits - 1}e}")))
        return 0

    def cells(self) -> list[tuple[str, str]]:
        """Write number and uncertainty of each row; empty for a missing one."""
        halves = self.halves or [math.nan] * len(self.values)
        return [(self._written(x), self._written(h)) for x, h in zip(self.values, halves, strict=True)]

    def _written(self, x: float) -> str:
        if not math.isfinite(x):
            return "never" if x == math.inf else ""
        return f"{round(x, self.decimals):.{max(0, self.decimals)}f}"


def write_paper_table(path: Path, head: str, rows: Sequence[str], columns: Sequence[Column]) -> None:
    """Write a table by the ending of its file.

    Parameters
    ----------
    path : Path
        ``.tex`` or ``.csv``.
    head : str
        Of the first column, which names the rows.

    Raises
    ------
    ScenarioError
        Another ending.
    """
    writers = {".tex": latex, ".csv": table_csv}
    if path.suffix not in writers:
        raise ScenarioError(f"{path}: expected a table as .tex or .csv")
    replace(path, writers[path.suffix](head, rows, columns))


def latex(head: str, rows: Sequence[str], columns: Sequence[Column]) -> str:
    """Write a table for LaTeX, which needs its package booktabs."""
    heads = [_escaped(head), *(_escaped(_title(c)) for c in columns)]
    cells = [c.cells() for c in columns]
    lines = [" & ".join([_escaped(name), *(_number(*col[k]) for col in cells)]) + r" \\" for k, name in enumerate(rows)]
    parts = [f"\\begin{{tabular}}{{l{'r' * len(columns)}}}", r"\toprule", " & ".join(heads) + r" \\", r"\midrule"]
    return "\n".join([*parts, *lines, r"\bottomrule", r"\end{tabular}", ""])


def table_csv(head: str, rows: Sequence[str], columns: Sequence[Column]) -> str:
    """Write a table as CSV; the uncertainty of a column is in the column after it."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    having = [(c, c.cells(), bool(c.halves)) for c in columns]
    title = [[_title(c), *([f"± {_title(c)}"] if sure else [])] for c, _, sure in having]
    writer.writerow([head, *(cell for cells_of in title for cell in cells_of)])
    for k, name in enumerate(rows):
        writer.writerow([name, *(cell for _, cells, sure in having for cell in cells[k][: 1 + sure])])
    return text.getvalue()


def _title(column: Column) -> str:
    unit = pretty_unit(column.unit)
    return column.name.replace("_", " ") + (f" ({unit})" if unit else "")


def _number(value: str, half: str) -> str:
    if not value or value == "never":
        return value or "--"
    return f"${value} \\pm {half}$" if half else f"${value}$"


def _escaped(text: str) -> str:
    return "".join((_SPECIAL | _UNICODE).get(c, c) for c in text)
