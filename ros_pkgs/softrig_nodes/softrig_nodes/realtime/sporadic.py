"""A sender in real time that may be silent: its acknowledgements report at which ticks, so a controller can wait."""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Sequence

from softrig_core.block.port import Port

from ..adapter.sender import Sender
from ..seam.tick import TICK, TickReader
from .live import KEPT, Live, LiveSenders


class Sporadic(Live):
    """A row of a controller that receives reports at which of its ticks the sender was silent.

    A message and the acknowledgement of its tick may overtake each other. The row waits for a message that was
    acknowledged as sent.
    """

    def __init__(self, table: LiveSenders, port: Port) -> None:
        super().__init__(table, port)
        self._acknowledged = -1  # stamp of the newest tick that the publisher has acknowledged
        self._sent: deque[int] = deque(maxlen=KEPT)  # stamps of sent messages that have not arrived

    def acknowledge(self, stamp: int, published: bool) -> None:
        """Process the report whether the sender published on this topic at the tick of a stamp."""
        if self.deaf() or stamp <= self._acknowledged:
            return
        self._begin(stamp)
        self._acknowledged = stamp
        if published:
            self._sent.append(stamp)
            return
        now = self.table.clock()
        self.arrived = now
        self.expected = self._optional
        if self.table.stale:
            self._recovered()
        self.table.on_value(self, stamp, stamp, None, now)

    def complete(self, stamp: int) -> bool:
        """Return whether it is known for the tick of a stamp that the sender published or was silent."""
        if not self.awaited and not self.expected:
            return True
        assert self.schedule is not None
        t = stamp - self.node.epoch
        want = self.node.epoch + self.schedule.awaited(t)
        newest = -1 if self.stamp is None else self.stamp
        # Messages of a writer arrive in order, so one with a later stamp shows that those before it have arrived.
        while self._sent and self._sent[0] <= newest:
            self._sent.popleft()
        complete = newest >= want or (self._acknowledged >= want and not (self._sent and self._sent[0] <= want))
        if complete:
            self.holds = self.node.epoch + self.schedule.next(t)
        return complete

    def ready(self, stamp: int) -> bool:
        """Return True: before the first message the block gets the safe value of the port."""
        return True

    def value_at(self, stamp: int) -> object:
        """Return the newest value up to a tick; end the wait for messages that were sent for it but did not arrive."""
        while self._sent and self._sent[0] <= stamp:
            self._sent.popleft()
        return super().value_at(stamp)

    def held_stamp(self) -> int | None:
        """Return the stamp of the value that the block gets, ns from its t = 0; None before the first message
        is used.
        """
        return None if self._used is None else self._used - self.node.epoch


class Acknowledgements(Sender):
    """The acknowledgements of a node's ticks, for those of its ports that may be silent.

    Parameters
    ----------
    name : str
        The node.
    rows : sequence of (Sporadic, str)
        Rows that we read from it, and the names of their ports.
    """

    def __init__(self, table: LiveSenders, name: str, rows: Sequence[tuple[Sporadic, str]]) -> None:
        super().__init__(table.node, Port("stamp", f"{table.node.namespace}/{name}/tick", TICK), name)
        self._table, self._rows, self._reader = table, rows, TickReader()

    def deaf(self) -> bool:
        """Return whether acknowledgements are ignored, as before the start and after the end."""
        return self.node.state != "running"

    def read(self, data: bytes) -> tuple[int, Collection[str]]:
        """Return the stamp and the ports that published."""
        stamp, published = self._reader(data)
        self._table.believe(stamp)
        return stamp, published

    def rejected(self, data: bytes) -> None:
        """Ignore an invalid acknowledgement: another one follows."""

    def accept(self, stamp: int, names: Collection[str], data: bytes) -> None:
        """Notify the rows."""
        for row, name in self._rows:
            row.acknowledge(stamp, name in names)
        self._table.act()


def listen(table: LiveSenders, rows: Iterable[Sporadic]) -> list[Acknowledgements]:
    """Subscribe to the acknowledgements of the senders of some rows."""
    node = table.node
    by_sender: dict[str, list[tuple[Sporadic, str]]] = {}
    for row in rows:
        by_sender.setdefault(row.publisher, []).append((row, node.links.inputs[row.name].port))
    result = [Acknowledgements(table, name, its_rows) for name, its_rows in by_sender.items()]
    for acknowledgement in result:
        node.paces.append(acknowledgement)
        node.middleware.subscribe(acknowledgement.port.topic, TICK, acknowledgement)
    return result
