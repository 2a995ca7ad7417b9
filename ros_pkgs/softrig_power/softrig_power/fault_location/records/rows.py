"""The samples of a record while it grows, as a value."""

from __future__ import annotations

Row = tuple[float, ...]


class Rows:
    """The newest samples, a value: one more makes another, and the one before stays what it was.

    Parameters
    ----------
    most : int
        How many are kept.

    Notes
    -----
    A sample more costs one place in a list that several share: who adds to the newest of them writes behind it, who
    adds to an older one gets a list of his own.
    """

    __slots__ = ("_count", "_list", "most")

    def __init__(self, most: int) -> None:
        self.most, self._count = most, 0
        self._list: list[Row] = []

    def put(self, row: Row) -> Rows:
        """Return them with one more; the oldest goes where there are too many."""
        rows = self._list
        if self._count != len(rows) or self._count >= 2 * self.most:
            rows = self.newest()
        rows.append(row)
        result = object.__new__(Rows)
        result.most, result._count, result._list = self.most, len(rows), rows
        return result

    def newest(self) -> list[Row]:
        """Return them, the oldest first."""
        return self._list[max(0, self._count - self.most) : self._count]

    def __eq__(self, other: object) -> bool:
        return self.newest() == other.newest() if isinstance(other, Rows) else NotImplemented

    __hash__ = None  # type: ignore[assignment]
