"""SQLite storage of a bag file (rosbag2's schema 4)."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ..content.topics import BagTopic
from .yaml_text import qos_dicts, to_yaml


class Sqlite3File:
    """One .db3 file; what has been committed by `flush` survives a crash.

    Parameters
    ----------
    path : Path
        Must not exist.
    compression : str
        Only ``none``: rosbag2 has no compression inside this storage.
    metadata : str
        The bag's metadata as far as known at the start, YAML.

    Raises
    ------
    OSError
        From any method that writes.
    """

    SUFFIX = ".db3"
    # A crash loses at most the pending rows, which are as many bytes as an open chunk of MCAP.
    COMMIT_BYTES = 1 << 19

    def __init__(self, path: Path, compression: str, metadata: str) -> None:
        self.path = path
        if path.exists():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
        # Imported here, because few bags are of this storage, and this module is imported for every bag.
        import sqlite3

        from rosbags.rosbag2.storage_sqlite3 import Sqlite3Writer

        self._db = sqlite3.connect(path)
        # Without this each commit waits for the disk. A crash of the process is still safe; only a loss of power is
        # not.
        self._db.execute("PRAGMA synchronous = OFF")
        self._pending: list[tuple[int, int, bytes]] = []
        self._pending_size = 0
        self._types: set[str] = set()
        self._size = 0
        self.counts: dict[int, int] = {}
        self.first, self.last = 0, 0
        with self._transaction():
            self._db.executescript(Sqlite3Writer.SQLITE_SCHEMA)
            self._db.execute("UPDATE schema SET ros_distro = 'jazzy'")
            self._add_metadata(metadata)

    @property
    def size(self) -> int:
        """Bytes in the file and waiting for the next commit."""
        return self._size + self._pending_size

    def add_topic(self, number: int, topic: BagTopic) -> None:
        """Declare a topic under a number."""
        with self._transaction():
            if topic.definition and topic.msgtype not in self._types:
                self._types.add(topic.msgtype)
                self._db.execute(
                    "INSERT INTO message_definitions VALUES (?, ?, ?, ?, ?)",
                    (len(self._types), topic.msgtype, topic.encoding, topic.definition, topic.digest),
                )
            offered = to_yaml(qos_dicts(topic.offered))
            self._db.execute(
                "INSERT INTO topics VALUES (?, ?, ?, ?, ?, ?)",
                (number, topic.name, topic.msgtype, topic.wire, offered, topic.digest),
            )
        self.counts[number] = 0

    def write(self, number: int, t: int, data: bytes) -> None:
        """Append one message with its bag time in ns."""
        self._pending.append((number, t, data))
        self._pending_size += len(data) + 24
        if self._pending_size >= self.COMMIT_BYTES:
            self.flush()

    def flush(self) -> None:
        """Commit pending rows."""
        pending = self._pending
        if not pending:
            return
        with self._transaction():
            self._db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", pending)
        times = [t for _, t, _ in pending]
        written = sum(self.counts.values())
        self.first, self.last = min(times + [self.first] * (written > 0)), max(*times, self.last)
        for number, _, _ in pending:
            self.counts[number] += 1
        self._pending, self._pending_size = [], 0

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Commit the changes of the block, or undo them and raise OSError, so that both storages fail alike."""
        import sqlite3

        try:
            yield
            self._db.commit()
        except sqlite3.Error as error:
            self._db.rollback()
            full = error.sqlite_errorcode == sqlite3.SQLITE_FULL
            raise OSError(errno.ENOSPC if full else errno.EIO, str(error), str(self.path)) from error
        self._size = self.path.stat().st_size

    def _add_metadata(self, text: str) -> None:
        self._db.execute("INSERT INTO metadata (metadata_version, metadata) VALUES (9, ?)", (text,))

    def discard(self) -> int:
        """Drop the waiting messages (after a failed write); return their number."""
        lost = len(self._pending)
        self._pending, self._pending_size = [], 0
        return lost

    def close(self, metadata: str) -> None:
        """Commit pending rows and the metadata of the bag."""
        self.flush()
        with self._transaction():
            self._add_metadata(metadata)
        self._db.close()

    def abort(self) -> None:
        """Close the file as it is."""
        self._db.close()
