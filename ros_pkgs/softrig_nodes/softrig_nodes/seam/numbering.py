"""Append numbers to counted messages in a rig with restarts: a repeated message is recognised by its number.

The stamp of such a message is not the time of its tick. Its number on its topic, from 0, is stored in eight bytes
after its end. A CDR reader stops before them, and a recording never contains them.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from softrig_core.block.codec import next_number
from softrig_core.wire.cdr import Layout

_NUMBER = struct.Struct("<Q")


class Numbering:
    """Publishes messages of one topic, each with its number.

    Parameters
    ----------
    publish : callable
        Gets the bytes.
    layout : Layout
        Of the messages.
    counts : dict of str to int
        By output: messages published before, see `Step.counts`.
    name : str
        Of the output.
    """

    def __init__(self, publish: Callable[[bytes], None], layout: Layout, counts: dict[str, int], name: str) -> None:
        self.publish: Callable[..., None] = publish
        self._encode, self._counts, self._name = layout.encode, counts, name

    def __call__(self, mark: int, values: tuple[float, ...]) -> None:
        """Publish the next message: its stamp in ns and all numbers."""
        self.publish(numbered(next_number(self._counts, self._name), self._encode(mark, values)))


def numbered(number: int, data: bytes) -> bytes:
    """Return a message with its number appended."""
    return data + _NUMBER.pack(number)


def split(data: bytes) -> tuple[int, bytes]:
    """Return the number of a message and the message without it."""
    return int.from_bytes(data[-_NUMBER.size :], "little"), data[: -_NUMBER.size]
