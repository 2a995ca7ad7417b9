r"""Delay-differential equations in native loops: classical Runge-Kutta steps over a history with both sides of jumps.

.. math:: \dot x(t) = f(t, x(t), x(t - \tau_1(t, x)), \ldots)

The right-hand side is a `jit` function that reads the history itself, so that delays may be constant, change with time
or depend on the state. Every step is stored as the cubic of its values and slopes at both ends. This has fourth order
throughout, and a jump of the state, of an input or of a slope at the border of two steps stays exactly there. The
caller knows where such jumps recur after a delay and must put borders there (for delays that are multiples of the step
they coincide with steps anyway), or use small steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from .jit import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ..arrays import Array


Past = float | Sequence[float] | Callable[[float], float | Sequence[float]]
FIELDS = ("x0", "x1", "dx0", "dx1")  # fields of a trajectory, with a channel each


class Trajectory(NamedTuple):
    """The newest steps of a solution, a ring that native loops write; made by `trajectory`, read by `delayed`.

    What a plant remembers of it from tick to tick is a `Track`.

    Step k is row k modulo capacity: from ``begin`` over ``length`` seconds, values and slopes at its two ends
    (capacity, width). ``meta`` is (steps so far, whether a time on a border reads the step before it).
    """

    begin: Array
    length: Array
    x0: Array
    x1: Array
    dx0: Array
    dx1: Array
    meta: NDArray[np.int64]


def trajectory(step: float, longest: float, past: Past, spare: int = 0) -> Trajectory:
    """Create a history that ends at t = 0.

    Parameters
    ----------
    step : float
        Usual length of a step, s; longer ones never occur, shorter ones use the spare.
    longest : float
        Longest delay that will be requested, s.
    past : float, sequence of float, or callable
        Constant, or a function of the time (s, 0 and negative) that can be evaluated a little before -longest too.
    spare : int
        Shorter steps (borders at located events) that may lie within the longest delay.

    Raises
    ------
    ValueError
        A step that is not positive.
    """
    import math

    import numpy as np

    if not step > 0.0:
        raise ValueError(f"step = {step} s: expected a positive time")

    def value(t: float) -> Array:
        return np.atleast_1d(np.asarray(past(t) if callable(past) else past, dtype=float))

    # The tolerance keeps a delay of whole steps from being rounded up by its last bit.
    capacity = math.ceil(longest / step - 1e-9) + 3 + spare
    begin = np.arange(-capacity, 0, dtype=float) * step
    x = np.array([value(t) for t in (*begin, 0.0)] if callable(past) else [value(0.0)] * (capacity + 1))
    dx = np.zeros_like(x)
    if callable(past):
        # The past is given by values alone, but the cubic between two steps needs slopes.
        dx[:] = [_slope(value, t, 1e-3 * step) for t in (*begin, 0.0)]
    length = np.full(capacity, step)
    meta = np.array([capacity, 0])
    return Trajectory(begin, length, x[:-1].copy(), x[1:].copy(), dx[:-1].copy(), dx[1:].copy(), meta)


class Track:
    """The newest steps of a solution, as a value: the past that a plant stores between two calls of native loops.

    Parameters
    ----------
    begin : Trajectory
        A result of `trajectory`; no other code may write to it from now on.

    Notes
    -----
    Tracks share arrays, so each new step needs only one more row. A continuation of the newest track appends to the
    shared arrays; a continuation of an older one gets arrays of its own.

    Examples
    --------
    ::

        past = track.open(rows=n)
        advance(past, t, x, h, n, p)
        track = track.after(past)
    """

    __slots__ = ("_capacity", "_count", "_shared")

    _capacity: int  # steps that count
    _count: int  # rows of this one
    _shared: _Shared

    # Later tracks append to the shared arrays, but the rows that this one reads never change.
    SCRATCH = frozenset({"_shared"})

    def __init__(self, begin: Trajectory) -> None:
        self._capacity = self._count = len(begin.begin)
        self._shared = _Shared(begin, self._count)

    def open(self, rows: int = 0) -> Trajectory:
        """Return the form for native loops, with space for some more steps."""
        shared, count = self._shared, self._count
        if rows and (count != shared.written or count + rows > len(shared.past.begin)):
            room = max(2 * self._capacity, self._capacity + rows)
            shared = self._shared = _Shared(self._copy(room), self._capacity)
            count = self._count = self._capacity
        meta = shared.past.meta
        meta[0], meta[1] = count, 0
        return shared.past

    def after(self, past: Trajectory) -> Track:
        """Return the track with the steps that native loops have added to the result of the last `open`."""
        new: Track = Track.__new__(Track)
        new._capacity, new._shared = self._capacity, self._shared
        new._count = new._shared.written = int(past.meta[0])
        return new

    def numbers(self) -> Array:
        """Return values and slopes of all its steps in one row: the states of a linear view."""
        import numpy as np

        past = self._copy(self._capacity)
        return np.concatenate([getattr(past, field).ravel() for field in FIELDS])

    def with_numbers(self, row: Array) -> Track:
        """Return it with other values and slopes, in the order of `numbers`."""
        past = self._copy(self._capacity)
        rows = row.reshape(len(FIELDS), *past.x0.shape)
        return Track(past._replace(**{field: column.copy() for field, column in zip(FIELDS, rows, strict=True)}))

    def native(self) -> TrackRing:
        """Return the track in the form of native code."""
        return TrackRing(self._capacity, self._copy(2 * self._capacity))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Track):
            return NotImplemented
        left, right = self._copy(self._capacity), other._copy(other._capacity)
        return all(a.shape == b.shape and (a == b).all() for a, b in zip(left, right, strict=True))

    def _copy(self, room: int) -> Trajectory:
        """Return the valid steps at the start of arrays of the given length."""
        import numpy as np

        past, first, size = self._shared.past, self._count - self._capacity, self._capacity
        arrays = [np.zeros((room, *rows.shape[1:])) for rows in past[:-1]]
        for rows, new in zip(past[:-1], arrays, strict=True):
            new[:size] = rows[first : self._count]
        return Trajectory._make([*arrays, np.array([size, 0])])


class TrackRing(NamedTuple):
    """A `Track` in native code: one ring, which is updated in place."""

    capacity: int
    past: Trajectory

    def open(self, rows: int = 0) -> Trajectory:
        """See `Track.open`."""
        return self.past

    def after(self, past: Trajectory) -> TrackRing:
        """See `Track.after`."""
        return self

    def python(self) -> Track:
        """Return its Python form."""
        import numpy as np

        past, size = self.past, self.capacity
        newest = np.arange(past.meta[0] - size, past.meta[0]) % len(past.begin)
        return Track(Trajectory._make([*(rows[newest] for rows in past[:-1]), np.array([size, 0])]))


class _Shared:
    """Arrays of several tracks, and how many of their rows the longest of them has."""

    __slots__ = ("past", "written")

    def __init__(self, past: Trajectory, written: int) -> None:
        self.past, self.written = past, written


def _slope(function: Callable[[float], Array], t: float, step: float) -> Array:
    """Return the slope of a past at t from values at and before t (of order 4: the past may end at t).

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


