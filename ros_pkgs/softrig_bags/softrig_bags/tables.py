"""Messages of a bag as tables of numbers, block by block: one layout for signals, exports and comparisons."""

from __future__ import annotations

import math
import mmap
import os
import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from softrig_core.wire.long import STRETCH, LongArray
from softrig_core.wire.types import TYPES

from .content.block import Block, Bytes, Ints, distinct
from .content.definitions import UnknownType
from .content.layouts import Column, Decoder, Template, Undecodable
from .files.reader import BagReader

FRAME = "header/frame_id"


class Piece(NamedTuple):
    """Some messages of a topic: bag times and header stamps in ns (bag times if it has none), and columns.

    A value that a message lacks is NaN in a column, or 0 in a column of whole numbers. For such integer columns
    `absent` marks the messages that lack the value. The columns may be views of the block from which they were read.
    """

    t: Ints
    stamp: Ints
    columns: dict[str, Column]
    absent: dict[str, NDArray[np.bool_]]


@dataclass
class Left:
    """Parts of a topic that were not converted to numbers, and why.

    Parameters
    ----------
    reason : str
        Why no message of the topic can be decoded; empty if some can.
    messages : int
        Number of damaged messages; the first of them is at bag time `first` ns and has `damage`.
    fields : dict of str to None
        Arrays that are too long for columns, in words.
    """

    reason: str = ""
    messages: int = 0
    first: int = 0
    damage: str = ""
    fields: dict[str, None] = field(default_factory=dict)


class Columns:
    """Makes tables of the messages of a bag's topics.

    Parameters
    ----------
    bag : BagReader
        Open.

    Attributes
    ----------
    left : dict of int to Left
        By topic: what has been left out so far.
    texts : dict of int to dict, or None
        By topic and field: one text, or two if there are several; only if it was set to a dict before reading.
    """

    def __init__(self, bag: BagReader) -> None:
        self._bag = bag
        self._decoders: dict[int, Decoder | None] = {}
        self._good: dict[int, int] = {}
        self.left: dict[int, Left] = {}
        self.texts: dict[int, dict[str, set[str]]] | None = None

    def decoder(self, topic: int) -> Decoder | None:
        """Return a function that reads a topic's messages; None if its type is unknown."""
        if topic not in self._decoders:
            try:
                self._decoders[topic] = self._bag.decoder(topic)
            except UnknownType as error:
                self._decoders[topic] = None
                self._left(topic).reason = str(error)
        return self._decoders[topic]

    def _left(self, topic: int) -> Left:
        return self.left.setdefault(topic, Left())

    def reason(self, topic: int) -> str:
        """Return why a topic cannot be decoded as a whole; empty where it can."""
        return self.left[topic].reason if topic in self.left else ""

    def pieces(self, block: Block) -> Iterator[tuple[int, Piece]]:
        """Return the tables of the topics in a block, by number of the topic."""
        for topic in distinct(block.topic):
            decoder = self.decoder(topic)
            if decoder is not None:
                chosen = block.select(np.flatnonzero(block.topic == topic))
                piece = self._piece(topic, decoder, chosen)
                self._good[topic] = self._good.get(topic, 0) + len(piece.t)
                if len(piece.t):
                    yield topic, piece

    def _piece(self, topic: int, decoder: Decoder, block: Block) -> Piece:
        groups = [*decoder.groups(block.raw, block.at, block.size)]
        good = [(rows, layout, data) for rows, layout, data in groups if isinstance(layout, Template)]
        # The columns are in the order of the messages that first have them.
        good.sort(key=lambda group: group[0][0])
        for rows, layout, _ in groups:
            if isinstance(layout, Undecodable):
                self._note(topic, int(block.t[rows[0]]), str(layout), len(rows))
        if self.texts is not None:
            for _, layout, data in good:
                self._note_texts(self.texts.setdefault(topic, {}), topic, layout, data)
        for _, layout, _ in good:
            self._left(topic).fields |= dict.fromkeys(layout.omitted) if layout.omitted else {}
        if len(good) == 1 and len(good[0][0]) == len(block):
            _, layout, data = good[0]
            return Piece(block.t, layout.stamps(data) if layout.stamp_at else block.t, layout.columns(data), {})
        return _merged(block, good)

    def _note(self, topic: int, t: int, damage: str, n: int) -> None:
        left = self._left(topic)
        if not left.messages or t < left.first:
            left.first, left.damage = t, damage
        left.messages += n

    def _note_texts(self, texts: dict[str, set[str]], topic: int, layout: Template, rows: Bytes) -> None:
        """Note the texts of messages that are not in a table; in the suite's own types only a frame is one."""
        own_type = self._bag.topics[topic].msgtype in TYPES
        for leaf in layout.leaves:
            if not leaf.text or (own_type and leaf.path != FRAME):
                continue
            result = texts.setdefault(re.sub(r"/\d+(?=/|$)", "/*", leaf.path), set())
            if len(result) < 2:
                cells = rows[:, leaf.at : leaf.at + int(leaf.kind[1:]) * leaf.n]
                other = cells != cells[0]
                # A text rarely changes. A reduction of a whole block is much faster than one of each row.
                first = int(other.any(axis=1).argmax()) if other.any() else 0
                result.update(layout.texts(rows[[0, first]], leaf))

    def untold(self) -> Iterator[str]:
        """Describe the texts that the tables do not show; a frame only where it changes."""
        for topic, texts in sorted((self.texts or {}).items()):
            name = self._bag.topics[topic].name
            frames = texts.pop(FRAME, set())
            if len(frames) > 1:
                several = " and ".join(repr(frame) for frame in sorted(frames)[:2])
                yield f"{name}: {FRAME} changes ({several}), which its table does not show"
            if fields := [field for field, result in texts.items() if result != {""}]:
                yield f"{name}: texts are not in its table: {', '.join(fields)}"

    def finish(self) -> None:
        """Note the topics of which no message could be decoded, after all have been read."""
        for topic, left in self.left.items():
            if left.messages and not self._good.get(topic):
                left.reason = left.damage

    def lines(self) -> Iterator[tuple[str, bool]]:
        """Describe what was left out; each line with whether messages of an otherwise read topic are lost."""
        for topic, left in sorted(self.left.items()):
            name = self._bag.topics[topic].name
            if left.reason:
                yield f"{name} ({self._bag.topics[topic].msgtype}) cannot be decoded: {left.reason}", False
            elif left.messages:
                yield (
                    f"{name}: {left.messages} of {left.messages + self._good[topic]} messages cannot be decoded, "
                    f"the first at {left.first} ns: {left.damage}",
                    True,
                )
            if left.fields and not left.reason:
                yield f"{name}: too long for columns: {', '.join(left.fields)}", False


