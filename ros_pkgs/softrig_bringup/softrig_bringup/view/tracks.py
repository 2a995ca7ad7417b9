"""Data that a page stores of a running run: everything while it is short, later only extremes of old data."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
from softrig_core import Array
from softrig_core.wire.signals import Signal, Table, full_name, topic_of

ROWS = 200_000  # messages of a topic that are kept
_BUCKET = 4  # old messages of which the lowest and the highest value are kept


class Track:
    """The messages of one topic as numbers.

    Parameters
    ----------
    limit : int
        Largest number of stored messages. If there are more, the older half is thinned: of four messages two remain,
        with the lowest and the highest value of each channel, so that no peak is lost.
    """

    def __init__(self, limit: int = ROWS) -> None:
        self._limit = limit
        self._t = np.empty(0)
        self._x = np.empty((0, 0))
        self._n = 0
        self.labels: list[str] = []
        self.thinned = False

    def __len__(self) -> int:
        return self._n

    def append(self, t: Array, columns: Mapping[str, Array]) -> None:
        """Add messages; a channel that is new or missing is NaN where it is not."""
        # Besides the remaining messages of a track that is thinned: three quarters and two more.
        most = self._limit // 5
        for first in range(0, len(t), most):
            rows = slice(first, first + most)
            self._append(t[rows], {label: x[rows] for label, x in columns.items()})

    def _append(self, t: Array, columns: Mapping[str, Array]) -> None:
        new = [label for label in columns if label not in self.labels]
        if new:
            self.labels += new
            self._x = np.vstack([self._x, np.full((len(new), self._t.size), np.nan)])
        if self._n + len(t) > self._limit:
            self._thin()
        if (needed := self._n + len(t)) > self._t.size:
            size = min(self._limit, max(1024, 2 * needed))
            self._t = np.resize(self._t, size)
            self._x = np.hstack([self._x, np.full((len(self.labels), size - self._x.shape[1]), np.nan)])
        self._t[self._n : needed] = t
        for k, label in enumerate(self.labels):
            self._x[k, self._n : needed] = columns.get(label, np.nan)
        self._n = needed

    def _thin(self) -> None:
        self.thinned = True
        old = self._n // 2 // _BUCKET * _BUCKET
        fmin: Any = np.fmin  # the annotations of numpy know no axis
        fmax: Any = np.fmax
        x = self._x[:, :old].reshape(len(self.labels), -1, _BUCKET)
        low, high = fmin.reduce(x, axis=2), fmax.reduce(x, axis=2)
        falls = np.argmax(x, axis=2) < np.argmin(x, axis=2)
        pairs = np.stack([np.where(falls, high, low), np.where(falls, low, high)], axis=2)
        thinned = old // _BUCKET * 2
        self._t[:thinned] = self._t[:old].reshape(-1, _BUCKET)[:, ::2].ravel()
        self._x[:, :thinned] = pairs.reshape(len(self.labels), -1)
        remaining = self._n - old
        self._t[thinned : thinned + remaining] = self._t[old : self._n].copy()
        self._x[:, thinned : thinned + remaining] = self._x[:, old : self._n].copy()
        self._n = thinned + remaining

    def table(self, first: float, last: float) -> Table:
        """Return the messages from `first` to `last` (s), and the one before them, which is valid until then."""
        t = self._t[: self._n]
        i = max(0, int(np.searchsorted(t, first, "right")) - 1)
        j = int(np.searchsorted(t, last, "right"))
        return Table(t[i:j], t[i:j], {label: self._x[k, i:j] for k, label in enumerate(self.labels)})


_EMPTY = Table(np.empty(0), np.empty(0), {})


class Pane(Mapping[str, Signal]):
    """Signals within a time window, in the form that pictures and figures use.

    Parameters
    ----------
    tables : mapping of str to Table
        By topic.
    """

    def __init__(self, tables: Mapping[str, Table]) -> None:
        self._tables = tables
        self.recording = self
        self.topics = {topic: SimpleNamespace(number=len(table.t)) for topic, table in tables.items()}

    def table(self, topic: str) -> Table:
        """Return all columns of a topic; none if no message has arrived."""
        return self._tables.get(topic, _EMPTY)

    def __getitem__(self, name: str) -> Signal:
        topic = topic_of(name, self._tables)
        if not topic:
            raise KeyError(f"no topic for signal {name!r}")
        table = self._tables[topic]
        label = full_name(name[len(topic) + 1 :], table.columns)
        if label not in table.columns:
            raise KeyError(f"no samples yet of {name}")
        return Signal(table.t, table.columns[label])

    def __iter__(self) -> Iterator[str]:
        for topic, table in self._tables.items():
            yield from (f"{topic}/{label}" for label in table.columns)

    def __len__(self) -> int:
        return sum(1 for _ in self)
