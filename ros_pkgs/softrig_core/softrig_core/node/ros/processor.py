"""The processor on which the two nodes of a lockstep rig take turns.

One plant and one law wait for each other, so that there is never work for two at a time. But the system wakes who gets
a message on a processor that is idle, and to wake that one takes longer than a short tick; what the tick needs is in
the caches of another one then. So they stay on one, by the number of their domain: both on the same, rigs that run
beside each other on others. Who computes for longer goes where there is room.

With a third node there is work for two: what that shares saves more than the way between processors costs. Whether it
is a rig of two is known to the rig alone, and comes from there.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress

SHORT = 200_000  # ns of processor time for a message: what two processors save a rig is less then
ENOUGH = 100  # messages, or as many as take a time, to judge by: what a process does beside is little then
LONG = 200_000_000  # ns, that time


class Processor:
    """Keeps the threads of this process on one processor while they take short turns.

    Parameters
    ----------
    domain : int
        The same number for nodes that are to be on the same processor.
    done : callable
        Gives how many messages were worked on.
    clock : callable
        Gives the processor time of this process, ns.

    Attributes
    ----------
    number : int or None
        Of the processor; None: any.
    """

    def __init__(self, domain: int, done: Callable[[], int], clock: Callable[[], int] = time.process_time_ns) -> None:
        self._allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        self._own = self._allowed[domain % len(self._allowed)] if len(self._allowed) > 1 else None
        self._done, self._clock = done, clock
        self._before = (0, 0)
        self.number: int | None = None
        self._go(self._own)

    def step(self) -> None:
        """See what the time of the last messages was; to be called some times a second."""
        now, before = (self._done(), self._clock()), self._before
        messages, used = now[0] - before[0], now[1] - before[1]
        if not before[0]:  # what the start took is no message's
            self._before = now
        elif messages >= ENOUGH or (messages and used >= LONG):
            self._before = now
            self._go(self._own if used < SHORT * messages else None)

    def _go(self, number: int | None) -> None:
        if number == self.number:
            return
        self.number = number
        to = self._allowed if number is None else [number]
        for thread in os.listdir("/proc/self/task"):
            with suppress(OSError):  # it has ended, or nobody may choose
                os.sched_setaffinity(int(thread), to)
