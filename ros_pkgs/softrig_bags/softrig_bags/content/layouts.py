"""Messages of any type as columns: where in its bytes a message has its numbers and texts, and which others are alike.

A template is made from one message by its definition. It fits every other message that has the same lengths in the same
places. The numbers of all these messages are read in one batch, after their bytes were checked: encapsulation, byte
order, lengths, and that the definition ends where the message does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from softrig_core.wire.types import TYPES

from .block import Bytes, Ints, distinct, numbers_at, rows_of
from .definitions import Types

Column = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.uint64]
LONGEST = 4096  # elements of an array that become columns of their own
LONGEST_OCTETS = 64  # elements of arrays of uint8, byte or char, which are images and other files more often
# The most values of a message. Each is a column of a table, and more make no table.
MANY = 20_000
PADDING = 3  # bytes that may follow the last field: DDS fills up to four
# plus this many bytes for each empty sequence of eight-byte numbers: Fast CDR counts the alignment of its elements into
# the length of a message, and `serialize_message` of rclcpp and rclpy returns buffers of that length
ALIGNMENT = 4
_LAST_LETTER = 0x10FFFF
_KINDS = {
    "bool": "u1", "byte": "u1", "octet": "u1", "char": "u1", "wchar": "u2", "int8": "i1", "uint8": "u1", "int16": "i2",
    "uint16": "u2", "int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_OCTETS = {"byte", "octet", "char", "uint8"}
_ORDERS = {b"\0\0": ">", b"\0\1": "<"}
_STAMPS = ("std_msgs/msg/Header", "builtin_interfaces/msg/Time")


class Undecodable(Exception):
    """The bytes of a message do not match the definition of its type; the text gives the reason."""


class Leaf(NamedTuple):
    """A number, an array of numbers, or a text: path below the topic, numpy's type, first byte, number of elements.

    ``text`` is ``utf-8`` or, of wide characters, ``utf-16`` or ``utf-32``; empty for numbers.
    """

    path: str
    kind: str
    at: int
    n: int
    flag: bool = False
    octets: bool = False
    text: str = ""


@dataclass
class Template:
    """Common structure of messages of one shape.

    Attributes
    ----------
    length : int
        Bytes of a message.
    order : str
        ``<`` or ``>``.
    fixed : list of (int, bytes)
        Places and bytes that every message of this shape has: encapsulation, lengths, and texts that name columns.
    leaves : list of Leaf
        All values, in wire order.
    labels : list of (str, Leaf, int)
        Name of each column, its leaf and which element of that.
    """

    length: int
    order: str
    fixed: list[tuple[int, bytes]] = field(default_factory=list)
    leaves: list[Leaf] = field(default_factory=list)
    labels: list[tuple[str, Leaf, int]] = field(default_factory=list)
    omitted: list[str] = field(default_factory=list)
    stamp_at: int = 0  # place of the stamp of its header; 0 without one

    def fits(self, rows: Bytes) -> NDArray[np.bool_]:
        """Return which rows of shape (n, length) are messages of this shape."""
        good: NDArray[np.bool_] = np.ones(len(rows), bool)
        for begin, mask, expected in self._words:
            same = (rows[:, begin : begin + 8 * len(mask)].view("<u8") & mask) == expected
            # Nearly always all rows fit. A reduction of a whole block is much faster than one of each row.
            if not same.all():
                good &= same.all(axis=1)
        for start, text in self.fixed:
            # These are in the last bytes, which do not fill a word and are not in `_words`.
            if start + len(text) > self.length // 8 * 8:
                good &= (rows[:, start : start + len(text)] == np.frombuffer(text, np.uint8)).all(axis=1)
        return good

    @cached_property
    def _words(self) -> list[tuple[int, NDArray[np.uint64], NDArray[np.uint64]]]:
        """Return runs of eight-byte words with fixed bits: where they begin, which bits are fixed, and their values."""
        mask, expected = np.zeros(self.length // 8 * 8, np.uint8), np.zeros(self.length // 8 * 8, np.uint8)
        for start, text in self.fixed:
            n = len(mask[start : start + len(text)])
            mask[start : start + n], expected[start : start + n] = 0xFF, np.frombuffer(text[:n], np.uint8)
        used = np.flatnonzero(mask.view("<u8"))
        runs = np.split(used, np.flatnonzero(np.diff(used) > 2) + 1) if len(used) else []
        spans = [(int(run[0]), int(run[-1]) + 1) for run in runs]
        return [(8 * a, mask.view("<u8")[a:b], expected.view("<u8")[a:b]) for a, b in spans]

    def values(self, rows: Bytes, leaf: Leaf) -> NDArray[Any]:
        """Return the numbers of a leaf, shape (n, elements), of the type that they have in the message."""
        width = int(leaf.kind[1:]) * leaf.n
        if not width:
            return np.empty((len(rows), 0), leaf.kind)
        result = rows[:, leaf.at : leaf.at + width].view(self.order + leaf.kind)
        return result != 0 if leaf.flag else result

    def stamps(self, rows: Bytes) -> Ints:
        """Return the header stamps of messages, ns, shape (n,)."""
        start = self.stamp_at
        fields = (rows[:, a : a + 4].view(self.order + k)[:, 0] for a, k in ((start, "i4"), (start + 4, "u4")))
        seconds, remaining = (value.astype(np.int64) for value in fields)
        return seconds * 10**9 + remaining

    def columns(self, rows: Bytes) -> dict[str, Column]:
        """Return the numbers of messages as columns by label, each of shape (n,).

        They are float64, but whole numbers of 64 bits keep their type: a float has 53 bits of them. Numbers that are
        so in the messages are not copied.
        """
        result: dict[str, Column] = {}
        blocks: dict[int, Column] = {}
        for label, leaf, k in self.labels:
            if leaf.at not in blocks:
                kind = leaf.kind if leaf.kind in ("i8", "u8") and not leaf.flag else "f8"
                blocks[leaf.at] = self.values(rows, leaf).T.astype(kind, copy=False)
            result[label] = blocks[leaf.at][k]
        return result

    def texts(self, rows: Bytes, leaf: Leaf) -> list[str]:
        """Return a text of each message; bytes that are not valid in its encoding become escapes."""
        coding, width = leaf.text, {"utf-8": 1, "utf-16": 2, "utf-32": 4}[leaf.text]
        if width > 1:
            coding += "-le" if self.order == "<" else "-be"
        cells = np.ascontiguousarray(rows[:, leaf.at : leaf.at + width * leaf.n])
        return [bytes(row).decode(coding, "backslashreplace") for row in cells]


def stamped(msgtype: str, types: Types) -> bool:
    """Return whether messages of a type begin with a header or a time."""
    fields = types[msgtype][1]
    kind, detail = fields[0][1] if fields else (None, "")
    return msgtype == _STAMPS[1] or (kind == Nodetype.NAME and detail in _STAMPS)


def _has_stamp(i: int, name: str, msgtype: str) -> bool:
    """Return whether a field is the stamp of its message."""
    return (i == 0 and msgtype in _STAMPS) or (name == "header" and msgtype == _STAMPS[0])


def stamps_of(raw: Bytes, starts: Ints) -> Ints:
    """Return the stamps in ns of messages that begin with one; all of them have at least 12 bytes."""
    result = np.empty(len(starts), np.int64)
    little = (raw[starts + 1] & 1).astype(bool)
    for order, chosen in (("<", little), (">", ~little)):
        some = starts if chosen.all() else starts[chosen]
        seconds, remaining = numbers_at(raw, some + 4, order + "i4"), numbers_at(raw, some + 8, order + "u4")
        result[chosen] = seconds.astype(np.int64) * 10**9 + remaining
    return result


class _Maker:
    """Walks through one message by its definition."""

    def __init__(self, types: Types, data: bytes, wide: int) -> None:
        order = _ORDERS.get(data[:2])
        if order is None or len(data) < 4:
            raise Undecodable(f"its bytes begin with {data[:4].hex() or 'nothing'}, which is not CDR of ROS 2")
        self._types, self._data, self._wide = types, data, wide
        self._at = 4
        self._empty = 0  # bytes of an empty sequence of numbers of eight bytes
        self.template = Template(len(data), order, [(0, data[:2])])
        self.names: dict[str, tuple[int, str]] = {}  # place of each text by path

    def make(self, msgtype: str) -> Template:
        if msgtype == _STAMPS[1]:
            self.template.stamp_at = self._at
        self._struct(msgtype, "")
        left = len(self._data) - self._at
        if left > PADDING + ALIGNMENT * self._empty:
            raise Undecodable(f"it is {left} bytes longer than its definition")
        return self.template

    def _align(self, n: int) -> None:
        self._at += -(self._at - 4) % n

    def _move(self, n: int, path: str) -> int:
        """Advance by some bytes; return where they begin."""
        start = self._at
        self._at += n
        if self._at > len(self._data):
            raise Undecodable(f"it ends within {path.removeprefix('/') or 'its first field'}")
        return start

    def _length(self, path: str) -> int:
        self._align(4)
        start = self._move(4, path)
        self.template.fixed.append((start, self._data[start : start + 4]))
        return int.from_bytes(self._data[start : start + 4], "little" if self.template.order == "<" else "big")

    def _struct(self, msgtype: str, path: str) -> None:
        fields = self._types[msgtype][1]
        # IDL has no empty structures, so an empty message has one byte on the wire.
        if not fields:
            self._move(1, path)
        for i, (name, kind) in enumerate(fields):
            if not path and kind[0] == Nodetype.NAME and _has_stamp(i, name, kind[1]):
                self._align(4)
                self.template.stamp_at = self.template.stamp_at or self._at
            if name == "structure_needs_at_least_one_member":
                self._move(1, path)
            else:
                self._item(kind, f"{path}/{name}")

    def _item(self, description: Any, path: str) -> None:
        kind, detail = description
        if kind == Nodetype.NAME:
            self._struct(detail, path)
        elif kind == Nodetype.BASE:
            self._base(detail[0], path, 1, single=True)
        else:
            inner, n = detail
            if kind == Nodetype.SEQUENCE:
                n = self._length(path)
                if n > len(self._data):
                    raise Undecodable(f"{path[1:]} claims {n} elements, more than its {len(self._data)} bytes hold")
            if inner[0] == Nodetype.BASE and inner[1][0] in _KINDS:
                self._base(inner[1][0], path, n, single=False)
            else:
                for i in range(n):
                    self._item(inner, f"{path}/{i}")

    def _base(self, name: str, path: str, n: int, *, single: bool) -> None:
        if len(self.template.leaves) > MANY:
            raise Undecodable(f"it has more than {MANY} fields")
        if name in ("string", "wstring"):
            self._text(name, path)
            return
        kind = _KINDS.get(name)
        if kind is None:
            raise Undecodable(f"{path[1:]} is of type {name}, which ROS 2 does not have")
        if name == "wchar" and self._wide == 4:
            kind = "u4"
        width = int(kind[1:])
        if n:
            self._align(width)
        self._empty += n == 0 and width == 8
        start = self._move(n * width, path)
        leaf = Leaf(path[1:], kind, start, n, name == "bool", name in _OCTETS and not single)
        self.template.leaves.append(leaf)
        if n > (LONGEST_OCTETS if leaf.octets else LONGEST):
            self.template.omitted.append(f"{leaf.path} of {n} elements")
        elif single:
            self.template.labels.append((leaf.path, leaf, 0))
        else:
            self.template.labels += [(f"{leaf.path}/{i}", leaf, i) for i in range(n)]

    def _text(self, name: str, path: str) -> None:
        n = self._length(path)
        if name == "wstring":
            start = self._move(n * self._wide, path)
            if self._wide == 4 and any(
                x > _LAST_LETTER for x in np.frombuffer(self._data, f"{self.template.order}u4", n, start)
            ):
                raise Undecodable(f"{path[1:]} has letters that do not exist")
            self.template.leaves.append(Leaf(path[1:], "u1", start, n, text="utf-16" if self._wide == 2 else "utf-32"))
            return
        start = self._move(n, path)
        ends = n > 0 and self._data[start + n - 1] == 0
        self.template.leaves.append(Leaf(path[1:], "u1", start, n - ends, text="utf-8"))


def template(msgtype: str, types: Types, data: bytes) -> Template:
    """Return the template of messages that are like one.

    Parameters
    ----------
    msgtype : str
        Its type.
    types : Types
        Definitions of the type and of all in it.
    data : bytes
        The message, encapsulation included.

    Raises
    ------
    Undecodable
        The message does not match its definition.
    """
    try:
        result = _Maker(types, data, 4).make(msgtype)
    except Undecodable:
        if not _is_wide(types):
            raise
        # Wide characters had four bytes in older distributions and have two in newer ones; the message shows which.
        result = _Maker(types, data, 2).make(msgtype)
    _name_columns(msgtype, result, data)
    return result


def _is_wide(types: Types) -> bool:
    def wide(description: Any) -> bool:
        kind, detail = description
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return wide(detail[0])
        return kind == Nodetype.BASE and detail[0] in ("wchar", "wstring")

    return any(wide(kind) for _, fields in types.values() for _, kind in fields)


def _name_columns(msgtype: str, layout: Template, data: bytes) -> None:
    """Name the columns of the suite's own types as it does, by channels or dimensions; leave out stamps."""
    stamp = (layout.stamp_at, layout.stamp_at + 4) if layout.stamp_at else ()
    layout.labels = [row for row in layout.labels if row[1].at not in stamp]
    if msgtype not in TYPES:
        return
    texts = {leaf.path: leaf for leaf in layout.leaves if leaf.text}
    rows = np.frombuffer(data, np.uint8)[None]
    read = {path: layout.texts(rows, leaf)[0] for path, leaf in texts.items()}
    # Also where the columns keep their places as names: a message that is named otherwise has another shape.
    for path in _NAMING.get(msgtype, ()):
        for text_leaf in (leaf for p, leaf in texts.items() if p.startswith(path)):
            layout.fixed.append((text_leaf.at, data[text_leaf.at : text_leaf.at + text_leaf.n]))
    if msgtype == "std_msgs/msg/Float64MultiArray":
        layout.fixed += [
            (leaf.at, data[leaf.at : leaf.at + 4])
            for leaf in layout.leaves
            if leaf.path.startswith("layout/dim/") and leaf.path.endswith("/size")
        ]
    renamed = _RENAMED.get(msgtype, lambda labels, *_: labels)(
        [label for label, _, _ in layout.labels], read, layout, rows
    )
    if renamed is None or len(set(renamed)) != len(renamed):
        return
    layout.labels = [
        (new, leaf, k) for new, (_, leaf, k) in zip(renamed, layout.labels, strict=True) if not new.startswith("\0")
    ]


