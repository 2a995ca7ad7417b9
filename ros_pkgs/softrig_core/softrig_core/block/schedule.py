"""Schedule: the one place for time. When a block is due, what a link holds, which tick is the last.

A period is a rational number of seconds, so that 1/2880 s stays exact in runs of any length; tick k is at ``t_k = k *
period``, rounded to the nearest ns. All schedules of a rig start together and have periods that are whole multiples of
the clock's, hence equal times round to equal stamps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from fractions import Fraction
from functools import lru_cache
from typing import TYPE_CHECKING

from ..timebase import SECOND

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@lru_cache(maxsize=1024)
def rational(seconds: float | str | Fraction) -> Fraction:
    """Return the exact number of seconds that a float stands for: the simplest fraction near it.

    Parameters
    ----------
    seconds : float, str or Fraction
        A float means the simplest fraction within one unit in its last place (0.00034722222222222224 is 1/2880,
        0.1 * 3 is 3/10); a text is a fraction or a decimal number ("1/2880", "0.001").

    Raises
    ------
    ValueError
        The text is no number.
    """
    if isinstance(seconds, Fraction):
        return seconds
    if isinstance(seconds, str):
        try:
            return Fraction(seconds)
        except (ValueError, ZeroDivisionError):
            raise ValueError(f"{seconds!r} is neither a number nor a fraction such as 1/2880") from None
    exact, step = Fraction(seconds), Fraction(math.ulp(seconds))
    return exact if exact.denominator == 1 else _simplest(exact - step, exact + step)


def _simplest(low: Fraction, high: Fraction) -> Fraction:
    """Return the fraction with the smallest denominator between two positive or two negative numbers."""
    if high < 0:
        return -_simplest(-high, -low)
    # This follows the continued fraction that both bounds share; where they part, the smallest denominator is
    # found.
    integer = math.floor(low)
    if low == integer:
        return Fraction(integer)
    if integer + 1 <= high:
        return Fraction(integer + 1)
    return integer + 1 / _simplest(1 / (high - integer), 1 / (low - integer))


class Schedule:
    """The ticks of one block in a run.

    Parameters
    ----------
    period : float, str or Fraction
        Period in s; see `rational`.
    clock : float, str or Fraction, optional
        Period of the rig's clock; `period` is an integer multiple of it. Default: the block's own period.
    duration : float, optional
        Length of the run in s; the run ends at the last tick of the clock that is not after it. None or 0: endless.
    at_end : bool
        Whether the block also has a tick at the end time, as plants, observers and blocks with `finish` do.

    Attributes
    ----------
    period : Fraction
        Period in s.
    every : int
        Number of clock ticks in a period.
    ticks : int or None
        Number of the clock's last tick.
    end : int or None
        Time of the clock's last tick in ns.
    last : int or None
        The block's own last tick, ns: the last one not after the end, or before the end without `at_end`.
    time : callable
        Tick number to time in ns.
    tick : callable
        Stamp in ns to the number of the tick to which it is nearest.
    held : callable
        Time in ns to the time of the block's newest tick: the stamp of the value that a link from it holds.
    next : callable
        Time in ns to the time of the first later tick.

    Raises
    ------
    ValueError
        The period is no multiple of the clock's, or the duration is shorter than one tick.
    """

    time: Callable[[int], int]
    tick: Callable[[int], int]
    held: Callable[[int], int]
    next: Callable[[int], int]

    def __init__(
        self,
        period: float | str | Fraction,
        clock: float | str | Fraction | None = None,
        duration: float | None = None,
        at_end: bool = False,
    ) -> None:
        self.period = rational(period)
        self.clock = self.period if clock is None else rational(clock)
        self.at_end = at_end
        ratio = self.period / self.clock
        if ratio.denominator != 1:
            raise ValueError(
                f"period {float(self.period)!r} s is not a multiple of the {float(self.clock)!r} s of the clock"
            )
        self.every = int(ratio)
        ns = self.period * SECOND
        self._n, self._d = ns.numerator, ns.denominator
        n = self._n
        # A period of whole nanoseconds is nearly always the case, and these functions are in the loop of every runner:
        # a bound method of the integer and a lambda save the calls and the divisions of the general form.
        if self._d == 1:
            self.time, self.tick = n.__mul__, lambda t: (2 * t + n) // (2 * n)
            self.held = lambda t: t - t % n
            self.next = lambda t: t - t % n + n
        else:
            self.time, self.tick = self._time, self._tick
            self.held = self._held
            self.next = self._next
        self.ticks: int | None = None
        self.end: int | None = None
        self.last: int | None = None
        if duration:
            # a duration that is half a ns short of a tick means that tick
            ticks = math.floor((rational(duration) + Fraction(1, 2 * SECOND)) / self.clock)
            if ticks < 1:
                raise ValueError(f"duration {duration:g} s is shorter than the period {float(self.clock):g} s")
            self.ticks = ticks
            self.end = (self if self.every == 1 else Schedule(self.clock)).time(ticks)
            self.last = self.time((ticks if self.at_end else ticks - 1) // self.every)

    def times(self, first: int, last: int) -> NDArray[np.int64]:
        """Return the times of ticks first to last - 1, ns, shape (last - first,)."""
        import numpy as np

        # numpy's integers overflow without an error, so long runs are computed with Python's.
        if 2 * last * self._n + self._d >= 1 << 62:
            return np.array([self.time(k) for k in range(first, last)], np.int64)
        # The general form needs two more arrays, which are fresh memory pages in a long run.
        if self._d == 1:
            return np.arange(first * self._n, last * self._n, self._n, dtype=np.int64)
        return (2 * np.arange(first, last, dtype=np.int64) * self._n + self._d) // (2 * self._d)

    def _tick(self, t: int) -> int:
        return (2 * t * self._d + self._n) // (2 * self._n)

    def due(self, t: int) -> bool:
        """Return whether `t` (ns) is one of the ticks."""
        return self.held(t) == t

    def before(self, t: int) -> int:
        """Return the time of the last tick before `t`, ns; negative if there is none."""
        return self.held(t - 1)

    def awaited(self, t: int) -> int:
        """Return the stamp of the message from this block that a reader needs at time `t`."""
        stamp = self.held(t)
        return stamp if self.last is None or stamp <= self.last else self.last

    def count(self) -> int:
        """Return the number of ticks at which the block publishes in the run."""
        if self.last is None:
            raise ValueError("the run has no end")
        return self.tick(self.last) + 1

    def _time(self, k: int) -> int:
        # To the nearest nanosecond, in integers: a float loses whole nanoseconds after 104 days.
        return (2 * k * self._n + self._d) // (2 * self._d)

    def _next(self, t: int) -> int:
        return self._time(self.tick(self._held(t)) + 1)

    def _held(self, t: int) -> int:
        # The nearest tick may lie after t, and its time is rounded up to half a nanosecond, so it is compared.
        k = self.tick(t)
        result = self._time(k)
        return result if result <= t else self._time(k - 1)


schedule_of = lru_cache(maxsize=256)(Schedule)  # cached, because the runs of a study have the same schedules


class Plan:
    """The ticks, by number, at which at least one of some members is due.

    Parameters
    ----------
    schedules : iterable of Schedule
        Of the members; they have one clock and end together.

    Attributes
    ----------
    stride : int
        Ticks of the rig's clock from one of these ticks to the next.
    clock : Schedule
        Number to time in ns, and back.
    ticks : int or None
        Number of the last one; None: there is none.
    """

    def __init__(self, schedules: Iterable[Schedule]) -> None:
        results = tuple(schedules)
        self.stride = math.gcd(*(s.every for s in results))
        self.clock = schedule_of(results[0].clock * self.stride)
        self.ticks = None if results[0].ticks is None else results[0].ticks // self.stride

    def every(self, schedule: Schedule) -> int:
        """Return how many ticks of the plan lie between two ticks of a member."""
        return schedule.every // self.stride

    def due(self, schedule: Schedule, k: int) -> bool:
        """Return whether a member has a tick at tick k of the plan."""
        return k % self.every(schedule) == 0

    def following(self, schedule: Schedule, k: int) -> int:
        """Return the first tick from k on at which a member is due."""
        every = self.every(schedule)
        return -(-k // every) * every

    def newest(self, schedule: Schedule, k: int) -> int:
        """Return the last tick up to k at which a member is due."""
        return k - k % self.every(schedule)

    def own(self, schedule: Schedule, first: int, last: int) -> range:
        """Return the ticks of a member, by its own numbers, that lie between two ticks of the plan."""
        every = self.every(schedule)
        return range((first + every - 1) // every, (last + every - 1) // every)

    def answers(self, schedule: Schedule, k: int) -> bool:
        """Return whether a member other than a plant, due at tick k, answers it; at the end of a run only some do."""
        return k != self.ticks or schedule.last == self.clock.time(k)

    def moves(self, schedule: Schedule, k: int) -> bool:
        """Return whether a plant that is due at tick k advances; it does not advance beyond the end."""
        return self.ticks is None or k + self.every(schedule) <= self.ticks
