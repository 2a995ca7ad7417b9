"""The recording of a run: shards written by each node, and all messages of a run in memory."""

from __future__ import annotations

import json
import struct
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .cdr import Layout
from .columns import Columns, Rows, Stored, row_type
from .parameter_event import TOPIC as EVENTS, TYPE as EVENT

_RECORD = struct.Struct("<qHI")  # time, number of the topic, length of the message that follows
_ROW_HEAD = struct.Struct("<qH")  # time, `_ROW`; the numbers of all messages of a row follow
_ROW = 0xFFFF
_MAGIC = b"softrig shard 2\n"
_HEAD = 1 << 20  # bytes in which the head of a shard ends
_LOOK = 1 << 22  # bytes of a shard that are read at a time
# A shard with more bytes stays on the disk, and its messages are read when somebody asks for them. With a larger bound
# the slow topics of a run of minutes would let its memory grow.
HELD = 1 << 21
ORDERED = 1 << 16  # times of a topic that are ordered at a time
# So many messages are turned into bytes at a time: they take ten times the memory of their numbers.
CHUNK = 4096


def relative(name: str) -> str:
    """Return a topic's name as scenarios and recordings write it: without the root, except for /clock."""
    return name if name == "/clock" else name.removeprefix("/")


class Sink(Protocol):
    """Receives the published bytes of blocks."""

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message of topic number `topic`, published at tick time `t` (ns)."""

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return a function that appends one message to each of some topics, all at one time, by their numbers.

        Parameters
        ----------
        layouts : mapping of int to Layout
            By number of the topic; arrays are numbered in the order of the calls.
        """

    def rows(self, layouts: Mapping[int, Layout]) -> Callable[[NDArray[np.int64], NDArray[np.float64]], object]:
        """Return a function that appends many such rows: their times in ns, shape (n,), and their numbers, (n,
        size of all).
        """

    def note(self, t: int, data: bytes) -> None:
        """Append a change of parameters (`parameter_event`), which took effect at tick time `t` (ns)."""


