"""Stops from outside: SIGINT, SIGTERM, SIGHUP and SIGQUIT end a run in the same orderly way.

A SIGHUP that is ignored from the start, as by `nohup`, stays ignored.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_HUNG_UP = (signal.SIGHUP,) if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN else ()
SIGNALS = (signal.SIGINT, signal.SIGTERM, *_HUNG_UP, signal.SIGQUIT)


class Stopped(KeyboardInterrupt):
    """A signal has requested the end.

    Attributes
    ----------
    number : int
        Of the signal; a process that ends because of it has the status 128 + number.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def signal_of(error: KeyboardInterrupt) -> int:
    """Return the number of the signal behind an interrupt."""
    return error.number if isinstance(error, Stopped) else int(signal.SIGINT)


class Stopping:
    """Records whether a signal has arrived."""

    number = 0

    def check(self) -> None:
        """Raise `Stopped` once more: Python may have swallowed it where it struck (at a fork, in a finaliser)."""
        if self.number:
            raise Stopped(self.number)


@contextmanager
def stoppable() -> Iterator[Stopping]:
    """Raise `Stopped` in the main thread at the first signal; later signals do not disturb the cleanup.

    In other threads, which get no signals, it does nothing. A long wait asks `Stopping.check` now and then.
    """
    stopping = Stopping()
    if threading.current_thread() is not threading.main_thread():
        yield stopping
        return

    def handle(number: int, frame: FrameType | None) -> None:
        # A later signal is ignored here and not by SIG_IGN: for a signal that has arrived already, Python would then
        # print a traceback.
        if not stopping.number:
            stopping.number = number
            raise Stopped(number)

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield stopping
    finally:
        for number, old in before.items():
            signal.signal(number, old)


@contextmanager
def unstopped() -> Iterator[None]:
    """Delay signals while something is written that must not be left incomplete."""
    with undisturbed() as arrived:
        yield
    if arrived:
        signal.raise_signal(arrived[0])


@contextmanager
def undisturbed() -> Iterator[list[int]]:
    """Yield a list of the signals that arrive within the block; they have no other effect, the caller handles them."""
    arrived: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield arrived
        return
    # The signals are handled, not blocked, because a blocked signal would be delivered to another thread.
    before = {number: signal.signal(number, lambda number, frame: arrived.append(number)) for number in SIGNALS}
    try:
        yield arrived
    finally:
        for number, old in before.items():
            signal.signal(number, old)
