"""A monitor (Hoare): it runs the calls of a node one at a time, from any thread.

A message may be processed in the thread that received it. This saves the hand-over to another thread, which is half
of the cost of a tick between two processes. That thread must not wait, because it holds locks of the middleware. So it
processes the message if no other thread is in the monitor, and otherwise leaves it to that thread. All other calls
(timers, services, matched endpoints) come from the executor's thread, which waits for its turn and has priority over
the messages.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Self

LONG = 5_000_000  # ns: longer work is for the executor, since the receiving thread takes no other message in this time
SHORT_ONES = 20  # short pieces of work in a row after which messages are processed in the receiving thread again


class Monitor:
    """Guards the state of one node.

    Only the executor's thread may use it as a context manager, and must not enter it twice.

    Parameters
    ----------
    wake : callable
        Makes the executor's thread call `serve` soon; called from any thread.
    clock : callable
        Returns ns.

    Attributes
    ----------
    done : int
        Number of processed messages.
    closed : bool
        Whether messages are no longer processed, because the node has ended or an exception was raised.
    """

    def __init__(self, wake: Callable[[], object], clock: Callable[[], int] = time.perf_counter_ns) -> None:
        self._wake, self._clock = wake, clock
        self._lock = threading.Lock()
        self._arrived: deque[Callable[[], object]] = deque()
        self._asked = False  # whether the executor's thread waits for the lock or holds it
        self._short = 0  # pieces of work in a row
        self._error: BaseException | None = None
        self.done = 0
        self.closed = False

    def arrive(self, work: Callable[[], object]) -> None:
        """Run some work now, or when other work has returned; callable from any thread, which it never blocks.

        Parameters
        ----------
        work : callable
            Takes a message and processes it. An exception in it is raised by `serve`.
        """
        arrived, lock = self._arrived, self._lock
        arrived.append(work)
        if self._short < SHORT_ONES:
            if not self._asked:
                self._wake()
            return
        # Another thread may add work after the last look at the queue and fail to get the lock before it is released,
        # so the queue is looked at again after the release.
        while arrived and not self._asked and lock.acquire(blocking=False):
            try:
                while arrived and not self._asked and self._short >= SHORT_ONES:
                    self._do(arrived.popleft())
            except BaseException as error:
                self._error, self.closed = error, True
                arrived.clear()
            finally:
                lock.release()
            if self._error is not None or self._short < SHORT_ONES:
                self._wake()
                return

    def _do(self, work: Callable[[], object]) -> None:
        if self.closed:
            return
        self.done += 1
        begun = self._clock()
        work()
        self._short = self._short + 1 if self._clock() - begun < LONG else 0

    def serve(self) -> None:
        """Run the queued work; raise errors of work in another thread."""
        with self:
            pass

    def __enter__(self) -> Self:
        self._asked = True
        self._lock.acquire()
        return self

    def __exit__(self, kind: object, *failed: object) -> None:
        self.closed = self.closed or kind is not None
        try:
            # This comes before the look at the queue: a thread that adds work from here on looks at the queue itself.
            self._asked = False
            # Messages that arrive during this work are left for the next turn, or the executor might never return to
            # its own work.
            for _ in range(len(self._arrived)):
                self._do(self._arrived.popleft())
        except BaseException:
            self.closed = True
            raise
        finally:
            self._lock.release()
        if self._error is not None:
            error, self._error = self._error, None
            raise error
        if self._arrived:
            self._wake()

    def close(self, patience: float) -> bool:
        """Stop processing messages; return whether the current call has returned within `patience` s."""
        self.closed = True
        if not self._lock.acquire(timeout=patience):
            return False
        self._lock.release()
        return True
