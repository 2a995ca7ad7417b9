"""The interface between a node's logic and its middleware.

Nodes depend only on this: bytes out, bytes in, matched endpoints, timers and two clocks. `ros.RosMiddleware`
implements it with ROS; a test, a simulation or a container supplies its own implementation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple, Protocol

from softrig_core.block.block import Level
from softrig_core.block.port import Port
from softrig_core.wire.cdr import Layout

Receive = Callable[[bytes], None]
Matched = Callable[[int], None]
Numbered = Callable[[int | None], None]
Place = Literal["together", "beside", "anywhere"]
Send = Callable[[int, tuple[float, ...]], None]  # gets the stamp in ns, or the number of an array, and all numbers


class Peer(NamedTuple):
    """An endpoint as the graph shows it."""

    name: str
    namespace: str
    msgtype: str

    @property
    def full_name(self) -> str:
        """Namespace and name."""
        return f"{self.namespace.rstrip('/')}/{self.name}"


class Reader:
    """Receives the messages of a topic; this base class drops them.

    Attributes
    ----------
    numbered : callable or None
        Gets the number of each message by its writer's count, or None if it is unknown, before `receive` gets the
        message.
    """

    numbered: Numbered | None = None

    def receive(self, data: bytes) -> None:
        """Receive the bytes of a message."""

    def matched(self, count: int) -> None:
        """Note how many writers there are in other processes; called at each change."""


class Timer(Protocol):
    """A timer that repeats until it is cancelled."""

    def again(self, ns: int, period: int = 0) -> None:
        """Fire after `ns`, counted from now, and then with a period, that time if it is 0."""

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""


class Middleware(Protocol):
    """The interface of one node to its environment.

    No method calls back before it returns. A message reaches its reader, even in the same process, only after the
    current call in the reader's node has returned. So no tick runs inside another one.

    Attributes
    ----------
    mute : bool
        Whether published messages are dropped while the number of readers passed to `matched` is 0.
    prompt : bool
        Whether messages are taken in the thread that receives them (see `be_prompt`).
    processor : int or None
        The processor on which the node works; None: any with free capacity.
    carrier : Carrier or None
        Publishes for other processes from memory, if that is possible (`softrig_nodes.below.carrier`).
    """

    name: str
    full_name: str
    mute: bool = False
    prompt: bool = False
    processor: int | None = None
    carrier: Any = None

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic, remapping applied."""

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Callable[[bytes], None]:
        """Offer a topic and return its publish function; `matched` gets the number of readers at each change."""

    def subscribe(self, topic: str, msgtype: str, reader: Reader) -> None:
        """Subscribe to a topic."""

    def be_prompt(self, place: Place) -> None:
        """Process messages of the present subscriptions where they arrive, if possible; for ticks of some us.

        They are processed one at a time, and never during another call of the node.

        Parameters
        ----------
        place : {"together", "beside", "anywhere"}
            Processor of the node: "together", the one of its single partner, where each waits for the other; "beside",
            any on which no such pair works; "anywhere", any with room.
        """

    def sender(self, topic: str, layout: Layout, matched: Matched) -> Send:
        """Offer a topic with one layout for all messages."""
        publish, encode = self.publisher(topic, layout.msgtype, matched), layout.encode
        return lambda mark, values: publish(encode(mark, values))

    def post(self, call: Callable[[], object]) -> None:
        """Call a function after the current call has returned; nodes of one process call each other so."""

    def timer(self, ns: int, callback: Callable[[], None]) -> Timer:
        """Call back every `ns`."""

    def now(self) -> int:
        """Wall-clock time in ns: the stamps of real time."""

    def steady(self) -> float:
        """Return the time in s of a monotonic clock, for timeouts."""

    def publishers(self, topic: str) -> list[Peer]:
        """Writers of a topic, by its full name, as the graph shows them."""

    def subscribers(self, topic: str) -> list[Peer]:
        """Readers of a topic, by its full name, as the graph shows them."""

    def unfit(self, topic: str, msgtype: str) -> list[tuple[str, str]]:
        """Name the subscribers that are never matched because they ask for more than is offered, with the reason."""
        return []

    def subscriptions_of(self, peer: Peer) -> list[str]:
        """Topics that a node reads; empty while the graph does not know the node."""

    def topics(self) -> dict[str, list[str]]:
        """Message types under which each topic exists, by its full name."""

    def deaf(self) -> str:
        """Describe why messages can no longer arrive; empty if they can."""

    def log(self, level: Level, text: str) -> None:
        """Log a message for the operator of the node."""

    def close(self) -> None:
        """Stop delivering messages after the current ones, or raise a RunError; raise pending errors."""

    def drain(self) -> None:
        """Wait, in bounded time, until every subscriber has received the messages."""


def other_types(middleware: Middleware, port: Port) -> str:
    """Name the types other than a port's own under which its topic exists: such endpoints never match."""
    types = middleware.topics().get(middleware.resolve(port.topic), ())
    return ", ".join(t for t in types if t != port.msgtype)
