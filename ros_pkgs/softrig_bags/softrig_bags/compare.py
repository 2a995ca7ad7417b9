"""Compare two bags topic by topic, messages paired by stamp, numbers within tolerances or bit for bit.

Both bags are read in parallel and in blocks; paired messages are dropped, so memory does not grow with the bags.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core import SECOND, Signals

from .content.block import Block, distinct
from .content.definitions import UnknownType
from .content.fields import bytes_that_differ, groups_of, visit_pairs
from .content.layouts import Decoder
from .errors import BagError
from .messages import Described, Messages, described, opened
from .pairing import Pairing, equal_rows, keys_of


@dataclass(frozen=True)
class Tolerance:
    """A number b agrees with its reference a when ``|b - a| <= max(absolute, relative |a|)``; NaN agrees with NaN."""

    absolute: float = 0.0
    relative: float = 0.0

    def exceeded(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return where two arrays of equal shape disagree."""
        with np.errstate(invalid="ignore", over="ignore"):
            # Equal infinities and two NaN agree, though their difference is NaN.
            near = np.abs(b - a) <= np.maximum(self.absolute, self.relative * np.abs(a))
        return ~(near | (a == b) | (np.isnan(a) & np.isnan(b)))


@dataclass(frozen=True)
class Difference:
    """The first disagreement of two bags: stamp in ns, topic, field and both values."""

    stamp: int
    topic: str
    field: str
    a: Any
    b: Any

    def __str__(self) -> str:
        return f"t = {_seconds(self.stamp)} s, {self.topic} {self.field}: {_show(self.a)} against {_show(self.b)}"


@dataclass
class TopicComparison:
    """Result of the comparison for one topic.

    Parameters
    ----------
    count_a, count_b : int
        Number of messages.
    missing, extra : int
        Messages of a that b lacks, messages of b that a lacks.
    differing : int
        Paired messages that disagree.
    largest : dict of str to float
        Largest ``|b - a|`` of each field that differs at all, within tolerance or not.
    """

    topic: str
    msgtype: str
    count_a: int
    count_b: int
    missing: int = 0
    extra: int = 0
    differing: int = 0
    first: Difference | None = None
    largest: dict[str, float] = field(default_factory=dict)

    @property
    def equal(self) -> bool:
        """Return whether nothing is missing, extra or different."""
        return not (self.missing or self.extra or self.differing)

    def note(self, stamp: int, name: str, a: Any, b: Any) -> None:
        """Keep a difference if it is the earliest."""
        if self.first is None or stamp < self.first.stamp:
            self.first = Difference(stamp, self.topic, name, a, b)


@dataclass
class Comparison:
    """Result of `compare`.

    Parameters
    ----------
    paired : int
        Number of messages that had a partner.
    notes : list of str
        What was done differently from the request, and why.
    complete : bool
        Whether all messages were read that the bags claim to have.
    """

    topics: list[TopicComparison]
    paired: int = 0
    notes: list[str] = field(default_factory=list)
    complete: bool = True

    @property
    def unrelated(self) -> bool:
        """Return whether both have messages on common topics, but not one with a stamp of the other's."""
        return not self.paired and any(t.count_a and t.count_b for t in self.topics)

    @property
    def equal(self) -> bool:
        """Return whether the bags agree."""
        return all(t.equal for t in self.topics)

    @property
    def first(self) -> Difference | None:
        """The earliest difference of all topics."""
        results = [t.first for t in self.topics if t.first is not None]
        return min(results, key=lambda d: d.stamp, default=None)

    def to_json(self) -> str:
        """Return everything as JSON; NaN and infinity as text."""
        content = {
            "equal": self.equal,
            "first": self.first and asdict(self.first),
            "topics": [{"equal": t.equal, **asdict(t)} for t in self.topics],
            "notes": self.notes,
            "whole": self.complete,
        }
        return json.dumps(plain(content), indent=2)

    def __str__(self) -> str:
        lines = list(self.notes)
        for t in self.topics:
            counts = str(t.count_a) if t.count_a == t.count_b else f"{t.count_a} against {t.count_b}"
            faults = [
                f"{n} {text}" for n, text in ((t.missing, "missing"), (t.extra, "extra"), (t.differing, "differ")) if n
            ]
            lines.append(f"{t.topic}: {counts} messages, {', '.join(faults) or 'equal'}")
            lines += [f"    {name}: largest deviation {value:.3g}" for name, value in t.largest.items()]
        agree = "the bags agree" if self.complete else "the messages that were read agree; the bags claim others"
        lines.append(f"first difference: {self.first}" if self.first else agree)
        return "\n".join(lines)


