"""What rosbag2 compresses on top of a storage format: whole files (mode file), single messages (mode message)."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from .mcap_recover import inflate

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdDecompressor, ZstdError
else:
    from backports.zstd import ZstdDecompressor, ZstdError

_MAGIC = b"\x28\xb5\x2f\xfd"  # no CDR message begins so
_PIECE = 1 << 20
SUFFIXES = (".mcap", ".db3")


def plain(path: Path) -> Path:
    """Give the name of a storage file without the suffix of its compression."""
    return path.with_suffix("") if path.suffix == ".zstd" else path


@contextmanager
def expanded(path: Path, scratch: Path) -> Iterator[tuple[Path, list[str]]]:
    """Give a storage file that is not compressed, and in words what of it could not be expanded.

    Parameters
    ----------
    path : Path
        As it is when it is not compressed whole; else a copy is made for as long as the context lasts.
    scratch : Path
        Folder for the copy.
    """
    if path.suffix != ".zstd":
        yield path, []
        return
    with TemporaryDirectory(dir=scratch, prefix=".expand-") as directory:
        copy = Path(directory) / plain(path).name
        stream = ZstdDecompressor()
        with path.open("rb") as source, copy.open("wb") as target, suppress(ZstdError):
            while not stream.eof:  # in pieces, so that what comes before the damage is not lost
                piece = source.read(_PIECE) if stream.needs_input else b""
                if stream.needs_input and not piece:
                    break
                target.write(stream.decompress(piece, max_length=_PIECE))
        yield (
            copy,
            []
            if stream.eof
            else [f"what follows byte {copy.stat().st_size} of {copy.name}, the compressed file ends there"],
        )


def expanded_message(data: bytes) -> bytes | None:
    """Give the bytes of a message, of one that is compressed what it stands for; None when it is damaged."""
    if data[:4] != _MAGIC:
        return data
    whole, complete = inflate(data, "zstd")
    return whole if complete else None
