"""Level of the water tank: a lower bound that holds for every delay up to h, however it varies.

The tank x' = -c sqrt(x) + k(x_d) x_d, k = kL for x_d < s and -kR from s on, has no equilibrium at s for any delay, only
a limit cycle; what can be proven is that it does not run empty. By comparison, for 0 <= d(t) <= h of any rate::

    X    = s + (kL s - c sqrt(s)) h                 the level is never above
    r    = kR X + c sqrt(X)                         nor falls faster
    s1   = min(h, (X - s)/r)
    m(h) = s - [kR (s s1 + r s1^2/2) + kR X (h - s1) + c sqrt(s) h]        nor below

certified while m(h) >= (c/kL) sqrt(s), from where on the inflow outweighs the drain, and the history is in (m, X]. A
constant history above X takes the place of X, one below m that of m. A law that holds its command for a period makes it
late by up to that period: h is pipe and period together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from ..system import TANK_C


class LevelBound(NamedTuple):
    """Lowest and highest level for delays up to h, and whether the proof holds."""

    lowest: float
    highest: float
    certified: bool


def level_bound(
    h: float, *, s: float = 0.5, kL: float = 0.2, kR: float = 0.1, c: float = TANK_C, start: float | None = None
) -> LevelBound:
    """Bound the level for every delay between 0 and h.

    Parameters
    ----------
    h : float
        Delay bound, s.
    s : float
        Level at which the law changes its gain.
    kL, kR : float
        Gains below and above it, 1/s.
    c : float
        Of the drain c sqrt(x).
    start : float, optional
        Level at and before the start; any in (m, X] when absent.
    """
    if kL * s <= c * math.sqrt(s):
        return LevelBound(0.0, max(s, start or 0.0), False)  # the drain outweighs the largest inflow
    highest = max(s + (kL * s - c * math.sqrt(s)) * h, start or 0.0)
    r = kR * highest + c * math.sqrt(highest)
    s1 = min(h, (highest - s) / r)
    lowest = s - (kR * (s * s1 + 0.5 * r * s1 * s1) + kR * highest * (h - s1) + c * math.sqrt(s) * h)
    lowest = lowest if start is None else min(lowest, start)
    return LevelBound(lowest, highest, lowest >= c / kL * math.sqrt(s))


def level_margin(
    *, s: float = 0.5, kL: float = 0.2, kR: float = 0.1, c: float = TANK_C, start: float | None = None
) -> float:
    """Return the largest h (s) with a certified level, 0 if there is none; parameters as in `level_bound`."""

    def certified(h: float) -> bool:
        return level_bound(h, s=s, kL=kL, kR=kR, c=c, start=start).certified

    low, high = 0.0, 1.0
    while certified(high):
        low, high = high, 2.0 * high
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        if certified(middle):
            low = middle
        else:
            high = middle
    return low
