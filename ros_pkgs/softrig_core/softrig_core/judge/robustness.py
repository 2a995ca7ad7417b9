"""Robustness: the distance of a formula from violation on a record, as far as it is known.

Two things may be unknown: what comes after the record, and what arithmetic does not define (NaN, a division by zero).
So a value is four numbers: the least and the greatest over all continuations of the record, each as the least and the
greatest over all undefined values. An unbounded operator is evaluated up to the end of the record; of the part that is
open there, it uses what is decided.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from ..timebase import SECOND
from ..wire.long import LongArray, elementwise, is_long
from .arithmetic import Samples, Tree, arithmetic, sure
from .formula import EDGES, FUTURE, PAST, Condition, horizon, nodes, variables
from .one_pass import Extreme, OnePass

Pick = np.ufunc
INF = float("inf")


class NotJudged(ValueError):
    """The record does not decide the formula, or its arithmetic is undefined."""


class Margin(NamedTuple):
    """Result of a formula over a record.

    Parameters
    ----------
    value : float
        Robustness: the distance from violation; negative if violated; infinite if only conditions decide. If it is only
        known within bounds, the decisive bound.
    at : float
        Instant, s, of the comparison that decides it.
    violated : tuple of (float, float)
        Intervals in which an ``always`` formula does not hold, s; for other formulas, the deciding instant.
    bounds : tuple of (float, float)
        Least and greatest possible value; equal if the value is known.
    open_from : float
        Instant, s, from which on the record does not decide the whole formula; infinite if it decides all of it.
    """

    value: float
    at: float
    violated: tuple[tuple[float, float], ...]
    bounds: tuple[float, float]
    open_from: float


COMPARED: Mapping[str, Callable[[Array, Array], Array]] = {
    "Less": lambda a, b: b - a,
    "LessEqual": lambda a, b: b - a,
    "Greater": lambda a, b: a - b,
    "GreaterEqual": lambda a, b: a - b,
    "Equal": lambda a, b: -np.abs(a - b),
    "NotEqual": lambda a, b: np.abs(a - b),
}


def opposite(values: Array) -> Array:
    """Return the negated bounds; the lower becomes the upper one."""
    return _each(np.negative, values[::-1, ::-1])


@elementwise
def _each(function: Callable[..., Array], *values: Array) -> Array:
    """Apply a function to the four bounds, only once if they are known to be equal."""
    if any(any(v.strides[:2]) for v in values):
        return function(*values)
    return np.broadcast_to(function(*(v[0, 0] for v in values)), values[0].shape)


def _joined(kind: str, a: Array, b: Array) -> Array:
    if kind == "And":
        return _each(np.minimum, a, b)
    return _each(np.maximum, opposite(a) if kind == "Implies" else a, b)


@elementwise
def _uncertain(values: Array, *late: NDArray[Any]) -> Array:
    """Return the four bounds of a comparison with values that may be undefined or signals that have not arrived yet."""
    undefined = np.isnan(values)
    result = np.array((np.where(undefined, -INF, values), np.where(undefined, INF, values)))
    for missing in late:
        # A comparison with a signal that has not arrived yet is false, not undefined, so that the formula is judged
        # all the same.
        result[:, missing] = -INF
    return np.array((result, result))


@elementwise
def _opened(values: Array, over: NDArray[Any], bound: int, none: float) -> Array:
    """Set one of the bounds to infinity where a window extends beyond the record."""
    result = np.array(values)
    result[bound][:, over] = none
    return result


def extremes(values: Array, first: NDArray[Any], last: NDArray[Any], pick: Pick, none: float) -> Array:
    """Return the least or greatest of ``values[..., first..last]`` for each pair of them, `none` if that is empty.

    Parameters
    ----------
    values : array, shape (2, 2, n)
    first, last : array of int, shape (m,)
        Between 0 and n - 1 where first <= last.
    pick : ufunc
        ``np.minimum`` or ``np.maximum``.
    """
    # A formula is asked at the first instant only, so its outermost operator has one window, which needs no table.
    if len(first) == 1:
        window = values[..., first[0] : last[0] + 1]
        if not any(values.strides[:2]):
            return np.full((*values.shape[:2], 1), pick.reduce(window[0, 0], initial=none))
        return pick.reduce(window, axis=-1, keepdims=True, initial=none)
    if is_long(first):
        return cast(Array, LongArray(len(first), partial(_extremes, values, first, last, pick, none)))
    count = last - first + 1
    result = np.full((*values.shape[:-1], len(first)), none)
    # values[..., j] covers span samples from j on. Doubling span needs n log n steps for windows of any length.
    span = 1
    longest = count.max(initial=0)
    while longest >= span:
        rows = np.flatnonzero((count >= span) & (count < 2 * span))
        result[..., rows] = pick(values[..., first[rows]], values[..., last[rows] - span + 1])
        values = pick(values[..., :-span], values[..., span:])
        span *= 2
    return result


def _extremes(values: Array, first: Any, last: Any, pick: Pick, none: float, a: int, b: int) -> Array:
    """Return the `extremes` of the windows a to b - 1, reading only the values that these windows need."""
    begins, ends = np.asarray(first[a:b]), np.asarray(last[a:b])
    low = int(np.min(begins, initial=len(first)))
    part = np.asarray(values[..., low : max(low, int(np.max(ends, initial=-1)) + 1)])
    # `extremes` would take a single window for that of a whole formula, so one window is asked for twice.
    if b - a == 1:
        return extremes(part, np.repeat(begins - low, 2), np.repeat(ends - low, 2), pick, none)[..., :1]
    return extremes(part, begins - low, ends - low, pick, none)


def decided(extreme: Extreme, times: Array) -> Margin:
    """Return the margin of a formula that is decided by an extreme of what it compares."""
    value, t = extreme.value, float(times[extreme.at] / SECOND)
    spans = tuple((float(times[a] / SECOND), float(times[b] / SECOND)) for a, b in extreme.spans)
    return Margin(value, t, spans or (((t, t),) if value < 0.0 else ()), (value, value), INF)


class Record:
    """Samples of a run on one grid of times, as a formula needs them.

    Parameters
    ----------
    times : array, shape (n,)
        Whole ns, ascending.
    samples : mapping of str to array, shape (n,)
        Numbers.
    truths : mapping of str to array, shape (n,), optional
        Of conditions, as returned by `truth`.
    late : mapping of str to array of bool, shape (n,), optional
        Where a variable has no value yet: comparisons with it are false there.
    after : float
        The first instant that is not recorded, ns; any after the last time when absent.
    ended : bool
        Whether the record is complete: unbounded operators then end with it.
    """

    def __init__(
        self,
        times: Array,
        samples: Samples,
        *,
        truths: Samples | None = None,
        late: Mapping[str, NDArray[np.bool_]] | None = None,
        after: float | None = None,
        ended: bool = True,
    ) -> None:
        self.times = times
        self.after = float(np.nextafter(times[-1], INF)) if after is None else after
        self.ended = ended
        self._samples, self._truths, self._late = samples, truths or {}, late or {}
        self._measured_trees: dict[int, tuple[Tree, Array]] = {}

    def margin(self, tree: Tree, native: OnePass | None = None) -> Margin:
        """Evaluate a formula at the first instant.

        Parameters
        ----------
        native : OnePass, optional
            The formula's, where it has one: the same result, sooner.

        Raises
        ------
        NotJudged
            The record does not decide the formula; the message names what is undefined, or where the record ends.
        """
        if native is not None and self.ended and not self._late and not is_long(self.times):
            window = self.window(tree)
            names, constants = {**self._samples, **self._truths}, native.constants(self._samples)
            if window is not None and (extreme := native(names, constants, *window)) is not None:
                return decided(extreme, self.times)
        result = self._at(tree, 0)
        least, greatest = float(result[0, 0]), float(result[1, 1])
        # What is unknown could still turn the verdict.
        if least < 0.0 <= greatest:
            raise NotJudged(self._why(tree, result))
        value, bound = (greatest, (1, 1)) if greatest < 0.0 else (least, (0, 0))
        t = float(self.times[self._decides(tree, *bound, 0)] / SECOND)
        violated = self._violated(tree) if value < 0.0 else ()
        known = least == greatest
        open_from = self._open_from(tree) if known or not self._undefined(tree).size else self._undefined(tree)[0]
        if not known:
            open_from = min(open_from, self.times[-1])
        return Margin(value, t, violated or (((t, t),) if value < 0.0 else ()), (least, greatest), open_from / SECOND)

    def window(self, tree: Tree) -> tuple[int, int] | None:
        """Return the first and the last index of the window of a formula; None if it extends beyond the record."""
        ((kind, body),) = tree.items()
        first, last, over = (int(each[0]) for each in self._window(kind, *limits(body), self.times[:1]))
        return None if over else (first, last)

    def bounds(self, tree: Tree) -> Array:
        """Return a formula's robustness at each instant.

        Returns
        -------
        array, shape (2, 2, n)
            By least and greatest value over all continuations of the record, and over undefined values.
        """
        if id(tree) not in self._measured_trees:
            ((kind, body),) = tree.items()
            # The tree is stored too: while it lives, no other tree can have its id.
            self._measured_trees[id(tree)] = tree, self._measured(kind, body)
        return self._measured_trees[id(tree)][1]

    def _measured(self, kind: str, body: Any) -> Array:
        if kind == "Predicate":
            return self._compared(body)
        if kind == "Not":
            return opposite(self.bounds(body))
        if kind in ("And", "Or", "Implies"):
            return _joined(kind, self.bounds(body[0]), self.bounds(body[1]))
        low, high = limits(body)
        if kind == "Since":
            held, then = (self.bounds(part)[..., ::-1] for part in body[1:])
            return self._until(held, then, low, high, past=True)[..., ::-1]
        if kind == "Until":
            return self._until(self.bounds(body[1]), self.bounds(body[2]), low, high)
        return self._over_time(kind, body, self.times)

    def _at(self, tree: Tree, k: int) -> Array:
        """Return a formula's robustness at one instant, shape (2, 2); other instants are computed only where it depends
        on them.
        """
        ((kind, body),) = tree.items()
        if kind == "Not":
            return opposite(self._at(body, k))
        if kind in ("And", "Or", "Implies"):
            return _joined(kind, self._at(body[0], k), self._at(body[1], k))
        if kind in (*FUTURE, *PAST) and id(tree) not in self._measured_trees:
            return self._over_time(kind, body, np.asarray(self.times[k : k + 1]))[..., 0]
        return self.bounds(tree)[..., k]

    def _over_time(self, kind: str, body: Any, times: Array) -> Array:
        """Return the robustness of operators over an interval (always, eventually, and their past forms) at
        some instants.
        """
        low, high = limits(body)
        first, last, over = self._window(kind, low, high, times)
        least = kind in ("Always", "Historically")
        inner = self.bounds(body[1])
        # An operator without end would stay open for ever; at the end of the record it takes what is decided of it.
        if kind in FUTURE and high == INF and self.ended:
            inner = np.broadcast_to(inner[1:] if least else inner[:1], inner.shape)
        pick, none = (np.minimum, INF) if least else (np.maximum, -INF)
        result = extremes(inner, first, last, pick, none)
        if over.any():
            result = _opened(result, over, 0 if least else 1, -none)
        return result

    def _compared(self, body: Any) -> Array:
        values = self._truths.get(body["lhs"].get("Variable", ""))
        if values is None:
            values = self._distance(body)
        late = [late for name in variables(body) if (late := self._late.get(name)) is not None and late.any()]
        if not late and not np.isnan(values).any():
            return np.broadcast_to(values, (2, 2, len(values)))
        return _uncertain(values, *late)

    def _distance(self, body: Any) -> Array:
        compare, sides = COMPARED[body["op"]], (body["lhs"], body["rhs"])
        with np.errstate(all="ignore"):
            result = compare(*(arithmetic(side, self._samples) for side in sides))
        return np.broadcast_to(sure(result), (len(self.times),))

    def _window(
        self, kind: str, low: float, high: float, times: Array
    ) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Return first and last index of the window of each of some instants, and whether it extends beyond the
        record.
        """
        known = self.times
        if kind in PAST:
            first = np.searchsorted(known, times - high)
            return first, np.searchsorted(known, times - low, side="right") - 1, np.broadcast_to(np.False_, len(times))
        first = np.searchsorted(known, times + low)
        last = np.searchsorted(known, times + high, side="right") - 1
        # A window without end is cut at the end of a complete record; it is open only if it begins beyond it.
        over = first >= len(known) if high == INF and self.ended else times + high >= self.after
        return first, last, over

    def _until(self, held: Array, then: Array, low: float, high: float, *, past: bool = False) -> Array:
        """Return the robustness of `held` until `then`; for the past with time reversed, where nothing precedes
        the record.
        """
        n = len(self.times)
        held, then = np.asarray(held), np.asarray(then)
        times = np.asarray(self.times[-1] - self.times[::-1] if past else self.times)
        first = np.searchsorted(times, times + low)
        result = extremes(held, np.arange(n), first - 1, np.minimum, INF)
        for arrived, lost in np.ndindex(2, 2):
            # After the last sample anything may come; before the first one there was nothing.
            start = INF if arrived and not past else -INF
            later = np.array([*_scan(held[arrived, lost].tolist(), then[arrived, lost].tolist(), start), start])
            result[arrived, lost] = np.minimum(result[arrived, lost], later[first])
        # As in `_over_time`, an operator without end takes what is decided within a complete record.
        if high == INF and self.ended and not past:
            result[1] = np.where(first < n, result[0], result[1])
        if high != INF:
            # "Until within a window" is "until at any time from its begin on" and "at some time within it" together.
            last = np.searchsorted(times, times + high, side="right") - 1
            within = extremes(then, first, last, np.maximum, -INF)
            if not past:
                within[1][:, times + high >= self.after] = INF
            result = np.minimum(result, within)
        return result

    def _why(self, tree: Tree, values: Array) -> str:
        undefined = self._undefined(tree)
        if (values[:, 0] != values[:, 1]).any() and undefined.size:
            first, end = undefined[0], self.times[-1]
            on = undefined.size > 1 and undefined.size == np.count_nonzero(self.times >= first)
            when = f"from t = {first / SECOND:.6g} s on" if on or first == end else f"at t = {first / SECOND:.6g} s"
            return f"not judged: undefined {when} (no number, a division by zero or a function beyond its domain)"
        return (
            f"not judged: the record ends at {self.times[-1] / SECOND:.6g} s, the requirement's last window at "
            f"{horizon(tree) / SECOND:.6g} s"
        )

    def _undefined(self, tree: Tree) -> Array:
        """Instants at which a comparison of the formula is undefined, ns."""
        lost = np.broadcast_to(np.False_, len(self.times))
        for kind, body in nodes(tree):
            if kind == "Predicate":
                result = self._compared(body)
                lost = lost | (result[0, 0] != result[0, 1])
        return self.times[lost]

    def _outermost(self, tree: Tree) -> Iterator[tuple[str, Any]]:
        ((kind, body),) = tree.items()
        if kind in ("And", "Or", "Implies", "Not"):
            for part in body if isinstance(body, list) else [body]:
                yield from self._outermost(part)
        else:
            yield kind, body

    def _open_from(self, tree: Tree) -> float:
        """Return the first instant, ns, at which the operand of an unbounded operator is undecided."""
        result = INF
        for kind, body in self._outermost(tree):
            if kind in FUTURE and limits(body)[1] == INF:
                inner = self.bounds(body[1])
                # Strides of 0 mean that all four numbers are one, so each instant is decided.
                if not any(inner.strides[:2]):
                    continue
                still = (inner[0, 0] < 0.0) & (inner[1, 1] >= 0.0) & (self.times >= self.times[0] + limits(body)[0])
                result = min(result, float(self.times[np.argmax(still)]) if still.any() else INF)
        return result

    def _decides(self, tree: Tree, arrived: int, lost: int, k: int) -> int:
        """Return the instant whose comparison determines a bound of a formula at instant `k`."""
        ((kind, body),) = tree.items()
        if kind == "Not":
            return self._decides(body, 1 - arrived, 1 - lost, k)
        if kind in ("And", "Or", "Implies"):
            sides = [
                (body[0], 1 - arrived, 1 - lost) if kind == "Implies" else (body[0], arrived, lost),
                (body[1], arrived, lost),
            ]
            a, b = (float(self._at(part, k)[c, n]) for part, c, n in sides)
            first = a <= b if kind == "And" else (-a if kind == "Implies" else a) >= b
            return self._decides(*sides[0 if first else 1], k)
        if kind in (*FUTURE, *PAST):
            low, high = limits(body)
            first_, last, _ = (int(each[0]) for each in self._window(kind, low, high, self.times[k : k + 1]))
            if last < first_:
                return k
            least = kind in ("Always", "Historically")
            arrived = (1 if least else 0) if kind in FUTURE and high == INF and self.ended else arrived
            values = self.bounds(body[1])[arrived, lost, first_ : last + 1]
            return self._decides(
                body[1], arrived, lost, first_ + int(np.argmin(values) if least else np.argmax(values))
            )
        # A comparison decides at its own instant; for until and since it is the instant at which they are asked.
        return k

    def _violated(self, tree: Tree) -> tuple[tuple[float, float], ...]:
        ((kind, body),) = tree.items()
        if kind == "And":
            return tuple(sorted(span for part in body for span in self._violated(part)))
        if kind != "Always":
            return ()
        low, high = limits(body)
        within = (self.times >= self.times[0] + low) & (self.times <= self.times[0] + high)
        bad = (self.bounds(body[1])[1, 1] < 0.0) & within
        # The zeros at both ends close a violation that begins or ends with the record.
        edges = np.flatnonzero(np.diff(np.concatenate(([0], bad.astype(np.int8), [0]))))
        first, last = (self.times[edges[::2]] / SECOND).tolist(), (self.times[edges[1::2] - 1] / SECOND).tolist()
        return tuple(zip(first, last, strict=True))


def truth(condition: Condition, now: Array | float, before: Array | float) -> Array:
    """Return infinity if a condition holds, else minus infinity (it decides without a distance); NaN: undefined.

    Parameters
    ----------
    now, before : array or float
        Its signal at each instant, and at the one before.
    """
    edge = EDGES.get(condition.edge)
    lost = np.isnan(now) | (np.isnan(before) if edge else False)
    # A condition has no distance, so it counts as infinitely far from changing.
    return np.where(lost, np.nan, np.where(edge(now, before) if edge else now > 0.5, INF, -INF))


def limits(body: Any) -> tuple[float, float]:
    """Return the interval of a temporal operator, ns; without end to infinity."""
    low, high = body[0]["lower"], body[0]["upper"]
    return low, INF if high is None else high


def _scan(held: list[float], then: list[float], value: float) -> list[float]:
    results = []
    for x, y in zip(reversed(held), reversed(then), strict=True):
        value = max(y, min(x, value))
        results.append(value)
    return results[::-1]
