"""Recorders that ask a rig to wait for them: who picks topics up as they appear would otherwise miss its first ticks.

A recorder that offers `RECORDER` is awaited by the nodes of a rig on everything they publish, but for what it says
there, again and again, that it leaves out. Other recorders (rosbag2) are awaited where the rig is told their names.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from softrig_core.block.block import Level
from softrig_core.block.port import Refused

from .middleware import Middleware, Reader
from .tick import TICK, TickReader, TickWriter

RECORDER = "/_softrig/recorder"  # hidden: no tool lists or records it unasked


def left_out(recorder: str, topics: Iterable[str]) -> bytes:
    """Return the message by which a recorder says what it leaves out.

    Parameters
    ----------
    recorder : str
        Its full name.
    topics : iterable of str
        By their full names.
    """
    return TickWriter()(0, [f"{recorder}:{topic}" for topic in topics])


class Awaited(Reader):
    """Who is awaited, to read the first message of each topic of a node.

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
        """Note what a recorder leaves out."""
        try:
            self._left_out |= self._read(data)[1]
        except Refused as error:
            self._middleware.log(Level.ERROR, f"refused on {RECORDER}: {error}")

    def of(self, topic: str) -> list[str]:
        """Name those that read a topic, by its full name."""
        asking = self._middleware.publishers(RECORDER)
        return self._named + [p.name for p in asking if f"{p.full_name}:{topic}" not in self._left_out]
