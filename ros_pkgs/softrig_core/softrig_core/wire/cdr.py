"""CDR bytes of softrig's messages: prepared layouts for speed, a general reader for all others.

A `Layout` is a message whose variable-size parts (frame, names, sequence lengths) are fixed; only the stamp and the
float64 numbers change. One prepared struct packs or unpacks the whole message, fixed bytes included, and decoding
compares the fixed bytes. A message of another layout is read by `parse`.

A Float64MultiArray has no stamp. Ours contain instead their number on their topic, from 0, at the end of the label of
the first dimension: ``row; sequence 000000000017``. Number, sizes and strides of the dimensions remain those of the
data, so a reader that reshapes by them, or uses ``dim[0].size``, is not affected. Only the twelve digits change.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import count, islice
from operator import itemgetter
from types import CodeType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..timebase import SECOND
from .stream import CdrError, Reader, Writer
from .types import TYPES, Dims

Picker = Callable[[tuple[Any, ...]], tuple[Any, ...]]  # takes some items

NUMBER = "; sequence "  # between the label of an array's first dimension and the number of the message
DIGITS = 12
_NUMBERS = 10**DIGITS
# Other publishers need not pad their numbers with zeros; 18 digits still fit into 64 bits.
_NUMBERED = re.compile(rf"(.*){NUMBER}([0-9]{{1,18}})", re.DOTALL)


@dataclass(frozen=True)
class Message:
    """A parsed message: stamp in ns (None without header), frame, channel names, numbers by field, array shape.

    For an array also its number on its topic, None if it contains none.
    """

    stamp: int | None
    frame_id: str
    names: tuple[str, ...]
    fields: dict[str, tuple[float, ...]]
    dims: Dims | None = None
    number: int | None = None

    @property
    def mark(self) -> int:
        """Return the stamp in ns, or for an array its number; -1 if there is neither."""
        mark = self.number if self.stamp is None else self.stamp
        return -1 if mark is None else mark

    def layout(self, msgtype: str) -> Layout:
        """Return the layout that messages of this form have."""
        counts = {name: len(values) for name, values in self.fields.items()}
        return Layout(msgtype, self.frame_id, self.names, counts, self.dims or (), self.number is not None)


class Layout:
    """Bytes of one message type with fixed frame, names and field lengths.

    Parameters
    ----------
    msgtype : str
        One of `softrig_core.wire.types.TYPES`.
    names : sequence of str
        Channel names.
    counts : mapping of str to int
        Length of each ``seq`` field; a field that is absent is empty.
    dims : Dims
        Shape of a Float64MultiArray.
    numbered : bool
        Whether an array contains its number on its topic.

    Attributes
    ----------
    encode : callable
        Gets the stamp in ns and all numbers in wire order, field by field; returns the bytes of the message. For a
        numbered array the first argument is its number on its topic, from 0. It is ignored if a message has neither.
    decode : callable
        Gets bytes; returns (stamp in ns, numbers), or None if they have another layout; for the stamp see
        `Message.mark`.
    """

    encode: Callable[[int, Sequence[float]], bytes]
    decode: Callable[[bytes], tuple[int, tuple[float, ...]] | None]

    def __init__(
        self,
        msgtype: str,
        frame_id: str = "",
        names: Sequence[str] = (),
        counts: Mapping[str, int] | None = None,
        dims: Dims = (),
        numbered: bool = False,
    ) -> None:
        counts = counts or {}
        # what makes an equal layout
        self.form = (msgtype, frame_id, tuple(names), dict(counts), tuple(dims), numbered)
        self.numbered = numbered
        writer = Writer()
        slots: list[tuple[int, str]] = []
        self.stamp_offset: int | None = None
        number_offset = -1
        self.fields: list[tuple[str, int]] = []

        def numbers(name: str, n: int, code: str = "d") -> None:
            self.fields.append((name, n))
            if n:
                slots.append((writer.room(code, n), f"{n}{code}"))

        for kind, name, size in TYPES[msgtype].schema:
            if kind == "stamp":
                self.stamp_offset = writer.room("I", 2)
            elif kind == "frame":
                writer.text(frame_id)
            elif kind == "names":
                writer.add("I", len(names))
                for text in names:
                    writer.text(text)
            elif kind == "one":
                writer.add("I", 1)
            elif kind == "sequence":
                writer.add("I", counts.get(name, 0))
                numbers(name, counts.get(name, 0))
            elif kind == "numbers":
                numbers(name, size)
            elif kind == "dims":
                writer.add("I", len(dims))
                for i, (label, extent) in enumerate(dims):
                    if numbered and i == 0:
                        number_offset = writer.text(label + NUMBER, DIGITS)
                    else:
                        writer.text(label)
                    writer.add("I", extent, math.prod(size for _, size in dims[i:]))  # with the stride
                writer.add("I", 0)  # the offset of the data
            elif kind == "flag":
                numbers(name, 1, "?")
            elif kind == "duration":
                writer.room("I", 2)

        self.msgtype = msgtype
        self.length = len(writer.data)
        self.size = sum(n for _, n in self.fields)
        self.slots = slots
        # Of the encapsulation only the first two bytes are compared, which have the byte order; the rest are options.
        self._fixed = [(a, b, bytes(writer.data[a:b])) for a, b in [(0, 2), *_merge(writer.written)]]
        # One struct for the whole message. Its items in wire order are those of (s, ns, *values, *constants);
        # of an array the first one is the text of its number.
        spans = [(a, f"{b - a}s") for a, b, _ in self._fixed]
        stamp = [] if self.stamp_offset is None else [(self.stamp_offset, "iI")]
        if numbered:
            stamp = [(number_offset, f"{DIGITS}s")]
        self._number_offset = number_offset
        form, position, wire = "<", 0, []
        values, constants = count(2), count(2 + self.size)
        for offset, code in sorted(spans + stamp + slots):
            form += f"{offset - position}x{code}"
            position = offset + struct.calcsize("<" + code)
            if offset == number_offset:
                wire.append(0)
            elif code[-1] == "s":
                wire.append(next(constants))
            else:
                wire += [0, 1] if code == "iI" else islice(values, int(code[:-1]))
        message = struct.Struct(f"{form}{self.length - position}x")
        self.encode, self.decode = _coders(message, wire, self.size, [data for _, _, data in self._fixed], numbered)

    def __reduce__(self) -> tuple[type[Layout], tuple[Any, ...]]:
        """Pickle the data from which it was made, because its functions are generated."""
        return Layout, self.form

    def encode_block(
        self, stamps: NDArray[np.int64], values: NDArray[np.float64], rows: NDArray[np.uint8] | None = None
    ) -> NDArray[np.uint8]:
        """Return the bytes of n messages as an array of shape (n, length); each row is a result of `encode`.

        Parameters
        ----------
        stamps : array of shape (n,)
            ns, or the numbers of arrays.
        values : array of shape (n, size)
        rows : array of shape (n, length), optional
            Where they are written, in place of a new array.
        """
        if rows is None:
            rows = np.empty((len(stamps), self.length), np.uint8)
        rows[:] = np.frombuffer(self.encode(0, (0.0,) * self.size), dtype=np.uint8)
        if self.stamp_offset is not None:
            parts = rows[:, self.stamp_offset : self.stamp_offset + 8].view("<u4")
            parts[:, 0], parts[:, 1] = np.divmod(stamps, SECOND)
        if self.numbered:
            start = self._number_offset
            text = b"".join(map(_digits, stamps.tolist()))
            rows[:, start : start + DIGITS] = np.frombuffer(text, dtype=np.uint8).reshape(-1, DIGITS)
        first = 0
        for offset, code in self.slots:
            n = int(code[:-1])
            block = np.ascontiguousarray(values[:, first : first + n])
            raw = block.astype("<f8", copy=False).view(np.uint8) if code[-1] == "d" else (block != 0.0).astype(np.uint8)
            rows[:, offset : offset + raw.shape[1]] = raw
            first += n
        return rows

    def same_shape(self, block: NDArray[np.uint8]) -> bool:
        """Return whether all messages of a (n, length) byte array have this layout."""
        rows = [(block[:, a:b], expected) for a, b, expected in self._fixed]
        return all(bool((part == np.frombuffer(expected, dtype=np.uint8)).all()) for part, expected in rows)

    def columns(self, block: NDArray[np.uint8]) -> list[NDArray[np.float64]]:
        """Return the numbers of a (n, length) byte array of such messages as arrays of shape (n,)."""
        result = []
        for offset, code in self.slots:
            n, kind = int(code[:-1]), np.dtype("<f8" if code[-1] == "d" else "u1")
            part = np.ascontiguousarray(block[:, offset : offset + n * kind.itemsize]).view(kind)
            result += [np.ascontiguousarray(part[:, i], dtype=np.float64) for i in range(n)]
        return result


CODERS = """
def encode(stamp, values):
    if len(values) != {size}:
        raise ValueError(f"{{len(values)}} values, expected {size}")
    return pack({items})

