"""The parts of CDR, one after the other: numbers aligned to their size, texts, lengths."""

from __future__ import annotations

import struct
from typing import Any


class CdrError(ValueError):
    """Bytes are not a well-formed message of the expected type."""


class Writer:
    """Writes the parts of a message one after the other, little endian.

    Attributes
    ----------
    data : bytearray
        The message so far, the four bytes of the encapsulation included; alignment counts after these.
    written : list of (int, int)
        Start and end of the written parts, without padding and reserved space.
    """

    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")
        self.written: list[tuple[int, int]] = []

    def room(self, code: str, n: int) -> int:
        """Reserve space for `n` values of a struct's code; return where it begins."""
        size = struct.calcsize(code)
        if n:
            self.data += bytes(-(len(self.data) - 4) % size)
        offset = len(self.data)
        self.data += bytes(n * size)
        return offset

    def add(self, code: str, *values: Any) -> None:
        """Write values of a struct's code."""
        pad = -(len(self.data) - 4) % struct.calcsize(code) if values else 0
        offset = len(self.data) + pad
        self.data += struct.pack(f"<{pad}x{len(values)}{code}", *values)
        self.written.append((offset, len(self.data)))

    def text(self, text: str, room: int = 0) -> int:
        """Write a string with space for more characters at its end; return the position of that space."""
        raw = text.encode()
        self.add("I", len(raw) + room + 1)
        offset = len(self.data) + len(raw)
        self.written += [(offset - len(raw), offset), (offset + room, offset + room + 1)]
        self.data += raw + bytes(room + 1)
        return offset


class Reader:
    """Reads the parts of a message one after the other, in either byte order.

    Parameters
    ----------
    msgtype : str
        Named in errors.
    data : bytes
        The four bytes of the encapsulation included.
    """

    def __init__(self, msgtype: str, data: bytes) -> None:
        self._type, self._data, self._at = msgtype, data, 4
        # The second byte of the encapsulation holds the byte order, which is that of the writer.
        self._order = ">" if len(data) > 1 and data[1] == 0 else "<"

    def read(self, code: str, n: int = 1) -> tuple[Any, ...]:
        """Read `n` values of a struct's code.

        Raises
        ------
        CdrError
            The bytes end before.
        """
        if not n:
            return ()
        size = struct.calcsize(code)
        offset = self._at + -(self._at - 4) % size
        if offset + n * size > len(self._data):
            raise CdrError(f"{self._type}: {len(self._data)} bytes end inside a field at byte {offset}")
        self._at = offset + n * size
        return struct.unpack_from(f"{self._order}{n}{code}", self._data, offset)

    def one(self, code: str) -> Any:
        """Read one value of a struct's code."""
        return self.read(code)[0]

    def count(self, items: str, size: int) -> int:
        """Read the number of following items, of at least so many bytes each.

        Raises
        ------
        CdrError
            More than fit.
        """
        n: int = self.one("I")
        # A damaged count could ask for gigabytes; no message has more items than bytes.
        if n * size > len(self._data):
            raise CdrError(f"{self._type}: claims {n} {items} in {len(self._data)} bytes")
        return n

    def text(self) -> str:
        """Read a string.

        Raises
        ------
        CdrError
            It does not fit.
        """
        n: int = self.one("I")
        if n == 0 or self._at + n > len(self._data):
            raise CdrError(f"{self._type}: a string of {n} bytes at byte {self._at} does not fit in {len(self._data)}")
        self._at += n
        return bytes(self._data[self._at - n : self._at - 1]).decode(errors="replace")
