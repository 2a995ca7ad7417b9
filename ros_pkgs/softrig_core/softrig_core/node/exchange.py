"""What the nodes of a container share: topics handed over in memory through one queue, and timers; no ROS in it.

A message goes to the readers in the same process as the numbers that its bytes would carry, or as these bytes where a
reader asks for them, and is taken from the queue when whoever sent it has returned: ticks follow each other, none runs
inside another, and the depth of the stack does not grow.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any

from ..wire.cdr import Layout
from .middleware import Direct, Join, Matched, Message, Receive, Send, SendRow, one_by_one

BATCH = 16  # messages between two looks at the time
BURST = 8  # messages for other processes that go out together: to wake a reader costs four times as much as to send
SLACK = 150_000  # ns to the next timer from which on they go out at once
SLICE = 5_000_000  # ns: how long messages may keep a timer waiting


class Writer:
    """Who writes a topic, and how its messages reach the readers in this process."""

    def __init__(self, matched: Matched, layout: Layout | None, bound: float) -> None:
        self.matched = matched
        self.layout = layout  # None: sends bytes only
        self.bound = bound
        self.outside = 0  # readers in other processes that are matched
        self.calls: list[Send] = []
        self.byte_calls: list[Receive] = []
        self.nodes: list[str] = []  # whose calls they are
        self.to_others: Receive | None = None  # publishes bytes to other processes


class Bundle:
    """Writers of one node that say something at each of its ticks, all at once."""

    def __init__(self, writers: Sequence[Writer]) -> None:
        self.writers = writers
        self.calls: list[SendRow] = []  # one for each node here that reads some of it
        self.abroad: list[tuple[int, Receive, Callable[..., bytes]]] = []  # what somebody in another process reads


class _Reader:
    """Who reads a topic."""

    def __init__(self, matched: Matched, receive: Receive, direct: Direct | None, node: str) -> None:
        self.matched = matched
        self.receive = receive
        self.direct = direct
        self.node = node
        self.outside = 0  # writers in other processes that are matched


End = Writer | _Reader


class _Channel:
    """One topic of one message type."""

    def __init__(self) -> None:
        self.writers: list[Writer] = []
        self.readers: list[_Reader] = []


class ExchangeTimer:
    """A timer of the container's own; see `Timer`.

    Attributes
    ----------
    due : int or None
        When it fires next, ns, monotonic; None when it is cancelled.
    moved : bool
        Whether it has been moved since the exchange has entered it; it is entered only once a turn, when all that
        waited has been handed over: most limits are off again by then.
    """

    def __init__(self, moved: list[ExchangeTimer], ns: int, callback: Callable[[], None]) -> None:
        self._moved = moved
        self.callback = callback
        self.moved = False
        self.again(ns)

    def again(self, ns: int) -> None:
        """Fire after `ns` and then with that period."""
        self.period = max(1000, ns)
        self.due: int | None = time.monotonic_ns() + self.period
        if not self.moved:
            self.moved = True
            self._moved.append(self)

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""
        self.due = None


class Exchange:
    """The queue, the topics and the timers of a container."""

    def __init__(self) -> None:
        self._queue: deque[tuple[Sequence[Callable[[Any], None]], Any]] = deque()
        self._channels: dict[tuple[str, str], _Channel] = {}
        self._bundles: list[Bundle] = []
        self._joins: dict[str, Join] = {}  # by node
        self._timers: list[tuple[int, int, ExchangeTimer]] = []
        self._moved: list[ExchangeTimer] = []
        self._order = count()
        self._owners: dict[Callable[..., None], str] = {}  # node names
        self._culprit: Callable[..., None] | None = None
        self._outbox: list[tuple[Receive, bytes]] = []
        self._turns = 0  # that the outbox has waited
        self.listens = False  # whether a writer in another process is matched

    # topics ----------------------------------------------------------------------------------------------------

    def writer(self, topic: str, msgtype: str, matched: Matched, layout: Layout | None = None,
               bound: float = 0.0) -> Writer:  # fmt: skip
        """Add a writer, of bytes or also of messages that all have one layout."""
        channel = self._channel(topic, msgtype)
        channel.writers.append(writer := Writer(matched, layout, bound))
        self._connect(channel)
        return writer

    def reader(self, topic: str, msgtype: str, receive: Receive, direct: Direct | None, matched: Matched,
               node: str) -> _Reader:  # fmt: skip
        """Add a reader that belongs to a node."""
        channel = self._channel(topic, msgtype)
        channel.readers.append(reader := _Reader(matched, receive, direct, node))
        self._owners[receive] = node
        self._connect(channel)
        return reader

    def outside(self, end: End, number: int) -> None:
        """Note how many ends in other processes are matched with one of ours."""
        end.outside = number
        for bundle in self._bundles:
            bundle.abroad[:] = [
                (k, w.to_others, w.layout.encode) for k, w in enumerate(bundle.writers)
                if w.outside and w.layout is not None and w.to_others is not None
            ]  # fmt: skip
        self.listens = any(r.outside for c in self._channels.values() for r in c.readers)
        self._tell(next(c for c in self._channels.values() if end in c.writers or end in c.readers))

    def bundle(self, writers: Sequence[Writer]) -> Bundle:
        """Have writers say something together: whoever reads several of them gets it by one call."""
        self._bundles.append(bundle := Bundle(writers))
        self._bind(bundle)
        return bundle

    def join(self, node: str, join: Join) -> None:
        """Note how a node takes by one call what another one says together."""
        self._joins[node] = join

    def _channel(self, topic: str, msgtype: str) -> _Channel:
        return self._channels.setdefault((topic, msgtype), _Channel())

    def _connect(self, channel: _Channel) -> None:
        """Work out how what each writer sends reaches each reader."""
        for writer in channel.writers:
            writer.byte_calls[:] = [reader.receive for reader in channel.readers]
            writer.nodes[:] = [reader.node for reader in channel.readers]
            if writer.layout is not None:
                writer.calls[:] = [self._call(writer.layout, writer.bound, reader) for reader in channel.readers]
        for bundle in self._bundles:
            if any(writer in bundle.writers for writer in channel.writers):
                self._bind(bundle)
        self._tell(channel)

    def _bind(self, bundle: Bundle) -> None:
        """Work out who gets what of a bundle."""
        parts: dict[str, list[tuple[int, Send]]] = {}
        for k, writer in enumerate(bundle.writers):
            for node, call in zip(writer.nodes, writer.calls, strict=True):
                parts.setdefault(node, []).append((k, call))
        bundle.calls[:] = [self._joins.get(node, one_by_one)(found) for node, found in parts.items()]
        self._owners |= dict(zip(bundle.calls, parts, strict=True))

    def _call(self, layout: Layout, bound: float, reader: _Reader) -> Send:
        call = None if reader.direct is None else reader.direct(layout, bound)
        if call is None:
            receive, encode = reader.receive, layout.encode

            def call(message: Message) -> None:
                receive(encode(*message))

        self._owners[call] = reader.node
        return call

    def _tell(self, channel: _Channel) -> None:
        for ends, others in ((channel.writers, channel.readers), (channel.readers, channel.writers)):
            for end in ends:
                self.post((end.matched,), end.outside + len(others))

    def timer(self, ns: int, callback: Callable[[], None], node: str) -> ExchangeTimer:
        """Add a timer that belongs to a node."""
        self._owners[callback] = node
        return ExchangeTimer(self._moved, ns, callback)

    def culprit(self) -> str:
        """Name of the node whose code has raised; empty when it is nobody's."""
        return self._owners.get(self._culprit, "") if self._culprit is not None else ""

    # what is to happen -------------------------------------------------------------------------------------------

    def post(self, calls: Sequence[Callable[[Any], None]], given: Any) -> None:
        """Call functions when whatever is under way has returned."""
        self._queue.append((calls, given))

    def poster(self) -> Callable[[tuple[Sequence[Callable[[Any], None]], Any]], None]:
        """Give the shortest way into the queue."""
        return self._queue.append

    def carry(self, publish: Receive, data: bytes) -> None:
        """Have a message published to other processes: soon, in a burst, when the loop has no time."""
        self._outbox.append((publish, data))
        if len(self._outbox) >= BURST:
            self.flush()

    def flush(self) -> None:
        """Publish what is for other processes."""
        outbox, self._outbox, self._turns = self._outbox, [], 0
        for publish, data in outbox:
            publish(data)

    def serve(self, until: int, awake: int = 0) -> int:
        """Fire timers and hand over messages until nothing is due for `awake` ns or `until` has passed.

        Parameters
        ----------
        until : int
            ns, monotonic.
        awake : int
            A timer that is nearer is waited for here.

        Returns
        -------
        int
            ns to the next timer; 0 when something waits to be done.
        """
        now, queue = time.monotonic_ns, self._queue
        while True:
            due = self.next_due()
            t = now()
            if due <= t:
                self._fire()
            elif not queue:
                if self._outbox:
                    self._turns += 1
                    if due - t > min(SLACK, awake) or self._turns >= BURST:
                        self.flush()
                        continue
                if due - t > awake:
                    return due - t
                self._wait(limit := min(due, until))
                if limit == due:
                    self._fire()
            if queue:
                self._drain(min(until, t + SLICE))
            if now() > until:
                self.flush()
                return 0

    def _wait(self, limit: int) -> None:
        """Stay awake until a time (ns, monotonic)."""
        now = time.monotonic_ns
        while now() < limit:
            pass

    def _drain(self, until: int) -> None:
        """Hand over what is queued and what comes of it until nothing is left or `until` (ns, monotonic) has passed."""
        queue, now = self._queue, time.monotonic_ns
        take = queue.popleft
        call: Callable[[Any], None] | None = None
        try:
            while queue:
                for _ in range(min(len(queue), BATCH)):
                    calls, given = take()
                    for call in calls:
                        call(given)
                if now() > until:
                    break
        except BaseException:
            self._culprit = call
            raise

    def next_due(self) -> int:
        """Time (ns, monotonic) of the next timer; far away when there is none."""
        timers = self._timers
        for timer in self._moved:
            timer.moved = False
            if timer.due is not None:
                heapq.heappush(timers, (timer.due, next(self._order), timer))
        self._moved.clear()
        while timers and timers[0][0] != timers[0][2].due:  # it was moved or cancelled
            heapq.heappop(timers)
        return timers[0][0] if timers else 1 << 62

    def _fire(self) -> None:
        """Fire the timer that has been due the longest; what it sends is queued."""
        due, _, timer = heapq.heappop(self._timers)
        try:
            timer.callback()
        except BaseException:
            self._culprit = timer.callback
            raise
        if timer.due == due:  # it has not moved itself
            timer.again(timer.period)
