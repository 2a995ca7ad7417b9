"""The middleware of a node in a container: its `Group` serves nodes of the process, DDS all others."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from ..below.carrier import Carrier
from ..seam.exchange import Exchange, ExchangeTimer
from ..seam.middleware import Matched, Place, Reader, Receive
from .ros import RosMiddleware, ServingNode


class ContainedMiddleware(RosMiddleware):
    """One rclpy node whose endpoints see only other processes; see `Middleware` for the methods.

    Parameters
    ----------
    node : ServingNode
        Node of a participant that does not match its own endpoints with each other (`profile.exclusive`).
    exchange : Exchange
        Exchange of the container.
    carrier : Carrier, optional
        Publishes for other processes; without it, the loop of the exchange does.
    """

    def __init__(self, node: ServingNode, exchange: Exchange, carrier: Carrier | None = None) -> None:
        self._exchange, self.carrier = exchange, carrier
        super().__init__(node)

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Receive:
        """Offer a topic; it is published by DDS while it has subscribers in another process."""
        readers, note = [0], _noting(matched)
        carry = super().publisher(topic, msgtype, lambda count: note(readers, count))

        def publish(data: bytes) -> None:
            if readers[0]:
                carry(data)

        return publish

    def _sending(self, publisher: Any) -> Callable[[bytes], None]:
        if self.carrier is not None:
            return self.carrier.sender(publisher)  # type: ignore[no-any-return]
        return partial(self._exchange.carry, super()._sending(publisher))

    def drain(self) -> None:
        """Wait, for a bounded time, until all subscribers have the published messages."""
        if self.carrier is not None:
            self.carrier.drain()
        super().drain()

    def subscribe(self, topic: str, msgtype: str, reader: Reader) -> None:
        """Subscribe to a topic of other processes."""
        self._exchange.owners[reader.receive] = self.name
        super().subscribe(topic, msgtype, _Exchanged(self._exchange, reader))

    def be_prompt(self, place: Place) -> None:
        """Do nothing: the loop of the exchange does not sleep, so messages are processed promptly."""

    def post(self, call: Callable[[], object]) -> None:
        """Call a function after the current call has returned."""
        self._exchange.post(call)

    def timer(self, ns: int, callback: Callable[[], None]) -> ExchangeTimer:  # type: ignore[override]
        """Call back every `ns`."""
        return self._exchange.timer(ns, callback, self.name)


class _Exchanged(Reader):
    """Passes messages to their subscriber by the exchange of its container, which knows all writers."""

    def __init__(self, exchange: Exchange, reader: Reader) -> None:
        self._exchange, self._reader, self.numbered = exchange, reader, reader.numbered

    def receive(self, data: bytes) -> None:
        self._exchange.hand(self._reader.receive, data)

    def matched(self, count: int) -> None:
        self._exchange.writers[self] = count
        self._reader.matched(count)


def _noting(matched: Matched) -> Callable[[list[int], int], None]:
    """Return a callback that stores the number of subscribers and passes it to `matched`."""

    def note(readers: list[int], count: int) -> None:
        readers[0] = count
        matched(count)

    return note