def _joints(labels: Sequence[str], texts: Mapping[str, str], *_: Any) -> list[str] | None:
    names = _listed(texts, "name/")
    return [_channel(names, *label.rpartition("/")[::2]) for label in labels]


def _trajectory(labels: Sequence[str], texts: Mapping[str, str], layout: Template, rows: Bytes) -> list[str] | None:
    if any(label.startswith("points/1/") for label in labels) or not labels:
        return None
    names, result = _listed(texts, "joint_names/"), []
    for label in labels:
        name, _, index = label.removeprefix("points/0/").rpartition("/")
        if name == "time_from_start":
            result.append(f"\0{label}")
        else:
            single = {"positions": "position", "velocities": "velocity", "accelerations": "acceleration"}.get(
                name, name
            )
            result.append(_channel(names, single, index))
    return result


def _array(labels: Sequence[str], _: Any, layout: Template, rows: Bytes) -> list[str] | None:
    sizes = [
        int(layout.values(rows, leaf)[0, 0])
        for leaf in layout.leaves
        if leaf.path.startswith("layout/dim/") and leaf.path.endswith("/size")
    ]
    n = sum(label.startswith("data/") for label in labels)
    if sizes and math.prod(sizes) != n:
        return None
    elements = [",".join(map(str, index)) for index in np.ndindex(*sizes)] if sizes else [f"data/{i}" for i in range(n)]
    names = iter(elements)
    return [next(names) if label.startswith("data/") else "\0" + label for label in labels]


