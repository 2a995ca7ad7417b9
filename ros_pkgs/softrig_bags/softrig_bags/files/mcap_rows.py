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
_LENGTH = 22  # bytes of a message record in front of its data


class _Feed:
    """Messages of a topic in their order, some at a time.

    Attributes
    ----------
    length : int
        Number of bytes of each message; 0 if they are not equally long.
    """

    def __init__(self, topic: Topic, number: int) -> None:
        self.number = number
        self._columns = topic.columns()
        self._times, self._data = ([], []) if self._columns else (topic.times, topic.data)
        self._position = 0
        lengths = set(map(len, self._data))
        only = next(iter(lengths), 0) if len(lengths) < 2 else 0
        self.length = self._columns.layout.length if self._columns else only

    def sizes(self, count: int) -> NDArray[np.int64]:
        """Return the number of bytes of each of the first unread messages."""
        return np.fromiter(map(len, self._data[self._position : self._position + count]), np.int64, count)

    def read(self, count: int) -> tuple[NDArray[np.int64], list[NDArray[Any]]]:
        """Return times and records of the next messages; all records in one array if they are equally long."""
        first, last = self._position, self._position + count
        self._position = last
        if self._columns is not None:
            part = self._columns.part(first, last)
            records = self._records(part.times, self.length)
            part.encoded(first, records["data"])
            return part.times, [records]
        times, data = np.array(self._times[first:last], np.int64), self._data[first:last]
        if self.length:
            records = self._records(times, self.length)
            records["data"] = np.frombuffer(b"".join(data), np.uint8).reshape(count, -1)
            return times, [records]
        result = [self._records(times[k : k + 1], len(message)) for k, message in enumerate(data)]
        for record, message in zip(result, data, strict=True):
            record["data"] = np.frombuffer(message, np.uint8)
        return times, result

    def _records(self, times: NDArray[np.int64], length: int) -> NDArray[Any]:
        """Return records of messages of one length without their data."""
        rows = np.empty(len(times), np.dtype([*_HEAD, ("data", "u1", (length,))]))
        rows["code"], rows["length"], rows["number"], rows["sequence"] = MESSAGE, _LENGTH + length, self.number, 0
        rows["log"] = rows["publish"] = times
        return rows


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
    lengths = np.array([feed.length for feed in feeds], np.int64)
    for ranks in recording.order():
        sizes = lengths[ranks]
        for rank in np.flatnonzero(lengths == 0).tolist():
            rows = np.flatnonzero(ranks == rank)
            sizes[rows] = feeds[rank].sizes(len(rows))
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
    rows = [(rank, np.flatnonzero(ranks == rank)) for rank in range(len(feeds))]
    index = {}
    # Topics are listed in the order of their first messages.
    for rank, members in sorted((each for each in rows if each[1].size), key=lambda each: int(each[1][0])):
        selected, done = offsets[members], 0
        times, blocks = feeds[rank].read(len(selected))
        index[feeds[rank].number] = times, selected
        for records in blocks:
            _write_at(content, selected[done : done + len(records)], records)
            done += len(records)
    file.write_block(content, index)


def _write_at(content: NDArray[np.uint8], offsets: NDArray[np.int64], records: NDArray[Any]) -> None:
    """Write records of one length where they belong."""
    size = records.itemsize
    # An item of this view begins at each byte, so that a record is copied as a whole.
    items = np.ndarray((len(content) - size + 1,), np.dtype((np.void, size)), content.data, 0, (1,))
    items[offsets] = records.view(items.dtype)
