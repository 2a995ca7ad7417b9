"""Bags for Python: recordings, named float64 signals, tables as CSV or Parquet."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryFile, gettempdir
from typing import cast

import numpy as np
from numpy.typing import NDArray
from softrig_core import SECOND, Array, Recording, Signals
from softrig_core.guard import incomplete, naming, print_line
from softrig_core.wire.recording import Topic
from softrig_core.wire.signals import Table

from .content.block import distinct
from .errors import BagError
from .files.reader import BagReader
from .tables import Columns, Growing, OnDisk

EPOCH = "epoch"  # key in a bag's metadata: the stamp of t = 0 of a run in real time, ns
# In ns. Bag times after September 2001 are those of a wall clock; simulated times begin near zero.
WALL_CLOCK = 10**18


def read_bag(path: Path | str, namespace: str = "") -> Recording:
    """Read a bag into memory, messages as bytes, whatever their type.

    Topics are named as in scenario files: relative to the root namespace (``plant/state``), but ``/clock``.

    Parameters
    ----------
    path : Path or str
        Directory of a rosbag2 bag (of any ROS distribution, MCAP or sqlite3), or a single .mcap or .db3 file.
    namespace : str
        Only the topics in it, which are named relative to it.

    Raises
    ------
    BagError
        No bag there, or it is damaged.
    """
    with BagReader(path, namespace=namespace) as bag:
        results: dict[int, tuple[list[int], list[bytes]]] = {}
        for topic, t, data in bag.messages():
            times, messages = results.setdefault(topic, ([], []))
            times.append(t)
            messages.append(data)
        recording = _empty(bag)
        for i, (times, messages) in results.items():
            topic_of_it = recording.topics[bag.labels[i]]
            topic_of_it.times.extend(times)
            topic_of_it.data.extend(messages)
        return recording


def _empty(bag: BagReader) -> Recording:
    return Recording((bag.labels[i], bag.topics[i].msgtype) for i in bag.chosen)


class _Unread(Topic):
    """A topic of a bag whose messages are read when first asked for.

    Parameters
    ----------
    number : int
        How many there are.
    newest : int, optional
        Time of the last one, ns.
    """

    def __init__(self, name: str, msgtype: str, number: int, newest: int | None) -> None:
        super().__init__(name, msgtype)
        self._number, self._newest = number, newest

    @property
    def number(self) -> int:
        """Return how many messages there are."""
        return self._number

    def newest(self) -> int | None:
        """Return the time of its last message, ns; None without one."""
        return self._newest


class BagSignals(Signals):
    """Signals of a bag by name ``topic/channel/field``; of foreign message types by the path of the field.

    sensor_msgs/Imu on ``/imu`` becomes ``imu/angular_velocity/x`` and ``imu/orientation_covariance/0``. A value that a
    message lacks and others of its topic have is NaN: elements of shorter arrays, channels of another publisher.
    Strings and long arrays of bytes are no signals.

    Attributes
    ----------
    path : Path
        Of the bag.
    namespace : str
        Of which it has the topics; empty for all.
    recording : Recording
        The messages as bytes; they are read when first asked for.
    from_start : bool
        Whether time is known to count from the start of the run: it is simulated, or the run has left its epoch.
    absent : dict of str to dict
        By topic and column: which messages lack the column, where some do; not known if the columns are on the disk.
    left_out : dict of str to Left
        By topic: what has not become signals, and why.
    undecodable : list of str
        Topics whose messages cannot be decoded, not even one.
    """

    def __init__(
        self,
        path: Path,
        bag: BagReader,
        columns: Columns,
        tables: dict[int, Growing | OnDisk],
        newest: Mapping[int, int],
        namespace: str = "",
    ) -> None:
        self.path, self.namespace = path, namespace
        epoch, self.from_start = epoch_of(bag)
        recording = _empty(bag)
        super().__init__(recording, epoch)
        for i in bag.chosen:
            name = bag.labels[i]
            topic = _Unread(name, bag.topics[i].msgtype, bag.counts[i], newest.get(i))
            topic.settle, recording.topics[name] = self._load, topic
        self.absent: dict[str, dict[str, NDArray[np.bool_]]] = {}
        for i in bag.chosen:
            label = bag.labels[i]
            if columns.decoder(i) is not None and not columns.reason(i):
                # The times in ns are dropped topic by topic, so that they do not wait for those in s of all topics.
                table = tables.pop(i, Growing()).whole()
                t, stamp = ((ticks - epoch) / SECOND for ticks in (table.t, table.stamp))
                self._tables[label] = Table(t, stamp, cast("dict[str, Array]", table.columns))
                self.absent[label] = table.absent
        self.left_out = {bag.labels[i]: left for i, left in columns.left.items()}
        self.undecodable = [x for i in bag.chosen if bag.counts[i] and (x := bag.labels[i]) not in self._tables]

    def _load(self) -> None:
        for topic in self.recording.topics.values():
            topic.settle = lambda: None
        for name, result in read_bag(self.path, self.namespace).topics.items():
            self.recording.topics[name].times.extend(result.times)
            self.recording.topics[name].data.extend(result.data)

    def _table(self, topic: str) -> Table:
        if topic not in self._tables and topic in self.recording.topics:
            reason = self.left_out[topic].reason
            raise BagError(f"{topic} ({self.recording.topics[topic].msgtype}) cannot be decoded: {reason}")
        return super()._table(topic)

    @property
    def decodable(self) -> list[str]:
        """Topics whose messages can be decoded with a definition in the bag or of this installation."""
        return [name for name in self.recording.topics if name in self._tables]

    def __iter__(self) -> Iterator[str]:
        for topic in self.decodable:
            yield from (f"{topic}/{label}" for label in self.table(topic).columns)


def epoch_of(bag: BagReader) -> tuple[int, bool]:
    """Return the time in ns that becomes 0 s, and whether it is known to be the start of the run."""
    left = bag.custom_data.get(EPOCH, "")
    recorded = int(left) if left.isdecimal() and len(left) < 20 and int(left) < 1 << 63 else 0
    epoch = recorded or (bag.start if bag.start >= WALL_CLOCK else 0)
    return epoch, bool(recorded) or not epoch


def signals(path: Path | str, namespace: str = "", on_disk: bool = False) -> BagSignals:
    """Return the signals of a bag as named float64 arrays with time.

    Parameters
    ----------
    path : Path or str
        Bag, as for `read_bag`.
    namespace : str
        As for `read_bag`.
    on_disk : bool
        Whether long columns are in a temporary file, so that memory does not grow with the bag: arrays are read a
        stretch at a time (`softrig_core.wire.long`).

    Returns
    -------
    BagSignals
        A mapping from ``topic/channel/field`` to ``(t, x)``, both of shape (n,), t in s: simulated time, or the time
        since the start of a run in real time, or since the first message in any other bag of wall-clock times. `table`
        returns all columns of a topic with the header stamps.

    Raises
    ------
    BagError
        No bag there, or it is damaged.

    Examples
    --------
    >>> from softrig_bags.read import signals
    >>> recorded = signals("run/bag")  # doctest: +SKIP
    >>> t, omega = recorded["shaft/velocity"]  # doctest: +SKIP
    >>> list(recorded)  # doctest: +SKIP
    """
    with BagReader(path, namespace=namespace) as bag:
        columns, tables, newest = Columns(bag), dict[int, Growing | OnDisk](), dict[int, int]()
        # It has no name, and it is closed with the last array that is read from it.
        file = TemporaryFile() if on_disk else None  # noqa: SIM115
        for block in bag.blocks():
            for topic in distinct(block.topic):
                newest[topic] = int(block.t[block.topic == topic][-1])
            for topic, piece in columns.pieces(block):
                if topic not in tables:
                    tables[topic] = Growing(bag.claimed(topic)) if file is None else OnDisk(file)
                with naming(Path(gettempdir())):
                    tables[topic].add(piece)
        if file is not None:
            with naming(Path(gettempdir())):
                file.flush()
        columns.finish()
        report_left_out(path, columns)
        return BagSignals(Path(path), bag, columns, tables, newest, namespace)


def report_left_out(path: Path | str, columns: Columns) -> None:
    """Report which parts of a bag have not become numbers."""
    for line, lost in columns.lines():
        (incomplete if lost else print_line)(f"{path}: {line}")
