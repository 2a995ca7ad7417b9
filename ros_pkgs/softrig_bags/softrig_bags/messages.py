"""Sources of messages to compare: a bag on disk, or a recording in memory, both in blocks."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import numpy as np
from softrig_core import Recording, Signals
from softrig_core.wire.recording import CHUNK, Topic, relative

from .content.block import EMPTY, Block, packed
from .content.definitions import Types, complete
from .files.reader import BagReader
from .read import BagSignals


class Described(NamedTuple):
    """A topic: its name as in scenarios, None outside the requested namespace, and its type."""

    name: str | None
    msgtype: str


class RecordedMessages:
    """A recording in memory."""

    is_whole = True

    def __init__(self, recording: Recording) -> None:
        self._topics = list(recording.topics.values())

    def __enter__(self) -> RecordedMessages:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Do nothing: there is nothing to close."""

    @property
    def topics(self) -> list[Described]:
        """The topics."""
        return [Described(relative(t.name), t.msgtype) for t in self._topics]

    def types(self, i: int) -> Types:
        """Return the definitions of a topic's type as installed here."""
        return complete(self._topics[i].msgtype, {})

    def blocks(self, topics: Collection[int] | None = None) -> Iterator[Block]:
        """Return the messages topic by topic."""
        for i, topic in enumerate(self._topics):
            if topics is None or i in topics:
                yield from _blocks(i, topic)


def _blocks(i: int, topic: Topic) -> Iterator[Block]:
    columns = topic.columns()
    n = topic.number
    for first in range(0, n, CHUNK):
        last = min(first + CHUNK, n)
        number = np.full(last - first, i, np.int64)
        if columns is None:
            times = np.array(topic.times[first:last], np.int64)
            yield packed(topic.data[first:last], Block(EMPTY.raw, number, times, EMPTY.at, EMPTY.size))
            continue
        chunk = columns.part(first, last)
        rows = chunk.encoded(first)
        size = np.full(len(rows), rows.shape[1], np.int64)
        yield Block(rows.reshape(-1), number, chunk.times, np.cumsum(size) - size, size)


Messages = BagReader | RecordedMessages


def described(messages: Messages) -> list[Described]:
    """Return the topics of a bag or recording, in the order of their numbers."""
    if isinstance(messages, BagReader):
        return [Described(messages.label(t.name), t.msgtype) for t in messages.topics]
    return messages.topics


def opened(source: Signals | Path | str, namespace: str = "") -> Messages:
    """Return a context manager with the messages behind signals, or of a bag by its path and in a namespace."""
    if isinstance(source, BagSignals):
        return BagReader(source.path, namespace=source.namespace)
    return RecordedMessages(source.recording) if isinstance(source, Signals) else BagReader(source, namespace=namespace)
