"""MCAP storage of a bag file: chunks with checksum and index, closed by size or on demand.

No library writes the file, for three reasons: a recorder must be able to close a chunk at any time, which limits what a
crash may cost; equal runs must produce equal bytes with any version of a library; and speed. In the tests two
independent libraries read the file back. Format: https://mcap.dev/spec, profile ros2.
"""

from __future__ import annotations

import sys
import zlib
from array import array
from collections.abc import Callable, Mapping
from io import FileIO
from pathlib import Path
from struct import Struct, pack

import numpy as np
from numpy.typing import NDArray

from ..content.topics import BagTopic
from .compressed import zstd
from .mcap_format import (
    CHANNEL,
    CHUNK,
    CHUNK_INDEX,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    SUMMARY_OFFSET,
)
from .yaml_text import qos_dicts, to_yaml

_MESSAGE_HEAD = Struct("<BQHIQQ")


class McapFile:
    """One MCAP file that grows chunk by chunk; whole chunks survive a crash.

    Parameters
    ----------
    path : Path
        Must not exist.
    compression : str
        ``none`` or ``zstd`` (each chunk by itself).
    metadata : str
        The bag's metadata as far as known at the start, YAML.

    Raises
    ------
    OSError
        From any method that writes; the file then ends with its last whole chunk, and `discard` and `close` still work
        when there is room for the index.
    """

    SUFFIX = ".mcap"
    # A crash loses at most the open chunk, so it is small.
    CHUNK_BYTES = 1 << 19

    def __init__(self, path: Path, compression: str, metadata: str) -> None:
        self.path = path
        self.compression = "" if compression == "none" else compression
        self._compress = _compressor(self.compression)
        self._file = FileIO(path, "xb")
        self._end = 0
        self._write(MAGIC + _record(HEADER, _text("ros2") + _text("softrig")))
        self._metadata_index: list[bytes] = []
        self._write(self._metadata_record(metadata))
        self._schemas: dict[tuple[str, str, str], bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._chunk_index: list[bytes] = []
        self.counts: dict[int, int] = {}
        self.first, self.last = 0, 0
        self._start_chunk()

    def _start_chunk(self) -> None:
        self._parts: list[bytes | NDArray[np.uint8]] = []
        self._size = 0
        self._index: dict[int, array[int]] = {}  # time and place of each message of a topic, in order

    @property
    def size(self) -> int:
        """Bytes in the file and in the open chunk."""
        return self._end + self._size

    def add_topic(self, number: int, topic: BagTopic) -> None:
        """Declare a topic under a number of 1 to 65535."""
        described = topic.msgtype, topic.encoding if topic.definition else "", topic.definition
        if described not in self._schemas:
            record = pack("<H", len(self._schemas) + 1) + b"".join(map(_text, described))
            self._schemas[described] = _record(SCHEMA, record)
            self._put(self._schemas[described])
        schema = list(self._schemas).index(described) + 1
        details = {"offered_qos_profiles": to_yaml(qos_dicts(topic.offered)), "topic_type_hash": topic.digest}
        self._channels[number] = _record(
            CHANNEL, pack("<HH", number, schema) + _text(topic.name) + _text(topic.wire) + _map(details)
        )
        self._put(self._channels[number])
        self.counts[number] = 0

    def _put(self, record: bytes | NDArray[np.uint8]) -> None:
        self._parts.append(record)
        self._size += len(record)

    def write(self, number: int, t: int, data: bytes) -> None:
        """Append one message with its bag time in ns."""
        parts = self._parts
        size = len(data)
        parts.append(_MESSAGE_HEAD.pack(MESSAGE, size + 22, number, 0, t, t))
        parts.append(data)
        try:
            index = self._index[number]
        except KeyError:
            index = self._index[number] = array("Q")
        index.append(t)
        index.append(self._size)
        self._size += size + 31
        # The chunk is closed after the message that fills it, so that a message is never split.
        if self._size >= self.CHUNK_BYTES:
            self.flush()

    @property
    def waiting(self) -> int:
        """Bytes in the open chunk."""
        return self._size

    def write_block(
        self, content: NDArray[np.uint8], index: Mapping[int, tuple[NDArray[np.int64], NDArray[np.int64]]]
    ) -> None:
        """Append records of messages that belong into the open chunk.

        Parameters
        ----------
        content : array of bytes
            The records, which are not copied; the last one may reach beyond `CHUNK_BYTES`.
        index : mapping of int to two int arrays of shape (n,)
            By topic, in the order of their first messages: bag times in ns, and where in the content they begin.
        """
        for number, (times, offsets) in index.items():
            rows = np.stack([times, offsets + self._size], axis=1).astype(np.uint64)
            self._index.setdefault(number, array("Q")).frombytes(rows.tobytes())
        self._put(content)
        if self._size >= self.CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Close the open chunk and hand it to the operating system."""
        if not self._index:
            return
        content = b"".join(self._parts)
        compressed = self._compress(content)
        times = np.frombuffer(b"".join(self._index.values()), np.uint64)[::2]
        first, last = int(np.min(times)), int(np.max(times))
        head = pack("<QQQI", first, last, len(content), zlib.crc32(content)) + _text(self.compression)
        head += pack("<Q", len(compressed))
        head = pack("<BQ", CHUNK, len(head) + len(compressed)) + head
        length = len(head) + len(compressed)
        records, offsets, start = list[bytes](), {}, self._end
        end = start + length
        for number, entries in self._index.items():
            offsets[number] = end
            records.append(_record(MESSAGE_INDEX, pack("<HI", number, 8 * len(entries)) + _little(entries)))
            end += len(records[-1])
        self._write(head, compressed, *records)
        record = pack("<QQQQI", first, last, start, length, 10 * len(offsets))
        record += b"".join(pack("<HQ", *o) for o in offsets.items())
        record += (
            pack("<Q", end - start - length) + _text(self.compression) + pack("<QQ", len(compressed), len(content))
        )
        self._chunk_index.append(_record(CHUNK_INDEX, record))
        written = sum(self.counts.values())
        # The zero of an empty file is no time of a message.
        self.first, self.last = min(self.first, first) if written else first, max(self.last, last)
        for number, entries in self._index.items():
            self.counts[number] += len(entries) // 2
        self._start_chunk()

    def _write(self, *parts: bytes) -> None:
        """Write all of them, or leave the file as it was and raise."""
        try:
            for part in parts:
                view = memoryview(part)
                while view:
                    view = view[self._file.write(view) or 0 :]
        except OSError:
            # A record cut in half would hide everything behind it from readers, so the file ends where it was whole.
            self._file.seek(self._end)
            self._file.truncate()
            raise
        self._end += sum(map(len, parts))

    def _metadata_record(self, text: str) -> bytes:
        """Return the next record to write, and add it to the index."""
        record = _record(METADATA, _text("rosbag2") + _map({"serialized_metadata": text}))
        self._metadata_index.append(_record(METADATA_INDEX, pack("<QQ", self._end, len(record)) + _text("rosbag2")))
        return record

    def discard(self) -> int:
        """Drop the open chunk (after a failed write); return the number of messages in it."""
        lost = sum(len(entries) // 2 for entries in self._index.values())
        self._start_chunk()
        return lost

    def close(self, metadata: str) -> None:
        """Write the open chunk, the metadata of the bag and the index."""
        self.flush()
        # An earlier close that found no room has noted its metadata already; only the first record was written.
        del self._metadata_index[1:]
        # A checksum of 0 means that the data section has none; every chunk has its own.
        data_end = self._metadata_record(metadata) + _record(DATA_END, pack("<I", 0))
        counts = {n: c for n, c in sorted(self.counts.items()) if c}
        statistics = pack(
            "<QHIIII",
            sum(counts.values()),
            len(self._schemas),
            len(self._channels),
            0,
            len(self._metadata_index),
            len(self._chunk_index),
        )
        statistics += pack("<QQI", self.first, self.last, 10 * len(counts))
        statistics += b"".join(pack("<HQ", *c) for c in counts.items())
        groups = {
            SCHEMA: list(self._schemas.values()),
            CHANNEL: list(self._channels.values()),
            STATISTICS: [_record(STATISTICS, statistics)],
            CHUNK_INDEX: self._chunk_index,
            METADATA_INDEX: self._metadata_index,
        }
        start = self._end + len(data_end)
        summary, offsets = b"", b""
        for code, records in groups.items():
            group = b"".join(records)
            if group:
                offsets += _record(SUMMARY_OFFSET, pack("<BQQ", code, start + len(summary), len(group)))
            summary += group
        footer = pack("<BQQQ", FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(footer, zlib.crc32(summary + offsets))
        self._write(data_end + summary + offsets + footer + pack("<I", crc) + MAGIC)
        self._file.close()

    def abort(self) -> None:
        """Close the file as it is, without index."""
        self._file.close()


def _compressor(name: str) -> Callable[[bytes], bytes]:
    if not name:
        return bytes
    compress: Callable[[bytes], bytes] = zstd().compress
    return compress


def _little(entries: array[int]) -> bytes:
    if sys.byteorder == "big":
        entries = entries[:]
        entries.byteswap()
    return entries.tobytes()


def _record(code: int, content: bytes) -> bytes:
    return pack("<BQ", code, len(content)) + content


def _text(text: str) -> bytes:
    data = text.encode()
    return pack("<I", len(data)) + data


def _map(items: Mapping[str, str]) -> bytes:
    content = b"".join(_text(k) + _text(v) for k, v in items.items())
    return pack("<I", len(content)) + content
