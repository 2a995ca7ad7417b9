"""Compare two bags of different clocks or rates: signals over the time since the start, deviation and time shift."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array
from softrig_core.wire.signals import Table

from .compare import Tolerance, plain
from .errors import BagError
from .pairing import useless
from .read import BagSignals

EXACT = Tolerance()
# This topic holds the times themselves and is no signal.
CLOCK = "clock"
# The most samples on which a time shift is searched for, so that the search takes the same time for long bags.
GRID = 2000
# A larger share of stamps that go back does not come from a few late messages but from several clocks.
BACK = 0.1
# The largest shift as a share of the common span; both ends are cut by it, so much more would leave little to compare.
REACH = 0.1
# A share of a signal's time. If one bag alone has more than this, it is no late start or end of a run in real time.
ALONE = 0.1
# A shift that lowers the rms deviation by less than this is noise and is not reported.
GAIN = 0.99


@dataclass(frozen=True)
class Deviation:
    """Deviation of signal b from its reference a at times at which both are known.

    Parameters
    ----------
    samples : int
        Number of times at which they were compared: those of the slower one.
    largest, rms : float
        Of ``|b - a|``.
    at : float
        Time of the largest, s.
    peak : float
        Largest ``|a|``.
    shift : float
        Delay of b, s: shifted back by this time, b is nearest to a. 0 if no shift reduces the distance.
    shifted_rms : float
        Root mean square of the difference after that shift.
    agrees : bool
        Whether the deviation is within the tolerance everywhere.
    off : int
        Samples beyond the tolerance.
    """

    signal: str
    samples: int
    largest: float
    at: float
    rms: float
    peak: float
    shift: float
    shifted_rms: float
    agrees: bool
    off: int = 0

    def __str__(self) -> str:
        if not self.largest:
            return f"{self.signal}: equal at {self.samples} times"
        share = f" ({100.0 * self.largest / self.peak:.2g} % of the peak)" if self.peak else ""
        text = f"{self.signal}: max {self.largest:.3g}{share} at t = {self.at:.6g} s, rms {self.rms:.3g}"
        if self.off:
            text += f"; {self.off} of {self.samples} samples beyond the tolerance"
        if self.shift:
            when = "late" if self.shift > 0 else "early"
            text += f"; {abs(self.shift) * 1e3:.3g} ms {when}, rms {self.shifted_rms:.3g} without that"
        return text


@dataclass(frozen=True)
class Alignment:
    """Result of `align`.

    Parameters
    ----------
    span : tuple of 2 floats
        The time that both bags have, s since their start.
    lacking, extra : list of str
        Signals that only a has, and signals that only b has.
    notes : list of str
        Topics whose header stamps do not identify the time of their messages, and why.
    unread : list of str
        Topics and signals that were not compared, and why.
    """

    deviations: list[Deviation]
    span: tuple[float, float]
    lacking: list[str]
    extra: list[str]
    notes: list[str] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)

    @property
    def equal(self) -> bool:
        """Return whether both have the same signals, and all were compared and agree within their tolerance."""
        return not (self.lacking or self.extra or self.unread) and all(d.agrees for d in self.deviations)

    def to_json(self) -> str:
        """Return everything as JSON; NaN and infinity as text."""
        return json.dumps(plain({"equal": self.equal, **asdict(self), "span": list(self.span)}), indent=2)

    def __str__(self) -> str:
        lines = [*self.notes, f"compared over the time since the start, {self.span[0]:.6g} to {self.span[1]:.6g} s"]
        lines += [str(d) for d in self.deviations]
        lines += [f"only in A: {name}" for name in self.lacking] + [f"only in B: {name}" for name in self.extra]
        lines += [f"not compared: {text}" for text in self.unread]
        off = sum(not d.agrees for d in self.deviations)
        lines.append(
            f"{off} of {len(self.deviations)} signals beyond their tolerance"
            if off
            else f"all {'signals that were compared' if self.unread else 'signals that both have'} "
            "agree within their tolerance"
        )
        return "\n".join(lines)


def align(
    a: BagSignals,
    b: BagSignals,
    *,
    default: Tolerance = EXACT,
    tolerances: Mapping[str, Tolerance] | None = None,
    topics: Sequence[str] | None = None,
    ignore: Sequence[str] = (),
) -> Alignment:
    """Compare the signals of recording b with its reference a, whatever their clocks and rates.

    Time counts from the start: of simulated time, of a run in real time that has left its epoch in the bag, else of
    the first stamp on a topic that both have. Values are compared at the samples of the slower of the two, between the
    samples of the faster one by a straight line.

    Parameters
    ----------
    default, tolerances
        See `softrig_bags.compare.compare`.
    topics : sequence of str, optional
        Topics to compare; default all of both.
    ignore : sequence of str
        Patterns of topics left out.

    Raises
    ------
    BagError
        No such topic, no common topic with messages, or no common time.
    """
    names = dict.fromkeys([*a.recording.topics, *b.recording.topics])
    for topic in topics or ():
        if topic not in names:
            raise BagError(f"no topic {topic} to compare; there are {', '.join(names)}")
    common = [t for t in a.decodable if t in b.decodable and _wanted(t, topics, ignore)]
    tables = {t: (a.table(t), b.table(t)) for t in common}
    tables = {t: (x, y) for t, (x, y) in tables.items() if x.t.size and y.t.size}
    if not tables:
        raise BagError("no topic with messages in both bags")
    notes = [f"{t}: {reason}: bag time is used" for t, pair in tables.items() if (reason := _useless(pair))]
    axes = {t: [x.t if _useless(pair) else x.stamp for x in pair] for t, pair in tables.items()}
    starts = [_start(signals, [pair[k] for pair in axes.values()]) for k, signals in enumerate((a, b))]
    results, spans = [], []
    unread = [
        f"{t} cannot be decoded; leave it out with --ignore"
        for t in names
        if t in {*a.undecodable, *b.undecodable} and _wanted(t, topics, ignore)
    ]
    for topic, (x, y) in tables.items():
        for label in x.columns.keys() & y.columns.keys():
            name = f"{topic}/{label}"
            limit = next((v for p, v in (tolerances or {}).items() if fnmatchcase(name, p)), default)
            first, second = (
                _samples(axes[topic][k] - starts[k], table.columns[label], signals.absent[topic].get(label))
                for k, (signals, table) in enumerate(((a, x), (b, y)))
            )
            if not np.array_equal(first[0], second[0]):
                # Without any time between its messages a signal has no line from which it could be interpolated.
                if any(len(t) > 1 and not np.ptp(t) for t, _ in (first, second)):
                    unread.append(f"{name}: all its messages have one time")
                    continue
                first, second = (_single(*samples) for samples in (first, second))
            span = max(first[0][0], second[0][0]), min(first[0][-1], second[0][-1])
            if span[0] <= span[1]:
                results.append(_deviation(name, first, second, span, limit))
                spans.append(span)
                length = max(float(np.ptp(t)) for t, _ in (first, second))
                if (alone := length - (span[1] - span[0])) > ALONE * length:
                    unread.append(f"{name}: {alone:.3g} of {length:.3g} s, which only one of the bags has")
            else:
                unread.append(f"{name}: A and B have no time in common")
    if not results:
        raise BagError("; ".join(["the bags have no time in common", *unread]))
    names_a, names_b = (_names(s, topics, ignore) for s in (a, b))
    return Alignment(
        sorted(results, key=lambda d: d.signal),
        (min(s[0] for s in spans), max(s[1] for s in spans)),
        [n for n in names_a if n not in names_b],
        [n for n in names_b if n not in names_a],
        notes,
        unread,
    )


def _wanted(topic: str, topics: Sequence[str] | None, ignore: Sequence[str]) -> bool:
    chosen = topics is None or topic in topics
    return chosen and topic.strip("/") != CLOCK and not any(fnmatchcase(topic, p) for p in ignore)


def _names(signals: BagSignals, topics: Sequence[str] | None, ignore: Sequence[str]) -> list[str]:
    return [f"{t}/{k}" for t in signals.decodable if _wanted(t, topics, ignore) for k in signals.table(t).columns]


def _useless(pair: tuple[Table, Table]) -> str:
    """Return why the header stamps of a topic do not date its messages; an empty text if they do."""
    for name, table in zip("AB", pair, strict=True):
        stamp = table.stamp
        steps = np.diff(stamp)
        if reason := useless(stamp):
            return f"{reason} in {name}"
        if (back := int(np.sum(steps < 0))) > BACK * len(steps):
            return f"header stamps go back {back} times in {name}, as those of several clocks do"
        order = np.argsort(stamp, kind="stable")
        same = np.flatnonzero(np.diff(stamp[order]) == 0)
        i, j = order[same], order[same + 1]
        unlike = [~((x[i] == x[j]) | (np.isnan(x[i]) & np.isnan(x[j]))) for x in table.columns.values()]
        if unlike and (n := int(np.sum(np.any(unlike, axis=0)))) > BACK * len(steps) and not _is_mixed(table, i, j):
            return f"{n} messages in {name} have the header stamp of another one, but other values"
    return ""


def _is_mixed(table: Table, i: NDArray[np.intp], j: NDArray[np.intp]) -> bool:
    """Return whether messages of equal stamps have no channel in common: those of several publishers."""
    return all((np.isnan(x[i]) | np.isnan(x[j])).all() for x in table.columns.values())


def _start(signals: BagSignals, axes: Sequence[Array]) -> float:
    """Time of the start on the bag's own time axis, s."""
    return 0.0 if signals.from_start else min(float(axis[0]) for axis in axes)


