"""Answer the requests of a node's services: in order of arrival, within a share of the time, and not to clients that
have left.

rclpy's executor serves all arrived requests one after the other, so during a flood of requests a timer waits for
seconds. Therefore requests stay in the queues of the middleware, which keep the newest ones, and a timer takes them
from there.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

from rclpy.node import Node
from softrig_core.timebase import SECOND

from ..below.uses import answer_readers, client_of, leave_requests_to_us, next_request

MOST = 100  # requests of a service that the middleware keeps
IDLE, BUSY = SECOND // 50, SECOND // 500  # ns between two looks for requests, and soon after one was answered
TURN = SECOND // 1000  # ns: the longest time of a look, apart from its last answer; timers and ticks wait for it
SOON = SECOND // 5  # ns: a client that has called will call again
PATIENCE = 2.0  # s: the longest time that a request waits for its share of the time
UNKNOWN = 2.0  # s: how long an answer waits for a client that discovery does not know yet, or not any more
WAITING = 200  # answers of a node that wait for their clients
AGAIN = SECOND // 20  # ns between two looks whether they are there


class Credit:
    """Wall-clock time that services may still use: a share of the elapsed time, with an upper limit."""

    SHARE, MOST = 0.2, 2.0  # s; a timeout of a rig is longer

    def __init__(self) -> None:
        self.left, self._since = self.MOST, time.monotonic()

    def wanting(self) -> float:
        """Return the time to wait until there is credit again, s; zero if there is."""
        now = time.monotonic()
        self.left = min(self.MOST, self.left + self.SHARE * (now - self._since))
        self._since = now
        return max(0.0, -self.left / self.SHARE)

    @contextmanager
    def spent(self) -> Iterator[None]:
        """Subtract the time of the block within."""
        start = time.monotonic()
        try:
            yield
        finally:
            # The time of the block itself earns no credit. The lower limit keeps one long call from blocking services
            # for longer than MOST / SHARE.
            self._since = time.monotonic()
            self.left = max(-self.MOST, self.left - (self._since - start))


class Periodic(Protocol):
    """A timer whose period can change; the present period ends first."""

    period: int  # ns


@dataclass
class _Offer:
    """A service, its oldest request with its header, and whether an earlier check has found it."""

    service: Any
    answer: Callable[..., Any]
    send: Callable[[Any, Any], None]
    request: Any = None
    header: Any = None
    known: bool = False

    def fetch(self) -> None:
        """Fetch the oldest request unless there is one."""
        if self.header is None:
            self.request, self.header = next_request(self.service)
            self.known = False


@dataclass
class _Reply:
    """An answer that is not sent yet."""

    offer: _Offer
    response: Any
    header: Any
    until: float  # s, monotonic


class Requests:
    """The requests of all services of a node.

    The middleware (rmw_fastrtps of Jazzy and Kilted) waits for 0.1 s at an answer to a client that left before its
    request was taken. So an answer is sent when the graph shows the client's reader. It waits for `UNKNOWN` s for a
    reader that is not there, since discovery may be behind; then it is dropped.

    Parameters
    ----------
    node : rclpy.node.Node
        The node.
    credit : Credit
        Time that services of the process may use.
    paused : callable
        Returns whether no ticks run here, so that services need not share the time with them.
    dropped : callable
        Called for each answer that is dropped.
    """

    def __init__(self, node: Node, credit: Credit, paused: Callable[[], bool], dropped: Callable[[], object]) -> None:
        self._node, self._credit, self._paused, self._dropped = node, credit, paused, dropped
        self._offers: list[_Offer] = []
        self._replies: deque[_Reply] = deque()
        self._answered, self._again = 0, 0  # ns, monotonic: the last answer, the next look for clients

    def add(self, service: Any, answer: Callable[..., Any]) -> None:
        """Serve a service from now on.

        Parameters
        ----------
        service : rclpy.service.Service
            Its `send_response` may be called later, too, with the header of a request.
        answer : callable
            Gets a request, an empty response and for how many seconds the services have no time; returns the response.
        """
        leave_requests_to_us(self._node, service)
        offer = _Offer(service, answer, service.send_response)
        service.send_response = partial(self._reply, offer)
        self._offers.append(offer)

    def serve(self) -> bool:
        """Answer requests as far as there is time; return whether more may come soon."""
        paused = self._paused()
        if wait := 0.0 if paused else self._credit.wanting():
            with self._credit.spent():
                self._refuse(wait)
        else:
            # A check costs time, too: a reader that receives a flood keeps its lock for up to a second.
            with nullcontext() if paused else self._credit.spent():
                self._serve(time.time_ns(), time.monotonic_ns() + TURN)
        return time.monotonic_ns() < self._answered + SOON

    def _serve(self, begun: int, deadline: int) -> None:
        self._fetch()
        while (first := self._oldest(begun)) is not None:
            self._answer(first)
            first.fetch()
            if self._answered > deadline:
                break
        self._send()

    def _refuse(self, wait: float) -> None:
        """Answer those requests that have waited too long for their share of the time, which is cheap for a set."""
        limit = time.time_ns() - round(PATIENCE * SECOND)
        if any(o.header is not None and o.header.received_timestamp < limit for o in self._offers):
            self._fetch()
            for offer in self._offers:
                # Only requests that are older than the limit are refused, whichever look has found them.
                offer.known = False
            while (first := self._oldest(limit)) is not None:
                self._answer(first, wait)
                first.fetch()

    def _fetch(self) -> None:
        for offer in self._offers:
            # A request that an earlier look has found is older than all that this look finds.
            offer.known = offer.header is not None
            offer.fetch()

    def _answer(self, offer: _Offer, wait: float = 0.0) -> None:
        request, header = offer.request, offer.header
        offer.request = offer.header = None
        response = offer.answer(request, offer.service.srv_type.Response(), wait)
        offer.service.send_response(response, header)
        self._answered = time.monotonic_ns()

    def _oldest(self, begun: int) -> _Offer | None:
        """Return the service with the oldest request of all.

        A request that arrived after the check had begun may not be the oldest.
        """
        offers = [o for o in self._offers if o.header is not None]
        offers = [o for o in offers if o.known or o.header.received_timestamp <= begun]
        return min(offers, key=lambda o: o.header.received_timestamp, default=None)  # type: ignore[no-any-return]

    def _reply(self, offer: _Offer, response: Any, header: Any) -> None:
        """Send an answer, or keep it until its client is visible."""
        reply = _Reply(offer, response, header, time.monotonic() + UNKNOWN)
        if not self._sent(reply, answer_readers(self._node, offer.service)):
            self._replies.append(reply)
            # The client of the oldest answer is the likeliest to have left.
            if len(self._replies) > WAITING:
                self._replies.popleft()
                self._dropped()

    def _sent(self, reply: _Reply, readers: set[bytes]) -> bool:
        client = client_of(reply.header)
        connected = client in readers if client else bool(readers)
        if connected:
            reply.offer.send(reply.response, reply.header)
        return connected

    def _send(self) -> None:
        """Send the kept answers to clients that have become visible."""
        if not self._replies or time.monotonic_ns() < self._again:
            return
        self._again = time.monotonic_ns() + AGAIN
        services = {id(r.offer): r.offer.service for r in self._replies}
        readers = {key: answer_readers(self._node, service) for key, service in services.items()}
        waiting, self._replies = self._replies, deque()
        for reply in waiting:
            if self._sent(reply, readers[id(reply.offer)]):
                continue
            if time.monotonic() < reply.until:
                self._replies.append(reply)
            else:
                self._dropped()
