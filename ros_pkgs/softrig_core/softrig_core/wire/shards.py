"""Record a run in one process into one shard for each node, as separate nodes would."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .cdr import Layout
from .recording import Recording, ShardWriter

# Changes of parameters, and outputs that are silent at times. No topic has a hyphen in its name.
REST = "not-rows"


class Shards:
    """A `Sink` that keeps only the newest messages in memory; the others remain on disk if the process is killed.

    Parameters
    ----------
    folder : Path
        Created when the first message arrives.
    topics : sequence of (name, message type)
        In the order of the topic numbers that `add` accepts.
    """

    def __init__(self, folder: Path, topics: Sequence[tuple[str, str]]) -> None:
        self._folder, self._topics = folder, list(topics)
        self._writers: dict[str, ShardWriter] = {}

    def _writer(self, name: str, row: Mapping[int, Layout] | None = None) -> ShardWriter:
        if name not in self._writers:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._writers[name] = ShardWriter(self._path(name), self._topics, row)
        return self._writers[name]

    def _path(self, name: str) -> Path:
        return self._folder / f"{name}.shard"

    def _of(self, layouts: Mapping[int, Layout]) -> ShardWriter:
        """Return the shard of a node that publishes in rows; it has the name of its first topic."""
        topic, _ = self._topics[next(iter(layouts))]
        return self._writer(topic.strip("/").replace("/", "."), layouts)

    def add(self, topic: int, t: int, data: bytes) -> None:
        """Append one message."""
        self._writer(REST).add(topic, t, data)

    def note(self, t: int, data: bytes) -> None:
        """Append a change of parameters."""
        self._writer(REST).note(t, data)

    def row(self, layouts: Mapping[int, Layout]) -> Callable[[int, Sequence[float]], object]:
        """Return a function that appends one message to each of some topics, all at one time, by their numbers."""
        return self._of(layouts).add_row

    def rows(self, layouts: Mapping[int, Layout]) -> Callable[[NDArray[np.int64], NDArray[np.float64]], object]:
        """Return a function that appends many such rows."""
        return self._of(layouts).add_rows

    def flush(self) -> None:
        """Pass everything to the operating system; raises OSError (disk full)."""
        for writer in self._writers.values():
            writer.flush()

    def recording(self) -> Recording:
        """Return the recording in the shards; long ones stay on the disk."""
        result = Recording(self._topics)
        for name in self._writers:
            result.read_shard(self._path(name))
        result.release = self.remove
        return result

    def remove(self) -> None:
        """Remove the shards; a recording of them has them open and can still be read."""
        for name in self._writers:
            self._path(name).unlink(missing_ok=True)
        if self._folder.is_dir() and not any(self._folder.iterdir()):
            self._folder.rmdir()
