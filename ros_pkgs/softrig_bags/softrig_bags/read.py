"""Bags for Python: recordings, named float64 signals, tables as CSV or Parquet."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore
from softrig_core import SECOND, Recording, Signals
from softrig_core.extras import need
from softrig_core.wire.recording import Topic, relative
from softrig_core.wire.signals import Table
from softrig_core.wire.types import TYPES

from .errors import BagError
from .reader import BagReader

EPOCH = "epoch"  # under which a run in real time leaves, in a bag's metadata, the ns that its stamps count from
WALL_CLOCK = 10**18  # ns; bag times after September 2001 are wall-clock times, simulated ones begin near zero


def read_bag(path: Path | str) -> Recording:
    """Read a bag into memory, messages as bytes, whatever their type.

    Topics are named as in scenario files: relative to the root namespace (``plant/state``), but ``/clock``.

    Parameters
    ----------
    path : Path or str
        Directory of a rosbag2 bag (of any ROS distribution, MCAP or sqlite3), or a single .mcap or .db3 file.

    Raises
    ------
    BagError
        No bag there, or it is damaged.
    """
    with BagReader(path) as bag:
        return _load(bag)


def _load(bag: BagReader) -> Recording:
    recording = Recording([(relative(t.name), t.msgtype) for t in bag.topics])
    add = recording.add
    for topic, t, data in bag.messages():
        add(topic, t, data)
    return recording


class BagSignals(Signals):
    """Signals of a bag by name ``topic/channel/field``; of foreign message types by the path of the field.

    sensor_msgs/Imu on ``/imu`` gives ``imu/angular_velocity/x`` and ``imu/orientation_covariance/0``. Elements that
    shorter arrays lack are NaN; strings and arrays of bytes are no signals.

    Attributes
    ----------
    from_start : bool
        Whether time is known to count from the start of the run: it is simulated, or the run has left its epoch.
    """

    def __init__(self, recording: Recording, epoch: int, stores: dict[str, Typestore | None], from_start: bool) -> None:
        super().__init__(recording, epoch)
        self._stores = stores
        self.from_start = from_start

    def store(self, msgtype: str) -> Typestore | None:
        """Give what deserialises a message type, None if it is not defined in the bag nor here."""
        return self._stores.get(msgtype)

    def table(self, topic: str) -> Table:
        """Give all columns of a topic."""
        found = self.recording.topics.get(topic)
        if found is not None and found.msgtype not in TYPES and topic not in self._tables:
            self._tables[topic] = self._foreign(topic)
        try:
            return super().table(topic)
        except ValueError:  # of a known type, but used in another way than the suite does
            self._tables[topic] = self._foreign(topic)
            return self._tables[topic]

    def _foreign(self, topic: str) -> Table:
        found = self.recording.topics[topic]
        store = self._stores[found.msgtype]
        if store is None:
            raise BagError(f"{topic}: the bag has no definition of {found.msgtype} and none is installed")
        t = (np.array(found.times, dtype=np.int64) - self._epoch) / SECOND
        rows, stamps = [], t.copy()
        for i in range(len(found.data)):
            message = deserialised(store, found, i)
            if hasattr(message, "header"):
                stamps[i] = (message.header.stamp.sec * SECOND + message.header.stamp.nanosec - self._epoch) / SECOND
            values = flatten(message)
            rows.append({k: float(v) for k, v in values if not isinstance(v, str | bytes) and k[:7] != "header/"})
        labels = dict.fromkeys(label for row in rows for label in row)
        return Table(t, stamps, {k: np.array([row.get(k, np.nan) for row in rows], dtype=np.float64) for k in labels})

    @property
    def decodable(self) -> list[str]:
        """Topics whose message type is defined in the bag or here."""
        topics = self.recording.topics.values()
        return [t.name for t in topics if t.msgtype in TYPES or self._stores[t.msgtype] is not None]

    def __iter__(self) -> Iterator[str]:
        for topic in self.decodable:
            yield from (f"{topic}/{label}" for label in self.table(topic).columns)


def deserialised(store: Typestore, topic: Topic, i: int) -> Any:
    """Give message number i of a topic as an object.

    Raises
    ------
    BagError
        Its bytes are damaged; names topic and number.
    """
    try:
        return store.deserialize_cdr(topic.data[i], topic.msgtype)
    except Exception as error:  # damaged bytes make the library raise whatever they lead to
        raise BagError(f"{topic.name}: message {i + 1} of {len(topic.data)} is damaged: {error}") from error


def flatten(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Give the path and value of every number, text and byte array inside a deserialised message."""
    if is_dataclass(value):
        for field in fields(value):
            yield from flatten(getattr(value, field.name), f"{path}/{field.name}" if path else field.name)
    elif isinstance(value, list):
        for i, item in enumerate(value):
            yield from flatten(item, f"{path}/{i}")
    elif isinstance(value, np.ndarray) and value.dtype.itemsize > 1:
        for i, item in enumerate(value.tolist()):
            yield f"{path}/{i}", item
    else:
        yield path, value.tobytes() if isinstance(value, np.ndarray) else value


def signals(path: Path | str) -> BagSignals:
    """Give the signals of a bag as named float64 arrays with time.

    Parameters
    ----------
    path : Path or str
        Bag, as for `read_bag`.

    Returns
    -------
    BagSignals
        A mapping from ``topic/channel/field`` to ``(t, x)``, both of shape (n,), t in s: simulated time, or the time
        since the start of a run in real time, or since the first message in any other bag of wall-clock times. `table`
        gives all columns of a topic with the header stamps.

    Raises
    ------
    BagError
        No bag there, or it is damaged.

    Examples
    --------
    >>> from softrig_bags.read import signals
    >>> found = signals("run/bag")  # doctest: +SKIP
    >>> t, omega = found["shaft/velocity"]  # doctest: +SKIP
    >>> list(found)  # doctest: +SKIP
    """
    with BagReader(path) as bag:
        left = bag.custom_data.get(EPOCH, "")
        own = int(left) if left.isdecimal() and len(left) < 20 else 0
        epoch = own or (bag.start if bag.start >= WALL_CLOCK else 0)
        stores = {t.msgtype: bag.typestore(t.msgtype) for t in bag.topics}
        return BagSignals(_load(bag), epoch, stores, from_start=bool(own) or not epoch)


def export(path: Path | str, directory: Path | str, file_format: str) -> list[Path]:
    """Write each topic's signals as a table: columns time, stamp (s), then one a signal.

    Parameters
    ----------
    path : Path or str
        Bag.
    directory : Path or str
        Where the files go; is created.
    file_format : str
        ``csv`` or ``parquet``.

    Returns
    -------
    list of Path
        The files; a topic of an undefined message type has none.

    Raises
    ------
    BagError
        Bad bag or unknown format.
    """
    need("pyarrow", "an export")
    import pyarrow  # half a second, only here
    import pyarrow.csv
    import pyarrow.parquet

    write = {"csv": pyarrow.csv.write_csv, "parquet": pyarrow.parquet.write_table}.get(file_format)
    if write is None:
        raise BagError(f"format {file_format!r}: expected csv or parquet")
    found = signals(path)
    Path(directory).mkdir(parents=True, exist_ok=True)
    written = []
    for topic in found.decodable:
        table = found.table(topic)
        columns = {"time": table.t, "stamp": table.stamp} | table.columns
        file = Path(directory) / f"{topic.strip('/').replace('/', '.')}.{file_format}"
        write(pyarrow.table(columns), str(file))
        written.append(file)
    return written
