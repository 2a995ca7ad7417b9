"""Bounds of a formula's robustness at the first instant, while its record grows."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from .arithmetic import Array, Tree
from .formula import FUTURE, PAST
from .robustness import INF, Record, limits, opposite

UNKNOWN = np.array(((-INF, -INF), (INF, INF)))


class Live:
    """A formula on a record that grows by one instant at a time.

    Of an operator at the first instant it keeps what is decided and the instants that are still open, so a tick costs
    what its windows are long; below it an operator without end leaves every instant open, and all are kept.

    Parameters
    ----------
    tree : plain data
    """

    def __init__(self, tree: Tree) -> None:
        self._tree = tree
        self._parts: dict[int, _Part] = {}
        self._grow(tree)

    def push(
        self, t: float, samples: Mapping[str, float], truths: Mapping[str, float], late: Mapping[str, bool]
    ) -> tuple[float, float]:
        """Take an instant in, and give the least and greatest that the margin may come to.

        Parameters
        ----------
        t : float
            Whole ns, ascending from 0.
        samples, truths, late : mapping
            See `softrig_core.judge.robustness.Record`.
        """
        for part in self._parts.values():
            part.push(t, samples, truths, late)
        found = self._now(self._tree)
        return float(found[0, 0]), float(found[1, 1])

    @property
    def decided(self) -> bool:
        """Whether nothing that comes can change the bounds."""
        found = self._now(self._tree)
        return all(part.over for part in self._parts.values()) or bool((found[0] == found[1]).all())

    def _grow(self, tree: Tree) -> None:
        ((kind, body),) = tree.items()
        if kind in ("And", "Or", "Implies", "Not"):
            for part in body if isinstance(body, list) else [body]:
                self._grow(part)
        else:
            self._parts[id(tree)] = _Part(tree)

    def _now(self, tree: Tree) -> Array:
        ((kind, body),) = tree.items()
        if kind == "Not":
            return opposite(self._now(body))
        if kind in ("And", "Or", "Implies"):
            a, b = self._now(body[0]), self._now(body[1])
            return np.minimum(a, b) if kind == "And" else np.maximum(opposite(a) if kind == "Implies" else a, b)
        return self._parts[id(tree)].value


class _Part:
    """An operator at the first instant."""

    def __init__(self, tree: Tree) -> None:
        ((self.kind, body),) = tree.items()
        if self.kind in (*FUTURE, "Until"):
            self.low, self.high = limits(body)
            self.trees = body[1:]
        else:  # what is asked at the first instant only
            self.kind, self.low, self.high, self.trees = "Always", 0.0, 0.0, [tree]
        spans = [span(each) for each in self.trees]
        self.back, self.ahead = max(s[0] for s in spans), max(s[1] for s in spans)
        self.times: deque[float] = deque()
        self.rows: deque[tuple[Mapping[str, Any], ...]] = deque()  # samples, truths, late of each
        self.next = 0.0  # instants before this one are in `sure`
        none = INF if self.kind == "Always" else -INF
        self.sure = (np.full((2, 2), none), np.full((2, 2), INF))  # the value, and how long `until` has held
        self.value, self.over = UNKNOWN, False

    def push(self, t: float, *given: Mapping[str, Any]) -> None:
        """Take an instant in."""
        if self.over:
            return
        self.times.append(t)
        self.rows.append(given)
        times = np.array(self.times)
        samples, truths, late = ({n: np.array([row[k][n] for row in self.rows]) for n in given[k]} for k in range(3))
        record = Record(times, samples, truths=truths, late=late, ended=False)
        values = [record.bounds(tree) for tree in self.trees]
        begin = int(np.searchsorted(times, self.next))
        settled = int(np.searchsorted(times, t - self.ahead, side="right"))  # nothing that comes changes those before
        end = int(np.searchsorted(times, self.high, side="right"))
        self.sure = self._fold(self.sure, times, values, begin, min(settled, end))
        value, held = self._fold(self.sure, times, values, max(begin, settled), end)
        if settled > begin:
            self.next = float(np.nextafter(times[settled - 1], INF))
        self.over = self.next > self.high
        if not self.over and self.high > t:  # instants of the window are still to come
            value = value.copy()
            if self.kind == "Always":
                value[0] = -INF
            else:
                value[1] = np.maximum(value[1], held[1])
        self.value = value
        while self.times and self.times[0] < self.next - self.back:
            self.times.popleft()
            self.rows.popleft()

    def _fold(self, sure: Any, times: Array, values: list[Array], begin: int, end: int) -> Any:
        """Go on from what is sure with the instants from `begin` to before `end`."""
        value, held = sure
        if self.kind == "Until":
            for k in range(begin, end):
                if times[k] >= self.low:
                    value = np.maximum(value, np.minimum(held, values[1][..., k]))
                held = np.minimum(held, values[0][..., k])
            return value, held
        inside = values[0][..., max(begin, int(np.searchsorted(times, self.low))) : end]
        if inside.shape[-1]:
            least = self.kind == "Always"
            value = np.minimum(value, inside.min(axis=-1)) if least else np.maximum(value, inside.max(axis=-1))
        return value, held


def span(tree: Tree) -> tuple[float, float]:
    """How far a formula looks back and ahead of an instant, ns."""
    ((kind, body),) = tree.items()
    if kind == "Predicate":
        return 0.0, 0.0
    parts = [span(part) for part in (body if isinstance(body, list) else [body]) if "lower" not in part]
    back, ahead = (max(p[k] for p in parts) for k in (0, 1))
    if kind in (*FUTURE, "Until"):
        return back, ahead + limits(body)[1]
    return (back + limits(body)[1], ahead) if kind in (*PAST, "Since") else (back, ahead)
