"""What the nodes of a container share: topics handed over in memory through one queue, and timers; no ROS in it.

A message goes to the readers in the same process as the bytes that it is, and is taken from the queue when whoever sent
it has returned: ticks follow each other, none runs inside another, and the depth of the stack does not grow.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Callable
from itertools import count
from typing import Any

from .middleware import Matched, Receive

BATCH = 16  # messages between two looks at the time


class _End:
    """A writer or a reader: who is told how many there are on the other side."""

    def __init__(self, channel: _Channel, matched: Matched) -> None:
        self.channel = channel
        self.matched = matched
        self.outside = 0  # of those that are matched, how many live in other processes


class _Channel:
    """One topic of one message type."""

    def __init__(self) -> None:
        self.writers: list[_End] = []
        self.readers: list[_End] = []
        self.receivers: list[Receive] = []


class ExchangeTimer:
    """A timer of the container's own; see `Timer`."""

    def __init__(self, exchange: Exchange, ns: int, callback: Callable[[], None]) -> None:
        self._exchange = exchange
        self.callback = callback
        self.generation = 0
        self.again(ns)

    def again(self, ns: int) -> None:
        """Fire after `ns` and then with that period."""
        self.generation += 1
        self.period = max(1000, ns)
        self._exchange.arm(self)

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""
        self.generation += 1


class Exchange:
    """The queue, the topics and the timers of a container."""

    def __init__(self) -> None:
        self._queue: deque[tuple[Callable[[Any], None], Any]] = deque()
        self._channels: dict[tuple[str, str], _Channel] = {}
        self._timers: list[tuple[int, int, int, ExchangeTimer]] = []
        self._order = count()
        self._owners: dict[Callable[..., None], str] = {}  # node names
        self._running: Callable[..., None] | None = None
        self.listens = False  # whether a writer in another process is matched

    # topics ----------------------------------------------------------------------------------------------------

    def writer(self, topic: str, msgtype: str, matched: Matched) -> tuple[_End, list[Receive]]:
        """Add a writer; gives it and the receivers in this process, those that come later included."""
        channel = self._channel(topic, msgtype)
        end = _End(channel, matched)
        channel.writers.append(end)
        self._tell(channel)
        return end, channel.receivers

    def reader(self, topic: str, msgtype: str, receive: Receive, matched: Matched, node: str) -> _End:
        """Add a reader that belongs to a node."""
        channel = self._channel(topic, msgtype)
        end = _End(channel, matched)
        channel.readers.append(end)
        channel.receivers.append(receive)
        self._owners[receive] = node
        self._tell(channel)
        return end

    def outside(self, end: _End, number: int) -> None:
        """Note how many ends in other processes are matched with one of ours."""
        end.outside = number
        self.listens = any(r.outside for c in self._channels.values() for r in c.readers)
        self._tell(end.channel)

    def _channel(self, topic: str, msgtype: str) -> _Channel:
        return self._channels.setdefault((topic, msgtype), _Channel())

    def _tell(self, channel: _Channel) -> None:
        for ends, others in ((channel.writers, channel.readers), (channel.readers, channel.writers)):
            for end in ends:
                self.post(end.matched, end.outside + len(others))

    def timer(self, ns: int, callback: Callable[[], None], node: str) -> ExchangeTimer:
        """Add a timer that belongs to a node."""
        self._owners[callback] = node
        return ExchangeTimer(self, ns, callback)

    def culprit(self) -> str:
        """Name of the node whose code is running or has just raised; empty when it is nobody's."""
        return self._owners.get(self._running, "") if self._running is not None else ""

    # what is to happen -------------------------------------------------------------------------------------------

    def post(self, call: Callable[[Any], None], given: Any) -> None:
        """Call a function when whatever is under way has returned."""
        self._queue.append((call, given))

    def poster(self) -> Callable[[tuple[Callable[[Any], None], Any]], None]:
        """Give the shortest way into the queue."""
        return self._queue.append

    def pending(self) -> bool:
        """Whether something waits in the queue."""
        return bool(self._queue)

    def drain(self, until: int) -> None:
        """Hand over what is queued and what comes of it until nothing is left or `until` (ns, monotonic) has passed."""
        queue, now = self._queue, time.monotonic_ns
        take = queue.popleft
        while queue:
            for _ in range(min(len(queue), BATCH)):
                self._running, given = take()
                self._running(given)
            if now() > until:
                break
        self._running = None

    def arm(self, timer: ExchangeTimer) -> None:
        """Have a timer fire after its period."""
        heapq.heappush(
            self._timers, (time.monotonic_ns() + timer.period, next(self._order), timer.generation, timer)
        )  # fmt: skip

    def next_due(self) -> int:
        """Time (ns, monotonic) of the next timer; far away when there is none."""
        while self._timers and self._timers[0][2] != self._timers[0][3].generation:
            heapq.heappop(self._timers)
        return self._timers[0][0] if self._timers else 1 << 62

    def fire(self) -> bool:
        """Fire the timer that has been due the longest, if one is; what it sends is queued."""
        if self.next_due() > time.monotonic_ns():
            return False
        timer = heapq.heappop(self._timers)[3]
        self.arm(timer)
        self._running = timer.callback
        timer.callback()
        self._running = None
        return True
