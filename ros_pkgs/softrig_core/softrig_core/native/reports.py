"""The reports of blocks in native ticks: native code counts them, Python formats them later with the newest numbers."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..block.block import Level
from ..block.held import RunningBlock

EXACT = 1 << 53  # whole numbers up to it are floats
HEAD = 3  # of a place: how often, the number of the first one and of the newest among all; its numbers after them


@dataclass(frozen=True)
class Place:
    """A line that reports: its block, its text, and the start of its row in the table."""

    block: int
    level: Level
    key: str
    text: Callable[[Sequence[float]], str]
    at: int


@dataclass
class Reports:
    """The places of a text that report.

    Attributes
    ----------
    size : int
        Size of the table; its first number counts all reports.
    worded : bool
        Whether their texts are needed. Without them every report can be counted, even if its text is made elsewhere.
    """

    places: list[Place] = field(default_factory=list)
    size: int = 1
    worded: bool = True

    def add(self, block: int, level: Level, key: str, text: Callable[[Sequence[float]], str], count: int) -> int:
        """Return a line that reports `count` numbers its place in the table."""
        self.places.append(Place(block, level, key, text, self.size))
        self.size += HEAD + count
        return self.places[-1].at

    def record(self, table: Sequence[float], running: Sequence[RunningBlock]) -> None:
        """Record the reports of each block in a table, as if they had been reported one by one."""
        received = [p for p in self.places if table[p.at]]
        newest: dict[tuple[int, str], Place] = {}
        for report in sorted(received, key=lambda p: table[p.at + 2]):
            newest[report.block, report.key] = report
        # Python keeps keys in the order of their first report and the text of the newest one.
        for report in sorted(received, key=lambda p: table[p.at + 1]):
            reports, last = running[report.block].reports, newest[report.block, report.key]
            before = reports[report.key][2] if report.key in reports else 0
            text = last.text([float(v) for v in table[last.at + HEAD :]])
            reports[report.key] = last.level, text, before + int(table[report.at])


def wording(node: ast.expr) -> list[str | ast.FormattedValue] | None:
    """Return the parts of a text that is written out; None: it is another one."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return [node.value]
    if not isinstance(node, ast.JoinedStr):
        return None
    result: list[str | ast.FormattedValue] = []
    for part in node.values:
        if isinstance(part, ast.FormattedValue):
            if part.format_spec is not None and (
                not isinstance(part.format_spec, ast.JoinedStr)
                or any(not isinstance(spec, ast.Constant) for spec in part.format_spec.values)
            ):
                return None
            result.append(part)
        elif isinstance(part, ast.Constant):
            result.append(str(part.value))
    return result


def spec_of(part: ast.FormattedValue) -> str:
    """Return the format specification of a value."""
    parts = part.format_spec.values if isinstance(part.format_spec, ast.JoinedStr) else []
    return "".join(str(spec.value) for spec in parts if isinstance(spec, ast.Constant))


CONVERSIONS: Mapping[int, Callable[[Any], Any]] = {-1: lambda v: v, 115: str, 114: repr, 97: ascii}
