"""Fills: which output of one step fills which input of another of its process, and with which numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, NamedTuple

from .answer import Row
from .port import Port, Sample

if TYPE_CHECKING:
    from .step import Step

Stamp = Literal["none", "own", "tick"]
# Of each number of an input: an int is its place among those of the output, a float the number itself, for a channel
# of a partial input that the output does not have.
Pick = tuple[int | float, ...]


def picked(pick: Pick | None, values: tuple[float, ...]) -> tuple[float, ...]:
    """Return the numbers of an input from those of an output; all of them if `pick` is None."""
    return values if pick is None else tuple([values[p] if type(p) is int else p for p in pick])


def value_text(row: str, pick: Pick | None, stamp: Stamp) -> str:
    """Return the effect of `Fill.value_of` on a row of that name, as Python text with `t` for the tick of the
    source.
    """
    if pick is None and stamp != "tick":
        return row
    data = f"{row}.data" if stamp == "own" else row
    if pick is not None:
        data = f"({''.join(f'{data}[{p}], ' if type(p) is int else f'{p!r}, ' for p in pick)})"
    if stamp == "none":
        return data
    return f"Sample({'t' if stamp == 'tick' else f'{row}.stamp'}, {data})"


class Fill(NamedTuple):
    """An output that fills an input.

    Parameters
    ----------
    source : Step
        Publishes.
    output : int
        Number of its output.
    port : Port
        The input of the reader.
    pick : tuple or None
        Its numbers; None: those of the output.
    stamp : str
        What the input gets: ``none``, a tuple; ``own``, the `Sample` that a delayed output is, with its stamp;
        ``tick``, a `Sample` with the tick of the source.
    """

    source: Step
    output: int
    reader: Step
    port: Port
    pick: Pick | None
    stamp: Stamp

    @property
    def places(self) -> Pick:
        """Return the source of each number of the input: a place among those of the output, or the number itself."""
        return tuple(range(self.source.outputs[self.output].size)) if self.pick is None else self.pick

    @property
    def silent(self) -> bool:
        """Return whether the source may publish nothing at a tick, or a message with an earlier stamp."""
        port = self.source.outputs[self.output]
        return port.sporadic or port.delayed

    @property
    def checked(self) -> bool:
        """Return whether the input checks what it receives, because a fault may publish bad values."""
        return self.source.outputs[self.output].unchecked

    def value_of(self, row: Row) -> Row:
        """Return the value of the input from the row that the output publishes at a tick."""
        if isinstance(row, Sample):
            return row if self.pick is None else Sample(row.stamp, picked(self.pick, row.data))
        data = picked(self.pick, row)
        return Sample(self.source.t, data) if self.stamp == "tick" else data

    def set_value(self, row: Row) -> None:
        """Copy the numbers of a row that the input reads into the subscriber's values."""
        self.reader.values[self.port.name] = self.value_of(row)

    def last_published(self) -> int | None:
        """Return the time of the output's newest message, ns; None before the first."""
        source = self.source
        return source.t if source.plain else source.published_at[self.output]