@jit
def between(s: float, step: float, x0: float, x1: float, dx0: float, dx1: float) -> float:
    """Return the cubic Hermite polynomial between two samples.

    Parameters
    ----------
    s : float
        0 at the first, 1 at the second.
    step : float
        Time between them, s.
    x0, x1, dx0, dx1 : float
        Values and slopes (1/s) at both.
    """
    r = 1.0 - s
    return (1.0 + 2.0 * s) * r * r * x0 + s * r * r * step * dx0 + s * s * (3.0 - 2.0 * s) * x1 - s * s * r * step * dx1


@jit
def delayed(past: Trajectory, t: float, channel: int) -> float:
    """Create the native function that reads one channel of a past, at any time.

    Parameters
    ----------
    t : float
        Time, s. After the newest step its cubic is extrapolated (for a delay shorter than the step, which has order 4
        only while the solution is smooth). Before the oldest step its first value is used.
    """
    size = past.begin.shape[0]
    newest = past.meta[0] - 1
    row = newest % size
    usual = past.length[row]
    guess = int((past.begin[row] - t) / usual)
    # While the ring is not full, it has fewer steps than rows.
    oldest = max(newest - size + 1, 0)
    k = max(newest - max(guess, 0), oldest)
    # The last stage of a step is at its border but still belongs to the time before a jump that returns there.
    edge = 1e-9 * usual if past.meta[1] == 1 else -1e-9 * usual
    while k > oldest and t < past.begin[k % size] + edge:
        k -= 1
    while k < newest and t >= past.begin[(k + 1) % size] + edge:
        k += 1
    row = k % size
    s = (t - past.begin[row]) / past.length[row]
    if s <= 0.0:
        return past.x0[row, channel]
    # At the end of a step its own value is exact, where the polynomial would round.
    if s == 1.0:
        return past.x1[row, channel]
    return between(
        s,
        past.length[row],
        past.x0[row, channel],
        past.x1[row, channel],
        past.dx0[row, channel],
        past.dx1[row, channel],
    )


