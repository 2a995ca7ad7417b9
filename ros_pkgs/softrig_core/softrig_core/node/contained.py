"""The middleware of a node in a container: its neighbours in memory, everybody else by DDS."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from rclpy.node import Node

from ..wire.cdr import Layout
from .exchange import Exchange, ExchangeTimer, Writer
from .middleware import Direct, Join, Matched, Message, Receive, Row, Send, SendRow
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
        self._writers: dict[Send, Writer] = {}

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Callable[[bytes], None]:
        """Offer a topic; DDS carries it while somebody in another process reads it."""
        exchange = self._exchange
        writer = exchange.writer(self.resolve(topic), msgtype, matched)
        to_others = super().publisher(topic, msgtype, lambda number: exchange.outside(writer, number))
        post, calls, carry = exchange.poster(), writer.byte_calls, exchange.carry

        def publish(data: bytes) -> None:
            if calls:
                post((calls, data))
            if writer.outside:
                carry(to_others, data)

        return publish

    def sender(self, topic: str, layout: Layout, bound: float, matched: Matched) -> tuple[Send, Send]:
        """Offer a topic; its messages become bytes only for who is outside, and for a closer look."""
        exchange = self._exchange
        writer = exchange.writer(self.resolve(topic), layout.msgtype, matched, layout, bound)
        writer.to_others = to_others = super().publisher(
            topic, layout.msgtype, lambda number: exchange.outside(writer, number)
        )
        post, calls, byte_calls, encode = exchange.poster(), writer.calls, writer.byte_calls, layout.encode
        carry = exchange.carry

        def send(message: Message) -> None:
            if calls:
                post((calls, message))
            if writer.outside:
                carry(to_others, encode(*message))

        def send_any(message: Message) -> None:
            data = encode(*message)
            post((byte_calls, data))
            if writer.outside:
                carry(to_others, data)

        self._writers[send] = writer
        return send, send_any

    def together(self, sends: Sequence[Send]) -> SendRow:
        """Publish several messages at once: each node here that reads some of them is called once."""
        bundle = self._exchange.bundle([self._writers[send] for send in sends])
        post, calls, abroad, carry = self._exchange.poster(), bundle.calls, bundle.abroad, self._exchange.carry

        def send_row(row: Row) -> None:
            if calls:
                post((calls, row))
            for k, to_others, encode in abroad:
                carry(to_others, encode(row[0], row[1][k]))

        return send_row

    def join(self, join: Join) -> None:
        """Take what a node here says together by one call."""
        self._exchange.join(self.name, join)

    def subscribe(self, topic: str, msgtype: str, receive: Receive, matched: Matched) -> None:
        """Read a topic from both sides, as bytes."""
        self._read(topic, msgtype, receive, None, matched)

    def listen(self, topic: str, msgtype: str, receive: Receive, direct: Direct | None, matched: Matched) -> None:
        """Read a topic from both sides, from this process without bytes where that can be."""
        self._read(topic, msgtype, receive, direct, matched)

    def _read(self, topic: str, msgtype: str, receive: Receive, direct: Direct | None, matched: Matched) -> None:
        exchange, calls = self._exchange, (receive,)
        end = exchange.reader(self.resolve(topic), msgtype, receive, direct, matched, self.name)
        super().subscribe(
            topic, msgtype, lambda data: exchange.post(calls, data), lambda number: exchange.outside(end, number)
        )

    def timer(self, ns: int, callback: Callable[[], None]) -> ExchangeTimer:  # type: ignore[override]
        """Call back every `ns`."""
        return self._exchange.timer(ns, callback, self.name)
