"""Ctrl-C: immediate while a node starts, orderly while it runs, and ignored when repeated during the end."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

PARENT = "SOFTRIG_PARENT"  # variable with the process whose end is that of the nodes that it has started
PR_SET_PDEATHSIG = 1
AT_ONCE = 3  # times that a person has to ask for the end of a node that does not hear: its code never returns


class Interrupt:
    """Handler of SIGINT in place of Python's own, which raises KeyboardInterrupt at any point of the program.

    Until rclpy handles signals itself, this handler ends the process: an import could swallow an exception, and the
    node would wait for its peers. From then on rclpy's handler is called first and shuts the context down, which the
    spinning code detects. An exception raised in a callback would leave the executor with a stack trace.
    """

    def __init__(self) -> None:
        self.early = True
        self._leave: Callable[[], object] | None = None
        self._times = 0

    def install(self) -> None:
        """Replace Python's own SIGINT handler, or that left by a launch that has died, and no other."""
        if _is_pythons_own():
            signal.signal(signal.SIGINT, self)
        parent = os.environ.get(PARENT)
        if parent == str(os.getppid()) and sys.platform == "linux":
            import ctypes  # imported late: Ctrl-C during an import of this module would print its stack

            ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGINT)
            if os.getppid() != int(parent):  # died before that
                os._exit(0)

    @contextmanager
    def leaving(self, leave: Callable[[], object]) -> Iterator[None]:
        """Call `leave`, which ends the process, on SIGINT within the block: for long work without visible results yet.

        An exception is not sufficient, because a compiler's callbacks swallow it.
        """
        self._leave = leave
        try:
            yield
        finally:
            self._leave = None

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise an error that ends the program; at this point nothing has been published, recorded or printed."""
        self._times += 1
        if self.early:
            os._exit(0)
        if self._times >= AT_ONCE:
            os._exit(128 + number)
        if self._leave is not None:
            self._leave()


interrupt = Interrupt()


def quiet_imports() -> None:
    """Install a handler that ends the process silently on SIGINT during imports, which are most of a node's start.

    Nothing has been done yet at that time, and launch would report the stack trace of an interrupted import as a
    crashed process. Afterwards, and in every other program, Python's own handler is used.
    """
    if _is_pythons_own():
        signal.signal(signal.SIGINT, _while_importing)


def _while_importing(number: int, frame: FrameType | None) -> None:
    frames = []
    current = frame
    while current is not None:
        frames.append(current)
        current = current.f_back
    # imports of the script itself, or of setuptools for it; an import in a function means that the program is running
    first = frames[-2].f_code if len(frames) > 1 else None
    if first is not None and (
        first.co_filename.startswith("<frozen importlib") or first.co_name == "importlib_load_entry_point"
    ):
        os._exit(0)
    signal.default_int_handler(number, frame)


def _is_pythons_own() -> bool:
    in_main = threading.current_thread() is threading.main_thread()
    return in_main and signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _while_importing)
