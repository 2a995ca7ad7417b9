"""Tables on a terminal of any width: no number or word is broken; columns that do not fit are moved below."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from softrig_core.guard import plain

Cell = str | Text
WORDS = ("unit", "")  # heads of the columns on the left


def fits(console: Console, table: Table) -> bool:
    """Return whether the terminal can show a table without breaking a line."""
    return Measurement.get(console, console.options.update(max_width=10_000), table).maximum <= console.width


def table_of(heads: Sequence[str], rows: Sequence[Sequence[Cell]], folded: bool = False) -> Table:
    """Create a table, its heads optionally folded at underscores and dots; cells other than words are right-aligned."""
    result = Table(box=None, pad_edge=False)
    for k, head in enumerate(heads):
        room = max((len(row[k]) for row in rows), default=0) if folded else len(head)
        result.add_column(_folded(head, room), justify="left" if not k or head in WORDS else "right", no_wrap=True)
    for row in rows:
        result.add_row(*row)
    return result


def print_judged(console: Console, heads: Sequence[str], rows: Sequence[Sequence[Cell]]) -> None:
    """Print one row for each name, its verdict last; if that is too wide, name and verdict with the rest below them."""
    table = table_of(heads, rows)
    if fits(console, table):
        console.print(table)
        return
    for name, *cells, verdict in rows:
        console.print(Text.assemble(str(name), "  ", verdict))
        messages = [
            f"{'in' if head == 'unit' else head} {cell}"
            for head, cell in zip(heads[1:-1], cells, strict=True)
            if str(cell)
        ]
        console.print(Padding(", ".join(messages), (0, 0, 0, 2)))


def print_columns(console: Console, heads: Sequence[str], rows: Sequence[Sequence[Cell]], keys: int = 1) -> None:
    """Print a table; columns that do not fit side by side follow below, with the first `keys` repeated."""
    table = table_of(heads, rows)
    if fits(console, table):
        console.print(table)
        return
    shown = list(range(keys))
    for k in [*range(keys, len(heads)), None]:
        now = shown if k is None else [*shown, k]
        if k is None or not fits(console, _chosen(heads, rows, now)):
            if len(shown) > keys or k is None:
                console.print(_chosen(heads, rows, shown))
            shown = list(range(keys))
        shown += [] if k is None else [k]


def _chosen(heads: Sequence[str], rows: Sequence[Sequence[Cell]], columns: Sequence[int]) -> Table:
    return table_of([heads[k] for k in columns], [[row[k] for k in columns] for row in rows], True)


def _folded(head: str, room: int) -> str:
    """Fold a head at its underscores and dots if the cells below it are narrower."""
    lines = [""]
    for piece in plain(head).replace("_", "_\0").replace(".", ".\0").split("\0"):
        if lines[-1] and len(lines[-1] + piece) > room:
            lines.append("")
        lines[-1] += piece
    return "\n".join(lines)
