"""Delay lines: a ring of samples that is read at any fractional age, from plain Python or inside `jit` functions.

Age 0 is the newest sample, age 1 the one before; a delay of tau seconds over samples h seconds apart is the age
tau / h, which may change with time and with the state. Before the first sample stands the past: a constant or a
function of time, filled in at the start.

A ring is a float64 array (capacity, width) with the count of samples put so far; sample k is row k modulo capacity.
Inside native loops the functions `put`, `linear`, `cubic` and `hermite` take it apart; `History` wraps them.
A jump or a kink between samples: `linear` keeps it within the interval; `cubic` rings over its two neighbours;
`hermite` needs slopes of each side, see `softrig_core.model.dde` for a history that keeps both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from .jit import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Ring = NDArray[np.float64]

Past = float | Sequence[float] | Callable[[float], float | Sequence[float]]


@jit
def put(ring: Ring, count: int, values: Ring) -> int:
    """Write the next sample.

    Parameters
    ----------
    ring : ndarray, shape (capacity, width)
    count : int
        Samples put so far.
    values : ndarray, shape (width,)

    Returns
    -------
    int
        The new count.
    """
    row = count % ring.shape[0]
    for channel in range(ring.shape[1]):
        ring[row, channel] = values[channel]
    return count + 1


@jit
def linear(ring: Ring, count: int, age: float, channel: int) -> float:
    """Read between two samples on a straight line; exact where the signal is one, error h^2/8 x''.

    Parameters
    ----------
    ring : ndarray, shape (capacity, width)
    count : int
        Samples put so far.
    age : float
        In samples before the newest, 0 to capacity - 1; outside it the nearest end is read.
    channel : int

    Returns
    -------
    float
    """
    size = ring.shape[0]
    age = min(max(age, 0.0), size - 1.0)
    back = min(int(age), size - 2)
    part = age - back
    newer = ring[(count - 1 - back) % size, channel]
    if part == 0.0:
        return newer
    return newer + part * (ring[(count - 2 - back) % size, channel] - newer)


@jit
def cubic(ring: Ring, count: int, age: float, channel: int) -> float:
    """Read on the cubic through the four samples around; exact for cubics, error 3/128 h^4 x'''' inside.

    At both ends of the ring the four samples are the last ones, with an error of up to h^4/24 x''''.

    Parameters
    ----------
    ring : ndarray, shape (capacity, width)
        At least four samples.
    count : int
        Samples put so far.
    age : float
        In samples before the newest, 0 to capacity - 1; outside it the nearest end is read.
    channel : int

    Returns
    -------
    float
    """
    size = ring.shape[0]
    age = min(max(age, 0.0), size - 1.0)
    first = min(max(int(age) - 1, 0), size - 4)
    s = age - first  # 0, 1, 2, 3 at the four samples, newest first
    newest = count - 1 - first
    if s == math.floor(s):
        return ring[(newest - int(s)) % size, channel]
    a, b = ring[newest % size, channel], ring[(newest - 1) % size, channel]
    c, d = ring[(newest - 2) % size, channel], ring[(newest - 3) % size, channel]
    return (
        -(s - 1.0) * (s - 2.0) * (s - 3.0) / 6.0 * a
        + s * (s - 2.0) * (s - 3.0) / 2.0 * b
        - s * (s - 1.0) * (s - 3.0) / 2.0 * c
        + s * (s - 1.0) * (s - 2.0) / 6.0 * d
    )


@jit
def between(s: float, step: float, x0: float, x1: float, dx0: float, dx1: float) -> float:
    """Give the cubic Hermite polynomial between two samples.

    Parameters
    ----------
    s : float
        0 at the first, 1 at the second.
    step : float
        Time between them, s.
    x0, x1, dx0, dx1 : float
        Values and slopes (1/s) at both.

    Returns
    -------
    float
    """
    r = 1.0 - s
    return (1.0 + 2.0 * s) * r * r * x0 + s * r * r * step * dx0 + s * s * (3.0 - 2.0 * s) * x1 - s * s * r * step * dx1


@jit
def hermite(ring: Ring, slopes: Ring, count: int, age: float, step: float, channel: int) -> float:
    """Read on the cubic through two samples with their slopes; error h^4/384 x'''', no further neighbours.

    Parameters
    ----------
    ring, slopes : ndarray, shape (capacity, width)
        Values, and their slopes in 1/s.
    count : int
        Samples put so far.
    age : float
        In samples before the newest, 0 to capacity - 1; outside it the nearest end is read.
    step : float
        Time between samples, s.
    channel : int

    Returns
    -------
    float
    """
    size = ring.shape[0]
    age = min(max(age, 0.0), size - 1.0)
    back = min(int(age), size - 2)
    part = age - back
    newer, older = (count - 1 - back) % size, (count - 2 - back) % size
    if part == 0.0:
        return ring[newer, channel]
    if part == 1.0:
        return ring[older, channel]
    return between(1.0 - part, step, ring[older, channel], ring[newer, channel], slopes[older, channel],
                   slopes[newer, channel])  # fmt: skip


class History:
    """The newest samples of a signal, read at any age up to the longest delay.

    Parameters
    ----------
    step : float
        Time between samples, s.
    longest : float
        Longest delay that will be asked for, s.
    past : float, sequence of float, or callable
        The signal at and before its first sample: constant, or a function of the time (s, 0 and negative). Its
        number of values is the number of channels.
    kind : {"linear", "cubic", "hermite"}
        Interpolation. With "hermite" every sample comes with its slope; before the first, slopes are differences of
        the past.

    Raises
    ------
    ValueError
        A step that is not positive, a longest delay that is not finite or negative, another kind.

    Examples
    --------
    >>> line = History(step=0.001, longest=0.25, past=(0.0,))
    >>> line.put((1.0,))
    >>> line.at(0.0005)
    (0.5,)
    """

    KINDS = ("linear", "cubic", "hermite")

    def __init__(self, step: float, longest: float, past: Past = 0.0, kind: str = "linear") -> None:
        if not step > 0.0 or not math.isfinite(step):
            raise ValueError(f"step = {step} s: expected a positive time")
        if not longest >= 0.0 or not math.isfinite(longest):
            raise ValueError(f"longest delay = {longest} s: expected a finite time of at least 0")
        if kind not in self.KINDS:
            raise ValueError(f"kind = {kind!r}: expected one of {', '.join(self.KINDS)}")
        self.step, self.longest, self.kind = step, longest, kind
        # one more than the samples around the longest delay, so that a delay that rounds up is still inside
        self.capacity = max(4, math.ceil(longest / step - 1e-9) + 3)
        self.reset(past)

    def reset(self, past: Past) -> None:
        """Fill in the past again; the sample at age 0 is the past at time 0.

        Parameters
        ----------
        past : float, sequence of float, or callable
            As for the class.
        """
        import numpy as np

        def value(t: float) -> Ring:
            return np.atleast_1d(np.asarray(past(t) if callable(past) else past, dtype=float))

        times = [-k * self.step for k in reversed(range(self.capacity))]
        self.ring: Ring = np.array([value(t) for t in times])
        self.slopes: Ring = np.zeros_like(self.ring)
        self.count = self.capacity
        if self.kind == "hermite" and callable(past):
            self.slopes[:] = [derivative(value, t, 1e-3 * self.step) for t in times]

    @property
    def width(self) -> int:
        """Number of channels."""
        return self.ring.shape[1]

    def put(self, values: Sequence[float], slopes: Sequence[float] | None = None) -> None:
        """Add the next sample.

        Parameters
        ----------
        values : sequence of float
            One a channel.
        slopes : sequence of float, optional
            One a channel, 1/s; needed by "hermite".

        Raises
        ------
        ValueError
            Wrong number of values, or slopes missing.
        """
        if len(values) != self.width:
            raise ValueError(f"{len(values)} values, expected {self.width}")
        row = self.count % self.capacity
        if self.kind == "hermite":
            if slopes is None or len(slopes) != self.width:
                raise ValueError("hermite interpolation needs the slope of each value")
            self.slopes[row] = slopes
        self.ring[row] = values
        self.count += 1

    def at(self, delay: float) -> tuple[float, ...]:
        """Read all channels a delay before the newest sample.

        Parameters
        ----------
        delay : float
            s, between 0 and the longest.

        Returns
        -------
        tuple of float
            One a channel.

        Raises
        ------
        ValueError
            The delay is negative, longer than the longest, or NaN.
        """
        if not 0.0 <= delay <= self.longest * (1.0 + 1e-9):
            raise ValueError(f"delay = {delay} s: expected 0 to {self.longest} s")
        age, count = delay / self.step, self.count
        if self.kind == "linear":
            found = (linear(self.ring, count, age, c) for c in range(self.width))
        elif self.kind == "cubic":
            found = (cubic(self.ring, count, age, c) for c in range(self.width))
        else:
            found = (hermite(self.ring, self.slopes, count, age, self.step, c) for c in range(self.width))
        return tuple(float(x) for x in found)


def derivative(function: Callable[[float], Ring], t: float, step: float) -> Ring:
    """Give the slope of a past at t from values at and before t (of order 4: the past may end at t).

    Parameters
    ----------
    function : callable
        Time (s) to values.
    t, step : float
        Where, and the distance of the values, s.

    Returns
    -------
    ndarray
        In 1/s.
    """
    f0, f1, f2, f3, f4 = (function(t - k * step) for k in range(5))
    return (25.0 * f0 - 48.0 * f1 + 36.0 * f2 - 16.0 * f3 + 3.0 * f4) / (12.0 * step)
