"""Bounds of a formula's robustness at the first instant, while its record grows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..arrays import Array
from .arithmetic import Tree
from .formula import FUTURE, PAST
from .robustness import INF, Record, limits, opposite

UNKNOWN = np.array(((-INF, -INF), (INF, INF)))


class Opened(NamedTuple):
    """The state of an operator at the first instant: its certain result, and the instants that are still undecided."""

    sure: tuple[Array, Array]
    """Its value so far, and how long `until` has held; nobody writes into them."""

    value: Array = UNKNOWN
    """(2, 2) bounds of the value."""

    over: bool = False
    """Whether nothing that comes can change it."""

    next: float = 0.0
    """Instants before this one are in `sure`, ns."""

    times: Array = np.empty(0)
    columns: tuple[Mapping[str, NDArray[Any]], ...] = ({}, {}, {})
    """Samples, truths and late at each of these; nobody writes into them."""


class Live:
    """A formula on a record that grows by one instant at a time.

    For an operator at the first instant it stores the decided part and the instants that are still open (`Opened`), so
    the cost of a tick depends on the lengths of its windows. An unbounded operator below it leaves every instant open,
    so all of them are stored.

    Parameters
    ----------
    tree : plain data
    """

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._parts: list[_Part] = []
        self._places: dict[int, int] = {}
        self._grow(tree)

    def first(self) -> tuple[Opened, ...]:
        """Return the state before the first instant."""
        return tuple(part.first() for part in self._parts)

    def push(
        self,
        x: tuple[Opened, ...],
        t: float,
        samples: Mapping[str, float],
        truths: Mapping[str, float],
        late: Mapping[str, bool],
    ) -> tuple[Opened, ...]:
        """Add an instant.

        Parameters
        ----------
        t : float
            Whole ns, ascending from 0.
        samples, truths, late : mapping
            See `softrig_core.judge.robustness.Record`.
        """
        return tuple(part.push(opened, t, samples, truths, late) for part, opened in zip(self._parts, x, strict=True))

    def bounds(self, x: tuple[Opened, ...]) -> tuple[float, float]:
        """Return the least and greatest values that the margin may still reach."""
        result = self._now(self._tree, x)
        return float(result[0, 0]), float(result[1, 1])

    def decided(self, x: tuple[Opened, ...]) -> bool:
        """Return whether no later message can change the bounds."""
        result = self._now(self._tree, x)
        return all(opened.over for opened in x) or bool((result[0] == result[1]).all())

    def _grow(self, tree: Tree) -> None:
        ((kind, body),) = tree.items()
        if kind in ("And", "Or", "Implies", "Not"):
            for part in body if isinstance(body, list) else [body]:
                self._grow(part)
        elif id(tree) not in self._places:
            self._places[id(tree)] = len(self._parts)
            self._parts.append(_Part(tree))

    def _now(self, tree: Tree, x: tuple[Opened, ...]) -> Array:
        ((kind, body),) = tree.items()
        if kind == "Not":
            return opposite(self._now(body, x))
        if kind in ("And", "Or", "Implies"):
            a, b = self._now(body[0], x), self._now(body[1], x)
            return np.minimum(a, b) if kind == "And" else np.maximum(opposite(a) if kind == "Implies" else a, b)
        return x[self._places[id(tree)]].value


class _Part:
    """An operator at the first instant."""

    def __init__(self, tree: Tree) -> None:
        ((self.kind, body),) = tree.items()
        if self.kind in (*FUTURE, "Until"):
            self.low, self.high = limits(body)
            self.trees = body[1:]
        else:
            # An operator at the first instant only is "always" over this one instant, so that one rule serves all.
            self.kind, self.low, self.high, self.trees = "Always", 0.0, 0.0, [tree]
        spans = [span(each) for each in self.trees]
        self.back, self.ahead = max(s[0] for s in spans), max(s[1] for s in spans)

    def first(self) -> Opened:
        """Return the initial state: nothing is certain."""
        none = INF if self.kind == "Always" else -INF
        return Opened((np.full((2, 2), none), np.full((2, 2), INF)))

    def push(self, x: Opened, t: float, *added: Mapping[str, Any]) -> Opened:
        """Add an instant."""
        sure, _, over, after, before, columns = x
        if over:
            return x
        times = np.append(before, t)
        columns = tuple(
            {name: np.append(old[name], value) if name in old else np.array([value]) for name, value in new.items()}
            for old, new in zip(columns, added, strict=True)
        )
        samples, truths, late = columns
        record = Record(times, samples, truths=truths, late=late, ended=False)
        values = [record.bounds(tree) for tree in self.trees]
        begin = int(np.searchsorted(times, after))
        # No later sample changes what an operator below says of the instants before this one.
        settled = int(np.searchsorted(times, t - self.ahead, side="right"))
        end = int(np.searchsorted(times, self.high, side="right"))
        sure = self._fold(sure, times, values, begin, min(settled, end))
        value, held = self._fold(sure, times, values, max(begin, settled), end)
        if settled > begin:
            after = float(np.nextafter(times[settled - 1], INF))
        over = after > self.high
        # Instants of the window are still to come, and they may make the value worse (of "always") or better (else).
        if not over and self.high > t:
            value = value.copy()
            if self.kind == "Always":
                value[0] = -INF
            else:
                value[1] = np.maximum(value[1], held[1])
        # Operators of the past look back from open instants, so these samples must stay.
        first = int(np.searchsorted(times, after - self.back))
        left = tuple({name: values[first:] for name, values in each.items()} for each in columns)
        return Opened(sure, value, over, after, times[first:], left)

    def _fold(self, sure: Any, times: Array, values: list[Array], begin: int, end: int) -> Any:
        """Extend the certain part by the instants from `begin` to before `end`."""
        value, held = sure
        if self.kind == "Until":
            for k in range(begin, end):
                if times[k] >= self.low:
                    value = np.maximum(value, np.minimum(held, values[1][..., k]))
                held = np.minimum(held, values[0][..., k])
            return value, held
        reached = values[0][..., max(begin, int(np.searchsorted(times, self.low))) : end]
        if reached.shape[-1]:
            least = self.kind == "Always"
            value = np.minimum(value, reached.min(axis=-1)) if least else np.maximum(value, reached.max(axis=-1))
        return value, held


def span(tree: Tree) -> tuple[float, float]:
    """Return how far a formula looks back and ahead of an instant, ns."""
    ((kind, body),) = tree.items()
    if kind == "Predicate":
        return 0.0, 0.0
    parts = [span(part) for part in (body if isinstance(body, list) else [body]) if "lower" not in part]
    back, ahead = (max(p[k] for p in parts) for k in (0, 1))
    if kind in (*FUTURE, "Until"):
        return back, ahead + limits(body)[1]
    return (back + limits(body)[1], ahead) if kind in (*PAST, "Since") else (back, ahead)
