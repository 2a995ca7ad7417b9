"""Signals of a recording as named float64 arrays."""

from __future__ import annotations

from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..timebase import SECOND
from .cdr import Layout, Message, parse
from .columns import SPARE, Columns, Stored, joined
from .long import is_long
from .recording import Recording, Topic
from .times import common, once_for_times
from .types import TYPES


class Signal(NamedTuple):
    """Time (s) and values, both of shape (n,)."""

    t: Array
    x: Array


class Table(NamedTuple):
    """All signals of one topic: tick time and header stamp (s), columns by label (``shaft/velocity``)."""

    t: Array
    stamp: Array
    columns: Mapping[str, Array]


class _InParts(Mapping[str, Array]):
    """The columns of a topic by label, each joined from its parts when it is first read.

    A column that is on the disk stays there, see `LongArray`.
    """

    def __init__(self, parts: Sequence[Columns | Stored], labels: Sequence[str], flags: Sequence[bool]) -> None:
        self._parts, self._flags = parts, flags
        self._places = {label: k for k, label in enumerate(labels)}
        self._joined: dict[int, Array] = {}

    def __getitem__(self, label: str) -> Array:
        k = self._places[label]
        if k not in self._joined:
            self._joined[k] = _as_carried(joined(self._parts, k), self._flags[k])
        return self._joined[k]

    def renamed(self, name: Callable[[str], str]) -> _InParts:
        """Return the same columns with other labels; in softrig's recordings no two have one name."""
        return _InParts(self._parts, [name(label) for label in self._places], self._flags)

    def __contains__(self, label: object) -> bool:
        return label in self._places  # no column is joined for this

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)


def full_name(name: str, known: Iterable[str]) -> str:
    """Return the whole name of a signal that was called without its field: ``buck/state/voltage`` of ``.../position``.

    Parameters
    ----------
    known : iterable of str
        All signals.

    Returns
    -------
    str
        The name itself if it is complete, or if no signal or several signals begin with it.
    """
    names = list(known)
    if name in names:
        return name
    results = [k for k in names if k.rpartition("/")[0] == name]
    return results[0] if len(results) == 1 else name


def short_name(name: str, known: Iterable[str]) -> str:
    """Return the shortest name that `full_name` expands to a signal: without the field if there is only one."""
    short = name.rpartition("/")[0]
    return short if full_name(short, known) == name else name


def topic_of(name: str, topics: Container[str]) -> str:
    """Return the topic of a signal; empty if no topic has it."""
    topic = name.rpartition("/")[0]
    while topic and topic not in topics:
        topic = topic.rpartition("/")[0]
    return topic


class Signals(Mapping[str, Signal]):
    """Signals by name ``topic/channel/field``, decoded on demand; the field may be left out if there is only one.

    Their arrays are read-only; `numpy.copy` makes one that can be changed.

    Parameters
    ----------
    epoch : int
        Time in ns that becomes 0 s (realtime runs are stamped with the wall clock).

    Raises
    ------
    KeyError
        No such signal; the message lists those of the topic or the topics.
    """

    def __init__(self, recording: Recording, epoch: int = 0) -> None:
        self.recording = recording
        self._epoch = epoch
        self._tables: dict[str, Table] = {}
        self._known: dict[str, Signal] = {}
        self.shared: dict[Hashable, Any] = {}  # results that figures share, see `measures.shared`
        # Topics of one node have the same times, which are converted once.
        self._times: dict[tuple[object, ...], tuple[Any, Array]] = {}
        self._also: Mapping[str, Mapping[str, str]] = {}
        self._named: dict[str, Table] = {}

    def known_as(self, also: Mapping[str, Mapping[str, str]]) -> Self:
        """Rename channels to the names of a rig's ports; must be called before a table is read.

        Parameters
        ----------
        also : mapping of str to mapping
            By topic: name by which an outside node may call a channel, to its own (`Port.also`); or label of a
            value to its own.
        """
        self._also = also
        return self

    @cached_property
    def end(self) -> float:
        """Time of the newest message of all signals, s; the last sample of each is held up to it."""
        ends = [topic.newest() for topic in self.recording.topics.values() if topic.msgtype in TYPES]
        return (max((end for end in ends if end is not None), default=0) - self._epoch) / SECOND

    def table(self, topic: str) -> Table:
        """Return all columns of a topic; values that a message lacks are NaN."""
        if topic not in self._also:
            return self._table(topic)
        if topic not in self._named:
            self._named[topic] = self._renamed(topic, self._table(topic))
        return self._named[topic]

    def _renamed(self, topic: str, table: Table) -> Table:
        names, columns = self._also[topic], dict[str, Array]()

        def own_name(label: str) -> str:
            channel, _, field = label.rpartition("/")
            return names.get(label) or (f"{names.get(channel, channel)}/{field}" if channel else label)

        if isinstance(table.columns, _InParts):
            return table._replace(columns=table.columns.renamed(own_name))
        for label, x in table.columns.items():
            name = own_name(label)
            # Messages with the one name lack the column of the other, so both are merged.
            columns[name] = np.where(np.isnan(columns[name]), x, columns[name]) if name in columns else x
        return table._replace(columns=columns)

    def _table(self, topic: str) -> Table:
        if topic not in self._tables:
            if topic not in self.recording.topics:
                raise KeyError(f"no topic {topic!r}; recorded are {', '.join(self.recording.topics)}")
            known = self.recording.topics[topic]
            parts = known.parts()
            self._tables[topic] = self._joined(known, parts) if parts else _decode(known, self._epoch)
        return self._tables[topic]

    def _joined(self, topic: Topic, parts: Sequence[Columns | Stored]) -> Table:
        """Return the columns of messages that are stored as numbers."""
        labels, flags = _labels_and_flags(topic.msgtype, parts[0].layout)
        t = self._clock(parts)
        return Table(t, t, _InParts(parts, labels, flags))

    def _clock(self, parts: Sequence[Columns | Stored]) -> Array:
        """Return the times of messages in s; one array for all topics that were published together."""
        key: tuple[object, ...] = tuple(id(part.clock) for part in parts)
        # Several nodes of one period have files with the same times, which take much memory.
        if len(parts) == 1 and isinstance(parts[0], Stored) and parts[0].rows.even:
            key = (*parts[0].rows.even, parts[0].number)
        if key not in self._times:
            # The parts are kept, so that no other object can get the id of their clock.
            self._times[key] = parts, _in_seconds([part.times for part in parts], self._epoch)
        return self._times[key][1]

    def __getitem__(self, name: str) -> Signal:
        if name in self._known:
            return self._known[name]
        self._known[name] = result = self._lookup(name)
        return result

    def _lookup(self, name: str) -> Signal:
        topic = topic_of(name, self.recording.topics)
        if not topic:
            raise KeyError(f"no topic for signal {name!r}; recorded are {', '.join(self.recording.topics)}")
        table = self.table(topic)
        label = name[len(topic) + 1 :]
        label = label if label in table.columns else full_name(label, table.columns)
        if label not in table.columns:
            have = f"it has {', '.join(table.columns)}" if table.columns else "no message was published on it"
            raise KeyError(f"no signal {label!r} on {topic}; {have}")
        result = Signal(table.t, table.columns[label])
        # Read-only: times belong to many signals, and figures and bags are made of the same columns afterwards.
        for array in result:
            if not is_long(array):
                array.flags.writeable = False
        return result

    def __iter__(self) -> Iterator[str]:
        for topic in self.recording.topics.values():
            if topic.msgtype in TYPES:
                yield from (f"{topic.name}/{label}" for label in self.table(topic.name).columns)

    def __len__(self) -> int:
        return sum(1 for _ in self)


