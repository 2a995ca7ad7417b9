"""The header stamp of a message, read from its bytes without decoding the rest."""

from __future__ import annotations

from struct import Struct

from softrig_core import SECOND
from softrig_core.wire.types import TYPES

from .topics import BagTopic

_LITTLE, _BIG = Struct("<iI"), Struct(">iI")


def is_stamped(topic: BagTopic) -> bool:
    """Return whether messages of a topic begin with a header or a time."""
    if topic.msgtype in TYPES:
        return TYPES[topic.msgtype].stamped
    # Constants have no place in a message, so the first field is the first line that is none.
    lines = (line.partition("#")[0].split() for line in topic.definition.splitlines())
    first = next((words[0] for words in lines if words and not _is_constant(words)), "")
    return first in ("std_msgs/Header", "std_msgs/msg/Header", "Header", "builtin_interfaces/Time")


def _is_constant(words: list[str]) -> bool:
    return "=" in "".join(words[1:2]) or words[2:3] == ["="]


def stamp(data: bytes, start: int = 4) -> int:
    """Return the stamp in ns of a message that begins with one, or the time or duration at another byte."""
    seconds, nanoseconds = (_LITTLE if data[1] & 1 else _BIG).unpack_from(data, start)
    return seconds * SECOND + nanoseconds
