"""Compression by rosbag2 on top of a storage format: whole files (mode file), single messages (mode message)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
from softrig_core.extras import need

from ..content.block import Block, numbers_at, packed
from .source import Damaged

# The first bytes of a zstd frame. No CDR message begins with them, so compressed messages need no other mark.
_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 1 << 20
_SMALL_PIECE = 1 << 16
# Bytes of a chunk uncompressed: rosbag2's default is 768 KiB, but a larger message has a chunk of its own.
LIMIT = 1 << 31
SUFFIXES = (".mcap", ".db3")


@cache
def zstd() -> Any:
    """Return the module of Python 3.14 for zstd, or its backport."""
    if sys.version_info >= (3, 14):
        from compression import zstd as module
    else:
        need("backports.zstd", "a bag that is compressed by zstd")
        from backports import zstd as module
    return module


def plain(path: Path) -> Path:
    """Return the name of a storage file without the suffix of its compression."""
    return path.with_suffix("") if path.suffix == ".zstd" else path


@contextmanager
def expanded(path: Path, scratch: Path) -> Iterator[tuple[Path, list[str]]]:
    """Yield a storage file that is not compressed, and a description of the parts that could not be decompressed.

    Parameters
    ----------
    path : Path
        The file itself if it is not compressed as a whole; otherwise a copy, which exists as long as the context.
    scratch : Path
        Folder for the copy.
    """
    if path.suffix != ".zstd":
        yield path, []
        return
    with TemporaryDirectory(dir=scratch, prefix=".expand-") as directory:
        copy = Path(directory) / plain(path).name
        with path.open("rb") as source, copy.open("wb") as target:
            complete = _expand(source, target)
        lost = f"what follows byte {copy.stat().st_size} of {copy.name}, the compressed file ends there"
        yield copy, [] if complete else [lost]


class Expanded:
    """An uncompressed copy of a file that is compressed as a whole; `close` deletes the copy.

    Raises
    ------
    Damaged
        The compressed file is cut or damaged.
    """

    def __init__(self, file: Path) -> None:
        self._folder = TemporaryDirectory(prefix="softrig-bag-")
        self.path = Path(self._folder.name) / plain(file).name
        with file.open("rb") as source, self.path.open("wb") as target:
            complete = _expand(source, target)
        if not complete:
            self.close()
            raise Damaged(f"{file.name} cannot be decompressed to its end")

    def close(self) -> None:
        """Delete the copy."""
        self._folder.cleanup()


def _expand(source: BinaryIO, target: BinaryIO) -> bool:
    """Decompress a file of one or several frames, in pieces; return whether it ends with the end of a frame."""
    stream = zstd().ZstdDecompressor()
    # Damage ends the output here, so that everything before it is kept.
    with suppress(zstd().ZstdError):
        while True:
            piece = b""
            if stream.eof:
                piece, stream = stream.unused_data or source.read(_PIECE), zstd().ZstdDecompressor()
                if not piece:
                    return True
            elif stream.needs_input and not (piece := source.read(_PIECE)):
                break
            target.write(stream.decompress(piece, max_length=_PIECE))
    return False


def inflate(data: bytes, compression: str, limit: int = LIMIT) -> tuple[bytes, bool]:
    """Decompress as much as possible.

    Parameters
    ----------
    data : bytes
        Content of a chunk, perhaps cut.
    compression : str
        As MCAP names it: empty, ``zstd`` or ``lz4``.
    limit : int
        Longest result.

    Returns
    -------
    (bytes, bool)
        The content up to the first damage or the limit, and whether this is all of it.
    """
    if not compression:
        return data[:limit], len(data) <= limit
    if compression not in ("zstd", "lz4"):
        return b"", False
    wrong: type[Exception] = RuntimeError  # the error that lz4 raises for damaged data
    if compression == "zstd":
        stream: Any = zstd().ZstdDecompressor()
        wrong = zstd().ZstdError
    else:
        need("lz4", "a bag that is compressed by lz4")
        from lz4.frame import LZ4FrameDecompressor

        stream = LZ4FrameDecompressor()
    result = bytearray()
    with suppress(wrong, EOFError):
        # A decompressor returns nothing for a call that fails; small pieces keep what comes before the damage.
        for start in range(0, len(data), _SMALL_PIECE):
            piece = data[start : start + _SMALL_PIECE]
            while piece and len(result) <= limit:
                # Several frames may follow each other.
                if stream.eof:
                    stream = type(stream)()
                result += stream.decompress(piece, max_length=limit + 1 - len(result))
                piece = stream.unused_data if stream.eof else b""
    return bytes(result[:limit]), stream.eof and len(result) <= limit


def expanded_message(data: bytes) -> bytes | None:
    """Return the bytes of a message, decompressed if it is compressed; None if it is damaged."""
    if data[:4] != _MAGIC:
        return data
    message, complete = inflate(data, "zstd")
    return message if complete else None


def decompressed(data: bytes | memoryview, compression: str, size: int) -> bytes | memoryview:
    """Return the content of a chunk.

    Parameters
    ----------
    data : bytes
        As stored.
    compression : str
        As MCAP names it: empty, ``zstd`` or ``lz4``.
    size : int
        Bytes of the content, as the chunk claims.

    Raises
    ------
    Damaged
        The claim is wrong, too large to be believed, or the data cannot be decompressed.
    """
    # The size in the frame is checked before anything is decompressed: a damaged chunk may claim terabytes.
    stated = None
    if compression == "zstd":
        with suppress(zstd().ZstdError):
            stated = zstd().get_frame_info(data).decompressed_size
    if size > LIMIT or (stated or 0) > size:
        raise Damaged(
            f"a chunk of {len(data)} bytes claims {size} uncompressed, expected the actual size and at most {LIMIT}"
        )
    if compression not in ("", "zstd", "lz4"):
        raise Damaged(f"a chunk is compressed by {compression!r}, expected zstd or lz4")
    content, complete = data, True
    if stated == size:
        try:
            content = zstd().decompress(data)
        except zstd().ZstdError as error:
            raise Damaged(f"a chunk cannot be decompressed: {error}") from None
    elif compression:
        content, complete = inflate(bytes(data), compression, size)
    if not complete or len(content) != size:
        raise Damaged(f"a chunk of {len(data)} bytes does not have the {size} uncompressed that it claims")
    return content


def plain_messages(block: Block) -> Block:
    """Return messages uncompressed: those of mode message are expanded, regardless of the metadata.

    Raises
    ------
    Damaged
        One of them cannot be expanded.
    """
    long = np.flatnonzero(block.size >= 4)
    starts = block.at if len(long) == len(block) else block.at[long]
    packed_rows = long[numbers_at(block.raw, starts, "<u4") == int.from_bytes(_MAGIC, "little")]
    if not len(packed_rows):
        return block
    view = memoryview(block.raw)
    data = [bytes(view[a : a + n]) for a, n in zip(block.at.tolist(), block.size.tolist(), strict=True)]
    for i in packed_rows.tolist():
        message = expanded_message(data[i])
        if message is None:
            raise Damaged(f"the compressed message at {int(block.t[i])} ns cannot be decompressed")
        data[i] = message
    return packed(data, block)
