"""Resampling, which aligns recorders of different rates or sampling times."""

from __future__ import annotations

import math

import numpy as np
from softrig_core import Array, jit

HALF = 10.0  # periods of the slower rate, half the width of the kernel


def reach(rate: float, to_rate: float) -> float:
    """Return the margin in s at both ends of a record in which resampled values are not reliable."""
    return HALF / min(rate, to_rate)


def resampled(x: Array, start: float, rate: float, t: Array, to_rate: float) -> Array:
    """Return a band-limited signal at other times.

    A sinc in a Blackman window, as wide as `HALF` periods of the slower rate; no phase shift; frequencies that the
    slower rate cannot represent are removed.

    Parameters
    ----------
    x : ndarray, shape (n, channels)
    start, rate : float
        Time of the first sample, s, and samples a second.
    t : ndarray, shape (m,)
        Wanted times, s, within the signal by `reach`.
    to_rate : float
        Their rate.

    Returns
    -------
    ndarray, shape (m, channels)
    """
    out = np.empty((len(t), x.shape[1]))
    _resample(x, (t - start) * rate, min(1.0, to_rate / rate), out)
    return out


@jit
def _resample(x: Array, positions: Array, cutoff: float, out: Array) -> None:
    """Write x at places counted in its samples; `cutoff` as a share of its own half rate."""
    half = HALF / cutoff
    for n in range(positions.shape[0]):
        first = max(math.ceil(positions[n] - half), 0)
        last = min(math.floor(positions[n] + half), x.shape[0] - 1)
        out[n] = 0.0
        total = 0.0
        for k in range(first, last + 1):
            u = positions[n] - k
            turn = math.pi * cutoff * u
            w = 0.42 + 0.5 * math.cos(math.pi * u / half) + 0.08 * math.cos(2.0 * math.pi * u / half)
            if abs(turn) > 1e-12:
                w *= math.sin(turn) / turn
            total += w
            for c in range(x.shape[1]):
                out[n, c] += w * x[k, c]
        for c in range(x.shape[1]):
            # The weights do not add to one exactly, and at the ends some are missing.
            out[n, c] /= total
