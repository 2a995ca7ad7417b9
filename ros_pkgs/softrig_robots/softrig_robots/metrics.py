"""Figures of tracking errors that `softrig_core.metrics` does not have; called the same way by a scenario."""

from __future__ import annotations

import numpy as np
from softrig_core.metrics import SignalMap
from softrig_core.signals import Array


def error_settling_time(signals: SignalMap, signal: str, *, reference: str, band: float) -> float:
    """Time in s of the first sample from which on |reference - signal| stays within `band`.

    Parameters
    ----------
    signal, reference : str
        Names of signals with common sample times.
    band : float
        In the unit of the signal.

    Returns
    -------
    float
        inf when the last sample is outside.
    """
    t, e = tracking_error(signals, signal, reference)
    outside = np.flatnonzero(np.abs(e) > band)
    if outside.size == 0:
        return float(t[0])
    k = int(outside[-1]) + 1
    return float(t[k]) if k < t.size else float("inf")


def error_overshoot(signals: SignalMap, signal: str, *, reference: str) -> float:
    """Largest error of the sign opposite to that of the first error, in the unit of the signal; 0 without one."""
    _, e = tracking_error(signals, signal, reference)
    return max(0.0, float(-(e * np.sign(e[0])).min()))


def tracking_error(signals: SignalMap, signal: str, reference: str) -> tuple[Array, Array]:
    """Give (t, reference - signal) at the samples that both have; a plant's last sample has no reference."""
    t, x = signals[signal]
    when, desired = signals[reference]
    n = min(t.size, when.size)
    if not n or not np.array_equal(t[:n], when[:n]):
        raise ValueError(f"{signal} and {reference} have no common sample times")
    return t[:n], desired[:n] - x[:n]