def compare(
    a: Signals | Path | str,
    b: Signals | Path | str,
    *,
    default: Tolerance = Tolerance(),
    tolerances: Mapping[str, Tolerance] | None = None,
    bitwise: bool = False,
    topics: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
    namespaces: tuple[str, str] = ("", ""),
) -> Comparison:
    """Compare recording b with its reference a.

    Messages are paired by header stamp, or by bag time if they have no header. Messages with equal stamps are paired by
    order. If all stamps of a topic are zero or equal, bag time is used instead, and a note reports it.

    Parameters
    ----------
    a, b : Signals, Path or str
        Bags by their path, from `softrig_bags.read.signals`, or made of a recording in memory.
    default : Tolerance
        Tolerance of every number that no pattern covers; default: exact.
    tolerances : mapping of str to Tolerance
        By pattern (``plant/*``, ``*/velocity``) of the signal name ``topic/channel/field``; the first matching pattern
        applies.
    bitwise : bool
        Demand equal bytes and equal bag times instead.
    topics : sequence of str, optional
        Topics to compare, by default all topics of both bags; an empty list requires no topic.
    ignore : sequence of str
        Patterns of topics left out.
    namespaces : (str, str)
        Of a and of b, where these are paths: the topics in them, named without them.

    Raises
    ------
    BagError
        A bag is bad, a topic does not exist, or neither bag has a message on the topics: two empty recordings do not
        count as equal.
    """
    limits = _Limits(Tolerance(), {}, True) if bitwise else _Limits(default, tolerances or {}, False)
    with ExitStack() as stack:
        sides: list[Messages] = []
        for source, namespace in zip((a, b), namespaces, strict=True):
            sides.append(side := opened(source, namespace))
            stack.enter_context(side)
        known = [described(side) for side in sides]
        names = dict.fromkeys(d.name for topics_of_it in known for d in topics_of_it if d.name is not None)
        for name in topics or ():
            if name not in names:
                raise BagError(f"no topic {name} to compare; there are {', '.join(names)}")
        chosen = names if topics is None else dict.fromkeys(topics)
        gathered = [
            _TopicPair(name, pair, sides, known, limits)
            for name in chosen
            if not any(fnmatchcase(name, p) for p in ignore)
            for pair in _pairs(name, known)
        ]
        pairs_of = [{i: pair for pair in gathered if (i := pair.numbers[k]) is not None} for k in (0, 1)]
        streams = [side.blocks(list(pairs_by)) for side, pairs_by in zip(sides, pairs_of, strict=True)]
        for k, block in _in_step(streams):
            for number in distinct(block.topic):
                if number in pairs_of[k]:
                    pairs_of[k][number].add(k, block.select(np.flatnonzero(block.topic == number)))
        results = [pair.finish() for pair in gathered]
    # Two bags without a message on these topics would count as equal, but an empty comparison proves nothing.
    if topics != [] and not any(r.count_a or r.count_b for r in results):
        raise BagError("nothing to compare: neither has a message on the topics that are compared")
    notes = [f"{pair.result.topic}: {pair.pairing.note}" for pair in gathered if pair.pairing.note]
    complete = all(side.is_whole for side in sides)
    return Comparison(results, sum(pair.pairing.paired for pair in gathered), notes, complete)


