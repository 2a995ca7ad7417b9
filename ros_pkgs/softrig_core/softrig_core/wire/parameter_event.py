"""Changes of parameters as a recording keeps them: rcl_interfaces/msg/ParameterEvent, stamped with the tick."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from ..timebase import SECOND
from .stream import Reader, Writer

TOPIC, TYPE = "parameter_events", "rcl_interfaces/msg/ParameterEvent"
_ONE = {1: "?", 2: "q", 3: "d"}  # types of a value's field: bool, int64, float64; a string is the fourth
_BOOL, _INTEGER, _DOUBLE, _STRING, _BOOLS, _INTEGERS, _DOUBLES, _STRINGS = 1, 2, 3, 4, 6, 7, 8, 9
_MANY = ((_BOOLS, "?"), (_INTEGERS, "q"), (_DOUBLES, "d"))
_KINDS = {bool: (_BOOL, _BOOLS), int: (_INTEGER, _INTEGERS), float: (_DOUBLE, _DOUBLES), str: (_STRING, _STRINGS)}


class Recorded(Protocol):
    """An object with topics by name, each with its messages: a recording."""

    @property
    def topics(self) -> Mapping[str, Any]:
        """By name."""


def encode(t: int, node: str, values: Mapping[str, Any]) -> bytes:
    """Return the bytes of a message.

    Parameters
    ----------
    t : int
        ns; of the tick from which the values hold.
    node : str
        Its name, behind a slash and without the namespace of the rig.
    values : mapping
        Value by name: numbers, texts, flags or lists of one of these; None: not set.
    """
    writer = Writer()
    writer.add("I", t // SECOND, t % SECOND)
    writer.text(node)
    writer.add("I", 0, len(values))  # no new parameters
    for name, value in values.items():
        writer.text(name)
        _write(writer, value)
    writer.add("I", 0)  # nor deleted
    return bytes(writer.data)


def _write(writer: Writer, value: Any) -> None:
    # Types are looked up exactly below, because a bool is an int as well.
    several = list(value) if isinstance(value, list | tuple) else []
    kind = 0
    if isinstance(value, list | tuple):
        kind = _KINDS[type(several[0])][1] if several else _DOUBLES
    elif value is not None:
        kind = _KINDS[type(value)][0]
    writer.add("B", kind)
    for known, code in _ONE.items():
        writer.add(code, value if kind == known else 0)
    writer.text(value if kind == _STRING else "")
    writer.add("I", 0)  # bytes
    for many, code in _MANY:
        result = several if kind == many else []
        writer.add("I", len(result))
        writer.add(code, *result)
    result = several if kind == _STRINGS else []
    writer.add("I", len(result))
    for text in result:
        writer.text(text)


def decode(data: bytes) -> tuple[int, str, dict[str, Any]]:
    """Return the tick in ns, the full name of the node and its changed values.

    Raises
    ------
    CdrError
        Malformed bytes.
    """
    reader = Reader(TYPE, data)
    t = reader.one("i") * SECOND + reader.one("I")
    node = reader.text()
    # A parameter that was deleted has no value.
    new, changed, _ = ([_read(reader) for _ in range(reader.one("I"))] for _ in range(3))
    return t, node, dict(new + changed)


def recorded(recording: Recorded, epoch: int = 0) -> list[tuple[int, str, dict[str, Any]]]:
    """Return the changes in a recording, in the order of their times: tick in ns after `epoch`, node, its new values.

    Raises
    ------
    ValueError
        A message is malformed.
    """
    topic = recording.topics.get(TOPIC)
    results = [decode(data) for data in (topic.data if topic is not None else ())]
    return [(t - epoch, node.rpartition("/")[2], values) for t, node, values in results]


def _read(reader: Reader) -> tuple[str, Any]:
    name, kind = reader.text(), reader.one("B")
    values: dict[int, Any] = {k: reader.one(code) for k, code in _ONE.items()}
    values[_STRING] = reader.text()
    for many, code in ((5, "B"), *_MANY):
        values[many] = list(reader.read(code, reader.one("I")))
    values[_STRINGS] = [reader.text() for _ in range(reader.one("I"))]
    return name, values.get(kind)
