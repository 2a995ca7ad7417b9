"""A thread that wakes at its time, and the clock by which it does."""

from __future__ import annotations

import ctypes
import os
import threading
import time
from contextlib import suppress

SLACK = 29  # PR_SET_TIMERSLACK
# Priorities above all processes without one: the thread that publishes must not delay a tick.
PUBLISHING, TICKING = 1, 2


def make_punctual() -> None:
    """Let the calling thread wake at its time, and before other processes where the system allows it."""
    # By default Linux lets a sleep take up to 50 us longer, which is a period at 20 kHz.
    ctypes.CDLL(None).prctl(SLACK, ctypes.c_ulong(1), 0, 0, 0)
    prefer(threading.get_native_id(), TICKING)


def prefer(thread: int, priority: int) -> None:
    """Run a thread of this process, by its number, before those without a priority; 0: no more. It may be refused."""
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    with suppress(OSError):
        os.sched_setscheduler(thread, policy, os.sched_param(priority))


def tested() -> bool:
    """Return whether C's monotonic clock is that of Python, in a timespec of two numbers of 64 bits (`_ticking`)."""
    spec = (ctypes.c_int64 * 2)()
    before = time.monotonic_ns()
    ctypes.CDLL(None).clock_gettime(1, spec)
    return before <= spec[0] * 10**9 + spec[1] <= time.monotonic_ns()
