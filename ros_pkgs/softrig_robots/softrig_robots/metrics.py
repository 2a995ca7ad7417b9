"""Figures of tracking errors that `softrig_core.rig.metrics` does not have; called the same way by a scenario.

`repeatability` alone compares two recordings: no scenario can name it, call it from Python on two bags.
"""

from __future__ import annotations

from math import degrees
from typing import Any

import numpy as np
import softrig_core.rig.metrics
from softrig_core.rig.metrics import SignalMap
from softrig_core.wire.signals import Array


def error_settling_time(signals: SignalMap, signal: str, *, reference: str, band: float) -> float:
    """Time in s of the first sample from which on |reference - signal| stays within `band`.

    Parameters
    ----------
    signal, reference : str
        Names of signals.
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
    """Give (t, reference - signal) at the sample times that both have; a plant's last sample has no reference."""
    (t, x), (when, desired) = signals[signal], signals[reference]
    common, here, there = np.intersect1d(t, when, assume_unique=True, return_indices=True)
    if not common.size:
        raise ValueError(f"{signal} and {reference} have no common sample times")
    return common, desired[there] - x[here]


def in_degrees(signals: SignalMap, *, of: str, **arguments: Any) -> float:
    """Value of the function `of` of `softrig_core.rig.metrics` in degrees instead of rad."""
    return degrees(getattr(softrig_core.rig.metrics, of)(signals, **arguments))


def mean_square_degrees(signals: SignalMap, signal: str) -> float:
    """Mean of the squares (MSE) of an error in rad, in square degrees."""
    return degrees(1.0) ** 2 * float(np.mean(signals[signal][1] ** 2))


def sum_absolute_degrees(signals: SignalMap, signal: str) -> float:
    """Sum of the absolute samples (SAE) of an error in rad, in degrees; grows with the number of samples."""
    return degrees(float(np.abs(signals[signal][1]).sum()))


def integral_absolute_degrees(signals: SignalMap, signal: str) -> float:
    """Integral of the absolute value (IAE) of an error in rad, in degree seconds."""
    t, _ = signals[signal]
    return sum_absolute_degrees(signals, signal) * float(t[1] - t[0])


def mean_absolute(signals: SignalMap, signal: str) -> float:
    """Mean of the absolute value, in the unit of the signal (MAC of a current, MAV of a voltage)."""
    return float(np.abs(signals[signal][1]).mean())


def repeatability(first: SignalMap, second: SignalMap, signal: str) -> float:
    """Squared change of an error from one run to another over its square, equation (25) of the rehabilitation paper.

    Parameters
    ----------
    first, second : mapping
        Signals of two recordings of equal length, such as `softrig_bags.read.signals` gives.
    signal : str
        Name of the error in both.

    Returns
    -------
    float
        0 when the runs are equal.
    """
    _, e = first[signal]
    _, other = second[signal]
    return float(((e - other) ** 2).sum() / (e**2).sum())
