"""The middleware of a node in a container: its neighbours in memory, everybody else by DDS."""

from __future__ import annotations

from collections.abc import Callable

from rclpy.node import Node

from .exchange import Exchange, ExchangeTimer
from .middleware import Matched, Receive
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

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Callable[[bytes], None]:
        """Offer a topic; DDS carries it while somebody in another process reads it."""
        end, receivers = self._exchange.writer(self.resolve(topic), msgtype, matched)
        carry = super().publisher(topic, msgtype, lambda number: self._exchange.outside(end, number))
        post = self._exchange.poster()

        def publish(data: bytes) -> None:
            for receive in receivers:
                post((receive, data))
            if end.outside:
                carry(data)

        return publish

    def subscribe(self, topic: str, msgtype: str, receive: Receive, matched: Matched) -> None:
        """Read a topic from both sides."""
        exchange = self._exchange
        end = exchange.reader(self.resolve(topic), msgtype, receive, matched, self.name)
        super().subscribe(
            topic, msgtype, lambda data: exchange.post(receive, data), lambda number: exchange.outside(end, number)
        )

    def timer(self, ns: int, callback: Callable[[], None]) -> ExchangeTimer:  # type: ignore[override]
        """Call back every `ns`."""
        return self._exchange.timer(ns, callback, self.name)
