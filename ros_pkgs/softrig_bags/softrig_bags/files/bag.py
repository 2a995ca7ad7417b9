"""A bag being written: its directory, its files and its metadata.yaml (rosbag2 metadata version 9)."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softrig_core import Recording
from softrig_core.guard import naming

from ..content.topics import BagTopic
from ..errors import BagError
from .mcap_file import McapFile
from .mcap_rows import write_recording
from .sqlite_file import Sqlite3File
from .yaml_text import qos_dicts, to_yaml

NEVER = 2**63 - 1


StorageFile = McapFile | Sqlite3File
STORAGES: Mapping[str, type[StorageFile]] = {"mcap": McapFile, "sqlite3": Sqlite3File}


class BagWriter:
    """Writes messages in the order given into a directory of one or more storage files.

    Parameters
    ----------
    directory : Path
        Is created; must not exist.
    storage : str
        ``mcap`` or ``sqlite3``.
    compression : str
        ``none`` or ``zstd`` (MCAP only).
    custom_data : mapping of str to str
        Kept in the metadata.
    name : str, optional
        Stem of the file names; default the directory's name.
    split_bytes, split_ns : int
        Begin a new file after so much data or bag time; 0 for never.
    reserve : int
        Bytes kept occupied on the disk until `close`, so that a bag can be closed properly on a full disk.

    Raises
    ------
    BagError
        Unknown storage or compression, or the directory exists.
    OSError
        The disk is full or broken. If the bag cannot be begun, nothing is left behind; later, `salvage` closes it
        without the messages that did not fit.
    """

    def __init__(
        self,
        directory: Path,
        *,
        storage: str = "mcap",
        compression: str = "none",
        custom_data: Mapping[str, str] | None = None,
        name: str = "",
        split_bytes: int = 0,
        split_ns: int = 0,
        reserve: int = 0,
    ) -> None:
        if storage not in STORAGES:
            raise BagError(f"storage {storage!r}: expected {' or '.join(STORAGES)}")
        if compression not in ("none", "zstd"):
            raise BagError(f"compression {compression!r}: expected none or zstd")
        if storage == "sqlite3" and compression != "none":
            raise BagError("compression is for mcap only: sqlite3 has none inside its file")
        try:
            directory.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f"{directory} exists already; a bag is never overwritten") from None
        self.directory = directory
        self._storage_id, self._compression = storage, compression
        self.custom_data = dict(custom_data or {})
        self._name = name or directory.name
        self._split_bytes, self._split_ns = split_bytes, split_ns
        self.topics: list[BagTopic] = []
        self._files: list[StorageFile] = []
        self._unwritten = 0
        self._reserve = directory / ".reserve"
        try:
            with naming(directory):
                if reserve:
                    self._reserve.write_bytes(bytes(reserve))
                self._open_file()
        except OSError:
            # The directory holds no message yet, and left behind it would keep a second attempt from using its name.
            shutil.rmtree(directory, ignore_errors=True)
            raise

    def _open_file(self) -> None:
        kind = STORAGES[self._storage_id]
        path = self.directory / f"{self._name}_{len(self._files)}{kind.SUFFIX}"
        try:
            file: StorageFile = kind(path, self._compression, to_yaml(self._metadata()))
            for number, topic in enumerate(self.topics, 1):
                file.add_topic(number, topic)
        except OSError:
            # This file holds nothing; without it the bag ends properly with the file before.
            path.unlink(missing_ok=True)
            raise
        self._file = file
        self._files.append(file)
        self._started: int | None = None
        self._head = 0
        self._open = True

    def add_topic(self, topic: BagTopic) -> int:
        """Declare a topic; return the number for `write`."""
        self.topics.append(topic)
        self._file.add_topic(len(self.topics), topic)
        return len(self.topics)

    def write(self, number: int, t: int, data: bytes) -> None:
        """Append one message at bag time `t` (ns, not negative)."""
        if self._split_bytes or self._split_ns:
            try:
                self._split(t)
            except OSError:
                # No file has this message, so `salvage` must count it as lost.
                self._unwritten += 1
                raise
        self._file.write(number, t, data)

    def write_recording(self, recording: Recording, numbers: Mapping[str, int]) -> None:
        """Append all messages of a recording by time, into the file that is open.

        Parameters
        ----------
        numbers : mapping of str to int
            Number of each topic, by its name in the recording.
        """
        if isinstance(self._file, McapFile):
            write_recording(self._file, recording, numbers)
            return
        for t, topic, data in recording.messages():
            self._file.write(numbers[topic.name], t, data)

    def _split(self, t: int) -> None:
        if self._started is not None:
            due = self._split_ns and t - self._started >= self._split_ns
            if due or (self._split_bytes and self._file.size - self._head >= self._split_bytes):
                self.next_file()
        # The size of a file counts from its first message, so that headers alone never split a bag.
        if self._started is None:
            self._started, self._head = t, self._file.size

    def next_file(self) -> None:
        """Close the file and continue in a new one."""
        self._close_file()
        self._open_file()

    def flush(self) -> None:
        """Flush everything written so far to the disk, safe against a crash."""
        self._file.flush()

    @property
    def count(self) -> int:
        """Number of messages flushed."""
        return sum(sum(f.counts.values()) for f in self._files)

    def close(self) -> None:
        """Flush, write index and metadata."""
        self._close_file()
        # The files are closed with their index, so the space is free for metadata.yaml.
        self._reserve.unlink(missing_ok=True)
        # A reader must never find half of the metadata, so they are moved into place whole.
        temporary = self.directory / "metadata.yaml.part"
        temporary.write_text(to_yaml({"rosbag2_bagfile_information": self._metadata()}))
        temporary.replace(self.directory / "metadata.yaml")

    def _close_file(self) -> None:
        # The file is closed already when there was no room to open the one after it.
        if not self._open:
            return
        self._file.flush()
        self._file.close(to_yaml(self._metadata()))
        self._open = False

    def salvage(self) -> int:
        """Close the bag after a failed write, without the data that could not be written.

        Returns
        -------
        int
            Number of messages lost.
        """
        # This frees the space that index and metadata need on a full disk.
        self._reserve.unlink(missing_ok=True)
        lost = self._file.discard() + self._unwritten
        self.close()
        return lost

    def abort(self) -> None:
        """Close the open file as it is, without index and metadata."""
        self._file.abort()

    def _metadata(self) -> dict[str, Any]:
        """Return the fields that rosbag2's parser of version 9 demands, in its order."""
        files = [
            {
                "path": f.path.name,
                "starting_time": {"nanoseconds_since_epoch": f.first if any(f.counts.values()) else NEVER},
                "duration": {"nanoseconds": f.last - f.first},
                "message_count": sum(f.counts.values()),
            }
            for f in self._files
        ]
        used = [f for f in self._files if any(f.counts.values())]
        first, last = min((f.first for f in used), default=NEVER), max((f.last for f in used), default=NEVER)
        return {
            "version": 9,
            "storage_identifier": self._storage_id,
            "duration": {"nanoseconds": last - first},
            "starting_time": {"nanoseconds_since_epoch": first},
            "message_count": self.count,
            "topics_with_message_count": [
                {
                    "topic_metadata": {
                        "name": topic.name,
                        "type": topic.msgtype,
                        "serialization_format": topic.wire,
                        "offered_qos_profiles": qos_dicts(topic.offered),
                        "type_description_hash": topic.digest,
                    },
                    "message_count": sum(f.counts.get(number, 0) for f in self._files),
                }
                for number, topic in enumerate(self.topics, 1)
            ],
            "compression_format": "",
            "compression_mode": "",
            "relative_file_paths": [f.path.name for f in self._files],
            "files": files,
            "custom_data": self.custom_data or None,
            "ros_distro": "jazzy",
        }
