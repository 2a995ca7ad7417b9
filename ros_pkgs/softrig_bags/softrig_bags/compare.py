"""Compare two bags topic by topic, messages paired by stamp, numbers within tolerances or bit for bit."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys.store import Typestore
from softrig_core import SECOND, Signals
from softrig_core.wire.cdr import parse
from softrig_core.wire.recording import Topic
from softrig_core.wire.types import TYPES

from .errors import BagError
from .read import BagSignals, deserialised, flatten
from .stamps import is_stamped, stamp
from .topics import BagTopic


@dataclass(frozen=True)
class Tolerance:
    """A number b agrees with its reference a when ``|b - a| <= max(absolute, relative |a|)``; NaN agrees with NaN."""

    absolute: float = 0.0
    relative: float = 0.0

    def exceeded(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Where two arrays of equal shape disagree."""
        with np.errstate(invalid="ignore", over="ignore"):
            near = np.abs(b - a) <= np.maximum(self.absolute, self.relative * np.abs(a))
        return ~(near | (a == b) | (np.isnan(a) & np.isnan(b)))


@dataclass(frozen=True)
class Difference:
    """Where two bags first disagree: stamp in ns, topic, field and both values."""

    stamp: int
    topic: str
    field: str
    a: Any
    b: Any

    def __str__(self) -> str:
        return f"t = {_seconds(self.stamp)} s, {self.topic} {self.field}: {_show(self.a)} against {_show(self.b)}"


