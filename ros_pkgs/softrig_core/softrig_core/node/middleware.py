"""The seam between a node's logic and what carries its messages.

`Lockstep` and `Realtime` know nothing but this: bytes out, bytes in, who is matched, timers and two clocks. ROS stands
behind it in `ros.RosMiddleware`; a test, a simulation or a container hands over its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol

from ..model.block import Level
from ..wire.cdr import Layout

Receive = Callable[[bytes], None]
Matched = Callable[[int], None]
Message = tuple[int, tuple[float, ...]]  # stamp in ns and all numbers in wire order
Send = Callable[[Message], None]
# A reader's way to take messages of a layout without bytes, if it has one; the second is what the magnitudes of all
# values of such a message add up to at most.
Direct = Callable[[Layout, float], "Send | None"]
Row = tuple[int, tuple[tuple[float, ...], ...]]  # what a node says at a tick: stamp in ns, numbers of each message
SendRow = Callable[[Row], None]
# A node's way to take by one call what another one of its process says at a tick: given are the places in the row that
# it reads and its functions for each of them.
Join = Callable[[Sequence[tuple[int, Send]]], SendRow]


def one_by_one(parts: Sequence[tuple[int, Send]]) -> SendRow:
    """Hand on what a node says together message by message; `parts` as for `Join`."""

    def send_row(row: Row) -> None:
        stamp, messages = row
        for k, call in parts:
            call((stamp, messages[k]))

    return send_row


class Peer(NamedTuple):
    """An endpoint as the graph shows it."""

    name: str
    namespace: str
    msgtype: str

    @property
    def full_name(self) -> str:
        """Namespace and name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class Timer(Protocol):
    """A timer that repeats until it is cancelled."""

    def again(self, ns: int) -> None:
        """Fire after `ns`, counted from now, and then with that period."""

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""


class Middleware(Protocol):
    """What one node needs of the world.

    No method calls back before it returns: a message that a node sends reaches a reader, be it in the same process,
    only after `publish` has returned. That is what keeps a tick from running inside another one.
    """

    name: str
    full_name: str

    def resolve(self, topic: str) -> str:
        """Give the full name of a topic, remapping applied."""

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Callable[[bytes], None]:
        """Offer a topic and give the function that publishes; `matched` gets the number of readers at each change."""

    def subscribe(self, topic: str, msgtype: str, receive: Receive, matched: Matched) -> None:
        """Read a topic; `matched` gets the number of writers at each change."""

    def sender(self, topic: str, layout: Layout, bound: float, matched: Matched) -> tuple[Send, Send]:
        """Offer a topic all of whose messages have one layout.

        Parameters
        ----------
        topic : str
        layout : Layout
        bound : float
            Of the first function.
        matched : callable
            As for `publisher`.

        Returns
        -------
        two callables
            Both publish a message: the first one whose magnitudes add up to `bound` at most, the second any other.
        """
        publish, encode = self.publisher(topic, layout.msgtype, matched), layout.encode

        def send(message: Message) -> None:
            publish(encode(*message))

        return send, send

    def together(self, sends: Sequence[Send]) -> SendRow:
        """Give what publishes one message by each of some functions that `sender` has given, all at one stamp."""

        def send_row(row: Row) -> None:
            stamp, messages = row
            for send, values in zip(sends, messages, strict=True):
                send((stamp, values))

        return send_row

    def join(self, join: Join) -> None:
        """Let this node take by one call what a node of the same process says `together`, where that can be."""
        return

    def listen(self, topic: str, msgtype: str, receive: Receive, direct: Direct | None, matched: Matched) -> None:
        """Read a topic; a message from the same process may come by `direct` instead of as bytes."""
        self.subscribe(topic, msgtype, receive, matched)

    def timer(self, ns: int, callback: Callable[[], None]) -> Timer:
        """Call back every `ns`."""

    def now(self) -> int:
        """Wall-clock time in ns: the stamps of real time."""

    def steady(self) -> float:
        """Time in s that nobody sets, for limits."""

    def publishers(self, topic: str) -> list[Peer]:
        """Writers of a topic, by its full name, as the graph shows them."""

    def subscribers(self, topic: str) -> list[Peer]:
        """Readers of a topic, by its full name, as the graph shows them."""

    def subscriptions_of(self, peer: Peer) -> list[str]:
        """Topics that a node reads; empty while the graph does not know the node."""

    def types(self, topic: str) -> list[str]:
        """Message types under which a topic, by its full name, exists."""

    def log(self, level: Level, text: str) -> None:
        """Say something to whoever operates the node."""

    def drain(self) -> None:
        """Wait, in bounded time, until every reader has what was sent."""