def _pairs(name: str, known: Sequence[list[Described]]) -> Iterator[tuple[int | None, int | None]]:
    """Return which topic of one belongs to which of the other: of a name, those of equal types first."""
    numbers = [[i for i, d in enumerate(topics) if d.name == name] for topics in known]
    for i in list(numbers[0]):
        same = [j for j in numbers[1] if known[1][j].msgtype == known[0][i].msgtype]
        if same:
            # A topic of one name may have two types, and equal types are the likelier pair.
            numbers[0].remove(i)
            numbers[1].remove(same[0])
            yield i, same[0]
    n = max(map(len, numbers))
    yield from zip(*([*x, *[None] * (n - len(x))] for x in numbers), strict=True)


def _in_step(streams: list[Iterator[Block]]) -> Iterator[tuple[int, Block]]:
    """Yield the blocks of both bags; the next block is always of the bag of which less has been read."""
    read = dict.fromkeys(range(len(streams)), 0)
    while read:
        # Both bags advance alike, so that few messages wait in memory for their partners.
        k = min(read, key=lambda i: read[i])
        block = next(streams[k], None)
        if block is None:
            del read[k]
        else:
            read[k] += len(block)
            yield k, block


@dataclass(frozen=True)
class _Limits:
    default: Tolerance
    patterns: Mapping[str, Tolerance]
    bitwise: bool

    def of(self, signal: str) -> Tolerance:
        return next((v for p, v in self.patterns.items() if fnmatchcase(signal, p)), self.default)


