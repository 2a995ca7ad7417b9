"""What a run recorded: shards written at the source, and all messages of a run in memory."""

from __future__ import annotations

import json
import struct
import weakref
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .cdr import Layout
from .parameter_event import TOPIC as EVENTS, TYPE as EVENT

_RECORD = struct.Struct("<qHI")  # time, number of the topic, length of the message that follows
_ROW_HEAD = struct.Struct("<qH")  # time, `_ROW`; the numbers of all messages of a row follow
_ROW = 0xFFFF
_MAGIC = b"softrig shard 2\n"
# So many messages are turned into bytes at a time: they take ten times the memory of their numbers.
CHUNK = 4096


def relative(name: str) -> str:
    """Return a topic's name as scenarios and recordings write it: without the root, except for /clock."""
    return name if name == "/clock" else name.removeprefix("/")


class Sink(Protocol):
    """Where a block's published bytes go."""

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message of topic number `topic`, published at tick time `t` (ns)."""

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return what appends one message of each of some topics, all of one time, by their numbers.

        Parameters
        ----------
        layouts : mapping of int to Layout
            By number of the topic; arrays are numbered in the order of the calls.
        """

    def rows(self, layouts: Mapping[int, Layout]) -> Callable[[NDArray[np.int64], NDArray[np.float64]], object]:
        """Return what appends many such rows: their times in ns, shape (n,), and their numbers, (n, size of all)."""

    def note(self, t: int, data: bytes) -> None:
        """Append a change of parameters (`parameter_event`), which took effect at tick time `t` (ns)."""


class ShardWriter:
    """Append-only file of one node's messages; cheap in the loop, flushed by size and by `flush`.

    The first message goes out at once: who looks at the file sees that the node speaks.

    What a node says at each of its ticks is a row: its messages have one stamp, and only their numbers are written.
    Their bytes are made when the shard is read, from the layouts in its head.

    Parameters
    ----------
    topics : sequence of (name, message type)
        In the order of the numbers that `add` takes.
    row : mapping of int to Layout
        The messages of a row, in order: number of the topic and layout.
    """

    # Bytes. The loop waits while they are written, 2 us a kB in new files, so a write must stay short.
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
        """Append a change of parameters, in the file at once: it must not be lost with the process."""
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
        kind = np.dtype([("t", "<i8"), ("mark", "<u2"), ("values", "<f8", (values.shape[1],))])
        rows = np.empty(len(times), kind)
        rows["t"], rows["mark"], rows["values"] = times, _ROW, values
        self._buffer += rows.tobytes()
        if len(self._buffer) > self._limit:
            self.flush()

    def flush(self) -> None:
        """Pass everything to the operating system; raises OSError (disk full), never drops silently."""
        while self._buffer:
            # An unbuffered file may write less than it is given, for instance on a disk that is nearly full.
            written = self._file.write(self._buffer)
            del self._buffer[: written or 0]
        self._limit = self.LIMIT

    def close(self) -> None:
        """Flush and close."""
        self.flush()
        self._file.close()


class Columns(NamedTuple):
    """Messages of one layout as numbers: their times in ns, shape (n,), and all their numbers, (n, size)."""

    times: NDArray[np.int64]
    values: NDArray[np.float64]
    layout: Layout

    def messages(self, said: int) -> list[bytes]:
        """Return their bytes; `said` messages of the topic were before them."""
        marks = np.arange(said, said + len(self.times)) if self.layout.numbered else self.times
        raw, n = self.layout.encode_block(marks, self.values).tobytes(), self.layout.length
        return [raw[i : i + n] for i in range(0, len(raw), n)]

    def part(self, first: int, last: int) -> Columns:
        """Return some of them."""
        return Columns(self.times[first:last], self.values[first:last], self.layout)


