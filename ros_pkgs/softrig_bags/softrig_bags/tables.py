"""Messages of a bag as tables of numbers, block by block: one layout for signals, exports and comparisons."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array
from softrig_core.wire.types import TYPES

from .content.block import Block, Bytes, Ints, distinct
from .content.definitions import UnknownType
from .content.layouts import Column, Decoder, Template, Undecodable
from .files.reader import BagReader

FRAME = "header/frame_id"


class Piece(NamedTuple):
    """Some messages of a topic: bag times and header stamps in ns (bag times if it has none), and columns.

    A value that a message lacks is NaN in a column, or 0 in a column of whole numbers. For such integer columns
    `absent` marks the messages that lack the value.
    """

    t: Ints
    stamp: Ints
    columns: dict[str, Column]
    absent: dict[str, NDArray[np.bool_]]


@dataclass
class Left:
    """Parts of a topic that were not converted to numbers, and why.

    Parameters
    ----------
    reason : str
        Why no message of the topic can be decoded; empty if some can.
    messages : int
        Number of damaged messages; the first of them is at bag time `first` ns and has `damage`.
    fields : dict of str to None
        Arrays that are too long for columns, in words.
    """

    reason: str = ""
    messages: int = 0
    first: int = 0
    damage: str = ""
    fields: dict[str, None] = field(default_factory=dict)


class Columns:
    """Makes tables of the messages of a bag's topics.

    Parameters
    ----------
    bag : BagReader
        Open.

    Attributes
    ----------
    left : dict of int to Left
        By topic: what has been left out so far.
    texts : dict of int to dict, or None
        By topic and field: one text, or two if there are several; only if it was set to a dict before reading.
    """

    def __init__(self, bag: BagReader) -> None:
        self._bag = bag
        self._decoders: dict[int, Decoder | None] = {}
        self._good: dict[int, int] = {}
        self.left: dict[int, Left] = {}
        self.texts: dict[int, dict[str, set[str]]] | None = None

    def decoder(self, topic: int) -> Decoder | None:
        """Return a function that reads a topic's messages; None if its type is unknown."""
        if topic not in self._decoders:
            try:
                self._decoders[topic] = self._bag.decoder(topic)
            except UnknownType as error:
                self._decoders[topic] = None
                self._left(topic).reason = str(error)
        return self._decoders[topic]

    def _left(self, topic: int) -> Left:
        return self.left.setdefault(topic, Left())

    def reason(self, topic: int) -> str:
        """Return why a topic cannot be decoded as a whole; empty where it can."""
        return self.left[topic].reason if topic in self.left else ""

    def pieces(self, block: Block) -> Iterator[tuple[int, Piece]]:
        """Return the tables of the topics in a block, by number of the topic."""
        for topic in distinct(block.topic):
            decoder = self.decoder(topic)
            if decoder is not None:
                chosen = block.select(np.flatnonzero(block.topic == topic))
                piece = self._piece(topic, decoder, chosen)
                self._good[topic] = self._good.get(topic, 0) + len(piece.t)
                if len(piece.t):
                    yield topic, piece

    def _piece(self, topic: int, decoder: Decoder, block: Block) -> Piece:
        groups = [*decoder.groups(block.raw, block.at, block.size)]
        good = [(rows, layout, data) for rows, layout, data in groups if isinstance(layout, Template)]
        # The columns are in the order of the messages that first have them.
        good.sort(key=lambda group: group[0][0])
        for rows, layout, _ in groups:
            if isinstance(layout, Undecodable):
                self._note(topic, int(block.t[rows[0]]), str(layout), len(rows))
        if self.texts is not None:
            for _, layout, data in good:
                self._note_texts(self.texts.setdefault(topic, {}), topic, layout, data)
        for _, layout, _ in good:
            self._left(topic).fields |= dict.fromkeys(layout.omitted) if layout.omitted else {}
        if len(good) == 1 and len(good[0][0]) == len(block):
            _, layout, data = good[0]
            return Piece(block.t, layout.stamps(data) if layout.stamp_at else block.t, layout.columns(data), {})
        return _merged(block, good)

    def _note(self, topic: int, t: int, damage: str, n: int) -> None:
        left = self._left(topic)
        if not left.messages or t < left.first:
            left.first, left.damage = t, damage
        left.messages += n

    def _note_texts(self, texts: dict[str, set[str]], topic: int, layout: Template, rows: Bytes) -> None:
        """Note the texts of messages that are not in a table; in the suite's own types only a frame is one."""
        own_type = self._bag.topics[topic].msgtype in TYPES
        for leaf in layout.leaves:
            if not leaf.text or (own_type and leaf.path != FRAME):
                continue
            result = texts.setdefault(re.sub(r"/\d+(?=/|$)", "/*", leaf.path), set())
            if len(result) < 2:
                cells = rows[:, leaf.at : leaf.at + int(leaf.kind[1:]) * leaf.n]
                first = int((cells != cells[0]).any(axis=1).argmax())
                result.update(layout.texts(rows[[0, first]], leaf))

    def untold(self) -> Iterator[str]:
        """Describe the texts that the tables do not show; a frame only where it changes."""
        for topic, texts in sorted((self.texts or {}).items()):
            name = self._bag.topics[topic].name
            frames = texts.pop(FRAME, set())
            if len(frames) > 1:
                several = " and ".join(repr(frame) for frame in sorted(frames)[:2])
                yield f"{name}: {FRAME} changes ({several}), which its table does not show"
            if fields := [field for field, result in texts.items() if result != {""}]:
                yield f"{name}: texts are not in its table: {', '.join(fields)}"

    def finish(self) -> None:
        """Note the topics of which no message could be decoded, after all have been read."""
        for topic, left in self.left.items():
            if left.messages and not self._good.get(topic):
                left.reason = left.damage

    def lines(self) -> Iterator[tuple[str, bool]]:
        """Describe what was left out; each line with whether messages of an otherwise read topic are lost."""
        for topic, left in sorted(self.left.items()):
            name = self._bag.topics[topic].name
            if left.reason:
                yield f"{name} ({self._bag.topics[topic].msgtype}) cannot be decoded: {left.reason}", False
            elif left.messages:
                yield (
                    f"{name}: {left.messages} of {left.messages + self._good[topic]} messages cannot be decoded, "
                    f"the first at {left.first} ns: {left.damage}",
                    True,
                )
            if left.fields and not left.reason:
                yield f"{name}: too long for columns: {', '.join(left.fields)}", False


