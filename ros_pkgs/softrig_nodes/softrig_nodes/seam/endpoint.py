"""The endpoints of a node: a subscribed port and a published one."""

from __future__ import annotations

from collections.abc import Callable

from softrig_core.block.codec import Decoder
from softrig_core.block.port import Port

from .middleware import Reader, Send

COPY = "copy the stamp of what you answer"  # advice to the author of an outside node


class Input(Reader):
    """A topic that is read: its decoder, its writers and its rejected messages.

    Attributes
    ----------
    outside : int
        Number of matched writers in other processes.
    local : bool
        Whether a node of this process writes it.
    following : int or None
        For arrays: the next number that is expected; None if any number is accepted, as from a new writer.
    lost : int
        Arrays that were sent but did not arrive, according to the numbers of the others.
    late : int
        Messages that arrived after a newer one, or twice, and were ignored.
    overdue : int
        Messages of the rig that arrived after the tick that should have used them.
    received_any : bool
        Whether a message has arrived.
    refused : int
        Messages that were rejected before they reached the block.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self.name = port.name
        self.decode = Decoder(port)
        self.outside = 0
        self.local = False
        self.following: int | None = None
        self.lost = 0
        self.late = 0
        self.overdue = 0
        self.received_any = False
        self.refused = 0
        self.last_refusal = ""

    @property
    def publishers(self) -> int:
        """Number of writers."""
        return self.outside + self.local

    def matched(self, count: int) -> None:
        """Note how many writers there are in other processes."""
        # Another publisher may number its arrays from 0 again.
        if count != self.outside:
            self.following = None
        self.outside = count


class Output:
    """A published port.

    Attributes
    ----------
    readers : int
        Readers in other processes that are matched, as the writer sees them.
    numbered : bool
        Whether its messages have no stamp but a number.
    """

    def __init__(self, port: Port, topic: str, number: int) -> None:
        self.port = port
        self.name = port.name
        self.topic = topic
        self.number = number
        self.layout = port.layout()
        self.numbered = self.layout.numbered
        self.send: Send = _unbound
        self.readers = 0
        self.joined: Callable[[], object] = _nobody  # called when a subscriber has been matched

    def matched(self, count: int) -> None:
        """Note how many readers there are in other processes."""
        more = count > self.readers
        self.readers = count
        if more:
            self.joined()


def _nobody() -> None:
    pass


def _unbound(mark: int, values: tuple[float, ...]) -> None:
    raise RuntimeError("output is not advertised yet")
