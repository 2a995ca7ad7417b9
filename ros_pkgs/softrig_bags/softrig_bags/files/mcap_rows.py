"""Messages of a recording in the form of MCAP, in blocks of numbers if the recording has numbers.

The bytes are those of `McapFile.write` called for each message: the same records in the same chunks.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from softrig_core import Recording
from softrig_core.wire.recording import Topic

from ..errors import BagError
from .mcap_file import McapFile
from .mcap_format import MESSAGE

_HEAD = [("code", "u1"), ("length", "<u8"), ("number", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")]
_HEAD_SIZE = np.dtype(_HEAD).itemsize
_LENGTH = 22  # bytes of a message's record beside its data


class _Feed:
    """Messages of a topic in their order, some at a time."""

    def __init__(self, topic: Topic, number: int) -> None:
        self.number = number
        self._columns = topic.columns()
        self._times, self._data = ([], []) if self._columns else (topic.times, topic.data)
        self._position = 0

    def sizes(self, count: int) -> NDArray[np.int64] | int:
        """Return the number of bytes of each of the first unread messages; one number if all are equally long."""
        if self._columns is not None:
            return self._columns.layout.length
        return np.fromiter(map(len, self._data[self._position : self._position + count]), np.int64, count)

    def read(self, count: int) -> tuple[NDArray[np.int64], NDArray[np.uint8] | list[bytes]]:
        """Return times and bytes of the next messages; an array of shape (count, bytes) where all are of one length."""
        first, last = self._position, self._position + count
        self._position = last
        if self._columns is not None:
            columns = self._columns.part(first, last)
            return columns.times, columns.encoded(first)
        data = self._data[first:last]
        times = np.array(self._times[first:last], np.int64)
        if len(set(map(len, data))) > 1:
            return times, data
        return times, np.frombuffer(b"".join(data), np.uint8).reshape(count, -1)


def write_recording(file: McapFile, recording: Recording, numbers: Mapping[str, int]) -> None:
    """Append all messages of a recording by time, equal times in topic order.

    Parameters
    ----------
    numbers : mapping of str to int
        Number of each topic in the file.

    Raises
    ------
    BagError
        A time is negative, which a bag cannot hold.
    """
    for topic in recording.topics.values():
        if (earliest := int(np.min(topic.ticks(), initial=0))) < 0:
            raise BagError(f"{topic.name}: a message at {earliest} ns, expected times from 0 on")
    feeds = [_Feed(topic, numbers[name]) for name, topic in recording.topics.items()]
    for ranks in recording.order():
        sizes = np.empty(len(ranks), np.int64)
        for rank, feed in enumerate(feeds):
            rows = np.flatnonzero(ranks == rank)
            sizes[rows] = feed.sizes(len(rows))
        ends = np.cumsum(sizes + _HEAD_SIZE)
        done = 0
        while done < len(ranks):
            before = int(ends[done - 1]) if done else 0
            # The bytes must be those of `McapFile.write`, so a chunk ends with the message that reaches its size.
            full = int(np.searchsorted(ends, before + file.CHUNK_BYTES - file.waiting)) + 1
            chunk = slice(done, min(full, len(ranks)))
            begins = ends[chunk] - sizes[chunk] - _HEAD_SIZE - before
            _write_part(file, feeds, ranks[chunk], begins, int(ends[chunk.stop - 1]) - before)
            done = chunk.stop


def _write_part(file: McapFile, feeds: list[_Feed], ranks: NDArray[Any], offsets: NDArray[np.int64], size: int) -> None:
    """Append messages that go into one chunk; `offsets` is the offset of each message."""
    content = np.empty(size, np.uint8)
    index = {}
    known, begins = np.unique(ranks, return_index=True)
    for rank in known[np.argsort(begins)].tolist():
        selected = offsets[np.flatnonzero(ranks == rank)]
        times, data = feeds[rank].read(len(selected))
        number = feeds[rank].number
        index[number] = times, selected
        if isinstance(data, list):
            for k, message in enumerate(data):
                _write_at(
                    content, selected[k : k + 1], number, times[k : k + 1], np.frombuffer(message, np.uint8)[None]
                )
        else:
            _write_at(content, selected, number, times, data)
    file.write_block(content.tobytes(), index)


def _write_at(
    content: NDArray[np.uint8],
    offsets: NDArray[np.int64],
    number: int,
    times: NDArray[np.int64],
    data: NDArray[np.uint8],
) -> None:
    """Write the records of messages of one length where they belong."""
    count, length = data.shape
    kind = np.dtype([*_HEAD, ("data", "u1", (length,))])
    steps = np.diff(offsets)
    # A rig publishes the same topics at each tick, so a topic's records mostly lie at equal distances in the chunk.
    regular = not len(steps) or bool((steps == steps[0]).all())
    if regular:
        step = int(steps[0]) if len(steps) else kind.itemsize
        rows: Any = np.ndarray((count,), kind, content.data, int(offsets[0]), (step,))
    else:
        rows = np.empty(count, kind)
    rows["code"], rows["length"], rows["number"], rows["sequence"] = MESSAGE, _LENGTH + length, number, 0
    rows["log"] = rows["publish"] = times
    rows["data"] = data
    if not regular:
        content[offsets[:, None] + np.arange(kind.itemsize)] = rows.view(np.uint8).reshape(count, -1)
