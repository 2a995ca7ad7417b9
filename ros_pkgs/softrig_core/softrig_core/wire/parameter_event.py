"""Changes of parameters as a recording keeps them: rcl_interfaces/msg/ParameterEvent, stamped with the tick."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any, Protocol

TOPIC, TYPE = "parameter_events", "rcl_interfaces/msg/ParameterEvent"
_ONE = {1: "?", 2: "q", 3: "d"}  # of a value's field: bool, int64, float64; a string is the fourth
_BOOL, _INTEGER, _DOUBLE, _STRING, _BOOLS, _INTEGERS, _DOUBLES, _STRINGS = 1, 2, 3, 4, 6, 7, 8, 9
_KINDS = {bool: (_BOOL, _BOOLS), int: (_INTEGER, _INTEGERS), float: (_DOUBLE, _DOUBLES), str: (_STRING, _STRINGS)}


class Recorded(Protocol):
    """What has topics by name, each with its messages: a recording."""

    @property
    def topics(self) -> Mapping[str, Any]:
        """By name."""


class _Writer:
    def __init__(self) -> None:
        self.data = bytearray(b"\x00\x01\x00\x00")

    def add(self, code: str, *values: Any) -> None:
        for value in values:
            size = struct.calcsize(code)
            self.data += bytes(-(len(self.data) - 4) % size) + struct.pack(f"<{code}", value)

    def text(self, text: str) -> None:
        raw = text.encode() + b"\x00"
        self.add("I", len(raw))
        self.data += raw


class _Reader:
    def __init__(self, data: bytes) -> None:
        if bytes(data[:2]) != b"\x00\x01":
            raise ValueError("expected little-endian CDR")
        self.data, self.at = bytes(data), 4

    def take(self, code: str) -> Any:
        size = struct.calcsize(code)
        self.at += -(self.at - 4) % size
        (value,) = struct.unpack_from(f"<{code}", self.data, self.at)
        self.at += size
        return value

    def text(self) -> str:
        n = self.take("I")
        self.at += n
        return self.data[self.at - n : self.at - 1].decode()


def encode(t: int, node: str, values: Mapping[str, Any]) -> bytes:
    """Give the bytes of a message.

    Parameters
    ----------
    t : int
        ns; of the tick from which the values hold.
    node : str
        Its name, behind a slash and without the namespace of the rig.
    values : mapping
        Value by name: numbers, texts, flags or lists of one of these; None: not set.
    """
    out = _Writer()
    out.add("i", t // 1_000_000_000)
    out.add("I", t % 1_000_000_000)
    out.text(node)
    out.add("I", 0, len(values))  # none is new
    for name, value in values.items():
        out.text(name)
        _write(out, value)
    out.add("I", 0)  # nor deleted
    return bytes(out.data)


def _write(out: _Writer, value: Any) -> None:
    several = list(value) if isinstance(value, list | tuple) else []
    kind = 0
    if isinstance(value, list | tuple):
        kind = _KINDS[type(several[0])][1] if several else _DOUBLES
    elif value is not None:
        kind = _KINDS[type(value)][0]
    out.add("B", kind)
    for one, code in _ONE.items():
        out.add(code, value if kind == one else 0)
    out.text(value if kind == _STRING else "")
    out.add("I", 0)  # bytes
    for many, code in ((_BOOLS, "?"), (_INTEGERS, "q"), (_DOUBLES, "d")):
        found = several if kind == many else []
        out.add("I", len(found))
        out.add(code, *found)
    found = several if kind == _STRINGS else []
    out.add("I", len(found))
    for text in found:
        out.text(text)


def decode(data: bytes) -> tuple[int, str, dict[str, Any]]:
    """Give the tick in ns, the full name of the node and its changed values.

    Raises
    ------
    ValueError
        Malformed bytes.
    """
    try:
        reader = _Reader(data)
        t = reader.take("i") * 1_000_000_000 + reader.take("I")
        node = reader.text()
        found: dict[str, Any] = {}
        for name, value in (_read(reader) for _ in range(reader.take("I"))):
            found[name] = value
        for name, value in (_read(reader) for _ in range(reader.take("I"))):
            found[name] = value
        return t, node, found
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"malformed {TYPE}: {error}") from None


def recorded(recording: Recorded, epoch: int = 0) -> list[tuple[int, str, dict[str, Any]]]:
    """Give the changes in a recording, in the order of their times: tick in ns after `epoch`, node, its new values.

    Raises
    ------
    ValueError
        A message is malformed.
    """
    topic = recording.topics.get(TOPIC)
    found = [decode(data) for data in (topic.data if topic is not None else ())]
    return [(t - epoch, node.rpartition("/")[2], values) for t, node, values in found]


def _read(reader: _Reader) -> tuple[str, Any]:
    name, kind = reader.text(), reader.take("B")
    values: dict[int, Any] = {k: reader.take(code) for k, code in _ONE.items()}
    values[_STRING] = reader.text()
    values[5] = [reader.take("B") for _ in range(reader.take("I"))]
    for many, code in ((_BOOLS, "?"), (_INTEGERS, "q"), (_DOUBLES, "d")):
        values[many] = [reader.take(code) for _ in range(reader.take("I"))]
    values[_STRINGS] = [reader.text() for _ in range(reader.take("I"))]
    return name, values.get(kind)