@lru_cache(maxsize=1024)
def _labels_and_flags(msgtype: str, layout: Layout) -> tuple[list[str], list[bool]]:
    """Return the labels of messages that are stored as numbers, and which of them are flags."""
    first = parse(msgtype, layout.encode(0, (0.0,) * layout.size))
    return _labels(msgtype, first), [code[-1] == "?" for _, code in layout.slots for _ in range(int(code[:-1]))]


def _in_seconds(parts: Sequence[NDArray[np.int64]], epoch: int) -> Array:
    # The few times of ticks in Python are in new arrays in each run, so they are told apart by their values.
    return _seconds(epoch, *[tuple(part.tolist()) if len(part) <= SPARE else part for part in parts])


@once_for_times
def _seconds(epoch: int, *parts: NDArray[np.int64] | tuple[int, ...]) -> Array:
    arrays = [np.array(part, np.int64) if isinstance(part, tuple) else part for part in parts]
    return (common(np.concatenate(arrays)) - epoch) / SECOND


def _decode(topic: Topic, epoch: int) -> Table:
    t = (np.array(topic.times, dtype=np.int64) - epoch) / SECOND
    if not topic.data:
        return Table(t, t, {})
    first = parse(topic.msgtype, topic.data[0])
    layout = first.layout(topic.msgtype)
    labels = _labels(topic.msgtype, first)
    size = len(topic.data[0])
    # A message of the same size may still have another byte order or padding, which no layout has.
    if all(len(d) == size for d in topic.data) and layout.decode(topic.data[0]) is not None:
        block = np.frombuffer(b"".join(topic.data), dtype=np.uint8).reshape(len(topic.data), size)
        if layout.same_shape(block):
            return Table(t, _stamps(layout, block, t, epoch), dict(zip(labels, layout.columns(block), strict=True)))
    messages = [parse(topic.msgtype, d) for d in topic.data]
    rows = [
        dict(zip(_labels(topic.msgtype, m), (x for v in m.fields.values() for x in v), strict=True)) for m in messages
    ]
    # by name: outside nodes may change order, fields and length, and several of them may publish on one topic
    labels = list(dict.fromkeys(label for row in rows for label in row))
    stamps = np.array([m.stamp or 0 for m in messages], dtype=np.int64)
    columns = {k: np.array([row.get(k, np.nan) for row in rows], dtype=np.float64) for k in labels}
    return Table(t, (stamps - epoch) / SECOND, columns)


def _as_carried(x: Array, flag: bool) -> Array:
    """Return a column as messages carry it: a flag is 0 or 1."""
    return (x != 0.0).astype(np.float64) if flag else x


def _stamps(layout: Layout, block: NDArray[np.uint8], t: Array, epoch: int) -> Array:
    if layout.stamp_offset is None:
        return t
    offset = layout.stamp_offset
    parts = np.ascontiguousarray(block[:, offset : offset + 8]).view("<u4").astype(np.int64)
    return (parts[:, 0] * SECOND + parts[:, 1] - epoch) / SECOND


def _labels(msgtype: str, message: Message) -> list[str]:
    counts = {name: len(values) for name, values in message.fields.items()}
    labels = TYPES[msgtype].labels(counts, message.names, message.dims)
    # Two channels of one name are told apart by their places.
    return list(labels if len(set(labels)) == len(labels) else TYPES[msgtype].labels(counts))
