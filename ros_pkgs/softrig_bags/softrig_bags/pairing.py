"""Pairing of the messages of two bags: by equal stamps, and equal stamps by order."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .content.block import Block, Bytes, Ints, distinct, joined, rows_of
from .content.layouts import stamps_of

# Each search for partners sorts all that wait, so it begins only when so many new messages have come.
ROWS = 1 << 13
# Bytes. Bags that differ much leave many messages without a partner; beyond this limit they wait in a file.
SPILL = 1 << 26
# Encapsulation and stamp take so many bytes; a shorter message is damaged and is paired by its bag time.
_SHORTEST = 12

#: Gets a block of each bag, of each the rows that belong together, and their stamps.
Compare = Callable[[Block, NDArray[np.intp], Block, NDArray[np.intp], Ints], None]


def useless(stamps: NDArray[Any]) -> str:
    """Return why stamps do not date messages; an empty text if they do.

    Parameters
    ----------
    stamps : array of shape (n,)
        Of the messages of a topic.
    """
    if len(stamps) < 2 or np.ptp(stamps):
        return ""
    return f"header stamps are all {'zero' if not stamps[0] else 'equal'}"


class Pairing:
    """The messages of one topic that have no partner yet.

    Parameters
    ----------
    stamped : bool
        Whether messages have a header stamp; otherwise bag time is used.
    compare : callable
        See `Compare`; called when partners have been found.

    Attributes
    ----------
    note : str
        Why bag time is used in place of header stamps; empty where it is not.
    paired : int
        Number of messages that had a partner.
    """

    def __init__(self, stamped: bool, compare: Compare) -> None:
        self._stamped, self._compare = stamped, compare
        self._waiting: tuple[list[Block], list[Block]] = ([], [])
        self._left = self._new = 0
        self._decided = False
        self.note = ""
        self.paired = 0

    def add(self, side: int, block: Block) -> None:
        """Add messages of bag 0 or 1."""
        self._waiting[side].append(block.compact())
        self._new += len(block)
        # The threshold grows with the messages that wait, so that the cost of sorting stays proportional to the bag.
        if self._new >= max(ROWS, self._left // 4) and all(self._waiting):
            self._match()

    def finish(self) -> tuple[Ints, Ints]:
        """Return the stamps of the messages that have no partner, of either bag."""
        self._match()
        a, b = (_gathered(blocks) for blocks in self._waiting)
        return self._keys(a), self._keys(b)

    def _match(self) -> None:
        block_a, block_b = (_gathered(blocks) for blocks in self._waiting)
        # The decision stands for the whole topic: pairs by two different keys would not fit together.
        if not self._decided and self._stamped:
            self._decide(block_a, block_b)
        self._decided = True
        keys = self._keys(block_a), self._keys(block_b)
        pairs = matched(*keys, block_a.size, block_b.size)
        if len(pairs[0]):
            self.paired += len(pairs[0])
            self._compare(block_a, pairs[0], block_b, pairs[1], keys[0][pairs[0]])
        for blocks, block, rows in zip(self._waiting, (block_a, block_b), pairs, strict=True):
            remaining = np.ones(len(block), bool)
            remaining[rows] = False
            blocks[:] = [block.select(remaining).compact()] if remaining.any() else []
        self._left, self._new = sum(len(b) for blocks in self._waiting for b in blocks), 0

    def _decide(self, a: Block, b: Block) -> None:
        """Decide from the first stamps whether stamps date the messages."""
        for name, block in (("A", a), ("B", b)):
            if reason := useless(self._keys(block)):
                self.note = f"{reason} in {name}: paired by bag time"
                self._stamped = False
                return

    def _keys(self, block: Block) -> Ints:
        return keys_of(block, self._stamped)


def keys_of(block: Block, stamped: bool) -> Ints:
    """Return the keys by which messages are paired, ns: header stamps or bag times."""
    if not stamped or not len(block):
        return block.t
    keys = block.t.copy()
    long_enough = block.size >= _SHORTEST
    keys[long_enough] = stamps_of(block.raw, block.at[long_enough])
    return keys


def matched(a: Ints, b: Ints, size_a: Ints, size_b: Ints) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows that belong together: of equal keys the first with the first, the second with the second.

    If both have equally many messages of a key, these are ordered by length first, because publishers of one topic with
    equal stamps may appear in another order.
    """
    # Recordings of equal runs need no sorting, and this is the usual case.
    if len(a) == len(b) and (a == b).all() and (len(a) < 2 or (np.diff(a) > 0).all()):
        rows = np.arange(len(a))
        return rows, rows
    order_a, order_b = np.argsort(a, kind="stable"), np.argsort(b, kind="stable")
    keys_a, first_a, n_a = np.unique(a[order_a], return_index=True, return_counts=True)
    keys_b, first_b, n_b = np.unique(b[order_b], return_index=True, return_counts=True)
    _, at_a, at_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
    n = np.minimum(n_a[at_a], n_b[at_b])
    several = (n_a[at_a] == n_b[at_b]) & (n > 1)
    if several.any():
        for order, first, size in ((order_a, first_a[at_a], size_a), (order_b, first_b[at_b], size_b)):
            for k, m in zip(first[several].tolist(), n[several].tolist(), strict=True):
                run = order[k : k + m]
                order[k : k + m] = run[np.argsort(size[run], kind="stable")]
    within = np.arange(int(n.sum())) - np.repeat(np.cumsum(n) - n, n)
    rows_a = order_a[np.repeat(first_a[at_a], n) + within]
    rows_b = order_b[np.repeat(first_b[at_b], n) + within]
    by_row = np.argsort(rows_a, kind="stable")
    return rows_a[by_row], rows_b[by_row]


def _gathered(blocks: Sequence[Block]) -> Block:
    """Return the messages of several blocks as one, in a file where they are many."""
    if sum(len(b.raw) for b in blocks) <= SPILL or len(blocks) == 1:
        return joined(blocks)
    start, starts = 0, []
    with tempfile.TemporaryFile() as file:
        for block in blocks:
            file.write(memoryview(block.raw))  # type: ignore[arg-type]
            starts.append(block.at + start)
            start += len(block.raw)
        file.flush()
        raw: Bytes = np.memmap(file, np.uint8, "r", shape=(start,))
    topic, t, size = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("topic", "t", "size"))
    return Block(raw, topic, t, np.concatenate(starts), size)


def equal_rows(a: Block, rows_a: NDArray[np.intp], b: Block, rows_b: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return which pairs of messages have equal bytes."""
    size = a.size[rows_a]
    same: NDArray[np.bool_] = size == b.size[rows_b]
    for length in distinct(size[same]):
        chosen = np.flatnonzero(same & (size == length))
        rows_1, rows_2 = rows_of(a.raw, a.at[rows_a[chosen]], length), rows_of(b.raw, b.at[rows_b[chosen]], length)
        # Words of eight bytes are compared at a time, which is faster than single bytes.
        aligned = length // 8 * 8
        good = (rows_1[:, aligned:] == rows_2[:, aligned:]).all(axis=1)
        if aligned:
            good &= (rows_1[:, :aligned].view("<u8") == rows_2[:, :aligned].view("<u8")).all(axis=1)
        same[chosen] = good
    return same