def _merged(block: Block, groups: list[tuple[NDArray[np.intp], Template, NDArray[np.uint8]]]) -> Piece:
    """Merge messages of several shapes into one table; values that a message lacks are NaN."""
    stamp = block.t.copy()
    columns: dict[str, Any] = {}
    absent: dict[str, NDArray[np.bool_]] = {}
    decoded = np.zeros(len(block), bool)
    for rows, layout, data in groups:
        decoded[rows] = True
        if layout.stamp_at:
            stamp[rows] = layout.stamps(data)
        for label, x in layout.columns(data).items():
            if label not in columns:
                columns[label] = np.full(len(block), _missing(x.dtype), x.dtype)
                absent[label] = np.ones(len(block), bool)
            columns[label][rows] = x
            absent[label][rows] = False
    if not decoded.all():
        columns = {label: x[decoded] for label, x in columns.items()}
    absent = {label: x[decoded] for label, x in absent.items() if x[decoded].any()}
    return Piece(block.t[decoded], stamp[decoded], columns, absent)


class Growing:
    """The table of a topic while it is read: the rows of its pieces one after the other.

    Parameters
    ----------
    rows : int
        For so many rows there is memory from the start; more rows get more, for which the columns are copied.
    exact : bool
        Whether columns of whole numbers keep their type; otherwise all are of floats.
    """

    def __init__(self, rows: int = 0, *, exact: bool = False) -> None:
        self._capacity, self._exact = rows, exact
        self._times: dict[str, NDArray[Any]] = {}
        self._columns: dict[str, NDArray[Any]] = {}
        self._absent: dict[str, NDArray[Any]] = {}
        self.rows = 0

    def add(self, piece: Piece) -> None:
        """Append the rows of a piece."""
        first, last = self.rows, self.rows + len(piece.t)
        if last > self._capacity:
            self._capacity = max(last, self._capacity * 3 // 2)
            for arrays in (self._times, self._columns, self._absent):
                for name, old in arrays.items():
                    arrays[name] = _memory(self._capacity, old.dtype)
                    arrays[name][:first] = old[:first]
        if not self._times:
            self._times = {name: _memory(self._capacity, np.dtype(np.int64)) for name in ("t", "stamp")}
        self._add_columns(piece, first)
        self.rows = last
        for name in ("t", "stamp"):
            self._times[name][first:last] = getattr(piece, name)
        for label, column in self._columns.items():
            values = piece.columns.get(label)
            column[first:last] = _missing(column.dtype) if values is None else values
            if (values is None or label in piece.absent) and label not in self._absent:
                self._absent[label] = np.zeros(self._capacity, bool)
            if label in self._absent:
                self._absent[label][first:last] = values is None or piece.absent.get(label, False)

    def _add_columns(self, piece: Piece, first: int) -> None:
        """Create the columns that are new."""
        new = {label: x.dtype for label, x in piece.columns.items() if label not in self._columns}
        kinds = {label: kind if self._exact and kind.kind in "iu" else np.dtype(float) for label, kind in new.items()}
        self._columns |= {label: _memory(self._capacity, kind) for label, kind in kinds.items()}
        for label, kind in kinds.items() if first else ():
            self._columns[label][:first] = _missing(kind)
            self._absent[label] = np.ones(self._capacity, bool)

    def whole(self) -> Piece:
        """Return all rows; the arrays are those of this table."""
        times, columns, absent = (
            {name: array[: self.rows] for name, array in arrays.items()}
            for arrays in (self._times or {"t": _NONE, "stamp": _NONE}, self._columns, self._absent)
        )
        return Piece(times["t"], times["stamp"], columns, absent)

    def clear(self) -> None:
        """Remove all rows and keep the memory for others: what `whole` returned before is no longer valid."""
        self.rows, self._absent = 0, {}


_NONE = np.empty(0, np.int64)


# Bytes from which numpy asks the system for huge pages.
HUGE = 1 << 22


def _memory(rows: int, kind: np.dtype[Any]) -> NDArray[Any]:
    """Return an array without values, in memory of pages of usual size.

    A system that has little memory in one piece moves other pages away for huge ones, which took twice as long as to
    make usual pages ready.
    """
    size = rows * kind.itemsize
    if size < HUGE:
        return np.empty(rows, kind)
    return np.frombuffer(mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), kind)