def _samples(t: Array, x: Array, absent: NDArray[np.bool_] | None) -> tuple[Array, Array]:
    if absent is not None:
        t, x = t[~absent], x[~absent]
    # Stamps of several publishers may go back, and interpolation needs times that ascend.
    order = np.argsort(t, kind="stable")
    return t[order], x[order]


def _single(t: Array, x: Array) -> tuple[Array, Array]:
    """Return the first sample of each time: a straight line needs one value at a time."""
    t, first = np.unique(t, return_index=True)
    return t, x[first]


def _deviation(
    name: str, a: tuple[Array, Array], b: tuple[Array, Array], span: tuple[float, float], limit: Tolerance
) -> Deviation:
    # Times in s are rounded, so a sample at an end of the span counts as inside within 1 ns.
    common = [(t[k], x[k]) for t, x in (a, b) if (k := (t >= span[0] - 1e-9) & (t <= span[1] + 1e-9)) is not None]
    slow = 0 if common[0][0].size <= common[1][0].size else 1
    times = common[slow][0]
    if np.array_equal(common[0][0], common[1][0]):
        # With equal times each sample has its partner; interpolation would need one value a time.
        x, y = common[0][1], common[1][1]
    else:
        x, y = (np.interp(times, *pair) for pair in (a, b))
    with np.errstate(invalid="ignore"):
        error = np.abs(y - x)
    known = np.isfinite(error)
    off = int(np.sum(limit.exceeded(x, y)))
    if not known.any():
        return Deviation(name, times.size, math.nan, math.nan, math.nan, math.nan, 0.0, math.nan, not off, off)
    worst = int(np.argmax(np.where(known, error, -1.0)))
    rms = _rms(error[known])
    shift, left = _shift(a, b, span) if rms and known.all() else (0.0, rms)
    peak = float(np.max(np.abs(x[known])))
    return Deviation(name, times.size, float(error[worst]), float(times[worst]), rms, peak, shift, left, not off, off)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _shift(a: tuple[Array, Array], b: tuple[Array, Array], span: tuple[float, float]) -> tuple[float, float]:
    """The delay of b, and the rms deviation after the delay is removed."""
    length = span[1] - span[0]
    reach = REACH * length
    times = np.linspace(span[0] + reach, span[1] - reach, min(GRID, 4 * max(a[0].size, b[0].size)))
    x = np.interp(times, *a)
    # A constant signal fits at each shift, so none can be found.
    if length <= 0.0 or not np.ptp(x):
        return 0.0, _rms(np.interp(times, *b) - x)

    def off(shift: float) -> float:
        return _rms(np.interp(times + shift, *b) - x)

    lags = np.linspace(-reach, reach, 401)
    best, step = 0.0, reach
    # The deviation may have several minima, so each round is a whole grid, a hundred times finer around the best so
    # far.
    for _ in range(4):
        best = min((best + step * lag / reach for lag in lags), key=off)
        step /= 100.0
    before = off(0.0)
    return (float(best), off(best)) if off(best) < GAIN * before else (0.0, before)
