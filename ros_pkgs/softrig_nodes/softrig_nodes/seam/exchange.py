"""Run the nodes of a container with one queue of calls and with timers, without ROS.

A message for a neighbour is taken from the queue only when the call that put it there has returned. So ticks follow
each other, none runs inside another, and the depth of the stack does not grow.
"""

from __future__ import annotations

import heapq
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import count
from typing import Any

from .middleware import Receive

BATCH = 16  # calls between two looks at the time
# Messages for other processes that are published together: waking a reader costs four times as much as publishing.
BURST = 8
SLACK = 150_000  # ns to the next timer that leave enough time to publish them before it
SLICE = 5_000_000  # ns: how long the queue may keep a timer waiting


class ExchangeTimer:
    """A timer of the container's own; see `Timer`.

    Attributes
    ----------
    due : int or None
        Time at which it fires next, ns, monotonic; None when it is cancelled.
    moved : bool
        Whether it was moved since the exchange entered it. It is entered only once a turn, when all waiting messages
        have been passed on, because most time limits are cancelled again by then.
    """

    def __init__(self, moved: list[ExchangeTimer], ns: int, callback: Callable[[], None]) -> None:
        self._moved = moved
        self.callback = callback
        self.moved = False
        self.again(ns)

    def again(self, ns: int, period: int = 0) -> None:
        """Fire after `ns` and then with a period, see `Timer`."""
        # A timer of 0 ns would always be due, and `serve` would never wait.
        self.period = max(1000, period or ns)
        self.due: int | None = time.monotonic_ns() + max(1000, ns)
        if not self.moved:
            self.moved = True
            self._moved.append(self)

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""
        self.due = None


class Exchange:
    """The queue and the timers of a container.

    Attributes
    ----------
    owners : dict of callable to str
        Node names, by what is called for them.
    writers : dict
        Number of writers in other processes that are matched, by reader.
    """

    def __init__(self) -> None:
        self._queue: deque[Callable[[], object]] = deque()
        self._timers: list[tuple[int, int, ExchangeTimer]] = []
        self._moved: list[ExchangeTimer] = []
        # Timers cannot be compared; their number decides between equal times, in the order in which they were entered.
        self._order = count()
        self.owners: dict[Callable[..., Any], str] = {}
        self.writers: dict[object, int] = {}
        self._culprit: Callable[..., Any] | None = None
        self._outbox: list[tuple[Receive, bytes]] = []
        self._turns = 0  # number of turns for which the outbox has waited

    @property
    def listens(self) -> bool:
        """Return whether a publisher in another process is matched."""
        return any(self.writers.values())

    def timer(self, ns: int, callback: Callable[[], None], node: str) -> ExchangeTimer:
        """Add a timer that belongs to a node."""
        self.owners[callback] = node
        return ExchangeTimer(self._moved, ns, callback)

    def culprit(self) -> str:
        """Name of the node whose code has raised; empty if it was not a node's code."""
        return self.owners.get(self._culprit, "") if self._culprit is not None else ""

    # what is to happen -------------------------------------------------------------------------------------------

    def post(self, call: Callable[[], object]) -> None:
        """Call a function after the current call has returned."""
        self._queue.append(call)

    def hand(self, receive: Receive, data: bytes) -> None:
        """Deliver a message from another process to a node at a time."""
        self._queue.append(partial(receive, data))

    def carry(self, publish: Receive, data: bytes) -> None:
        """Queue a message for other processes; the queue is published in bursts when the loop has time."""
        self._outbox.append((publish, data))
        if len(self._outbox) >= BURST:
            self.flush()

    def flush(self) -> None:
        """Publish the messages for other processes."""
        outbox, self._outbox, self._turns = self._outbox, [], 0
        for publish, data in outbox:
            publish(data)

    def serve(self, until: int, awake: int = 0) -> int:
        """Fire timers and pass messages on until nothing is due for `awake` ns or `until` has passed.

        Parameters
        ----------
        until : int
            ns, monotonic.
        awake : int
            A timer that is due within this time, ns, is awaited here.

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
                # Publishing wakes other processes, which costs the loop time: it waits for a gap before the next timer,
                # but not without end.
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
        """Poll until a time (ns, monotonic) without sleeping."""
        now = time.monotonic_ns
        # Sleeping and waking up takes longer than the remaining time.
        while now() < limit:
            pass

    def _drain(self, until: int) -> None:
        """Process the queue and its consequences until it is empty or `until` (ns, monotonic) has passed."""
        queue, now = self._queue, time.monotonic_ns
        accept = queue.popleft
        call: Callable[[], object] | None = None
        try:
            while queue:
                for _ in range(min(len(queue), BATCH)):
                    call = accept()
                    call()
                if now() > until:
                    break
        except BaseException:
            self._culprit = call.func if isinstance(call, partial) else call
            raise

    def next_due(self) -> int:
        """Return the time (ns, monotonic) of the next timer; far in the future if there is none."""
        timers = self._timers
        for timer in self._moved:
            timer.moved = False
            if timer.due is not None:
                heapq.heappush(timers, (timer.due, next(self._order), timer))
        self._moved.clear()
        # A heap cannot remove an entry inside of it, so those of moved or cancelled timers are dropped on top.
        while timers and timers[0][0] != timers[0][2].due:
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
        # The callback may have moved or cancelled its own timer, which must then not be set again.
        if timer.due == due:
            timer.again(timer.period)
