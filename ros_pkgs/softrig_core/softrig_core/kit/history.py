"""Delay lines: the newest samples of a signal, read at any fractional age."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple

from .jit import jit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

Row = tuple[float, ...]


class History:
    """The newest samples of a signal, as a value: interpolated linearly at any age up to the longest delay.

    The result is exact where the signal is a line, and a jump between two samples stays between them. Elsewhere the
    error is h^2/8 x''. A plant's own delay equation needs order four: use `softrig_core.kit.dde`.

    Parameters
    ----------
    step : float
        Time between samples, s.
    longest : float
        Longest delay that will be requested, s.
    past : sequence of float
        The signal at and before its first sample, one value a channel.

    Raises
    ------
    ValueError
        A step that is not positive, a longest delay that is not finite or negative.

    Notes
    -----
    Histories share a list, so each new sample needs only one more place. A sample for the newest history is appended
    to the shared list; an older history gets a list of its own.

    Examples
    --------
    >>> line = History(step=0.001, longest=0.25, past=(0.0,))
    >>> later = line.put((1.0,))
    >>> later.at(0.0005), line.at(0.0005)
    ((0.5,), (0.0,))
    """

    __slots__ = ("_count", "_line")
    RING: ClassVar[type[HistoryRing]]
    # Later histories append to the shared list, but the rows that this one reads never change.
    SCRATCH = frozenset({"_line"})

    _line: _Line
    _count: int  # rows of the line up to its newest sample

    def __init__(self, step: float, longest: float, past: Sequence[float] = (0.0,)) -> None:
        if not step > 0.0 or not math.isfinite(step):
            raise ValueError(f"step = {step} s: expected a positive time")
        if not longest >= 0.0 or not math.isfinite(longest):
            raise ValueError(f"longest delay = {longest} s: expected a finite time of at least 0")
        self._count = size = History.rows(step, longest)
        self._line = _Line(step, longest, size, [tuple(past)] * size)

    @staticmethod
    def rows(step: float, longest: float) -> int:
        """Return the number of stored samples: around the longest delay, and one more if it is rounded up."""
        return math.ceil(longest / step - 1e-9) + 3

    def put(self, values: Sequence[float]) -> History:
        """Return the history with one sample more, one value a channel.

        Raises
        ------
        ValueError
            Another number of values than before.
        """
        line, count = self._line, self._count
        if len(values) != line.width:
            raise ValueError(f"{len(values)} values, expected {line.width}")
        # A later history has added to the list already, or the list is full, so this one gets its own.
        if count != len(line.rows) or count == line.full:
            line = _Line(line.step, line.longest, line.size, self._newest())
            count = line.size
        line.rows.append(tuple(values))
        new: History = _new(History)
        new._line, new._count = line, count + 1
        return new

    def again(self) -> History:
        """Return the history with its newest sample once more."""
        return self.put(self._line.rows[self._count - 1])

    def at(self, delay: float) -> Row:
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
        line = self._line
        # A delay computed from the same parameters may exceed the longest one by rounding.
        if not 0.0 <= delay <= line.longest * (1.0 + 1e-9):
            raise ValueError(f"delay = {delay} s: expected 0 to {line.longest} s")
        return self.aged(delay / line.step)

    def back(self, k: int) -> Row:
        """Return the k-th sample before the newest; the longest delay reaches that far."""
        return self._line.rows[self._count - 1 - k]

    def aged(self, age: float) -> Row:
        """Read all channels at an age in samples: 0 is the newest, 1 the one before; beyond the oldest, that one."""
        line = self._line
        back = min(int(age), line.size - 2)
        share = min(age, line.size - 1.0) - back
        index = self._count - 1 - back
        newer = line.rows[index]
        if share == 0.0:
            return newer
        older = line.rows[index - 1]
        return tuple([new + share * (old - new) for new, old in zip(newer, older, strict=True)])

    def numbers(self) -> NDArray[np.float64]:
        """Return all its samples in one row, the oldest first: the states of a linear view."""
        import numpy as np

        return np.array(self._newest(), dtype=np.float64).ravel()

    def with_numbers(self, row: NDArray[np.float64]) -> History:
        """Return it with other samples, in the order of `numbers`."""
        line = self._line
        rows = [tuple(values) for values in row.reshape(line.size, -1).tolist()]
        return History.of(line.step, line.longest, rows)

    @classmethod
    def of(cls, step: float, longest: float, rows: list[tuple[float, ...]]) -> History:
        """Return a history with these samples, at most as many as it stores."""
        new: History = _new(History)
        new._line, new._count = _Line(step, longest, len(rows), rows), len(rows)
        return new

    def native(self) -> HistoryRing:
        """Return the history in the form of native code."""
        import numpy as np

        line, rows = self._line, self._newest()
        ring = np.zeros(2 * line.size * line.width)
        ring[: line.size * line.width] = np.array(rows, np.float64).ravel()
        return HistoryRing(line.step, line.longest, line.size, line.size, tuple(map(float, rows[-1])), ring)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, History):
            return NotImplemented
        left, right = self._line, other._line
        return (left.step, left.longest, self._newest()) == (right.step, right.longest, other._newest())

    def _newest(self) -> list[Row]:
        return self._line.rows[self._count - self._line.size : self._count]


_new = object.__new__


class _Line:
    """Rows of several successive histories, of which `size` are valid."""

    __slots__ = ("full", "longest", "rows", "size", "step", "width")

    def __init__(self, step: float, longest: float, size: int, rows: list[Row]) -> None:
        self.step, self.longest, self.size, self.rows = step, longest, size, rows
        self.width, self.full = len(rows[0]), 2 * size


class HistoryRing(NamedTuple):
    """A `History` in native code, which puts samples into one ring; the newest is at hand.

    Native code uses it: its arithmetic is the same as that of `History`.
    """

    step: float
    longest: float
    size: int
    written: int
    newest: Row
    ring: NDArray[np.float64]

    @staticmethod
    def begin(size: int, step: float, longest: float, past: Sequence[float] = (0.0,)) -> HistoryRing:
        """See `History`."""
        row = tuple([float(v) for v in past])
        return HistoryRing(step, longest, size, size, row, _repeated(size, row))

    def put(self, values: Sequence[float]) -> HistoryRing:
        """See `History.put`."""
        if len(values) != len(self.newest):
            raise ValueError(f"{len(values)} values, expected {len(self.newest)}")
        row = tuple([float(v) for v in values])
        _write(self.ring, self.written % (2 * self.size) * len(self.newest), row)
        return self._replace(written=self.written + 1, newest=row)

    def again(self) -> HistoryRing:
        """See `History.again`."""
        return self.put(self.newest)

    def at(self, delay: float) -> Row:
        """See `History.at`."""
        if not 0.0 <= delay <= self.longest * (1.0 + 1e-9):
            raise ValueError(f"delay = {delay} s: expected 0 to {self.longest} s")
        return self.aged(delay / self.step)

    def back(self, k: int) -> Row:
        """See `History.back`."""
        index, width = (self.written - 1 - k) % (2 * self.size), len(self.newest)
        return tuple([self.ring[index * width + j] for j, _ in enumerate(self.newest)])

    def aged(self, age: float) -> Row:
        """See `History.aged`."""
        back = min(int(age), self.size - 2)
        share = min(age, self.size - 1.0) - back
        index, room, width = self.written - 1 - back, 2 * self.size, len(self.newest)
        newer = tuple([self.ring[index % room * width + k] for k, _ in enumerate(self.newest)])
        if share == 0.0:
            return newer
        older = tuple([self.ring[(index - 1) % room * width + k] for k, _ in enumerate(self.newest)])
        return tuple([new + share * (old - new) for new, old in zip(newer, older, strict=True)])

    def python(self) -> History:
        """Return its Python form."""
        size, width = self.size, len(self.newest)
        table = self.ring.reshape(2 * size, width).tolist()
        rows = [tuple(table[k % (2 * size)]) for k in range(self.written - size, self.written)]
        return History.of(self.step, self.longest, rows)


History.RING = HistoryRing


@jit
def _repeated(size: int, row: Row) -> NDArray[np.float64]:
    import numpy as np

    n = len(row)
    ring = np.zeros(2 * size * n)
    for k in range(size):
        for j in range(n):
            ring[k * n + j] = row[j]
    return ring


@jit
def _write(ring: NDArray[np.float64], offset: int, row: Row) -> None:
    for k in range(len(row)):
        ring[offset + k] = row[k]
