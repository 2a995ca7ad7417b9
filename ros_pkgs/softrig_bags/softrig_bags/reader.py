"""A bag being read: its topics and its messages in the order in which they were written."""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any

from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinitionFormat
from rosbags.rosbag2 import Reader, ReaderError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from .compressed import SUFFIXES, plain
from .errors import BagError
from .mcap_recover import check_sizes
from .topics import BagTopic, custom_data, typestore

METADATA_LIMIT = 1 << 24


class BagReader:
    """Context manager around a rosbag2 bag: MCAP or sqlite3, split or not, compressed or not, metadata versions to 9.

    Parameters
    ----------
    path : Path or str
        Bag directory, or a single .mcap or .db3 file.

    Raises
    ------
    BagError
        On entering and on reading: no bag, damaged, or of an unknown format.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self._reader: Any = None
        self.topics: list[BagTopic] = []
        self.counts: list[int] = []

    def __enter__(self) -> BagReader:
        if self.path.is_dir() and not (self.path / "metadata.yaml").exists():
            if any(p.suffix in SUFFIXES for p in map(plain, self.path.iterdir())):
                raise BagError(
                    f"{self.path} has no metadata.yaml: the recording was cut off; "
                    f"`softrig bag repair {self.path}` restores it"
                )
            raise BagError(f"{self.path} is not a bag: no metadata.yaml, no .mcap and no .db3 file in it")
        try:
            if self.path.is_dir() and (self.path / "metadata.yaml").stat().st_size > METADATA_LIMIT:
                raise BagError(f"{self.path}/metadata.yaml is longer than {METADATA_LIMIT} bytes")
            for file in (self.path,) if self.path.is_file() else self.path.glob("*.mcap"):
                if file.suffix == ".mcap":
                    check_sizes(file)
            self._reader = Reader(self.path)
            self._reader.open()
        except BagError:
            raise
        except (FileNotFoundError, ReaderError) as error:
            raise BagError(f"{self.path}: {error}") from None
        except Exception as error:  # a damaged file makes the library raise whatever its bytes lead to
            raise self._damaged(error) from error
        self._connections: list[Connection] = list(self._reader.connections)
        try:
            self._check_metadata()
        except Exception as error:
            raise self._damaged(error) from error
        for connection in self._connections:
            if any(t.name == connection.topic for t in self.topics):
                raise BagError(f"{self.path}: two types on topic {connection.topic}")
            try:
                self.topics.append(_topic(connection))
            except Exception as error:  # a damaged definition or profile
                raise self._damaged(error) from error
            self.counts.append(connection.msgcount)
        return self

    def _check_metadata(self) -> None:
        """Make sure that what the metadata says is of the right kinds: the library takes what stands there."""
        for connection in self._connections:
            if not isinstance(connection.topic, str) or not isinstance(connection.msgtype, str):
                what = f"topic {connection.topic!r} of type {connection.msgtype!r}"
                raise ValueError(f"{what[:100]}, expected names")
            _check_number(f"messages on {connection.topic}", connection.msgcount)
        for name, number in (("messages", self.count), ("start", self.start), ("end", self.end + 1)):
            _check_number(name, number)
        if not isinstance(custom := self.custom_data, dict):
            raise ValueError(f"custom_data is {custom!r}"[:100] + ", expected a mapping")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(AttributeError):  # what it closes is what the metadata says
            self._reader.close()

    @property
    def start(self) -> int:
        """Bag time of the first message in ns; 0 in an empty bag."""
        return self._reader.start_time if self.count else 0

    @property
    def end(self) -> int:
        """Bag time of the last message in ns; 0 in an empty bag."""
        return self._reader.end_time - 1 if self.count else 0

    @property
    def count(self) -> int:
        """Number of messages."""
        return self._reader.message_count

    @property
    def custom_data(self) -> dict[str, str]:
        """Give what the writer left in the metadata; a single MCAP file has a copy of it."""
        if self.path.suffix == ".mcap" and self.path.is_file():
            return _of_mcap(self.path)
        return self._reader.storage.metadata.custom or {}

    @property
    def files(self) -> list[Path]:
        """Storage files."""
        if self.path.is_dir():
            return [s.path for s in self._reader.storage.storages]
        return [self.path]

    def messages(self, topics: Collection[str] | None = None, start: int = 0) -> Iterator[tuple[int, int, bytes]]:
        """Give (index into `topics`, bag time in ns, bytes) by time, equal times as written.

        Parameters
        ----------
        topics : collection of str, optional
            Absolute names; default all.
        start : int
            First bag time in ns.
        """
        index = {t.name: i for i, t in enumerate(self.topics)}
        chosen = [c for c in self._connections if topics is None or c.topic in topics]
        if not chosen:
            return
        try:
            for connection, t, data in self._reader.messages(chosen, start=start or None):
                if not isinstance(data, bytes | memoryview) or not isinstance(t, int):
                    found = f"{type(data).__name__} at {t!r}"
                    raise ValueError(f"a message on {connection.topic} is {found}, expected bytes at a whole number")
                message: Any = data
                yield index[connection.topic], t, message
        except Exception as error:  # a damaged file makes the library raise whatever its bytes lead to
            raise self._damaged(error) from error

    def _damaged(self, error: Exception) -> BagError:
        return BagError(f"{self.path} is damaged: {error}; `softrig bag repair` saves what is readable")

    def typestore(self, msgtype: str) -> Typestore | None:
        """Give a store that can deserialise a type, from the bag's own definition if it has one."""
        for connection in self._connections:
            if connection.msgtype == msgtype and connection.msgdef.format != MessageDefinitionFormat.NONE:
                try:
                    return _store(connection)
                except Exception as error:  # a damaged text makes the parser raise whatever it leads to
                    raise BagError(f"{self.path}: the definition of {msgtype} cannot be read: {error}") from error
        return typestore() if BagTopic.known("", msgtype).definition else None


def _of_mcap(path: Path) -> dict[str, str]:
    found: dict[str, str] = {}
    with path.open("rb") as file, suppress(McapError, EOFError, ValueError, struct.error):
        for record in make_reader(file).iter_metadata():
            if record.name == "rosbag2":
                found = custom_data(record.metadata.get("serialized_metadata", "")) or found
    return found


def _check_number(name: str, number: object) -> None:
    if not isinstance(number, int) or not 0 <= number < 1 << 63:
        raise ValueError(f"{name}: {number!r}"[:100] + ", expected a whole number of 64 bits")


def _topic(connection: Connection) -> BagTopic:
    assert isinstance(connection.ext, ConnectionExtRosbag2)
    known = BagTopic.known(connection.topic, connection.msgtype, connection.ext.offered_qos_profiles, connection.digest)
    if connection.msgdef.format == MessageDefinitionFormat.NONE:
        return known
    encoding = "ros2msg" if connection.msgdef.format == MessageDefinitionFormat.MSG else "ros2idl"
    return BagTopic(known.name, known.msgtype, connection.msgdef.data, known.digest, known.offered, encoding)


def _store(connection: Connection) -> Typestore:
    store = get_typestore(Stores.EMPTY)
    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        store.register(get_types_from_msg(text, connection.msgtype))
    else:
        for part in text.split("=" * 80 + "\n"):
            store.register(get_types_from_idl(part.partition("\n")[2] if part.startswith("IDL: ") else part))
    return store