def decode(data):
    if len(data) != {length}:
        return None
    found = unpack(data)
    if {differs}:
        return None
    return {mark}, {values}
"""
# Up to so many values the generated code names each one; beyond it, slices keep the code short.
SINGLY = 32


def _coders(
    message: struct.Struct, wire: Sequence[int], size: int, constants: Sequence[bytes], numbered: bool
) -> tuple[Any, Any]:
    """Create the functions that write and read messages of a layout: their text names each item of its struct.

    Parameters
    ----------
    wire : sequence of int
        The items: 0 and 1 the stamp in s and ns, or 0 the digits of a number; then `size` values, then the constants.
    """
    known: dict[str, Any] = {f"constant{k}": data for k, data in enumerate(constants)}
    index_of = {item: k for k, item in enumerate(wire)}
    indices = [index_of[2 + k] for k in range(size)]
    written = {0: "stamp // SECOND", 1: "stamp % SECOND"} if not numbered else {0: "digits(stamp)"}
    written |= {2 + size + k: name for k, name in enumerate(known)}
    values = []
    for first, last in _runs(indices) if size > SINGLY else [(k, k + 1) for k in range(size)]:
        single = last == first + 1
        written[2 + first] = f"values[{first}]" if single else f"*values[{first}:{last}]"
        values.append(f"found[{indices[first]}]" if single else f"*found[{indices[first]}:{indices[last - 1] + 1}]")
    items = [written[item] for item in wire if item in written]
    mark = "-1"
    if 0 in index_of:
        mark = f"found[{index_of[0]}] * SECOND + found[{index_of[1]}]" if not numbered else f"int(found[{index_of[0]}])"
    differs = [f"found[{index_of[2 + size + k]}] != {name}" for k, name in enumerate(known)]
    text = CODERS.format(
        size=size,
        length=message.size,
        items=", ".join(items),
        # `int` would also read blanks, signs and underscores, so the digits are checked by themselves.
        differs=" or ".join(differs + ([f"not found[{index_of[0]}].isdigit()"] if numbered else [])),
        mark=mark,
        values=f"({''.join(f'{value}, ' for value in values)})",
    )
    known |= {"pack": message.pack, "unpack": message.unpack, "digits": _digits, "SECOND": SECOND}
    exec(_compiled(text), known)
    return known["encode"], known["decode"]


# The text names places only, so layouts of the same form share it.
@lru_cache(maxsize=256)
def _compiled(text: str) -> CodeType:
    return compile(text, "<layout>", "exec")


def _runs(indices: Sequence[int]) -> list[tuple[int, int]]:
    """Return the spans, first and after the last, in which each place follows the one before."""
    starts = [k for k in range(len(indices)) if k == 0 or indices[k] != indices[k - 1] + 1]
    return list(zip(starts, [*starts[1:], len(indices)], strict=True))


def getter(indices: Sequence[int]) -> Picker:
    """Return an itemgetter that always returns a tuple (of a tuple)."""
    if len(indices) > 1:
        return itemgetter(*indices)
    start = indices[0] if indices else 0
    return itemgetter(slice(start, start + len(indices)))


def _digits(number: int) -> bytes:
    if not 0 <= number < _NUMBERS:
        raise ValueError(f"message number {number}, expected one of at most {DIGITS} digits")
    return b"%012d" % number


def _merge(spans: list[tuple[int, int]]) -> list[tuple[int, int]]:
    merged: list[tuple[int, int]] = []
    for start, end in spans:
        if merged and merged[-1][1] == start:
            merged[-1] = (merged[-1][0], end)
        else:
            merged.append((start, end))
    return merged


def parse(msgtype: str, data: bytes) -> Message:
    """Read any well-formed message of a known type, either endianness.

    Parameters
    ----------
    msgtype : str
        ``package/msg/Type``.
    data : bytes
        Serialized message, the four bytes of the encapsulation included.

    Raises
    ------
    CdrError
        The bytes are truncated or malformed; the error names the place.
    """
    reader = Reader(msgtype, data)
    stamp: int | None = None
    frame_id = ""
    names: tuple[str, ...] = ()
    fields: dict[str, tuple[float, ...]] = {}
    dims: Dims | None = None
    number: int | None = None
    for kind, name, size in TYPES[msgtype].schema:
        if kind == "stamp":
            stamp = reader.one("i") * SECOND + reader.one("I")
        elif kind == "frame":
            frame_id = reader.text()
        elif kind == "names":
            # A text takes at least five bytes, its length and a zero; a dimension eight more, its size and stride.
            names = tuple(reader.text() for _ in range(reader.count("names", 5)))
        elif kind == "one":
            if (count := reader.one("I")) != 1:
                raise CdrError(f"{msgtype}: {count} points, expected exactly one")
        elif kind == "sequence":
            fields[name] = reader.read("d", reader.count(f"values of {name}", 8))
        elif kind == "numbers":
            fields[name] = reader.read("d", size)
        elif kind == "dims":
            shape = []
            for i in range(reader.count("dimensions", 13)):
                label = reader.text()
                if i == 0 and (match := _NUMBERED.fullmatch(label)):
                    label, number = match[1], int(match[2])
                shape.append((label, reader.read("I", 2)[0]))  # without the stride
            dims = tuple(shape)
            reader.one("I")
        elif kind == "flag":
            fields[name] = reader.read("B")
        elif kind == "duration":
            reader.read("I", 2)
    if dims and math.prod(size for _, size in dims) != len(fields["data"]):
        raise CdrError(f"{msgtype}: {len(fields['data'])} values for the shape {dict(dims)}")
    return Message(stamp, frame_id, names, fields, dims, number)