class Topic:
    """All messages of one topic: tick times in ns and message bytes.

    What came as numbers stays so until somebody asks for bytes: they take a tenth of the room.
    """

    def __init__(self, name: str, msgtype: str) -> None:
        self.name = name
        self.msgtype = msgtype
        self._times: list[int] = []
        self._data: list[bytes] = []
        self._columns: list[Columns] = []
        self._timed = self._made = 0  # so many of the columns are in the lists
        self.settle: Callable[[], object] = lambda: None  # brings what is still under way

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Topic):
            return NotImplemented
        mine, theirs = (self.name, self.msgtype, self.times), (other.name, other.msgtype, other.times)
        return mine == theirs and self.data == other.data

    __hash__ = None  # type: ignore[assignment]

    def add_columns(self, columns: Columns) -> None:
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

    def parts(self) -> Sequence[Columns]:
        """Return all messages as numbers, in one or several parts of one layout; none as `columns`."""
        self.settle()
        known = self._columns
        number = sum(len(c.times) for c in known)
        if not number or self._data or (self._timed and len(self.times) != number):
            return ()
        return () if any(c.layout.form != known[0].layout.form for c in known) else known

    def columns(self) -> Columns | None:
        """Return all messages as numbers; None when some came as bytes or may have been changed."""
        known = self.parts()
        if len(known) > 1:
            times, values = (np.concatenate([c[k] for c in known]) for k in (0, 1))
            self._columns, self._timed = [Columns(times, values, known[0].layout)], min(1, self._timed)
        return self._columns[0] if known else None

    def ticks(self) -> NDArray[np.int64]:
        """Return the times as an array."""
        whole = self.columns()
        return np.array(self.times, np.int64) if whole is None else whole.times

    def newest(self) -> int | None:
        """Return the time of its last message, ns; None without one."""
        # The parts need not be joined for this.
        if parts := self.parts():
            return next(int(part.times[-1]) for part in reversed(parts) if len(part.times))
        return self.times[-1] if self.times else None

    def before(self, t: int) -> Topic:
        """Return its messages that are earlier than t, ns."""
        result, whole = Topic(self.name, self.msgtype), self.columns()
        if whole is not None:
            n = int(whole.times.searchsorted(t))
            result._columns = [whole.part(0, n)] if n else []
        else:
            n = bisect_left(self.times, t)
            result._times, result._data = self.times[:n], self.data[:n]
        return result

    def since(self, n: int) -> Topic:
        """Return its messages but the first n."""
        result, parts = Topic(self.name, self.msgtype), self.parts()
        for part in parts:
            if n < (size := len(part.times)):
                result._columns.append(part.part(max(n, 0), size))
            n -= size
        if not parts:
            result._times, result._data = self.times[n:], self.data[n:]
        return result

    def stream(self) -> Iterator[tuple[int, bytes]]:
        """Yield time and bytes of each message; what stands as numbers is not kept as bytes."""
        whole = self.columns()
        if whole is None:
            yield from zip(self.times, self.data, strict=True)
            return
        for first in range(0, len(whole.times), CHUNK):
            part = whole.part(first, first + CHUNK)
            yield from zip(part.times.tolist(), part.messages(first), strict=True)


class Recording:
    """Messages of a run by topic, in memory; also a `Sink` for in-process runs."""

    def __init__(self, topics: Iterable[tuple[str, str]]) -> None:
        self.topics = {name: Topic(name, msgtype) for name, msgtype in topics}
        self._order = list(self.topics.values())

    def before(self, t: int) -> Recording:
        """Return what was recorded before t, ns; what is added to one of the two is not in the other."""
        result = Recording(())
        result.topics = {name: topic.before(t) for name, topic in self.topics.items()}
        # The topic of changes exists from the first change on only; an empty one would make two equal runs differ.
        if EVENTS in result.topics and not result.topics[EVENTS].times:
            del result.topics[EVENTS]
        result._order = list(result.topics.values())
        return result

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        found = self._order[topic]
        found.times.append(t)
        found.data.append(data)

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return what appends one message of each of some topics; their bytes are made when somebody asks for them."""
        buffer, pack = bytearray(), _row_packer(layouts.values())
        # References are weak: a cycle through `settle` would hold the memory until the garbage collector runs.
        topics = [(weakref.ref(self._order[number]), layout) for number, layout in layouts.items()]

        def settle() -> None:
            if buffer:
                content = bytes(buffer)
                buffer.clear()
                _read_rows(memoryview(content), [(topic(), layout) for topic, layout in topics])

        def add(t: int, values: Sequence[float]) -> None:
            buffer.extend(pack(t, _ROW, *values))

        for number in layouts:
            self._order[number].settle = settle
        return add

    def rows(self, layouts: Mapping[int, Layout]) -> Callable[[NDArray[np.int64], NDArray[np.float64]], object]:
        """Return what appends many such rows, after all that came before them."""
        topics = [(self._order[number], layout) for number, layout in layouts.items()]

        def add(times: NDArray[np.int64], values: NDArray[np.float64]) -> None:
            first = 0
            for topic, layout in topics:
                topic.settle()
                topic.add_columns(Columns(times, values[:, first : first + layout.size], layout))
                first += layout.size

        return add

    def note(self, t: int, data: bytes) -> None:
        """Add a change of parameters, by time and then by content: whoever made it, in whatever order they are read."""
        if EVENTS not in self.topics:
            self.topics[EVENTS] = Topic(EVENTS, EVENT)
            self._order.append(self.topics[EVENTS])
        topic = self.topics[EVENTS]
        # Changes of several nodes at one time are sorted by content, because shards are read in any order.
        k = bisect_right(list(zip(topic.times, topic.data, strict=True)), (t, data))
        topic.times.insert(k, t)
        topic.data.insert(k, data)

    def order(self) -> NDArray[np.int64]:
        """Return the place among the topics of each message, by time; equal times in topic order."""
        # A topic keeps its own order even where a time goes back, as `messages` takes them one after the other.
        ticks = [np.maximum.accumulate(topic.ticks()) for topic in self._order] or [np.empty(0, np.int64)]
        ranks = np.repeat(np.arange(len(ticks)), [len(times) for times in ticks])
        return ranks[np.argsort(np.concatenate(ticks), kind="stable")]

    def messages(self) -> Iterator[tuple[int, Topic, bytes]]:
        """Yield all messages by time; equal times in topic order, those of a topic as they came."""
        order = self.order()
        streams = [(topic, topic.stream()) for topic in self._order]
        for first in range(0, len(order), CHUNK):
            for rank in order[first : first + CHUNK].tolist():
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
        content = memoryview(path.read_bytes())
        head, start = _read_head(content)
        if head is None:
            return len(content)
        return len(content) - start - self.take(head, content[start:], namespace)

    def take(self, head: Mapping[str, Any], content: memoryview, namespace: str = "") -> int:
        """Add the messages of a part of a shard.

        Parameters
        ----------
        head : mapping
            What the shard says of itself.
        content : memoryview
            From the beginning of a message on.
        namespace : str
            See `read_shard`.

        Returns
        -------
        int
            Bytes of the messages that are there as a whole.
        """
        topics = [self.topics[name.removeprefix(namespace)] for name, _ in head["topics"] if name != EVENTS]
        row = [(topics[number], Layout(*form)) for number, form in head["row"]]
        at, size = 0, _RECORD.size
        while at + _ROW_HEAD.size <= len(content):
            if _ROW_HEAD.unpack_from(content, at)[1] == _ROW:
                taken = _read_rows(content[at:], row)
                at += taken
                if not taken:
                    break
                continue
            if at + size > len(content):
                break
            t, topic, length = _RECORD.unpack_from(content, at)
            # The last record may be cut off by a crash.
            if at + size + length > len(content):
                break
            data = bytes(content[at + size : at + size + length])
            if topic == len(topics):
                self.note(t, data)
            else:
                topics[topic].times.append(t)
                topics[topic].data.append(data)
            at += size + length
        return at


class ShardTail:
    """A shard that is still being written: what has come since the last look.

    Parameters
    ----------
    path : Path
        It need not be there yet.
    """

    LIMIT = 1 << 22  # bytes of one look

    def __init__(self, path: Path) -> None:
        self._path = path
        self._head: dict[str, Any] | None = None
        self._at = 0

    def read(self, recording: Recording) -> bool:
        """Add what is new to a recording; whether there may be more than one look takes.

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
            self._at += start + recording.take(self._head, content[start:])
        return len(content) == self.LIMIT


