"""All calls of a library since its start: the state of a library that hides its own state."""

from __future__ import annotations

from typing import NamedTuple

Row = tuple[float, ...]


class Call(NamedTuple):
    """A call, and the numbers of the struct after it."""

    method: str
    values: Row
    state: Row


class History:
    """Calls in their order; a value: `after` returns a longer one that shares the common part."""

    __slots__ = ("length", "shared")

    def __init__(self, rows: list[Call] | None = None, length: int = 0) -> None:
        self.shared: list[Call] = [] if rows is None else rows
        self.length = length

    def after(self, reported: Call) -> History:
        """Return the history with one call more."""
        # After a rewind the shared list already has other calls behind this history; they belong to another branch.
        rows = self.shared if self.length == len(self.shared) else self.shared[: self.length]
        rows.append(reported)
        return History(rows, self.length + 1)

    def rows(self) -> list[Call]:
        """Return the calls."""
        return self.shared[: self.length]

    def is_same(self, other: History | None) -> bool:
        """Return whether another one is this one, or a copy of the same list."""
        return other is not None and other.shared is self.shared and other.length == self.length

    def __reduce__(self) -> tuple[type[History], tuple[list[Call], int]]:
        return History, (self.rows(), self.length)
