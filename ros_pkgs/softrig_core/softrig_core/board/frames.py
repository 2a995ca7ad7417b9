"""Frames of the link to a board: COBS(number, kind, values, CRC) and a zero; `softrig_link.h` is the board's side."""

from __future__ import annotations

import struct
from binascii import crc_hqx
from enum import IntEnum
from typing import NamedTuple

HEAD = struct.Struct("<HB")
CRC = struct.Struct("<H")
LONGEST = 1 << 16  # bytes between two zeros: more is no frame


class Kind(IntEnum):
    """The kind of a frame."""

    HELLO = 1
    RESET = 2
    PARAMS = 3
    STEP = 4
    ANSWER = 5


class Frame(NamedTuple):
    """A frame without its checksum."""

    number: int
    kind: int
    values: bytes


def encoded(body: bytes) -> bytes:
    """Return bytes as COBS, which has no zero in it."""
    result = bytearray()
    for part in body.split(b"\0"):
        while len(part) >= 254:
            result += b"\xff" + part[:254]
            part = part[254:]
        result.append(len(part) + 1)
        result += part
    if body and not part and body[-1]:
        del result[-1]  # a full block at the end needs no further one
    return bytes(result)


def decoded(data: bytes) -> bytes | None:
    """Return the bytes decoded from COBS; None if it is truncated."""
    result, position, end = bytearray(), 0, len(data)
    while position < end:
        code = data[position]
        if code == 0 or position + code > end:
            return None
        result += data[position + 1 : position + code]
        position += code
        if code != 0xFF and position < end:
            result.append(0)
    return bytes(result)


def written(number: int, kind: int, values: bytes, session: int) -> bytes:
    """Return a frame as it is sent over the wire, after a zero that ends a frame started by noise.

    Parameters
    ----------
    session : int
        Initial value of the checksum; 0 in a hello.
    """
    body = HEAD.pack(number, kind) + values
    return b"\0" + encoded(body + CRC.pack(crc_hqx(CRC.pack(session) + body, 0))) + b"\0"


def read(data: bytes, session: int) -> Frame | None:
    """Return the frame in bytes between two zeros; None where it is damaged or of another session."""
    body = decoded(data)
    if body is None or len(body) < HEAD.size + CRC.size:
        return None
    inner = body[: -CRC.size]
    number, kind = HEAD.unpack_from(inner)
    owner = 0 if kind == Kind.HELLO else session
    if crc_hqx(CRC.pack(owner) + inner, 0) != CRC.unpack(body[-CRC.size :])[0]:
        return None
    return Frame(number, kind, inner[HEAD.size :])


class Splitter:
    """Cuts a stream of bytes at its zeros."""

    def __init__(self) -> None:
        self._partial = b""

    def split_frames(self, data: bytes) -> list[bytes]:
        """Return the complete pieces between two zeros; empty ones are left out."""
        *complete, self._partial = (self._partial + data).split(b"\0")
        self._partial = self._partial[-LONGEST:]
        return [piece for piece in complete if piece]
