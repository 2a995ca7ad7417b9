"""A trajectory of points that a reference follows in place of its own motion, as a joint_trajectory_controller does.

The points are live parameters of the block. A new goal is therefore a change like any other: it takes effect between
two ticks, is recorded in the bag, and a run that repeats the recorded changes produces the same numbers.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from .block.params import Params, param
from .timebase import SECOND, to_ns, to_s

FIELDS = ("positions", "velocities", "accelerations")


class Goal(Params):
    """Points to pass at given times; the last position is held. Without points the block has its own motion.

    Between two points each joint moves along the polynomial that fits the values at both: a line for positions alone, a
    cubic with velocities, a quintic with accelerations as well.
    """

    start: float = param(
        0.0, "time of the run from which the times of the points count", "s", ge=0.0, le=1e9, live=True
    )
    times: tuple[float, ...] = param(
        (),
        "times of the points after `start`, increasing; none: the block's own motion",
        "s",
        each=(0.0, 1e9),
        live=True,
    )
    positions: tuple[float, ...] = param((), "of all joints at the first point, then at the next, and so on", live=True)
    velocities: tuple[float, ...] = param((), "as the positions; may be missing", live=True)
    accelerations: tuple[float, ...] = param((), "as the velocities, which they need; may be missing", live=True)

    def _check(self) -> None:
        ns = [to_ns(t) for t in self.times]
        if any(b <= a for a, b in pairwise(ns)):
            raise ValueError(f"times {list(self.times)}: expected each later than the one before")
        if self.accelerations and not self.velocities:
            raise ValueError("accelerations without velocities: expected both, or positions alone")

    def require(self, joints: int) -> None:
        """Check the number of values.

        Raises
        ------
        ValueError
            Another number than points times joints; names the field.
        """
        wanted = len(self.times) * joints
        for field in FIELDS:
            count = len(getattr(self, field))
            if count != wanted and (count or field == "positions"):
                raise ValueError(
                    f"goal.{field} has {count} values, expected {wanted} ({len(self.times)} points, {joints} joints)"
                )


Polynomial = tuple[float, float, float, float, float, float]  # coefficients, lowest power first


class Segment(NamedTuple):
    """The motion from one point to the next."""

    begin: int  # ns, of the run
    polynomials: tuple[Polynomial, ...]  # one for each joint


class Path:
    """The motion through the points of a goal.

    Parameters
    ----------
    goal : Goal
        With at least one point.
    """

    def __init__(self, goal: Goal, joints: int) -> None:
        goal.require(joints)
        start = to_ns(goal.start)
        times = [start + to_ns(t) for t in goal.times]
        rows = [self._row(goal, k, joints) for k in range(len(times))]
        pairs = pairwise(zip(times, rows, strict=True))
        segments = [Segment(a, _between(p, q, to_s(b - a))) for (a, p), (b, q) in pairs]
        last = tuple((q, 0.0, 0.0, 0.0, 0.0, 0.0) for q in rows[-1][0])
        segments.append(Segment(times[-1], last))
        self.begins = tuple(s.begin for s in segments)
        self.polynomials = tuple(s.polynomials for s in segments)

    @staticmethod
    def _row(goal: Goal, k: int, joints: int) -> list[Sequence[float]]:
        return [getattr(goal, field)[k * joints : (k + 1) * joints] for field in FIELDS]

    def at(self, t: int) -> tuple[float, ...]:
        """Return the positions of all joints at t (ns), their velocities, then their accelerations.

        Before the time of the first point the motion rests at that point.
        """
        k = max(0, bisect_right(self.begins, t) - 1)
        s = max(0.0, (t - self.begins[k]) / SECOND)
        q, v, a = [], [], []
        for c0, c1, c2, c3, c4, c5 in self.polynomials[k]:
            q.append(c0 + s * (c1 + s * (c2 + s * (c3 + s * (c4 + s * c5)))))
            v.append(c1 + s * (2.0 * c2 + s * (3.0 * c3 + s * (4.0 * c4 + s * 5.0 * c5))))
            a.append(2.0 * c2 + s * (6.0 * c3 + s * (12.0 * c4 + s * 20.0 * c5)))
        return (*q, *v, *a)


def _between(p: list[Sequence[float]], q: list[Sequence[float]], T: float) -> tuple[Polynomial, ...]:
    """Return the polynomials of all joints from one point to the next, T s later."""
    (p0, v0, a0), (p1, v1, a1) = p, q
    if not v0:
        return tuple((b, (e - b) / T, 0.0, 0.0, 0.0, 0.0) for b, e in zip(p0, p1, strict=True))
    if not a0:
        return tuple(
            (b, v, (3.0 * (e - b) / T - 2.0 * v - w) / T, (v + w - 2.0 * (e - b) / T) / (T * T), 0.0, 0.0)
            for b, v, e, w in zip(p0, v0, p1, v1, strict=True)
        )
    return tuple(
        (
            b,
            v,
            0.5 * c,
            (20.0 * (e - b) - (8.0 * w + 12.0 * v) * T - (3.0 * c - d) * T * T) / (2.0 * T**3),
            (30.0 * (b - e) + (14.0 * w + 16.0 * v) * T + (3.0 * c - 2.0 * d) * T * T) / (2.0 * T**4),
            (12.0 * (e - b) - 6.0 * (w + v) * T - (c - d) * T * T) / (2.0 * T**5),
        )
        for b, v, c, e, w, d in zip(p0, v0, a0, p1, v1, a1, strict=True)
    )
