"""Reader of an SQLite storage file of rosbag2, of any version of its schema."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from ..content.block import Block
from .source import Damaged, Source, SourceTopic
from .sqlite_recover import columns_of, journals, topics_of

# Rows that are read at a time at most, and their bytes, about: messages may be of a few bytes or of megabytes.
ROWS, BYTES = 1 << 14, 1 << 22
LATEST = 2**63 - 1
_MESSAGES = "SELECT topic_id, timestamp, data FROM messages WHERE timestamp >= ? ORDER BY timestamp, id"


@dataclass
class SqliteSource(Source):
    """One SQLite file that is open for reading. The file itself is never changed.

    Raises
    ------
    Damaged
        It is no database, or not one of rosbag2.
    """

    def __post_init__(self) -> None:
        self._copy: TemporaryDirectory[str] | None = None
        # Topics are numbered here again, because their numbers in the file may be any.
        self._numbers: dict[Any, int] = {}
        path = self.path
        # A recorder was killed. SQLite would finish its commit in the folder itself, so a copy is opened.
        if beside := journals(path):
            self._copy = TemporaryDirectory(prefix="softrig-bag-")
            for file in (path, *beside):
                shutil.copyfile(file, Path(self._copy.name) / file.name)
            path = Path(self._copy.name) / path.name
        # With `immutable` SQLite creates neither a journal nor a lock beside the file, whose folder may be read-only.
        mode = "" if beside else "?mode=ro&immutable=1"
        try:
            self._db = sqlite3.connect(path.absolute().as_uri() + mode, uri=True, check_same_thread=False)
            self._read_topics()
            self.first, self.last = self._one("SELECT min(timestamp), max(timestamp) FROM messages")
        except (sqlite3.Error, OverflowError, UnicodeDecodeError, ValueError) as error:
            self.close()
            raise Damaged(str(error)) from error
        if self.first is None:
            self.first, self.last = LATEST, 0
        elif not isinstance(self.first, int) or not isinstance(self.last, int) or self.first < 0:
            self.close()
            raise Damaged(f"messages are at {self.first!r} to {self.last!r}, expected whole numbers of ns from 0")

    def close(self) -> None:
        """Close the file."""
        with suppress(AttributeError):
            self._db.close()
        if self._copy is not None:
            self._copy.cleanup()

    def _one(self, text: str) -> Any:
        return self._db.execute(text).fetchone()

    def _read_topics(self) -> None:
        if not columns_of(self._db, "topics") or not columns_of(self._db, "messages"):
            raise Damaged("it has no tables of topics and messages")
        for number, topic in topics_of(self._db):
            if not all(isinstance(text, str) for text in topic):
                raise Damaged(f"topic {topic.name!r} of type {topic.msgtype!r}"[:100] + ", expected names")
            self.topics[len(self._numbers)] = topic
            self._numbers[number] = len(self._numbers)
        if columns_of(self._db, "metadata"):
            for (text,) in self._db.execute("SELECT metadata FROM metadata ORDER BY id"):
                self.metadata = str(text) or self.metadata

    def blocks(self, start: int = 0) -> Iterator[tuple[int, Block, int]]:
        """Yield blocks, each with its place in the file and the time before which nothing follows that precedes it."""
        try:
            rows, n, position = self._db.execute(_MESSAGES, (start,)), 1, 0
            while result := rows.fetchmany(n):
                block = self._block(result)
                yield position, block, int(block.t[-1]) + 1  # equal times are in the order of writing
                position += len(block)
                # Messages may be long, so the number of rows grows from one on, as their bytes allow.
                n = max(1, min(ROWS, 2 * n, BYTES * n // max(len(block.raw), 1)))
        except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
            raise Damaged(str(error)) from error

    def _block(self, rows: list[tuple[Any, Any, Any]]) -> Block:
        for topic, t, message in rows:
            if type(message) is not bytes or type(t) is not int or type(topic) is not int:
                raise Damaged(f"a message is {type(message).__name__} at {t!r}, expected bytes at a whole number")
        topics, times, data = zip(*rows, strict=True)
        for topic in set(topics) - self._numbers.keys():
            self.topics[len(self._numbers)] = SourceTopic(f"topic {topic} without a name", "")
            self._numbers[topic] = len(self._numbers)
        size = np.fromiter(map(len, data), np.int64, len(data))
        raw = np.frombuffer(b"".join(data), np.uint8)
        numbers = np.fromiter(map(self._numbers.__getitem__, topics), np.int64, len(data))
        return Block(raw, numbers, np.array(times, np.int64), np.cumsum(size) - size, size)
