"""Figures of the functional over time; called as ``f(signals, **arguments)``."""

from __future__ import annotations

import numpy as np
from softrig_core import SignalMap, figure, window
from softrig_core.judge.measures import HALF_NS, newest

V = "lyapunov/V/position"


@figure("", reads=[V])
def largest_rise(signals: SignalMap, *, delay: float) -> float:
    """Largest relative rise of V over one delay (s), 0 if it only falls."""
    return max(0.0, float(np.max(_over_a_delay(signals, delay))))


@figure("", reads=[V])
def fall(signals: SignalMap, *, delay: float) -> float:
    """Median relative fall of V over one delay (s); negative when it rises."""
    return -float(np.median(_over_a_delay(signals, delay)))


@figure(
    "",
    ["certificate/verdict/h/position", "certificate/verdict/valid/position"],
    {"delay": "tank/delay", "hold": "tank/hold"},
    (0.0, 1.0),
)
def level_covered(signals: SignalMap, *, delay: float, hold: float) -> float:
    """Return whether the newest certificate is valid for a pipe of this delay and a controller with this hold time.

    Parameters
    ----------
    delay, hold : float
        Largest delay of the pipe and sampling period of the law, s.

    Returns
    -------
    float
        1 or 0.
    """
    _, h = signals["certificate/verdict/h/position"]
    _, valid = signals["certificate/verdict/valid/position"]
    return float(valid[-1] == 1.0 and delay + hold <= h[-1])


def _over_a_delay(signals: SignalMap, delay: float) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    t, v = window(signals, V, None, None)
    late = t - t[0] > delay - HALF_NS
    if not late.any():
        raise ValueError(f"V is recorded for {t[-1] - t[0]:g} s, needed more than the delay {delay:g} s")
    return np.asarray(v[late] / v[newest(t, t[late] - delay + HALF_NS)] - 1.0)
