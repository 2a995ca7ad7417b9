"""Recorders that a rig waits for: a recorder that subscribes to topics as they appear would miss its first ticks.

The nodes of a rig wait for a recorder that offers `RECORDER` on every topic that they publish, except those that it
lists there as left out; it repeats this message. The nodes wait for other recorders (rosbag2) if the rig is given their
names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from softrig_core.block.block import Level
from softrig_core.block.port import Refused

from .middleware import Middleware, Reader
from .tick import TICK, TickReader, TickWriter

RECORDER = "/_softrig/recorder"  # hidden: no tool lists or records it unasked


def left_out(recorder: str, topics: Iterable[str]) -> bytes:
    """Return the message by which a recorder lists the topics that it leaves out.

    Parameters
    ----------
    recorder : str
        Full name of the recorder.
    topics : iterable of str
        Full names of the topics.
    """
    return TickWriter()(0, [f"{recorder}:{topic}" for topic in topics])


class Awaited(Reader):
    """The recorders that must read the first message of each topic of a node.

    Parameters
    ----------
    named : sequence of str
        Nodes that read everything.
    """

    def __init__(self, middleware: Middleware, named: Sequence[str]) -> None:
        self._middleware = middleware
        self._named = list(named)
        self._left_out: frozenset[str] = frozenset()
        self._read = TickReader()
        middleware.subscribe(RECORDER, TICK, self)

    def receive(self, data: bytes) -> None:
        """Store the topics that a recorder leaves out."""
        try:
            self._left_out |= self._read(data)[1]
        except Refused as error:
            self._middleware.log(Level.ERROR, f"refused on {RECORDER}: {error}")

    def of(self, topic: str) -> list[str]:
        """Name the recorders that subscribe to a topic, given by its full name."""
        asking = self._middleware.publishers(RECORDER)
        return self._named + [p.name for p in asking if f"{p.full_name}:{topic}" not in self._left_out]