def _merged(block: Block, groups: list[tuple[NDArray[np.intp], Template, NDArray[np.uint8]]]) -> Piece:
    """Merge messages of several shapes into one table; values that a message lacks are NaN."""
    stamp = block.t.copy()
    columns: dict[str, Column] = {}
    absent: dict[str, NDArray[np.bool_]] = {}
    decoded = np.zeros(len(block), bool)
    for rows, layout, data in groups:
        decoded[rows] = True
        if layout.stamp_at:
            stamp[rows] = layout.stamps(data)
        for label, x in layout.columns(data).items():
            if label not in columns:
                columns[label] = lacking(len(block), x.dtype)
                absent[label] = np.ones(len(block), bool)
            columns[label][rows] = x
            absent[label][rows] = False
    if not decoded.all():
        columns = {label: x[decoded] for label, x in columns.items()}
    absent = {label: x[decoded] for label, x in absent.items() if x[decoded].any()}
    return Piece(block.t[decoded], stamp[decoded], columns, absent)


def lacking(n: int, kind: np.dtype[Any]) -> Column:
    """Return a column for which no message has a value: NaN, or 0 if the type has no NaN."""
    return np.full(n, np.nan) if kind.kind == "f" else np.zeros(n, kind)


def stacked(pieces: list[Piece]) -> Piece:
    """Return the rows of several tables one after the other; columns that one of them lacks are NaN or 0 there."""
    if len(pieces) == 1:
        return pieces[0]
    dtypes = {label: x.dtype for piece in pieces for label, x in piece.columns.items()}
    columns, absent = {}, {}
    for label, kind in dtypes.items():
        columns_of = (p.columns[label] if label in p.columns else lacking(len(p.t), kind) for p in pieces)
        columns[label] = np.concatenate([*columns_of])
        if any(label in p.absent or label not in p.columns for p in pieces):
            lacks = (p.absent.get(label, np.full(len(p.t), label not in p.columns)) for p in pieces)
            absent[label] = np.concatenate([*lacks])
    empty = np.empty(0, np.int64)
    t, stamp = (np.concatenate([empty, *(getattr(p, name) for p in pieces)]) for name in ("t", "stamp"))
    return Piece(t, stamp, columns, absent)


class Growing:
    """The table of a topic while it is read: float columns that grow in place, so that no row is stored twice."""

    def __init__(self) -> None:
        self._rows = 0
        self._columns: dict[str, Array] = {}
        self._absent: dict[str, NDArray[np.bool_]] = {}
        self._times: dict[str, Ints] = {"t": np.empty(0, np.int64), "stamp": np.empty(0, np.int64)}

    def add(self, piece: Piece) -> None:
        """Append the rows of a piece."""
        first, last = self._rows, self._rows + len(piece.t)
        self._rows = last
        for label in [x for x in piece.columns if x not in self._columns]:
            self._columns[label] = np.full(first, np.nan)
            if first:
                self._absent[label] = np.ones(first, bool)
        lacking = self._columns.keys() - piece.columns.keys() if len(self._columns) > len(piece.columns) else ()
        for label in (*lacking, *piece.absent):
            self._absent.setdefault(label, np.zeros(first, bool))
        for arrays, result, fill in (
            (self._times, piece._asdict(), 0),
            (self._columns, piece.columns, np.nan),
            (self._absent, piece.absent, None),
        ):
            for name, array in arrays.items():
                if len(array) < last:
                    array.resize(max(last, len(array) * 3 // 2), refcheck=False)
                array[first:last] = result.get(name, (name in lacking) if fill is None else fill)

    def whole(self) -> tuple[Ints, Ints, dict[str, Array], dict[str, NDArray[np.bool_]]]:
        """Return the times, stamps, columns and absences of all rows, as a piece has them."""
        for arrays in (self._times, self._columns, self._absent):
            for array in arrays.values():
                array.resize(self._rows, refcheck=False)
        return self._times["t"], self._times["stamp"], self._columns, self._absent
