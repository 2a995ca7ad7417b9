"""Comparison of two recordings of an exercise."""

from __future__ import annotations

from softrig_core import SignalMap


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
