"""The samples of a growing record: as an immutable value, and in the form for native code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Row = tuple[float, ...]


class Rows:
    """The newest samples as an immutable value: adding a sample returns a new value and leaves the old one unchanged.

    Parameters
    ----------
    most : int
        Number of samples to keep.
    width : int
        Numbers per row.

    Notes
    -----
    Adding a sample appends one item to a list that several values share. Adding to the newest value appends to
    this list; adding to an older value copies the list first. If native code has filled a table, the list is created
    from the table only on demand. This is rare, because native code usually continues with the table.
    """

    __slots__ = ("_count", "_list", "_table", "most", "width")
    SCRATCH = frozenset({"_list"})  # list of a table, made when it is needed

    _list: list[Row] | None
    _table: NDArray[np.float64] | None

    def __init__(self, most: int, width: int) -> None:
        self.most, self.width, self._count = most, width, 0
        self._list, self._table = [], None

    def put(self, row: Row) -> Rows:
        """Return the samples with one more; the oldest is dropped if there are too many."""
        rows = self._rows()
        if self._count != len(rows) or self._count >= 2 * self.most:
            rows = self.newest()
        rows.append(row)
        return _with(self.most, self.width, len(rows), rows)

    def newest(self) -> list[Row]:
        """Return them, the oldest first."""
        return self._rows()[max(0, self._count - self.most) : self._count]

    def native(self) -> RowsRing:
        """Convert the samples to their form for native code."""
        rows = np.array(self.newest(), dtype=np.float64) if self._table is None else self._table
        ring = np.zeros(self.most * self.width)
        ring[: rows.size] = rows.ravel()
        return RowsRing(self.most, self.width, len(rows), ring)

    def _rows(self) -> list[Row]:
        if self._list is None:
            assert self._table is not None
            self._list = list(map(tuple, self._table.tolist()))
        return self._list

    def __repr__(self) -> str:
        """Show the rows."""
        return f"Rows({self.newest()})"

    def __eq__(self, other: object) -> bool:
        return self.newest() == other.newest() if isinstance(other, Rows) else NotImplemented


def _with(most: int, width: int, count: int, rows: list[Row] | None, table: NDArray[np.float64] | None = None) -> Rows:
    result = object.__new__(Rows)
    result.most, result.width, result._count, result._list, result._table = most, width, count, rows, table
    return result


class RowsRing(NamedTuple):
    """`Rows` in native code, which writes them into one ring."""

    most: int
    width: int
    written: int
    ring: NDArray[np.float64]

    def put(self, row: Row) -> RowsRing:
        """See `Rows.put`."""
        offset = self.written % self.most * self.width
        for k, value in enumerate(row):
            self.ring[offset + k] = value
        return self._replace(written=self.written + 1)

    def python(self) -> Rows:
        """Return them as Python has them."""
        table, oldest = self.ring.reshape(self.most, self.width), self.written % self.most
        full = self.written >= self.most
        newest = np.concatenate([table[oldest:], table[:oldest]]) if full else table[:oldest].copy()
        return _with(self.most, self.width, len(newest), None, newest)