class ShardWriter:
    """Append-only file of one node's messages; cheap in the loop, flushed by size and by `flush`.

    The first message is written immediately, so that a reader of the file sees that the node publishes.

    The messages of a node at one of its ticks are a row: they have one stamp, and only their numbers are written.
    Their bytes are created when the shard is read, from the layouts in its head.

    Parameters
    ----------
    topics : sequence of (name, message type)
        In the order of the topic numbers that `add` accepts.
    row : mapping of int to Layout
        The messages of a row, in order: number of the topic and layout.
    """

    # Bytes. The loop waits while they are written, 2 us a kB in new files; 32 kB would take a whole tick at 20 kHz.
    LIMIT = 1 << 12

    def __init__(self, path: Path, topics: Sequence[tuple[str, str]], row: Mapping[int, Layout] | None = None) -> None:
        row = row or {}
        self._note = len(topics)
        head = {"topics": [*topics, (EVENTS, EVENT)], "row": [[number, layout.form] for number, layout in row.items()]}
        self._file = path.open("wb", buffering=0)
        self._buffer = bytearray(_MAGIC + json.dumps(head).encode() + b"\n")
        self._pack_row = _row_packer(row.values())
        self.flush()
        # The first message is written at once, so that the file shows that the node runs.
        self._limit = 0

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        buffer = self._buffer
        buffer += _RECORD.pack(t, topic, len(data))
        buffer += data
        if len(buffer) > self._limit:
            self.flush()

    def note(self, t: int, data: bytes) -> None:
        """Append a change of parameters and flush it to the file: it must not be lost with the process."""
        self.add(self._note, t, data)
        self.flush()

    def add_row(self, t: int, values: Iterable[float]) -> None:
        """Append one message of each topic of the row, all stamped `t`, by their numbers."""
        buffer = self._buffer
        buffer += self._pack_row(t, _ROW, *values)
        if len(buffer) > self._limit:
            self.flush()

    def add_rows(self, times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Append many such rows: their times, shape (n,), and their numbers, (n, size of all)."""
        # Native code computes 16 MB of numbers at a time; a copy of all would double the memory of a long run.
        for first in range(0, len(times), CHUNK):
            part = values[first : first + CHUNK]
            rows = np.empty(len(part), row_type(values.shape[1]))
            rows["t"], rows["mark"], rows["values"] = times[first : first + CHUNK], _ROW, part
            if rows.nbytes <= self.LIMIT:
                self._buffer += rows.tobytes()
                if len(self._buffer) > self._limit:
                    self.flush()
                continue
            self.flush()
            content = memoryview(rows.view(np.uint8))
            while content:
                content = content[self._write(content) :]

    def flush(self) -> None:
        """Pass everything to the operating system; raises OSError (disk full), never drops silently."""
        while self._buffer:
            del self._buffer[: self._write(self._buffer)]
        self._limit = self.LIMIT

    def _write(self, content: bytearray | memoryview) -> int:
        """Write as much as the operating system accepts; return the number of bytes."""
        # An unbuffered file may write less than it is given, for instance on a disk that is nearly full.
        try:
            return self._file.write(content) or 0
        # The error of a write does not name the file.
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._file.name)) from error

    def close(self) -> None:
        """Flush and close."""
        self.flush()
        self._file.close()


def _nothing() -> None:
    """Do nothing."""


class Topic:
    """All messages of one topic: tick times in ns and message bytes.

    Messages that were stored as numbers are converted to bytes only on demand: numbers need a tenth of the memory.
    """

    def __init__(self, name: str, msgtype: str) -> None:
        self.name = name
        self.msgtype = msgtype
        self._times: list[int] = []
        self._data: list[bytes] = []
        self._columns: list[Columns | Stored] = []
        self._timed = self._made = 0  # number of columns that are in the lists already
        # Rows that were added are converted in one batch, when somebody reads the topic.
        self.settle: Callable[[], object] = _nothing

    def __getstate__(self) -> dict[str, Any]:
        """Pickle all messages; messages that a tick adds afterwards are not in the copy."""
        self.settle()
        return self.__dict__ | {"settle": _nothing}

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Topic):
            return NotImplemented
        left, right = (self.name, self.msgtype, self.times), (other.name, other.msgtype, other.times)
        return left == right and self.data == other.data

    def add_columns(self, columns: Columns | Stored) -> None:
        """Append messages as numbers."""
        self._columns.append(columns)

    @property
    def times(self) -> list[int]:
        """Tick time of each message, ns."""
        self.settle()
        for columns in self._columns[self._timed :]:
            self._times += columns.times.tolist()
        self._timed = len(self._columns)
        return self._times

    @property
    def data(self) -> list[bytes]:
        """The messages."""
        self.settle()
        for columns in self._columns[self._made :]:
            self._data += columns.messages(len(self._data))
        self._made = len(self._columns)
        return self._data

    @property
    def number(self) -> int:
        """Return how many messages there are, without a list of their times."""
        self.settle()
        return sum(c.number for c in self.parts()) or len(self.times)

    def parts(self) -> Sequence[Columns | Stored]:
        """Return all messages as numbers, in one or several parts of one layout; none as `columns`."""
        self.settle()
        known = self._columns
        number = sum(c.number for c in known)
        if not number or self._data or (self._timed and len(self.times) != number):
            return ()
        return () if any(c.layout.form != known[0].layout.form for c in known) else known

    def columns(self) -> Columns | Stored | None:
        """Return all messages as numbers; None if some were added as bytes or may have been changed."""
        known = self.parts()
        if len(known) > 1:
            times, values = (
                np.concatenate(arrays) for arrays in zip(*((c.times, c.values) for c in known), strict=True)
            )
            # If the times of any part were listed, `parts` has listed those of all.
            self._columns, self._timed = [Columns(times, values, known[0].layout)], min(1, self._timed)
        return self._columns[0] if known else None

    def ticks(self) -> NDArray[np.int64]:
        """Return the times as an array."""
        columns = self.columns()
        return np.array(self.times, np.int64) if columns is None else columns.times

    def newest(self) -> int | None:
        """Return the time of its last message, ns; None without one."""
        # The parts need not be joined for this.
        if parts := self.parts():
            last = next(part for part in reversed(parts) if part.number)
            last = last if isinstance(last, Columns) else last.part(last.number - 1, last.number)
            return int(last.times[-1])
        return self.times[-1] if self.times else None

    def before(self, t: int) -> Topic:
        """Return its messages that are earlier than t, ns."""
        result, columns = Topic(self.name, self.msgtype), self.columns()
        if columns is not None:
            n = int(np.searchsorted(columns.times, t))
            result._columns = [columns.part(0, n)] if n else []
        else:
            n = bisect_left(self.times, t)
            result._times, result._data = self.times[:n], self.data[:n]
        return result

    def since(self, n: int) -> Topic:
        """Return its messages but the first n."""
        result, parts = Topic(self.name, self.msgtype), self.parts()
        for part in parts:
            if n < (size := part.number):
                result._columns.append(part.part(max(n, 0), size))
            n -= size
        if not parts:
            result._times, result._data = self.times[n:], self.data[n:]
        return result

    def texts(self) -> Iterator[bytes]:
        """Yield the bytes of all messages one after the other, those of many at a time."""
        table = self.columns()
        for first in range(0, self.number, CHUNK):
            last = first + CHUNK
            yield b"".join(self.data[first:last]) if table is None else table.part(first, last).encoded(first).tobytes()

    def stream(self) -> Iterator[tuple[int, bytes]]:
        """Yield time and bytes of each message; messages that are stored as numbers are not kept as bytes."""
        columns = self.columns()
        if columns is None:
            yield from zip(self.times, self.data, strict=True)
            return
        for first in range(0, columns.number, CHUNK):
            part = columns.part(first, first + CHUNK)
            yield from zip(part.times.tolist(), part.messages(first), strict=True)


class Recording:
    """Messages of a run by topic, in memory; also a `Sink` for in-process runs."""

    def __init__(self, topics: Iterable[tuple[str, str]]) -> None:
        self.topics = {name: Topic(name, msgtype) for name, msgtype in topics}
        self._order = list(self.topics.values())
        self.release: Callable[[], object] = _nothing  # removes the files that it reads from, where it owns some

    def __getstate__(self) -> dict[str, Any]:
        """Pickle without the files, because topics pickle the messages that they read from them."""
        return self.__dict__ | {"release": _nothing}

    def newest(self, default: int) -> int:
        """Return the time of the newest message, ns; the default without one."""
        return max((t for topic in self.topics.values() if (t := topic.newest()) is not None), default=default)

    def before(self, t: int) -> Recording:
        """Return the recording before t, ns; messages added to one of the two are not in the other."""
        result = Recording(())
        result.topics = {name: topic.before(t) for name, topic in self.topics.items()}
        # The topic of changes exists from the first change on only; an empty one would make two equal runs differ.
        if EVENTS in result.topics and not result.topics[EVENTS].times:
            del result.topics[EVENTS]
        result._order = list(result.topics.values())
        return result

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        result = self._order[topic]
        result.times.append(t)
        result.data.append(data)

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return a callable that appends one message of each of some topics; their bytes are created on demand."""
        buffer, pack = bytearray(), _row_packer(layouts.values())
        # References are weak: a cycle through `settle` would hold the memory until the garbage collector runs.
        topics = [(weakref.ref(self._order[number]), layout) for number, layout in layouts.items()]
        kind = row_type(sum(layout.size for layout in layouts.values()))

        def settle() -> None:
            if buffer:
                rows = np.frombuffer(bytes(buffer), kind)
                buffer.clear()
                _add_rows(rows, [(topic(), layout) for topic, layout in topics])

        def add(t: int, values: Sequence[float]) -> None:
            buffer.extend(pack(t, _ROW, *values))

        for number in layouts:
            self._order[number].settle = settle
        return add

    def rows(self, layouts: Mapping[int, Layout]) -> Callable[[NDArray[np.int64], NDArray[np.float64]], object]:
        """Return a callable that appends many such rows after all existing messages."""
        topics = [self._order[number] for number in layouts]

        def add(times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
            for topic, columns in zip(topics, Columns.of_node(times, values, layouts.values()), strict=True):
                topic.settle()
                topic.add_columns(columns)

        return add

    def note(self, t: int, data: bytes) -> None:
        """Add a change of parameters, sorted by time and then by content, independent of the order of reading."""
        if EVENTS not in self.topics:
            self.topics[EVENTS] = Topic(EVENTS, EVENT)
            self._order.append(self.topics[EVENTS])
        topic = self.topics[EVENTS]
        # Changes of several nodes at one time are sorted by content, because shards are read in any order.
        k = bisect_right(list(zip(topic.times, topic.data, strict=True)), (t, data))
        topic.times.insert(k, t)
        topic.data.insert(k, data)

    def with_topics(self, topics: Iterable[tuple[str, str]]) -> Recording:
        """Return a recording with these messages, not copied, and other topics after them.

        A topic that is there already is copied, so that what is added to it does not change this recording.
        """
        result = Recording(topics)
        for name in result.topics.keys() & self.topics.keys():
            result.topics[name].times.extend(self.topics[name].times)
            result.topics[name].data.extend(self.topics[name].data)
        result.topics = self.topics | result.topics
        result._order = list(result.topics.values())
        return result

    def order(self) -> Iterator[NDArray[np.intp]]:
        """Yield the place among the topics of each message, by time, equal times in topic order; some at a time."""
        clocks = [_Clock(topic) for topic in self._order]
        while any(clock.left for clock in clocks):
            # Earlier times than the last one that each clock has seen cannot come any more.
            limit = min((clock.seen for clock in clocks if clock.more), default=None)
            ticks = [clock.pop_until(limit) for clock in clocks]
            ranks = np.repeat(np.arange(len(ticks)), [len(times) for times in ticks])
            yield ranks[np.argsort(np.concatenate(ticks), kind="stable")]

    def messages(self) -> Iterator[tuple[int, Topic, bytes]]:
        """Yield all messages by time; equal times in topic order, messages of one topic in their order."""
        streams = [(topic, topic.stream()) for topic in self._order]
        for ranks in self.order():
            for rank in ranks.tolist():
                topic, stream = streams[rank]
                t, data = next(stream)
                yield t, topic, data

    def read_shard(self, path: Path, namespace: str = "") -> int:
        """Add the messages of a shard; a record cut off by a crash at its end is left out.

        Parameters
        ----------
        namespace : str
            Of the node that wrote it, below which its topics are: ``a/``; empty for the root.

        Returns
        -------
        int
            Bytes at the end that belong to a record cut off.
        """
        size = path.stat().st_size
        with path.open("rb", buffering=0) as file:
            head, offset = _read_head(memoryview(file.read(_HEAD)))
            if head is None:
                return size
            file.seek(offset)
            if size <= HELD:
                return size - offset - self.add_part(head, memoryview(file.readall()), namespace)
            spans, length = list[tuple[int, int]](), _LOOK
            # Rows stay in the file; only their places and what is not a row are kept in memory.
            while content := file.read(length):
                used = self.add_part(head, memoryview(content), namespace, partial(_note_rows, spans, offset))
                # A message may be longer than what was read.
                length = _LOOK if used else 2 * length
                if not used and offset + len(content) == size:
                    break
                offset += used
                file.seek(offset)
        self._store(path, head, spans, namespace)
        return size - offset

    def _store(self, path: Path, head: Mapping[str, Any], spans: list[tuple[int, int]], namespace: str) -> None:
        """Add the messages of rows that stay in a shard; `spans` has the first byte and the length of each stretch of
        rows.
        """
        layouts = [(head["topics"][number][0], Layout(*form)) for number, form in head["row"]]
        width = sum(layout.size for _, layout in layouts)
        length = row_type(width).itemsize
        rows, first = Rows(path, width, [(start, size // length) for start, size in spans]), 0
        for name, layout in layouts:
            if rows.number:
                self.topics[name.removeprefix(namespace)].add_columns(Stored(rows, first, layout))
            first += layout.size

    def add_part(
        self,
        head: Mapping[str, Any],
        content: memoryview,
        namespace: str = "",
        callback: Callable[[int, int], object] | None = None,
    ) -> int:
        """Add the messages of a part of a shard.

        Parameters
        ----------
        head : mapping
            Description in the head of the shard.
        content : memoryview
            From the beginning of a message on.
        namespace : str
            See `read_shard`.
        callback : callable, optional
            Gets the offset and the number of bytes of rows in the content; their messages are then not added.

        Returns
        -------
        int
            Number of bytes of the complete messages.
        """
        topics = [self.topics[name.removeprefix(namespace)] for name, _ in head["topics"] if name != EVENTS]
        row = [(topics[number], Layout(*form)) for number, form in head["row"]]
        offset, size = 0, _RECORD.size
        while offset + _ROW_HEAD.size <= len(content):
            if _ROW_HEAD.unpack_from(content, offset)[1] == _ROW:
                rows = _rows_in(content[offset:], sum(layout.size for _, layout in row))
                used = rows.nbytes
                if callback is None:
                    _add_rows(rows, row)
                elif used:
                    callback(offset, used)
                offset += used
                if not used:
                    break
                continue
            if offset + size > len(content):
                break
            t, topic, length = _RECORD.unpack_from(content, offset)
            # The last record may be cut off by a crash.
            if offset + size + length > len(content):
                break
            data = bytes(content[offset + size : offset + size + length])
            if topic == len(topics):
                self.note(t, data)
            else:
                topics[topic].times.append(t)
                topics[topic].data.append(data)
            offset += size + length
        return offset


class ShardTail:
    """A reader of a shard that is still being written: it reads the messages that are new since the last call.

    Parameters
    ----------
    path : Path
        Path of the shard, which need not exist yet.
    """

    LIMIT = 1 << 22  # bytes of one look

    def __init__(self, path: Path) -> None:
        self._path = path
        self._head: dict[str, Any] | None = None
        self._at = 0

    def read(self, recording: Recording) -> bool:
        """Add new messages to a recording; return whether there may be more than one call reads.

        Parameters
        ----------
        recording : Recording
            Of the shard's topics.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._at)
                content = memoryview(file.read(self.LIMIT))
        except FileNotFoundError:
            return False
        start = 0
        if self._head is None:
            self._head, start = _read_head(content)
        if self._head is not None:
            # Only whole messages advance the place, so that a record still being written is read again.
            self._at += start + recording.add_part(self._head, content[start:])
        return len(content) == self.LIMIT


def _row_packer(layouts: Iterable[Layout]) -> Callable[..., bytes]:
    return struct.Struct(f"{_ROW_HEAD.format}{sum(layout.size for layout in layouts)}d").pack


def _rows_in(content: memoryview, width: int) -> NDArray[Any]:
    """Return the whole rows at the beginning of some bytes, shape (n,), see `row_type`."""
    kind = row_type(width)
    rows = np.frombuffer(content, kind, len(content) // kind.itemsize)
    # Anything else in the place of the mark begins a record of an unknown kind.
    odd = np.flatnonzero(rows["mark"] != _ROW)
    return rows[: odd[0]] if odd.size else rows


def _add_rows(rows: NDArray[Any], row: Sequence[tuple[Topic | None, Layout]]) -> None:
    """Add the messages of some rows to their topics."""
    times, values = np.ascontiguousarray(rows["t"]), np.ascontiguousarray(rows["values"])
    first = 0
    for topic, layout in row:
        # The topic may be gone with its recording, as the reference is weak.
        if topic is not None:
            topic.add_columns(Columns(times, values[:, first : first + layout.size], layout))
        first += layout.size


def _note_rows(spans: list[tuple[int, int]], start: int, offset: int, size: int) -> None:
    """Store the place of rows in a file, joined with the rows directly before them."""
    if spans and sum(spans[-1]) == start + offset:
        spans[-1] = spans[-1][0], spans[-1][1] + size
    else:
        spans.append((start + offset, size))


class _Clock:
    """The times of a topic, read in parts; a time that is earlier than the one before it is replaced by that one."""

    def __init__(self, topic: Topic) -> None:
        self._topic, self._whole = topic, topic.columns()
        self._read, self._newest = 0, np.iinfo(np.int64).min
        self._held = np.empty(0, np.int64)
        self.number = topic.number

    @property
    def left(self) -> bool:
        """Return whether some times have not been returned yet."""
        return self.more or len(self._held) > 0

    @property
    def more(self) -> bool:
        """Return whether not all times were read."""
        return self._read < self.number

    @property
    def seen(self) -> int:
        """Return the newest time that was read; reads on if all have been returned."""
        # Times that all equal the limit are not returned, so without reading on `order` would never end.
        if len(self._held) < 2 or self._held[0] == self._held[-1]:
            last = min(self._read + ORDERED, self.number)
            if self._whole is None:
                part = np.array(self._topic.times[self._read : last], np.int64)
            else:
                part = self._whole.part(self._read, last).times
            part = np.maximum.accumulate(np.maximum(part, self._newest))
            self._held, self._read, self._newest = np.concatenate([self._held, part]), last, part[-1]
        return int(self._newest)

    def pop_until(self, limit: int | None) -> NDArray[np.int64]:
        """Return the times before a limit that have not been returned yet; all if there is no limit."""
        n = len(self._held) if limit is None else int(np.searchsorted(self._held, limit))
        used, self._held = self._held[:n], self._held[n:]
        return used


def read_shards(paths: Iterable[Path]) -> Recording:
    """Return the joint recording of some shards, skipping missing ones."""
    results = [path for path in paths if path.exists()]
    recording = Recording({topic: kind for path in results for topic, kind in shard_topics(path).items()}.items())
    for path in results:
        recording.read_shard(path)
    return recording


def shard_topics(path: Path) -> dict[str, str]:
    """Return name and message type of a shard's topics, without changes; empty if its head is cut off."""
    head, _ = _read_head(memoryview(path.read_bytes()))
    return {} if head is None else {name: msgtype for name, msgtype in head["topics"] if name != EVENTS}


def _read_head(content: memoryview) -> tuple[dict[str, Any] | None, int]:
    """Return the head of a shard, and the offset of its messages."""
    start = bytes(content[:_HEAD]).find(b"\n", len(_MAGIC)) + 1
    if bytes(content[: len(_MAGIC)]) != _MAGIC or not start:
        return None, 0
    return json.loads(bytes(content[len(_MAGIC) : start])), start
