"""MCAP files after a crash: record by record, and the complete messages inside a truncated chunk."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.records import McapRecord
from mcap.stream_reader import StreamReader

from .compressed import LIMIT, inflate

_MAGIC = b"\x89MCAP0\r\n"
_HEAD = struct.Struct("<BQ")  # head of a record: opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last time, size and checksum of the content, length of the compression
_CHUNK_CODE = 0x06


def whole_records(content: bytes) -> tuple[list[McapRecord], int]:
    """Return the records in a chunk's content up to the first incomplete one, and the number of their bytes."""
    file, good = BytesIO(content), 0
    records: list[McapRecord] = []
    # A chunk has no footer, so its end raises; the other errors are due to damage that no checksum covers. The limit is
    # needed because a damaged record may claim any length.
    with suppress(McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError):
        for record in StreamReader(file, skip_magic=True, record_size_limit=len(content)).records:
            records.append(record)
            good = file.tell()
    return records, good


class Recovery:
    """Whole records of an MCAP file, those inside chunks included.

    Attributes
    ----------
    lost : list of str
        What could not be read, in words.
    compression : str
        Of the chunks: ``none`` or ``zstd``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._size = path.stat().st_size
        self.lost: list[str] = []
        self.compression = "none"

    def __iter__(self) -> Iterator[McapRecord]:
        damaged = cut = 0
        good = len(_MAGIC)
        with self._path.open("rb") as file:
            file.seek(good)
            while len(head := file.read(_HEAD.size)) == _HEAD.size:
                code, length = _HEAD.unpack(head)
                present = min(length, self._size - file.tell())
                if code == _CHUNK_CODE:
                    records, complete = self._chunk(file, present)
                    yield from records
                    if present < length:
                        cut += 1
                        break
                    damaged += not complete
                elif present < length:
                    break
                else:
                    records, used = whole_records(head + file.read(length))
                    if used != _HEAD.size + length:
                        break
                    yield from records
                good = file.tell()
                # This is the footer, and what follows it is no record.
                if code == 0x02:
                    break
        if damaged:
            self.lost.append(f"{damaged} damaged chunks")
        if cut:
            self.lost.append("the end of a chunk that was cut")
        # After a whole footer only the closing magic bytes follow, and they are no loss.
        elif self._size - good > len(_MAGIC):
            self.lost.append(f"the last {self._size - good} bytes")

    def _chunk(self, file: BinaryIO, present: int) -> tuple[list[McapRecord], bool]:
        """Read a truncated chunk of which this many bytes are present. If it has a checksum, all of it or
        nothing is read.
        """
        body = file.read(present)
        head = _chunk_head(body)
        if head is None:
            return [], False
        size, checksum, compression, start, length = head
        self.compression = "zstd" if compression == "zstd" else self.compression
        data = body[start : start + length]
        content, complete = inflate(data, compression, min(size, LIMIT))
        # The checksum is of the whole content, which is cut; records that are whole were written whole.
        if len(data) < length:
            return whole_records(content)[0], False
        if not complete or len(content) != size or (checksum and zlib.crc32(content) != checksum):
            return [], False
        records, used = whole_records(content)
        return records, used == len(content)


def _chunk_head(body: bytes) -> tuple[int, int, str, int, int] | None:
    """Return (size uncompressed, checksum, compression, start and length of the data); None when it is cut."""
    if len(body) < _CHUNK.size:
        return None
    _, _, size, checksum, letters = _CHUNK.unpack_from(body)
    start = _CHUNK.size + letters + 8
    # Names of compressions are short; a longer one is due to damage.
    if letters > 16 or len(body) < start:
        return None
    compression = body[_CHUNK.size : start - 8].decode(errors="replace")
    return size, checksum, compression, start, int.from_bytes(body[start - 8 : start], "little")
