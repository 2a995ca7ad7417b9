"""Switching term of sliding mode laws."""

from __future__ import annotations


def switching(s: float, delta: float = 0.0) -> float:
    """Return the sign of s, or its continuous approximation.

    Parameters
    ----------
    s : float
        Sliding variable.
    delta : float
        Softening, >= 0, in the unit of s.

    Returns
    -------
    float
        s/(|s| + delta), which is sgn(s) for delta = 0; 0 at s = 0 in both cases.
    """
    return s / (abs(s) + delta) if s else 0.0
