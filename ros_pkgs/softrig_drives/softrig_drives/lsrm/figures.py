"""Figure functions of the drive: overshoot and dip of the speed, tracking error, force.

Signs refer to that of `v_d`, those of the force to the direction of the motion: a backward motion has the figures of
its mirror image; forces keep their own sign.

`start` and `end` (s) limit the samples as in `softrig_core.judge.measures`. Of two drives in one rig, `drive` is the
name before the topics of one (``trapezoid``).
"""

from __future__ import annotations

import math

import numpy as np
from softrig_core import Array, SignalMap, figure, window
from softrig_core.judge.measures import HALF_NS, NS, begin, held, mean_over, newest

POSITION = "joint_states/translator/position"
SPEED = "joint_states/translator/velocity"
FORCE = "joint_states/translator/effort"
REFERENCE = "reference/translator/velocity"
PITCH = {"pitch": "lsrm/pitch"}
BOTH_WAYS = 1.2  # way over distance from the start, beyond which a motion has gone there and back


@figure("%", (SPEED,))
def overshoot(
    signals: SignalMap, *, v_d: float, start: float | None = None, end: float | None = None, drive: str = ""
) -> float:
    """Largest of (v - v_d)/v_d in %; negative when the speed never reaches v_d."""
    return 100.0 * (float(np.max(np.sign(v_d) * window(signals, _of(drive, SPEED), start, end)[1])) / abs(v_d) - 1.0)


@figure("%", (SPEED,))
def dip(
    signals: SignalMap, *, v_d: float, start: float | None = None, end: float | None = None, drive: str = ""
) -> float:
    """Largest of (v_d - v)/v_d in %."""
    return 100.0 * (1.0 - float(np.min(np.sign(v_d) * window(signals, _of(drive, SPEED), start, end)[1])) / abs(v_d))


@figure("m", (SPEED, REFERENCE))
def iae(signals: SignalMap, *, start: float | None = None, end: float | None = None, drive: str = "") -> float:
    """Integral of |v_ref - v| over the time in m."""
    _, error, holds = _tracking(signals, start, end, drive)
    return float((error * holds).sum())


@figure("m s", (SPEED, REFERENCE))
def itae(signals: SignalMap, *, start: float | None = None, end: float | None = None, drive: str = "") -> float:
    """Integral of t |v_ref - v| over the time in m s, t from `start` or the first sample on."""
    t, error, holds = _tracking(signals, start, end, drive)
    return float(((t - begin(t, start)) * error * holds).sum())


@figure("N", (FORCE, POSITION))
def peak_force(
    signals: SignalMap,
    *,
    width: float = 0.005,
    sign: float | None = None,
    start: float | None = None,
    end: float | None = None,
    drive: str = "",
) -> float:
    """Largest (with `sign` -1: smallest) mean over time of the force over any `width` (s), in N.

    Without `sign`, the peak in the direction of the motion; after a motion in both directions, the larger in magnitude.
    """
    means = _moving_means(signals, _of(drive, FORCE), width, start, end)
    if sign is None:
        x = window(signals, _of(drive, POSITION), start, end)[1]
        forward, back = float(np.max(x) - x[0]), float(x[0] - np.min(x))
        travelled = float(np.max(np.abs(np.diff(x, prepend=x[0])).cumsum()))
        if travelled > BOTH_WAYS * max(forward, back):
            return float(means[np.argmax(np.abs(means))])
        sign = 1.0 if forward >= back else -1.0
    return float(sign * np.max(sign * means))


@figure("N", (FORCE, POSITION), PITCH)
def mean_force(
    signals: SignalMap, *, pitch: float, pitches: int = 2, end: float | None = None, drive: str = ""
) -> float:
    """Mean over time of the force in N over the last whole pole pitches (m) travelled before `end`."""
    return mean_over(*_last_pitches(signals, pitch * pitches, end, drive))


@figure("N", (FORCE, POSITION), PITCH)
def force_ripple(
    signals: SignalMap, *, pitch: float, pitches: int = 2, end: float | None = None, drive: str = ""
) -> float:
    """Standard deviation over time of the force in N over the last whole pole pitches (m) travelled before `end`."""
    F, holds = _last_pitches(signals, pitch * pitches, end, drive)
    return math.sqrt(mean_over((F - mean_over(F, holds)) ** 2, holds))


@figure("s", (SPEED,))
def arrival(signals: SignalMap, *, v_d: float, part: float = 0.99, drive: str = "") -> float:
    """First time of the run in s at which the speed is at `part` of v_d, linear between samples; inf when never."""
    t, v = signals[_of(drive, SPEED)]
    v, goal = np.sign(v_d) * v, part * abs(v_d)
    k = int(np.argmax(v >= goal))
    if v[k] < goal:
        return float("inf")
    return float(t[k - 1] + (t[k] - t[k - 1]) * (goal - v[k - 1]) / (v[k] - v[k - 1])) if k else float(t[0])


def _tracking(signals: SignalMap, start: float | None, end: float | None, drive: str) -> tuple[Array, Array, Array]:
    """Return the reference's instants, |v_ref - v| there, and the times (s) to the next: in between it is no target."""
    t, reference, gaps = held(signals, _of(drive, REFERENCE), start, end)
    when, v = signals[_of(drive, SPEED)]
    indices = newest(when, t)
    if indices[0] < 0:
        raise ValueError(f"{_of(drive, SPEED)} has no value yet at {t[0]:g} s, where the reference begins")
    return t, np.abs(reference - v[indices]), gaps * NS


def _of(drive: str, signal: str) -> str:
    return f"{drive}/{signal}" if drive else signal


def _moving_means(signals: SignalMap, signal: str, width: float, start: float | None, end: float | None) -> Array:
    """Return the means over time of a held signal over all windows that begin or end at a sample."""
    t, x, gaps = held(signals, signal, start, end)
    edges = np.append(t, t[-1] + gaps[-1] * NS)
    total = np.append(0.0, np.cumsum(x * np.diff(edges)))
    begins = np.concatenate([edges, edges - width])
    begins = begins[(begins > edges[0] - HALF_NS) & (begins + width < edges[-1] + HALF_NS)]
    if not begins.size or width <= 0.0:
        raise ValueError(
            f"{signal} is recorded for {edges[-1] - edges[0]:g} s, expected width = {width:g} s or more, > 0"
        )
    return np.asarray((np.interp(begins + width, edges, total) - np.interp(begins, edges, total)) / width)


def _last_pitches(signals: SignalMap, length: float, end: float | None, drive: str) -> tuple[Array, Array]:
    """Return the force over the last distance of some length, and how long (ns) each value is valid."""
    x = window(signals, _of(drive, POSITION), None, end)[1]
    _, F, gaps = held(signals, _of(drive, FORCE), None, end)
    if abs(x[-1] - x[0]) < length:
        raise ValueError(f"the translator moved {abs(x[-1] - x[0]):g} m, needed {length:g} m")
    on = np.abs(x - x[-1]) < length
    return F[on], gaps[on]
