"""The processor on which the two nodes of a lockstep loop take turns.

One plant and one controller wait for each other, so only one of them works at a time. But the system wakes the receiver
of a message on an idle processor. Waking that processor takes longer than a short tick, and the data of the tick is
then in the caches of another one. So both nodes stay on one processor, chosen by the number of their domain; rigs that
run at the same time use different ones. Followers use the remaining processors. A node with longer computations runs on
any processor with free capacity.

With a third node in the loop two can work at a time; running them in parallel saves more than the transfer between
processors costs. Only the rig knows which nodes it has, so it selects the placement (`Middleware.be_prompt`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

# ns of processor time for a message. Below it, a second processor saves less than waking it costs.
SHORT = 200_000
# A judgement is made after this number of messages, or after messages that took `LONG`. The other work of the process
# is a small share of that.
ENOUGH = 100
LONG = 200_000_000  # ns


class Processor:
    """Keeps the threads of this process on one processor, or off it, while they take short turns.

    Parameters
    ----------
    domain : int
        Domain number; nodes with the same number share a processor.
    beside : bool
        Whether this process must run on any other processor.
    done : callable
        Returns the number of processed messages.
    clock : callable
        Returns the processor time of this process, ns.

    Attributes
    ----------
    number : int or None
        Number of the processor; None: any, or any other.
    """

    def __init__(
        self,
        domain: int,
        beside: bool,
        done: Callable[[], int],
        clock: Callable[[], int] = time.process_time_ns,
    ) -> None:
        self._allowed = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        chosen = self._allowed[domain % len(self._allowed)] if self._allowed else 0
        self._own = [n for n in self._allowed if (n == chosen) is not beside] or self._allowed
        self._done, self._clock = done, clock
        self._before = (0, 0)
        self._now: Sequence[int] = self._allowed
        self._go(self._own)

    @property
    def number(self) -> int | None:
        """Return the number of the processor on which the process runs."""
        return self._now[0] if len(self._now) == 1 < len(self._allowed) else None

    def step(self) -> None:
        """Choose the processor by the processor time of the last messages; must be called some times a second."""
        now, before = (self._done(), self._clock()), self._before
        messages, used = now[0] - before[0], now[1] - before[1]
        # The processor time of the start belongs to no message.
        if not before[0]:
            self._before = now
        elif messages >= ENOUGH or (messages and used >= LONG):
            self._before = now
            self._go(self._own if used < SHORT * messages else self._allowed)

    def _go(self, cores: Sequence[int]) -> None:
        if cores == self._now:
            return
        self._now = cores
        for thread in os.listdir("/proc/self/task"):
            # The thread may have ended, or the process may not be allowed to choose.
            with suppress(OSError):
                os.sched_setaffinity(int(thread), cores)
