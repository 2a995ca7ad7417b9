"""Comparison of two recordings of an exercise."""

from __future__ import annotations

from softrig_core import SignalMap
from softrig_core.judge.measures import HALF_NS, held, mean_over, newest


def repeatability(first: SignalMap, second: SignalMap, signal: str) -> float:
    """Squared change of an error from one run to another over its square, equation (25) of the rehabilitation paper.

    Parameters
    ----------
    first, second : mapping
        Signals of two recordings, such as `softrig_bags.read.signals` gives.
    signal : str
        Name of the error in both.

    Returns
    -------
    float
        Both squares are integrals over time; 0 when the runs are equal.
    """
    t, e, gaps = held(first, signal)
    when, e_second = second[signal]
    indices = newest(when, t + HALF_NS)
    if indices[0] < 0:
        raise ValueError(f"{signal} of the second run has no value yet at {t[0]:g} s")
    return mean_over((e - e_second[indices]) ** 2, gaps) / mean_over(e**2, gaps)