@dataclass
class TopicComparison:
    """What was found on one topic.

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
        """Whether nothing is missing, extra or different."""
        return not (self.missing or self.extra or self.differing)

    def note(self, stamp: int, name: str, a: Any, b: Any) -> None:
        """Keep a difference if it is the earliest."""
        if self.first is None or stamp < self.first.stamp:
            self.first = Difference(stamp, self.topic, name, a, b)


@dataclass
class Comparison:
    """Result of `compare`."""

    topics: list[TopicComparison]

    @property
    def equal(self) -> bool:
        """Whether the bags agree."""
        return all(t.equal for t in self.topics)

    @property
    def first(self) -> Difference | None:
        """The earliest difference of all topics."""
        found = [t.first for t in self.topics if t.first is not None]
        return min(found, key=lambda d: d.stamp, default=None)

    def to_json(self) -> str:
        """Give everything as JSON; NaN and infinity as text."""
        content = {
            "equal": self.equal,
            "first": self.first and asdict(self.first),
            "topics": [{"equal": t.equal, **asdict(t)} for t in self.topics],
        }
        return json.dumps(plain(content), indent=2)

    def __str__(self) -> str:
        lines = []
        for t in self.topics:
            counts = str(t.count_a) if t.count_a == t.count_b else f"{t.count_a} against {t.count_b}"
            faults = [
                f"{n} {what}" for n, what in ((t.missing, "missing"), (t.extra, "extra"), (t.differing, "differ")) if n
            ]
            lines.append(f"{t.topic}: {counts} messages, {', '.join(faults) or 'equal'}")
            lines += [f"    {name}: largest deviation {value:.3g}" for name, value in t.largest.items()]
        lines.append(f"first difference: {self.first}" if self.first else "the bags agree")
        return "\n".join(lines)


def compare(
    a: Signals,
    b: Signals,
    *,
    default: Tolerance = Tolerance(),
    tolerances: Mapping[str, Tolerance] | None = None,
    bitwise: bool = False,
    topics: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
) -> Comparison:
    """Compare recording b with its reference a.

    Messages are paired by header stamp, without a header by bag time, equal stamps by order.

    Parameters
    ----------
    a, b : Signals
        From `softrig_bags.read.signals`, or made of a recording in memory.
    default : Tolerance
        Of every number that no pattern covers; exact if not given.
    tolerances : mapping of str to Tolerance
        By pattern (``plant/*``, ``*/velocity``) of the signal name ``topic/channel/field``; the first that fits counts.
    bitwise : bool
        Demand equal bytes and equal bag times instead.
    topics : sequence of str, optional
        Topics to compare; default all of both.
    ignore : sequence of str
        Patterns of topics left out.
    """
    topics_a, topics_b = a.recording.topics, b.recording.topics
    for name in topics or ():
        if name not in topics_a and name not in topics_b:
            raise BagError(f"no topic {name} to compare; there are {', '.join({**topics_a, **topics_b})}")
    chosen = dict.fromkeys([*topics_a, *topics_b]) if topics is None else topics
    names = [n for n in chosen if not any(fnmatchcase(n, p) for p in ignore)]
    results = []
    for name in names:
        one, two = topics_a.get(name), topics_b.get(name)
        if one is not None and two is not None and one.msgtype != two.msgtype:
            result = TopicComparison(name, one.msgtype, len(one.data), len(two.data), len(one.data), len(two.data))
            result.note(min([*one.times[:1], *two.times[:1]], default=0), "type", one.msgtype, two.msgtype)
        else:
            result = _Pairing(name, one, two, a, b).compare(a, b, default, tolerances or {}, bitwise)
        results.append(result)
    return Comparison(results)


class _Pairing:
    """The messages of one topic in both bags, paired."""

    def __init__(self, name: str, one: Topic | None, two: Topic | None, a: Signals, b: Signals) -> None:
        known = one or two
        assert known is not None
        empty = Topic(name, known.msgtype)
        self.one, self.two = one or empty, two or empty
        self.result = TopicComparison(name, known.msgtype, len(self.one.data), len(self.two.data))
        store = _store(a, known.msgtype) or _store(b, known.msgtype)
        stamped = is_stamped(BagTopic.known(name, known.msgtype), store)
        keys_a, keys_b = _keys(self.one, stamped), _keys(self.two, stamped)
        if keys_a == keys_b:
            self.rows_a = self.rows_b = np.arange(len(keys_a))
        else:
            found_b = {key: i for i, key in enumerate(keys_b)}
            pairs = [(i, found_b.pop(key)) for i, key in enumerate(keys_a) if key in found_b]
            self.rows_a, self.rows_b = np.array(pairs, dtype=int).reshape(-1, 2).T
            paired = {keys_a[i] for i, _ in pairs}
            absent = [key for key in keys_a if key not in paired]
            self._lacking(absent, list(found_b), "message")
        self.times = [keys_a[i][0] for i in self.rows_a]

    def _lacking(self, absent: list[tuple[int, int]], extra: list[tuple[int, int]], what: str) -> None:
        self.result.missing, self.result.extra = len(absent), len(extra)
        if absent:
            self.result.note(min(absent)[0], what, "present", "missing")
        if extra:
            self.result.note(min(extra)[0], what, "missing", "present")

    def compare(
        self, a: Signals, b: Signals, default: Tolerance, tolerances: Mapping[str, Tolerance], bitwise: bool
    ) -> TopicComparison:
        result = self.result
        data_a, data_b = self.one.data, self.two.data
        unequal = np.array([data_a[i] != data_b[j] for i, j in zip(self.rows_a, self.rows_b, strict=True)], dtype=bool)
        bad = np.zeros(len(self.times), dtype=bool)
        if bitwise:
            default, tolerances = Tolerance(), {}
            for k, (i, j) in enumerate(zip(self.rows_a, self.rows_b, strict=True)):
                if self.one.times[i] != self.two.times[j]:
                    bad[k] = True
                    result.note(self.times[k], "bag time", self.one.times[i], self.two.times[j])
        rows = np.flatnonzero(unequal)
        if rows.size:
            bad[rows] |= self._values(a, b, rows, default, tolerances, bitwise)
        result.differing = int(bad.sum())
        return result

    def _values(
        self,
        a: Signals,
        b: Signals,
        rows: NDArray[np.intp],
        default: Tolerance,
        tolerances: Mapping[str, Tolerance],
        bitwise: bool,
    ) -> NDArray[np.bool_]:
        """Compare the messages whose bytes differ, field by field; give which of them disagree."""
        result = self.result
        bad = np.zeros(len(rows), dtype=bool)
        fields_a = _fields(a, self.one, self.rows_a[rows])
        fields_b = _fields(b, self.two, self.rows_b[rows])
        for label in dict.fromkeys([*fields_a, *fields_b]):
            if label not in fields_a or label not in fields_b:
                bad[:] = True
                here = "present" if label in fields_a else "missing"
                result.note(self.times[rows[0]], label, here, "missing" if label in fields_a else "present")
                continue
            x, y = fields_a[label], fields_b[label]
            if isinstance(x, np.ndarray) and isinstance(y, np.ndarray):
                name = f"{result.topic}/{label}"
                tolerance = next((v for p, v in tolerances.items() if fnmatchcase(name, p)), default)
                wrong = tolerance.exceeded(x, y)
                with np.errstate(invalid="ignore"):
                    deviation = np.abs(y - x)
                largest = float(np.max(deviation, where=~np.isnan(deviation), initial=0.0))
                if largest > 0:
                    result.largest[label] = largest
            else:
                wrong = np.array([p != q for p, q in zip(x, y, strict=True)])
            if wrong.any():
                k = int(np.argmax(wrong))
                result.note(self.times[rows[k]], label, _item(x[k]), _item(y[k]))
                bad |= wrong
        if bitwise and not bad.all():
            k = int(np.argmin(bad))
            one, two = self.one.data[self.rows_a[rows[k]]], self.two.data[self.rows_b[rows[k]]]
            at = next((i for i, (p, q) in enumerate(zip(one, two, strict=False)) if p != q), min(len(one), len(two)))
            result.note(self.times[rows[k]], f"byte {at}", one[at : at + 8].hex(), two[at : at + 8].hex())
            bad[:] = True
        return bad


def _keys(topic: Topic, stamped: bool) -> list[tuple[int, int]]:
    """Give (stamp, how many messages before had the same) of each message."""
    times = [stamp(d) for d in topic.data] if stamped else topic.times
    if len(set(times)) == len(times):
        return [(t, 0) for t in times]
    seen: dict[int, int] = defaultdict(int)
    keys = []
    for t in times:
        keys.append((t, seen[t]))
        seen[t] += 1
    return keys


def _fields(signals: Signals, topic: Topic, rows: NDArray[np.intp]) -> dict[str, Any]:
    """Give chosen messages as columns: arrays for numbers, lists for names and texts, bytes if nothing is known."""
    columns: dict[str, Any]
    if topic.msgtype in TYPES:
        with suppress(ValueError):  # of a known type, but used in another way than the suite does
            heads = [parse(topic.msgtype, topic.data[i]) for i in rows]
            columns = {k: v[rows] for k, v in signals.table(topic.name).columns.items()}
            columns["frame_id"] = [m.frame_id for m in heads]
            columns["name"] = [", ".join(m.names) for m in heads]
            if TYPES[topic.msgtype].timed:  # no signal, and the end of the message
                ends = [stamp(topic.data[i], len(topic.data[i]) - 8) for i in rows]
                columns["time_from_start"] = np.array(ends) / SECOND
            return columns
    store = _store(signals, topic.msgtype)
    if store is None:
        return {"bytes": [topic.data[i].hex() for i in rows]}
    messages = [dict(flatten(deserialised(store, topic, i))) for i in rows]
    columns = {}
    for label in dict.fromkeys(label for message in messages for label in message):
        if label in ("header/stamp/sec", "header/stamp/nanosec"):
            continue
        values = [message.get(label, math.nan) for message in messages]
        texts = any(isinstance(v, str | bytes) for v in values)
        columns[label] = values if texts else np.array(values, dtype=np.float64)
    return columns


def _store(signals: Signals, msgtype: str) -> Typestore | None:
    return signals.store(msgtype) if isinstance(signals, BagSignals) else None


def _item(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _seconds(ns: int) -> str:
    return f"{ns // SECOND}.{ns % SECOND:09d}".rstrip("0").rstrip(".")


def _show(value: Any) -> str:
    return repr(value) if isinstance(value, float) else str(value)


def plain(value: Any) -> Any:
    """Give what JSON can say: bytes as hex, NaN and infinity as text."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list):
        return [plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value.hex() if isinstance(value, bytes) else value