def integrator(rhs: Callable[..., None], limit: Callable[..., None] | None = None) -> Callable[..., None]:
    """Create the native step of a delay-differential equation.

    Parameters
    ----------
    rhs : callable
        `jit` function (t, x, past, p, dx): writes the slope of x into dx; reads delayed values by
        ``delayed(past, t - tau, channel)``; p is passed by the caller (inputs, parameters: a tuple or array).
    limit : callable, optional
        `jit` function (x, p): brings a state back into its range (a queue that cannot be negative), at each stage and
        at the end of a step. The right-hand side must return no slope that points outwards at a bound.

    Returns
    -------
    callable
        `jit` function (past, t, x, h, n, p): n Runge-Kutta steps of h seconds from t, x is changed in place and past is
        extended. The value in x may jump between calls: the history keeps both sides.
    """
    clip: Callable[..., None] = _nothing if limit is None else limit

    @jit
    def advance(past: Trajectory, t: float, x: Array, h: float, n: int, p: Any) -> None:
        width = x.shape[0]
        size = past.begin.shape[0]
        start, stage, slope, total = x.copy(), x.copy(), x.copy(), x.copy()
        for step in range(n):
            now = t + step * h
            row = past.meta[0] % size
            for j in range(width):
                start[j] = stage[j] = total[j] = x[j]
            for i in range(4):
                # for each stage: its time, its weight, and how far its slope extends to the next one
                past.meta[1] = 1 if i == 3 else 0
                t_stage = now if i == 0 else (now + h if i == 3 else now + 0.5 * h)
                weight = h / 6.0 if i == 0 or i == 3 else h / 3.0
                ahead = h if i == 2 else 0.5 * h
                rhs(t_stage, stage, past, p, slope)
                if i == 0:
                    first = slope.copy()
                for j in range(width):
                    total[j] += weight * slope[j]
                    stage[j] = start[j] + ahead * slope[j]
                clip(stage, p)
            clip(total, p)
            # A fifth evaluation: the slope at the end of the step, after `limit`, is needed for the cubic.
            rhs(now + h, total, past, p, slope)
            for j in range(width):
                past.x0[row, j], past.x1[row, j] = start[j], total[j]
                past.dx0[row, j], past.dx1[row, j] = first[j], slope[j]
                x[j] = total[j]
            past.begin[row], past.length[row] = now, h
            past.meta[0] += 1
            past.meta[1] = 0

    return advance


@jit
def _nothing(x: Array, p: Any) -> None:
    pass