def _missing(kind: np.dtype[Any]) -> float:
    """Return what a column has where no message has a value: NaN, or 0 if the type has no NaN."""
    return math.nan if kind.kind == "f" else 0


class OnDisk:
    """The table of a topic as `Growing` makes it, but long columns stay in a file and are read a stretch at a time.

    Parameters
    ----------
    file : file
        Temporary, for any number of tables.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self._rows = file, 0
        self._times = _Parts(file, np.int64), _Parts(file, np.int64)
        self._columns: dict[str, _Parts] = {}

    def add(self, piece: Piece) -> None:
        """Append the rows of a piece."""
        for parts, times in zip(self._times, (piece.t, piece.stamp), strict=True):
            parts.add(self._rows, times)
        for label, x in piece.columns.items():
            if label not in self._columns:
                self._columns[label] = _Parts(self._file, np.float64)
            self._columns[label].add(self._rows, x)
        self._rows += len(piece.t)

    def whole(self) -> Piece:
        """Return all rows; absences are not kept. The file must have been flushed."""
        t, stamp = (parts.whole(self._rows) for parts in self._times)
        return Piece(t, stamp, {label: parts.whole(self._rows) for label, parts in self._columns.items()}, {})


class _Parts:
    """The rows of one column in a file, in parts; a row that is in none of them is NaN."""

    def __init__(self, file: IO[bytes], kind: type[np.float64 | np.int64]) -> None:
        self._file, self._kind = file, np.dtype(kind)
        self._parts: list[tuple[int, int, int]] = []  # first row, number of rows, place in the file

    def add(self, first: int, x: NDArray[Any]) -> None:
        """Append rows, of which the first has the number `first`."""
        self._parts.append((first, len(x), self._file.seek(0, os.SEEK_END)))
        self._file.write(np.ascontiguousarray(x, self._kind))

    def _read(self, first: int, last: int) -> NDArray[Any]:
        result = np.full(last - first, _missing(self._kind), self._kind)
        for k in range(max(bisect_right(self._parts, (first + 1,)) - 1, 0), len(self._parts)):
            begin, count, place = self._parts[k]
            if begin >= last:
                break
            low, high = max(begin, first), min(begin + count, last)
            if low < high:
                # Not by seek and read: a page draws in one thread while another computes figures.
                part = result[low - first : high - first]
                os.preadv(self._file.fileno(), [part], place + (low - begin) * result.itemsize)
        return result

    def whole(self, rows: int) -> NDArray[Any]:
        """Return all rows, in memory if they are few."""
        return self._read(0, rows) if rows <= STRETCH else cast("NDArray[Any]", LongArray(rows, self._read))
