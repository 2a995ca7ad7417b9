"""Ctrl-C: at once while a node starts, orderly while it runs, and not twice while it leaves."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType

AT_ONCE = 3  # times that a person has to ask for the end of a node that does not hear: its code never returns


class Interrupt:
    """Handler of SIGINT in place of Python's own, which raises KeyboardInterrupt wherever the program stands.

    Until rclpy listens to signals itself it ends the process: what is being imported could swallow an exception, and
    the node would wait for its peers. From then on rclpy's handler, which is called first, shuts the context down, and
    whoever spins sees that; raised in a callback, an exception would come out of the executor with its stack.
    """

    def __init__(self) -> None:
        self.early = True
        self._times = 0

    def install(self) -> None:
        """Take SIGINT from Python's own handler, and from no other."""
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Nothing has been published, recorded or said yet when it is early."""
        self._times += 1
        if self.early:
            os._exit(0)
        if self._times >= AT_ONCE:
            os._exit(128 + number)


interrupt = Interrupt()
