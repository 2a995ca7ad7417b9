"""The table of a node's publishers: who publishes what, and which messages have arrived for which tick.

The table has a row for each topic that the node reads. Every message is processed by its row. The kind of row decides
what the message means for the ticks: `paired` for lockstep, `live` for real time.
"""

from __future__ import annotations

from typing import Any

from softrig_core.block.block import Level
from softrig_core.block.port import Port, Refused, Sample

from ..seam.endpoint import Input
from .adapter import Adapter


class Sender(Input):
    """A row of the table: one input topic and its publisher.

    Parameters
    ----------
    node : Adapter
        The node that reads the topic.
    publisher : str
        Name of the publishing node, for errors.

    Attributes
    ----------
    stamp : int or None
        Stamp of the value that the input holds, ns.
    """

    def __init__(self, node: Adapter, port: Port, publisher: str = "another node") -> None:
        super().__init__(port)
        self.node = node
        self.publisher = publisher
        self.stamp: int | None = None
        self._number = node.record.foreign.get(port.name)
        self._valued = port.partial or port.delayed  # whether the held value is not simply that of the message

    # the way of a message ------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Receive the bytes of a message."""
        if self.deaf():
            return
        self.received_any = True
        try:
            stamp, result = self.read(data)
        except Refused as error:
            self.node.account.refuse(self, str(error))
            self.rejected(data)
            return
        self.accept(stamp, result, data)

    def matched(self, count: int) -> None:
        """Note the number of writers in other processes, and let the drive react."""
        super().matched(count)
        if self in self.node.inputs:
            self.node.drive.on_matched(self)

    def deaf(self) -> bool:
        """Return whether messages are ignored now."""
        return self.node.state in ("done", "failed")

    def read(self, data: bytes) -> tuple[int, Any]:
        """Return stamp (or number) and values; raise `Refused` with the reason if they are invalid."""
        return self.decode(data)

    def rejected(self, data: bytes) -> None:
        """Handle a rejected message: no value of it reaches the block."""
        raise NotImplementedError

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Process a valid message."""
        raise NotImplementedError

    # what the kinds of rows have in common -------------------------------------------------------------------------

    def value(self, stamp: int, values: tuple[float, ...]) -> Any:
        """Return the value to hold; channels that a partial message leaves out keep their values."""
        if self.port.partial:
            self.decode.kept = values
        return Sample(stamp - self.node.epoch, values) if self.port.delayed else values

    def record(self, t: int, data: bytes) -> None:
        """Record a message from outside the rig, at the time `t` (ns) at which it takes effect."""
        node = self.node
        if self._number is not None and node.record.sink is not None:
            node.record.sink.add(self._number, t, data)

    def in_order(self, number: int) -> bool:
        """Return whether an array is new to an input that uses the newest; reject repeated ones, count lost ones.

        Number 0 may start a new sequence: a bag that is played in a loop.

        Parameters
        ----------
        number : int
            Number that the array contains; -1 when it contains none: then it is new.
        """
        expected = self.following
        if number < 0 or expected is None:
            pass
        # A 0 may begin a new round, as of a bag that is played in a loop, unless it repeats the 0 right before it.
        elif number < expected and (number or expected == 1):
            self.repeated(number, expected)
            return False
        elif number > expected:
            self.lost += number - expected
            text = f"{self.lost} messages of {self.publisher} are lost"
            self.node.step.note(Level.WARN, f"lost {self.port.topic}", text)
        self.following = None if number < 0 else number + 1
        return True

    def repeated(self, number: int, expected: int) -> None:
        """Refuse an array that has arrived before."""
        self.node.account.refuse(self, f"number {number} from {self.publisher}, expected {expected} (already there)")
