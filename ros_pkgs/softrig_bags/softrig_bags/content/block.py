"""Many messages in one buffer, with arrays for the topic, time, offset and length of each message."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Block:
    """Messages in the order in which they are listed; no message is a Python object.

    Parameters
    ----------
    raw : array of uint8
        The buffer in which all of them are.
    topic : array of int64, shape (n,)
        Number of the topic of each message.
    t : array of int64, shape (n,)
        Bag time, ns.
    at, size : array of int64, shape (n,)
        Where the bytes of a message begin in the buffer, and how many there are.
    """

    raw: Bytes
    topic: Ints
    t: Ints
    at: Ints
    size: Ints

    def __len__(self) -> int:
        return len(self.t)

    def select(self, rows: NDArray[np.bool_] | NDArray[np.intp] | slice) -> Block:
        """Return some of the messages; they share the buffer."""
        return Block(self.raw, self.topic[rows], self.t[rows], self.at[rows], self.size[rows])

    def compact(self) -> Block:
        """Return the messages in a separate buffer that contains nothing else."""
        starts, start, pieces = np.empty_like(self.at), 0, []
        for length in distinct(self.size):
            chosen = np.flatnonzero(self.size == length)
            rows = rows_of(self.raw, self.at[chosen], length)
            pieces.append(np.ascontiguousarray(rows).reshape(-1))
            starts[chosen] = start + length * np.arange(len(rows))
            start += rows.size
        return Block(np.concatenate([*pieces, np.empty(0, np.uint8)]), self.topic, self.t, starts, self.size)

    def data(self, i: int) -> bytes:
        """Return the bytes of one message."""
        start = int(self.at[i])
        return self.raw[start : start + int(self.size[i])].tobytes()

    def texts(self) -> Iterator[bytes]:
        """Return the bytes of all messages in their order: as one piece where they have one length."""
        if len(lengths := distinct(self.size)) == 1:
            yield rows_of(self.raw, self.at, lengths[0]).tobytes()
        else:
            yield from (data for _, _, data in self.messages())

    def messages(self) -> Iterator[tuple[int, int, bytes]]:
        """Return topic number, bag time and bytes of each message."""
        view = memoryview(self.raw)
        rows = zip(self.topic.tolist(), self.t.tolist(), self.at.tolist(), self.size.tolist(), strict=True)
        for topic, t, start, size in rows:
            yield topic, t, bytes(view[start : start + size])


_NONE = np.empty(0, np.int64)
EMPTY = Block(np.empty(0, np.uint8), _NONE, _NONE, _NONE, _NONE)


def packed(data: Sequence[bytes | Bytes], like: Block) -> Block:
    """Return messages with other bytes, one after the other in a new buffer."""
    size = np.fromiter(map(len, data), np.int64, len(data))
    raw = np.frombuffer(b"".join(data), np.uint8)  # type: ignore[arg-type]
    return Block(raw, like.topic, like.t, np.cumsum(size) - size, size)


def joined(blocks: Sequence[Block]) -> Block:
    """Return the messages of several blocks, one block after the other."""
    if len(blocks) == 1:
        return blocks[0]
    if not blocks:
        return EMPTY
    starts = np.cumsum([0, *(len(b.raw) for b in blocks[:-1])])
    offsets = np.concatenate([b.at + start for b, start in zip(blocks, starts.tolist(), strict=True)])
    raw, topic, t, size = (np.concatenate([getattr(b, name) for b in blocks]) for name in ("raw", "topic", "t", "size"))
    return Block(raw, topic, t, offsets, size)


def numbers_at(raw: Bytes, starts: Ints, kind: str) -> NDArray[Any]:
    """Return the numbers of one type, as numpy names it, that begin at some bytes of a buffer, aligned or not."""
    width = int(kind[-1])
    if not len(starts):
        return np.empty(0, kind)
    return np.ndarray((len(raw) - width + 1,), kind, raw, strides=(1,))[starts]  # type: ignore[call-overload, no-any-return]


def distinct(numbers: Ints) -> list[int]:
    """Return the different ones of some numbers that are not negative, in order."""
    if not len(numbers):
        return []
    if numbers[0] == np.max(numbers) == np.min(numbers):
        return [int(numbers[0])]
    if np.max(numbers) < 1 << 16:
        return np.flatnonzero(np.bincount(numbers)).tolist()
    return np.unique(numbers).tolist()


def rows_of(raw: Bytes, starts: Ints, length: int) -> Bytes:
    """Return pieces of equal length as the rows of an array, a view where they are evenly spaced.

    Parameters
    ----------
    raw : array of uint8
        Buffer.
    starts : array of int64, shape (n,)
        Where the pieces begin; all of them are inside of the buffer.
    length : int
        Bytes of a piece.

    Returns
    -------
    array of uint8, shape (n, length)
        Not to be written to.
    """
    n = len(starts)
    if not n or not length:
        return np.empty((n, length), np.uint8)
    step = int(starts[1] - starts[0]) if n > 1 else length
    if step > 0 and (n < 3 or bool((np.diff(starts) == step).all())):
        return np.lib.stride_tricks.as_strided(raw[int(starts[0]) :], (n, length), (step, 1), writeable=False)
    return np.lib.stride_tricks.sliding_window_view(raw, length)[starts]
