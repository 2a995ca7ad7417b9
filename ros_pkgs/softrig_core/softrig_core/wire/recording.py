"""What a run recorded: shards written at the source, and all messages of a run in memory."""

from __future__ import annotations

import heapq
import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

_RECORD = struct.Struct("<qHI")
_MAGIC = b"softrig shard 1\n"


def relative(name: str) -> str:
    """Give a topic's name as scenarios and recordings write it: without the root, except for /clock."""
    return name if name == "/clock" else name.removeprefix("/")


class Sink(Protocol):
    """Where a block's published bytes go."""

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message of topic number `topic`, published at tick time `t` (ns)."""


class ShardWriter:
    """Append-only file of one node's published messages; cheap in the loop, flushed by size and by `flush`.

    Parameters
    ----------
    path : Path
    topics : sequence of (name, message type)
        In the order of the numbers that `add` takes.
    """

    LIMIT = 1 << 18

    def __init__(self, path: Path, topics: Sequence[tuple[str, str]]) -> None:
        self._file = path.open("wb", buffering=0)
        self._buffer = bytearray(_MAGIC + json.dumps(list(topics)).encode() + b"\n")
        self.flush()

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        buffer = self._buffer
        buffer += _RECORD.pack(t, topic, len(data))
        buffer += data
        if len(buffer) > self.LIMIT:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system; raises OSError (disk full), never drops silently."""
        while self._buffer:
            written = self._file.write(self._buffer)
            del self._buffer[: written or 0]

    def close(self) -> None:
        """Flush and close."""
        self.flush()
        self._file.close()


@dataclass
class Topic:
    """All messages of one topic: tick times in ns and message bytes."""

    name: str
    msgtype: str
    times: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)


class Recording:
    """Messages of a run by topic, in memory; also a `Sink` for in-process runs."""

    def __init__(self, topics: Iterable[tuple[str, str]]) -> None:
        self.topics = {name: Topic(name, msgtype) for name, msgtype in topics}
        self._order = list(self.topics.values())
        self._append = [(t.times.append, t.data.append) for t in self._order]

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        time, datum = self._append[topic]
        time(t)
        datum(data)

    def messages(self) -> Iterator[tuple[int, Topic, bytes]]:
        """Give all messages by time; equal times in topic order."""
        streams = [
            zip(topic.times, [rank] * len(topic.times), topic.data, strict=True)
            for rank, topic in enumerate(self._order)
        ]
        for t, rank, data in heapq.merge(*streams):
            yield t, self._order[rank], data

    def read_shard(self, path: Path) -> int:
        """Add the messages of a shard; a record cut off by a crash at its end is left out.

        Returns
        -------
        int
            Bytes at the end that belong to a record cut off.
        """
        content = memoryview(path.read_bytes())
        if bytes(content[: len(_MAGIC)]) != _MAGIC:
            return len(content)
        start = bytes(content[: 1 << 20]).find(b"\n", len(_MAGIC)) + 1
        if not start:  # cut off inside its head
            return len(content)
        numbers = {t.name: i for i, t in enumerate(self._order)}
        index = [numbers[name] for name, _ in json.loads(bytes(content[len(_MAGIC) : start]))]
        at, size = start, _RECORD.size
        while at + size <= len(content):
            t, topic, length = _RECORD.unpack_from(content, at)
            if at + size + length > len(content):
                break
            time, datum = self._append[index[topic]]
            time(t)
            datum(bytes(content[at + size : at + size + length]))
            at += size + length
        return len(content) - at
