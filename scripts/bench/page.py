"""Tables of measurements: printed, and written between the marks of a page with what they were measured under."""

from __future__ import annotations

import os
import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

from rich.table import Table as Printed

from .console import console

ROOT = Path(__file__).resolve().parents[2]
LAB = "ros_pkgs/softrig_{}/doc/lab/{}.md"

Table = list[tuple[str, ...]]  # head, then rows
Tables = dict[str, Table]  # tables by their mark on the page


class Page(NamedTuple):
    """Where a part of the bench writes its tables, and a sentence about the kind of time in them."""

    path: Path
    times: str


class Begin(NamedTuple):
    """When a measurement began, and the load of the machine then."""

    date: str
    load: float

    @classmethod
    def now(cls) -> Begin:
        """Create it for this moment."""
        return cls(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC", os.getloadavg()[0])

    def line(self, command: str, times: str) -> str:
        """Return the sentences that stand above a table: command, commit, processor, load, kind of time."""
        load = f"load {self.load:.1f} at the begin and {os.getloadavg()[0]:.1f} at the end"
        machine = f"{os.cpu_count()} cores of {_processor()}"
        return f"Written by `{command}` on {self.date} at {_commit()}; {machine}; {load}. {times}"


def page(package: str, name: str, times: str) -> Page:
    """Return the laboratory page of a package."""
    return Page(ROOT / LAB.format(package, name), times)


def show(table: Table) -> None:
    """Print a table."""
    printed = Printed(*table[0], box=None, pad_edge=False)
    for row in table[1:]:
        printed.add_row(*row)
    console.print(printed)


def written(text: str, mark: str, line: str, table: Table) -> str:
    """Return a page's text with a table in place of the one that has this mark.

    Raises
    ------
    ValueError
        It has no such mark.
    """
    rows = "\n".join(f"| {' | '.join(row)} |" for row in (table[0], ("---",) * len(table[0]), *table[1:]))
    part = re.compile(rf"(<!-- bench: {re.escape(mark)} -->\n).*?(<!-- end -->)", re.DOTALL)
    result, count = part.subn(lambda m: f"{m[1]}{line}\n\n{rows}\n{m[2]}", text)
    if count != 1:
        raise ValueError(f"the page has {count} parts `<!-- bench: {mark} -->`, expected one")
    return result


def write(page: Page, tables: Tables, command: str, begun: Begin) -> None:
    """Write tables to their page."""
    text = page.path.read_text()
    for mark, table in tables.items():
        text = written(text, mark, begun.line(command, page.times), table)
    page.path.write_text(text)
    console.print(f"written: {page.path.relative_to(ROOT)}")


def _processor() -> str:
    names = re.findall(r"^model name\s*: (.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    return names[0] if names else os.uname().machine


def _commit() -> str:
    """Return the commit of this checkout; with a note when its code has been changed since."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "--short=8", "HEAD"], capture_output=True, text=True).stdout.strip()
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", ".", ":!*.md"]).returncode
    return f"{head}, changed" if changed else head
