"""The middleware of a node in a container: its `Group` serves nodes of the process, DDS all others."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from ..seam.exchange import Exchange, ExchangeTimer
from ..seam.middleware import Matched, Numbered, Place, Receive
from .ros import RosMiddleware


class ContainedMiddleware(RosMiddleware):
    """One rclpy node whose endpoints see only other processes; see `Middleware` for the methods.

    Parameters
    ----------
    node : rclpy.node.Node
        Of a participant that does not match its own endpoints with each other (`profile.exclusive`).
    exchange : Exchange
        That of the container.
    """

    def __init__(self, node: Node, exchange: Exchange) -> None:
        super().__init__(node)
        self._exchange = exchange

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Receive:
        """Offer a topic; DDS carries it while somebody in another process reads it."""
        carry, readers, note = self._exchange.carry, [0], _noting(matched)
        to_others = super().publisher(topic, msgtype, lambda count: note(readers, count))

        def publish(data: bytes) -> None:
            if readers[0]:
                carry(to_others, data)

        return publish

    def subscribe(
        self, topic: str, msgtype: str, receive: Receive, matched: Matched, numbered: Numbered | None = None
    ) -> None:
        """Read a topic of other processes."""
        exchange, end = self._exchange, object()
        exchange.owners[receive] = self.name

        def count(number: int) -> None:
            exchange.writers[end] = number
            matched(number)

        super().subscribe(topic, msgtype, lambda data: exchange.hand(receive, data), count, numbered)

    def be_prompt(self, place: Place) -> None:
        """The exchange takes what has come: its loop does not sleep."""

    def post(self, call: Callable[[], object]) -> None:
        """Call a function when whatever is under way has returned."""
        self._exchange.post(call)

    def timer(self, ns: int, callback: Callable[[], None]) -> ExchangeTimer:  # type: ignore[override]
        """Call back every `ns`."""
        return self._exchange.timer(ns, callback, self.name)


def _noting(matched: Matched) -> Callable[[list[int], int], None]:
    """Return what keeps a number of readers and tells it."""

    def note(readers: list[int], count: int) -> None:
        readers[0] = count
        matched(count)

    return note