def _listed(texts: Mapping[str, str], prefix: str) -> list[str]:
    return [text for path, text in texts.items() if path.startswith(prefix)]


def _channel(names: Sequence[str], field_name: str, index: str) -> str:
    """Return the label of an element: the name of its channel, or its index if it has no name."""
    known = index.isdecimal() and int(index) < len(names) and names[int(index)]
    return f"{names[int(index)]}/{field_name}" if known else f"{field_name}/{index}".removeprefix("/")


def _below(prefix: str) -> Any:
    return lambda labels, *_: [label.removeprefix(prefix) for label in labels]


_RENAMED: dict[str, Any] = {
    "sensor_msgs/msg/JointState": _joints,
    "trajectory_msgs/msg/JointTrajectory": _trajectory,
    "geometry_msgs/msg/Vector3Stamped": _below("vector/"),
    "geometry_msgs/msg/WrenchStamped": _below("wrench/"),
    "geometry_msgs/msg/PoseStamped": _below("pose/"),
    "std_msgs/msg/Float64MultiArray": _array,
}
_NAMING = {"sensor_msgs/msg/JointState": ("name/",), "trajectory_msgs/msg/JointTrajectory": ("joint_names/",)}


class Decoder:
    """The templates of one topic: sorts its messages by shape.

    Parameters
    ----------
    msgtype : str
        Type of the topic.
    types : Types
        Its definitions, from `definitions.complete`.
    """

    def __init__(self, msgtype: str, types: Types) -> None:
        self._msgtype, self._types = msgtype, types
        self._templates: dict[int, list[Template]] = {}
        self.stamped = stamped(msgtype, types)

    def groups(
        self, raw: Bytes, starts: Ints, size: Ints
    ) -> Iterator[tuple[NDArray[np.intp], Template | Undecodable, Bytes]]:
        """Return messages of one shape together: which they are, their template, and their bytes as rows.

        Groups with an invalid message are yielded message by message, with the error in place of a template.
        """
        for length in distinct(size):
            chosen = np.flatnonzero(size == length)
            rows = rows_of(raw, starts[chosen], length)
            known = self._templates.setdefault(length, [])
            for layout in known:
                if not len(chosen):
                    break
                good = layout.fits(rows)
                if good.all():
                    yield chosen, layout, rows
                    chosen = chosen[:0]
                elif good.any():
                    yield chosen[good], layout, rows[good]
                    chosen, rows = chosen[~good], rows[~good]
            while len(chosen):
                try:
                    layout = template(self._msgtype, self._types, rows[0].tobytes())
                except Undecodable as error:
                    yield chosen[:1], error, rows[:1]
                    chosen, rows = chosen[1:], rows[1:]
                    continue
                known.append(layout)
                good = layout.fits(rows)
                if good.all():
                    yield chosen, layout, rows
                    break
                yield chosen[good], layout, rows[good]
                chosen, rows = chosen[~good], rows[~good]
            del known[:-_KEPT]


# Templates of one length that are kept. Every message is tried against them, so a topic whose messages all have other
# shapes must not collect them without end.
_KEPT = 256
