"""The endpoints of a node: a subscribed port and a published one."""

from __future__ import annotations

from collections.abc import Callable

from ..model.port import Port
from ..wire.codec import Decoder
from .middleware import Message, Send


class Input:
    """A subscribed port: decoder, writers and what was refused.

    Attributes
    ----------
    publishers : int
        Writers that are matched.
    following : int or None
        Of arrays: the number after that of the newest one; None when any may come, as from a new writer.
    lost : int
        Arrays that were sent, as the numbers of others say, and did not come.
    heard : bool
        Whether a message has come.
    refused : int
        Messages that never reached the block.
    last_refusal : str
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self.name = port.name
        self.decode = Decoder(port)
        self.publishers = 0
        self.following: int | None = None
        self.lost = 0
        self.heard = False
        self.refused = 0
        self.last_refusal = ""

    def matched(self, count: int) -> None:
        """Note how many writers there are."""
        if count != self.publishers:
            self.following = None
        self.publishers = count


class Output:
    """A published port.

    Attributes
    ----------
    readers : int
        Readers that are matched, as the writer sees them.
    numbered : bool
        Whether its messages have no stamp but a number.
    said : int
        Of these: the number of the next one.
    """

    def __init__(self, port: Port, topic: str, number: int) -> None:
        self.port = port
        self.name = port.name
        self.delayed = port.delayed
        self.sporadic = port.sporadic
        self.topic = topic
        self.number = number
        self.layout = port.layout()
        self.numbered = self.layout.numbered
        self.said = 0
        self.bound = min(port.limits, default=0.0)
        self.send: Send = _unbound  # of messages whose magnitudes add up to the bound at most
        self.send_any: Send = _unbound
        self.readers = 0
        self.joined: Callable[[], object] = _nobody  # called when a reader has come

    def matched(self, count: int) -> None:
        """Note how many readers there are."""
        more = count > self.readers
        self.readers = count
        if more:
            self.joined()


def _nobody() -> None:
    pass


def _unbound(message: Message) -> None:
    raise RuntimeError("output is not advertised yet")
