"""Messages of one layout as numbers: in memory, or in rows of a file that are read some at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple, cast
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from .cdr import Layout
from .long import LongArray, is_long

# So many rows of a file are in memory at a time. A row has 10 bytes and 8 for each number.
READ = 1 << 15
SPARE = 1  # rows at either end of answers of native code, for those of the ticks before and after that Python answers

HUGE = (1 << 21) // 8  # numbers of a huge page

_spacious: WeakValueDictionary[int, NDArray[np.float64]] = WeakValueDictionary()


def spacious(shapes: Sequence[tuple[int, int]]) -> list[NDArray[np.float64]]:
    """Return arrays of shapes (count, size), column after column in memory, with free rows at both ends."""
    sizes = [(count + 2 * SPARE) * size for count, size in shapes]
    memory = memoryview(_in_huge_pages(sum(sizes)))
    result = []
    for (_, size), length, end in zip(shapes, sizes, accumulate(sizes), strict=True):
        # An array has no attributes of its own, so `of_node` recognises this memory by the id of the array at its base.
        base = np.frombuffer(memory[end - length : end])
        _spacious[id(base)] = base
        result.append(base.reshape(size, -1)[:, SPARE:-SPARE].T)
    return result


def _in_huge_pages(size: int) -> NDArray[np.float64]:
    """Return an array of so many numbers; a large one lies in huge pages that hold nothing else."""
    # The first use of 4 kB of memory takes 1.3 us, which is more than native code needs to fill them, and that of a
    # huge page 70 us. numpy asks for huge pages for large arrays; only those that lie wholly inside are provided.
    if size < HUGE:
        return np.empty(size)
    memory = np.empty((size // HUGE + 2) * HUGE)
    first = -memory.ctypes.data // memory.itemsize % HUGE
    return memory[first : first + size]


class Columns(NamedTuple):
    """Messages of one layout as numbers: their times in ns, shape (n,), and all their numbers, (n, size).

    `room` is the memory of the numbers where it has free rows at both ends that belong to no other messages.
    """

    times: NDArray[np.int64]
    values: NDArray[np.float64]
    layout: Layout
    room: NDArray[np.float64] | None = None

    @classmethod
    def of_node(
        cls, times: NDArray[np.int64], values: NDArray[np.float64], layouts: Iterable[Layout]
    ) -> Iterator[Columns]:
        """Yield the messages on each output of a node from the numbers of all, shape (n, size of all)."""
        base, room = _spacious.get(id(values.base)), None
        # If only a part of the answers is given, the rows next to it belong to other messages.
        if base is not None and base.size == values.shape[1] * (len(values) + 2 * SPARE):
            room = base.reshape(values.shape[1], -1)
        first = 0
        for layout in layouts:
            last = first + layout.size
            yield cls(times, values[:, first:last], layout, None if room is None else room[first:last])
            first = last

    @property
    def number(self) -> int:
        """Return how many messages there are."""
        return len(self.times)

    @property
    def clock(self) -> object:
        """Return the array of times that all messages published together share."""
        return self.times

    def column(self, k: int) -> NDArray[np.float64]:
        """Return one number of each message, shape (n,)."""
        return self.values[:, k]

    def between(
        self, k: int, before: Sequence[NDArray[np.float64]], after: Sequence[NDArray[np.float64]]
    ) -> NDArray[np.float64] | None:
        """Return a column with free rows before and after it, without a copy; None if there is no room for them."""
        sizes = [sum(map(len, parts)) for parts in (before, after)]
        if self.room is None or max(sizes) > SPARE:
            return None
        offset = first = SPARE - sizes[0]
        for parts in (before, after):
            for part in parts:
                self.room[k, offset : offset + len(part)] = part
                offset += len(part)
            offset = SPARE + len(self.times)
        return self.room[k, first : offset + sizes[1]]

    def encoded(self, count: int, rows: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """Return the bytes of the messages, a row each; `count` is the number of earlier messages of the topic.

        They are written into `rows`, of shape (n, bytes), if that is given.
        """
        marks = np.arange(count, count + len(self.times)) if self.layout.numbered else self.times
        return self.layout.encode_block(marks, self.values, rows)

    def messages(self, count: int) -> list[bytes]:
        """Return the bytes of each message; see `encoded`."""
        raw, n = self.encoded(count).tobytes(), self.layout.length
        return [raw[i : i + n] for i in range(0, len(raw), n)]

    def part(self, first: int, last: int) -> Columns:
        """Return the messages from `first` up to `last`."""
        return Columns(self.times[first:last], self.values[first:last], self.layout)


@lru_cache(maxsize=256)
def row_type(width: int) -> np.dtype[Any]:
    """Return the form of a row in a shard: its time in ns, the mark of a row, and its numbers."""
    return np.dtype([("t", "<i8"), ("mark", "<u2"), ("values", "<f8", (width,))])


class Rows:
    """The rows of a shard, which stay on the disk.

    Parameters
    ----------
    path : Path
        The file stays open, so the rows can be read even after it was removed.
    width : int
        Numbers of a row.
    stretches : list of (int, int)
        Where rows follow each other without a gap: the first byte, and how many rows there are.
    """

    def __init__(self, path: Path, width: int, stretches: list[tuple[int, int]]) -> None:
        self._file = path.open("rb", buffering=0)
        self._kind = row_type(width)
        self._places = stretches
        self._ends = list(accumulate(count for _, count in stretches))
        self.number = self._ends[-1] if stretches else 0
        self._even: tuple[int, int] | None = None
        self._checked = False
        self._last: tuple[int, int, NDArray[Any]] | None = None

    def read(self, first: int, last: int) -> NDArray[Any]:
        """Return the rows from `first` up to `last` as a structured array.

        Raises
        ------
        OSError
            The file is shorter than it was.
        """
        # All signals of a node are in its rows, and several of them are read side by side.
        if self._last is not None and self._last[:2] == (first, last):
            return self._last[2]
        result = np.empty(max(0, min(last, self.number) - first), self._kind)
        content, size, done = memoryview(result.view(np.uint8)), self._kind.itemsize, 0
        for (start, count), end in zip(self._places, self._ends, strict=True):
            if first + done < end and done < len(result):
                skip = first + done - (end - count)
                n = min(count - skip, len(result) - done)
                begin = start + skip * size
                part = content[done * size : (done + n) * size]
                # A read may return less than was asked for, so it goes on where the last one ended.
                while part:
                    if not (got := os.preadv(self._file.fileno(), [part], begin)):
                        raise OSError(f"{self._file.name} ends before row {first + done + n}")
                    part, begin = part[got:], begin + got
                done += n
        result.flags.writeable = False
        # A longer result would keep a large part of the file in memory.
        if len(result) <= READ:
            self._last = first, last, result
        return result

    def blocks(self) -> Iterator[tuple[slice, NDArray[Any]]]:
        """Yield the rows in blocks, each with its place among all rows."""
        for first in range(0, self.number, READ):
            block = self.read(first, first + READ)
            yield slice(first, first + len(block)), block

    @property
    def even(self) -> tuple[int, int] | None:
        """Return first time and period in ns if all times are evenly spaced, else None."""
        if not self._checked:
            self._checked, self._even = True, self._spacing()
        return self._even

    def _spacing(self) -> tuple[int, int] | None:
        start = self.read(0, 2)["t"].tolist()
        if len(start) < 2:
            return None
        first, step = start[0], start[1] - start[0]
        for rows, block in self.blocks():
            if (block["t"] != first + step * np.arange(rows.start, rows.stop)).any():
                return None
        return first, step

    @property
    def times(self) -> NDArray[np.int64]:
        """Return the times of all rows, ns."""
        # Evenly spaced times can be computed, so they are not read from the file.
        if self.even is None:
            return _long(self.number, lambda a, b: np.ascontiguousarray(self.read(a, b)["t"]))
        first, step = self.even
        return _long(self.number, lambda a, b: first + step * np.arange(a, b, dtype=np.int64))


class Stored(NamedTuple):
    """Messages of one layout as numbers that are read from a file on demand; see `Columns`."""

    rows: Rows
    first: int
    layout: Layout

    def __reduce__(self) -> tuple[type[Columns], tuple[Any, ...]]:
        """Pickle the numbers themselves, since another process has not opened the file."""
        return Columns, tuple(self.part(0, self.number))

    @property
    def number(self) -> int:
        """Return how many messages there are."""
        return self.rows.number

    @property
    def clock(self) -> object:
        """Return the array of times that all messages published together share."""
        return self.rows

    @property
    def times(self) -> NDArray[np.int64]:
        """Return the times, ns, shape (n,); they are read again at each call."""
        return self.rows.times

    @property
    def values(self) -> NDArray[np.float64]:
        """Return all numbers, shape (n, size)."""
        return self.part(0, self.number).values

    def column(self, k: int) -> NDArray[np.float64]:
        """Return one number of each message, shape (n,)."""
        return _long(self.number, lambda a, b: np.ascontiguousarray(self.rows.read(a, b)["values"][:, self.first + k]))

    def messages(self, count: int) -> list[bytes]:
        """Return their bytes; see `Columns.messages`."""
        return self.part(0, self.number).messages(count)

    def part(self, first: int, last: int) -> Columns:
        """Return some of them, in memory."""
        block = self.rows.read(first, last)
        values = block["values"][:, self.first : self.first + self.layout.size]
        return Columns(np.ascontiguousarray(block["t"]), np.ascontiguousarray(values), self.layout)


def joined(parts: Sequence[Columns | Stored], k: int) -> NDArray[np.float64]:
    """Return one number of each message of several parts, shape (n,), in one piece of memory."""
    columns = [part.column(k) for part in parts]
    if len(parts) == 1:
        return columns[0] if is_long(columns[0]) else np.ascontiguousarray(columns[0])
    longest = max(range(len(parts)), key=lambda i: parts[i].number)
    result, part = None, parts[longest]
    if isinstance(part, Columns) and part.room is not None:
        result = part.between(k, columns[:longest], columns[longest + 1 :])
    return np.concatenate(columns) if result is None else result


def _long(size: int, read: Callable[[int, int], NDArray[Any]]) -> NDArray[Any]:
    return cast("NDArray[Any]", LongArray(size, read))
