"""Piecewise constant signals in time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from typing import Generic, TypeVar

from softrig_core import BlockParams, param, to_ns

T = TypeVar("T")

NEVER = 2**63 - 1


class StepProfile(Generic[T]):
    """Values that change at given times and are held in between.

    Parameters
    ----------
    times : sequence of float
        In s, increasing; before the first the first value holds.
    values : sequence
        One a time.

    Raises
    ------
    ValueError
        Times not increasing, or another number of values than of times.
    """

    def __init__(self, times: Sequence[float], values: Sequence[T]) -> None:
        self._times = [to_ns(t) for t in times]
        if not times or any(b <= a for a, b in zip(self._times, self._times[1:], strict=False)):
            raise ValueError(f"times {list(times)}: expected at least one, each later than the one before")
        if len(values) != len(times):
            raise ValueError(f"{len(values)} values for {len(times)} times")
        self._values = list(values)

    def at(self, t: int) -> T:
        """Return the value at t (ns); a change at t itself has happened."""
        return self._values[max(0, bisect_right(self._times, t) - 1)]

    def next_change(self, t: int) -> int:
        """Return the time in ns of the first change after t, `NEVER` when there is none."""
        later = max(1, bisect_right(self._times, t))
        return self._times[later] if later < len(self._times) else NEVER


class ProfileParams(BlockParams):
    """Parameters of a block that publishes a step profile of several channels."""

    channels: tuple[str, ...] = param(("shaft",), "names of the channels", min_length=1)
    times: tuple[float, ...] = param(
        (0.0,), "times of the steps, increasing from 0", "s", min_length=1, each=(0.0, 1e9), live=True
    )

    def _check(self) -> None:
        if self.times[0] != 0.0:
            raise ValueError(f"times begins with {self.times[0]:g} s, expected 0")
        StepProfile(self.times, self.times)

    def rows(self, field: str) -> list[tuple[float, ...]]:
        """Cut the flat list `field` (all channels at the first time, then at the next, ...) into one row a time.

        Raises
        ------
        ValueError
            It has not times x channels values.
        """
        values: tuple[float, ...] = getattr(self, field)
        n = len(self.channels)
        if len(values) != len(self.times) * n:
            raise ValueError(
                f"{field} has {len(values)} values, expected {len(self.times) * n} "
                f"({len(self.times)} times, {n} channels)"
            )
        return [values[k : k + n] for k in range(0, len(values), n)]
