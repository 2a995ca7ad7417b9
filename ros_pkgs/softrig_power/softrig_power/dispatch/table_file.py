"""Tables of units and of losses as CSV: their columns, and reading rows that are as wide as the head."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path

from softrig_core.guard import print_line
from softrig_core.kit.file_format import FileFormat, number_of, text_of

UNITS = FileFormat(
    "a table of units",
    "softrig; CSV with commas and decimal points, or with semicolons or tabs and decimal commas",
    {
        "unit": ("used", "name of the unit"),
        "p_min_MW": ("used", "lower limit"),
        "p_max_MW": ("used", "upper limit"),
        "a_usd_per_MW2h": ("used", "cost a P^2 + b P + c + abs(e sin(f (p_min - P)))"),
        "b_usd_per_MWh": ("used", "coefficient b of this cost"),
        "c_usd_per_h": ("used", "coefficient c of this cost"),
        "e_usd_per_h": ("used", "coefficient e of this cost"),
        "f_rad_per_MW": ("used", "coefficient f of this cost"),
        "p_now_MW": ("used", "present output, from which the ramps count"),
        "ramp_up_MW": ("used", "largest rise to the next dispatch; needs p_now_MW"),
        "ramp_down_MW": ("used", "largest fall to the next dispatch; needs p_now_MW"),
        "reserve_MW": ("used", "largest reserve that the unit provides"),
        "prohibited zones": ("refused", "no method of dispatch supports them"),
        "fuels": ("refused", "no method of dispatch supports several cost curves of a unit"),
    },
)
LOSSES = FileFormat(
    "a table of losses",
    "softrig; the same CSV as a table of units",
    {
        "unit": ("used", "name of the unit, in the order of the table of units"),
        "a column named as each unit": ("used", "B, 1/MW"),
        "b0": ("used", "B0 of the unit, 0 when absent or empty"),
        "b00_MW": ("used", "B00, in the first row"),
    },
)


class TableError(ValueError):
    """A table that cannot be used; the text names row and column."""


class Row:
    """A row of a table, with its line for messages."""

    def __init__(self, source: str, values: Mapping[str, str], decimal_comma: bool) -> None:
        self.source = source
        self.values = values
        self._comma = decimal_comma

    def number(self, column: str, default: float | None = None) -> float:
        """Return a finite number; `default` where the field is empty or there is no such column.

        Raises
        ------
        TableError
            The value is not a number, or it is missing.
        """
        text = self.values.get(column, "")
        if not text and default is not None:
            return default
        shown = text
        if self._comma:
            text = text.replace(",", ".") if text.count(",") == 1 and "." not in text else text
        try:
            result = float(text)
        except ValueError:
            hint = "; it has a decimal comma in a file with decimal points" if text.count(",") == 1 else ""
            raise TableError(f"{self.source}, column {column}: {shown!r} is not a number{hint}") from None
        if not math.isfinite(number_of(text)):
            raise TableError(f"{self.source}, column {column}: {shown}, expected a finite number")
        return result


@lru_cache(maxsize=64)
def _log_once(text: str) -> None:
    # A note is written once, however often the table is read.
    print_line(text)


def read_rows(path: Path) -> tuple[tuple[str, ...], list[Row]]:
    """Read the columns and rows of a table.

    Fields are separated by commas with decimal points, or by semicolons or tabs with decimal points or commas. Empty
    rows and columns are left out.

    Raises
    ------
    TableError
        A row is longer or shorter than the head, or a column occurs twice or has no name.
    """
    text = text_of(path.read_bytes())
    head = text.partition("\n")[0]
    separator = next((mark for mark in (";", "\t") if mark in head), ",")
    lines = [(k, [f.strip() for f in row]) for k, row in _numbered(text, separator)]
    lines = [(k, row) for k, row in lines if any(row)]
    columns = lines[0][1] if lines else []
    used = len(columns)
    while used and not columns[used - 1] and not any(any(row[used - 1 : used]) for _, row in lines):
        used -= 1
    columns = columns[:used]
    twice = [name for name, count in Counter(columns).items() if count > 1 or not name]
    if twice:
        reason = f"column {twice[0]} occurs twice" if twice[0] else "a column has no name"
        raise TableError(f"{path.name}: {reason}")
    body = [(k, row[:used] if not any(row[used:]) else row) for k, row in lines[1:]]
    for k, row in body:
        if len(row) != used:
            comma = separator == "," and len(row) > used
            hint = "; write decimal points, or separate columns by semicolons" if comma else ""
            raise TableError(f"{path.name}, line {k}: {len(row)} fields, but the head has {used}{hint}")
    fields = [field for _, row in body for field in row]
    # A comma within a field is a decimal comma here, because the table has no decimal points anywhere.
    decimal_comma = separator != "," and any("," in f for f in fields) and not any("." in f for f in fields)
    if decimal_comma:
        _log_once(f"{path.name}: read with decimal commas")
    rows = [Row(f"{path.name}, line {k}", dict(zip(columns, row, strict=True)), decimal_comma) for k, row in body]
    return tuple(columns), rows


def _numbered(text: str, separator: str) -> list[tuple[int, list[str]]]:
    reader = csv.reader(text.splitlines(keepends=True), delimiter=separator, skipinitialspace=True)
    return [(reader.line_num, row) for row in reader]
