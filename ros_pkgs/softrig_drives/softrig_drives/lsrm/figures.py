"""Figures of a recorded run.

Every function is called as ``f(signals, **arguments)`` and gives a float. Arguments with the same meaning everywhere:

start, end : float
    Time window in s, both ends included.
drive : str
    Of two drives in one rig, what stands before the topics of this one (``trapezoid/``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from softrig_core.rig.metrics import SignalMap

Array = NDArray[np.float64]

SPEED = "joint_states/translator/velocity"
POSITION = "joint_states/translator/position"
FORCE = "joint_states/translator/effort"
REFERENCE = "reference/translator/velocity"
SLACK = 1e-6  # s


def overshoot(signals: SignalMap, *, v_d: float, start: float = 0.0, end: float = np.inf, drive: str = "") -> float:
    """(max v - v_d)/v_d in %; negative when the speed never reaches v_d."""
    return 100.0 * (float(np.max(_cut(signals, drive + SPEED, start, end)[1])) / v_d - 1.0)


def dip(signals: SignalMap, *, v_d: float, start: float = 0.0, end: float = np.inf, drive: str = "") -> float:
    """(v_d - min v)/v_d in %."""
    return 100.0 * (1.0 - float(np.min(_cut(signals, drive + SPEED, start, end)[1])) / v_d)


def peak_error(signals: SignalMap, *, start: float = 0.0, end: float = np.inf, drive: str = "") -> float:
    """Largest |v_ref - v| in m/s at the reference's instants."""
    return float(np.abs(_error(signals, start, end, drive)[1]).max())


def iae(signals: SignalMap, *, start: float = 0.0, end: float = np.inf, drive: str = "") -> float:
    """Integral of |v_ref - v| over the time in m; at the reference's instants."""
    t, e = _error(signals, start, end, drive)
    return float(np.abs(e).sum() * _interval(t))


def itae(signals: SignalMap, *, start: float = 0.0, end: float = np.inf, drive: str = "") -> float:
    """Integral of t |v_ref - v| over the time in m s; at the reference's instants."""
    t, e = _error(signals, start, end, drive)
    return float((t * np.abs(e)).sum() * _interval(t))


def peak_force(
    signals: SignalMap, *, window: float = 0.005, sign: float = 1.0, start: float = 0.0, end: float = np.inf,
    drive: str = "",
) -> float:  # fmt: skip
    """Largest (with `sign` -1: smallest) centred mean of the force over `window` (s), in N."""
    t, F = _cut(signals, drive + FORCE, start, end)
    width = max(1, round(window / _interval(t)))
    means = np.convolve(F, np.full(width, 1.0 / width), mode="valid")
    return float(sign * np.max(sign * means))


def mean_force(signals: SignalMap, *, pitch: float = 0.052, pitches: int = 2, end: float = np.inf,
               drive: str = "") -> float:  # fmt: skip
    """Mean force in N over the last whole pole pitches (m) travelled before `end`."""
    return float(_last_pitches(signals, pitch * pitches, end, drive).mean())


def force_ripple(signals: SignalMap, *, pitch: float = 0.052, pitches: int = 2, end: float = np.inf,
                 drive: str = "") -> float:  # fmt: skip
    """Standard deviation of the force in N over the last whole pole pitches (m) travelled before `end`."""
    return float(_last_pitches(signals, pitch * pitches, end, drive).std())


def arrival(signals: SignalMap, *, v_d: float, part: float = 0.99, drive: str = "") -> float:
    """First time in s at which the speed is at `part` of v_d, linear between samples; inf when never."""
    t, v = signals[drive + SPEED]
    reached = v >= part * v_d
    k = int(np.argmax(reached))
    if not reached[k]:
        return float("inf")
    return float(t[k - 1] + (t[k] - t[k - 1]) * (part * v_d - v[k - 1]) / (v[k] - v[k - 1])) if k else float(t[0])


def _cut(signals: SignalMap, name: str, start: float, end: float) -> tuple[Array, Array]:
    t, x = signals[name]
    inside = (t >= start - SLACK) & (t <= end + SLACK)
    if not inside.any():
        raise ValueError(f"{name} has no samples from {start:g} to {end:g} s")
    return t[inside], x[inside]


def _error(signals: SignalMap, start: float, end: float, drive: str) -> tuple[Array, Array]:
    """Give time and v_ref - v where the reference was told: between its ticks the held value is no target."""
    when, reference = _cut(signals, drive + REFERENCE, start, end)
    t, v = signals[drive + SPEED]
    return when, reference - v[np.searchsorted(t, when + SLACK, side="right") - 1]


def _interval(t: Array) -> float:
    return float((t[-1] - t[0]) / (t.size - 1))


def _last_pitches(signals: SignalMap, length: float, end: float, drive: str) -> Array:
    _, x = _cut(signals, drive + POSITION, 0.0, end)
    _, F = _cut(signals, drive + FORCE, 0.0, end)
    if abs(x[-1] - x[0]) < length:
        raise ValueError(f"the translator moved {abs(x[-1] - x[0]):g} m, needed {length:g} m")
    return F[np.abs(x - x[-1]) < length]