def _row_packer(layouts: Iterable[Layout]) -> Callable[..., bytes]:
    return struct.Struct(f"{_ROW_HEAD.format}{sum(layout.size for layout in layouts)}d").pack


def _read_rows(content: memoryview, row: Sequence[tuple[Topic | None, Layout]]) -> int:
    """Add the messages of the whole rows at the beginning of some bytes; returns how many bytes that are."""
    length = _ROW_HEAD.size + 8 * sum(layout.size for _, layout in row)
    block = np.frombuffer(content, dtype=np.uint8)[: len(content) // length * length].reshape(-1, length)
    other = np.flatnonzero((block[:, 8:10] != 0xFF).any(axis=1))
    block = block[: other[0]] if other.size else block
    times = np.ascontiguousarray(block[:, :8]).view("<i8")[:, 0]
    values = np.ascontiguousarray(block[:, _ROW_HEAD.size :]).view("<f8")
    first = 0
    for topic, layout in row:
        # The topic may be gone with its recording, as the reference is weak.
        if topic is not None:
            topic.add_columns(Columns(times, values[:, first : first + layout.size], layout))
        first += layout.size
    return int(block.size)


def read_shards(paths: Iterable[Path]) -> Recording:
    """Return what some shards have together, of those that are there."""
    found = [path for path in paths if path.exists()]
    recording = Recording({topic: kind for path in found for topic, kind in shard_topics(path).items()}.items())
    for path in found:
        recording.read_shard(path)
    return recording


def shard_topics(path: Path) -> dict[str, str]:
    """Return name and message type of a shard's topics, without changes; nothing if its head is cut off."""
    head, _ = _read_head(memoryview(path.read_bytes()))
    return {} if head is None else {name: msgtype for name, msgtype in head["topics"] if name != EVENTS}


def _read_head(content: memoryview) -> tuple[dict[str, Any] | None, int]:
    """Return what a shard says of itself, and where its messages begin."""
    start = bytes(content[: 1 << 20]).find(b"\n", len(_MAGIC)) + 1
    if bytes(content[: len(_MAGIC)]) != _MAGIC or not start:
        return None, 0
    return json.loads(bytes(content[len(_MAGIC) : start])), start
