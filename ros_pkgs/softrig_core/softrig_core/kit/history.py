"""Delay lines: the newest samples of a signal, read at any fractional age."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

Row = tuple[float, ...]


def aged(samples: Sequence[Row], age: float) -> Row:
    """Read all channels of samples, the newest last, at an age in samples; beyond the oldest, that one.

    Between two samples it is the straight line. There are at least two.
    """
    size = len(samples)
    back = min(int(age), size - 2)
    part = min(age, size - 1.0) - back
    newer = samples[-1 - back]
    if part == 0.0:
        return newer
    older = samples[-2 - back]
    return tuple([new + part * (old - new) for new, old in zip(newer, older, strict=True)])


def samples_of(step: float, longest: float) -> int:
    """Give how many samples a line needs whose longest delay is so long (both in s)."""
    # more than the samples around the longest delay, so that a delay that rounds up is still inside
    return math.ceil(longest / step - 1e-9) + 3


class History:
    """The newest samples of a signal, read on a straight line between two at any age up to the longest delay.

    That is exact where the signal is a line, and a jump between two samples stays between them; elsewhere the error
    is h^2/8 x''. A plant's own delay equation wants order four: `softrig_core.kit.dde`.

    Parameters
    ----------
    step : float
        Time between samples, s.
    longest : float
        Longest delay that will be asked for, s.
    past : sequence of float
        The signal at and before its first sample, one value a channel.

    Raises
    ------
    ValueError
        A step that is not positive, a longest delay that is not finite or negative.

    Examples
    --------
    >>> line = History(step=0.001, longest=0.25, past=(0.0,))
    >>> line.put((1.0,))
    >>> line.at(0.0005)
    (0.5,)
    """

    def __init__(self, step: float, longest: float, past: Sequence[float] = (0.0,)) -> None:
        if not step > 0.0 or not math.isfinite(step):
            raise ValueError(f"step = {step} s: expected a positive time")
        if not longest >= 0.0 or not math.isfinite(longest):
            raise ValueError(f"longest delay = {longest} s: expected a finite time of at least 0")
        self.step, self.longest = step, longest
        self._size = samples_of(step, longest)
        self.reset(past)

    def reset(self, past: Sequence[float]) -> None:
        """Fill in the past again; the sample at age 0 is the past at time 0."""
        self._samples = deque([tuple(past)] * self._size, self._size)  # the newest last

    def put(self, values: Sequence[float]) -> None:
        """Add the next sample, one value a channel.

        Raises
        ------
        ValueError
            Another number of values than before.
        """
        if len(values) != len(self._samples[0]):
            raise ValueError(f"{len(values)} values, expected {len(self._samples[0])}")
        self._samples.append(tuple(values))

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
        return self.aged(delay / self.step)

    def aged(self, age: float) -> tuple[float, ...]:
        """Read all channels at an age in samples: 0 is the newest, 1 the one before; beyond the oldest, that one."""
        return aged(self._samples, age)