class _TopicPair:
    """One topic in both bags, or in one of them."""

    def __init__(
        self,
        name: str,
        numbers: tuple[int | None, int | None],
        sides: Sequence[Messages],
        known: Sequence[list[Described]],
        limits: _Limits,
    ) -> None:
        self.numbers, self._limits = numbers, limits
        self._types = [topics[i].msgtype for topics, i in zip(known, numbers, strict=True) if i is not None]
        self.result = TopicComparison(name, self._types[0], 0, 0)
        self._counts = [0, 0]
        self._decoders = [_decoder(side, i) for side, i in zip(sides, numbers, strict=True)]
        decoder = next((d for d in self._decoders if d is not None), None)
        # The types have one name, so the definition of one bag serves for the other where that has none.
        self._decoders = [d or decoder for d in self._decoders]
        self._stamped = decoder is not None and decoder.stamped
        self.pairing = Pairing(self._stamped, self._compare)
        self._alone = len(self._types) < 2 or self._types[0] != self._types[1]
        self._first: list[int] = []

    def add(self, side: int, block: Block) -> None:
        self._counts[side] += len(block)
        if not self._alone:
            self.pairing.add(side, block)
        elif len(self._types) > 1:
            self._first.append(int(block.t[0]))
        else:
            self._first.append(int(np.min(keys_of(block, self._stamped))))

    def finish(self) -> TopicComparison:
        result = self.result
        result.count_a, result.count_b = self._counts
        if not self._alone:
            absent, extra = self.pairing.finish()
            result.missing, result.extra = len(absent), len(extra)
            for lacking, x, y in ((extra, "missing", "present"), (absent, "present", "missing")):
                # At equal stamps a missing message is reported before a field that differs: it may be the cause.
                if len(lacking) and (result.first is None or np.min(lacking) <= result.first.stamp):
                    result.first = Difference(int(np.min(lacking)), result.topic, "message", x, y)
            return result
        result.missing, result.extra = self._counts
        if len(self._types) > 1:
            result.note(min(self._first, default=0), "type", *self._types)
        elif self._first:
            states = ("present", "missing") if self.numbers[0] is not None else ("missing", "present")
            result.note(min(self._first), "message", *states)
        return result

    def _compare(
        self, a: Block, rows_a: NDArray[np.intp], b: Block, rows_b: NDArray[np.intp], stamps: NDArray[np.int64]
    ) -> None:
        result, bitwise = self.result, self._limits.bitwise
        bad = np.zeros(len(rows_a), bool)
        if bitwise:
            bad = a.t[rows_a] != b.t[rows_b]
            if bad.any():
                k = _earliest(bad, stamps)
                result.note(int(stamps[k]), "bag time", int(a.t[rows_a[k]]), int(b.t[rows_b[k]]))
        # Most messages of equal runs have equal bytes, so only the others are decoded.
        rows = np.flatnonzero(~equal_rows(a, rows_a, b, rows_b))
        if len(rows):
            bad[rows] |= self._values(a, rows_a[rows], b, rows_b[rows], stamps[rows])
        result.differing += int(bad.sum())

    def _values(
        self, a: Block, rows_a: NDArray[np.intp], b: Block, rows_b: NDArray[np.intp], stamps: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Compare the messages whose bytes differ, field by field; return which of them disagree."""
        result, bad = self.result, np.zeros(len(rows_a), bool)

        def visit(rows: NDArray[np.intp], label: str, x: Any, y: Any) -> None:
            if x is None or y is None or np.shape(x) != np.shape(y):
                bad[rows] = True
                shown = ["missing" if v is None else _shape(x, y, v) for v in (x, y)]
                result.note(int(np.min(stamps[rows])), label, *shown)
                return
            wrong = self._wrong(label, x, y)
            if wrong.any():
                within = wrong if wrong.ndim == 1 else wrong.any(axis=1)
                k = _earliest(within, stamps[rows])
                element = () if wrong.ndim == 1 else (int(np.argmax(wrong[k])),)
                name = "/".join((label, *map(str, element)))
                values = (_item(v[k] if not element else v[k][element[0]]) for v in (x, y))
                result.note(int(stamps[rows][k]), name, *values)
                bad[rows] |= within

        groups_a, groups_b = groups_of(self._decoders[0], a, rows_a), groups_of(self._decoders[1], b, rows_b)
        visit_pairs(result.msgtype, groups_a, groups_b, visit)
        # These differ in bytes that no field shows, such as padding or the sign of a zero.
        if self._limits.bitwise and not bad.all():
            k = _earliest(~bad, stamps)
            field_name, x, y = bytes_that_differ(a.data(rows_a[k]), b.data(rows_b[k]), "byte {at}")
            result.note(int(stamps[k]), field_name, x[0], y[0])
            bad[:] = True
        return bad

    def _wrong(self, label: str, x: Any, y: Any) -> NDArray[np.bool_]:
        """Return where two fields disagree, and note how far numbers are apart."""
        result = self.result
        if not isinstance(x, np.ndarray):
            return np.array([p != q for p, q in zip(x, y, strict=True)], bool)
        tolerance = self._limits.of(f"{result.topic}/{label}")
        p, q = x.astype(np.float64), y.astype(np.float64)
        wrong = tolerance.exceeded(p, q)
        if x.dtype.kind in "iu" and tolerance == Tolerance():
            # Integers of 64 bits have more digits than a float64, so without a tolerance they are compared as they are.
            wrong = x != y
        with np.errstate(invalid="ignore"):
            deviation = np.abs(q - p)
        largest = float(np.max(deviation, where=~np.isnan(deviation), initial=0.0))
        if largest > result.largest.get(label, 0.0):
            result.largest[label] = largest
        return wrong


def _decoder(side: Messages, number: int | None) -> Decoder | None:
    if number is None:
        return None
    try:
        return Decoder(described(side)[number].msgtype, side.types(number))
    except UnknownType:
        return None


def _earliest(chosen: NDArray[np.bool_], stamps: NDArray[np.int64]) -> int:
    """Return the chosen row with the smallest stamp, the first of several."""
    rows = np.flatnonzero(chosen)
    return int(rows[np.argmin(stamps[rows])])


def _shape(x: Any, y: Any, present: Any) -> str:
    """Describe a field that only one message has, or that both have in other lengths."""
    return "present" if x is None or y is None else f"{np.shape(present)[1]} elements"


def _item(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _seconds(ns: int) -> str:
    return f"{ns // SECOND}.{ns % SECOND:09d}".rstrip("0").rstrip(".")


def _show(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)


def plain(value: Any) -> Any:
    """Convert a value to plain JSON data: bytes as hex, NaN and infinity as text."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value.hex() if isinstance(value, bytes) else value
