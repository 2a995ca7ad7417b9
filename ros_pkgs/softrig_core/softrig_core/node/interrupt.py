"""Ctrl-C while a node starts."""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType


class Interrupt:
    """Handler of SIGINT: until rclpy listens to signals itself, the end of the process, at once.

    A KeyboardInterrupt could be swallowed by whatever is being imported then, and the node would wait for its peers.
    """

    def __init__(self) -> None:
        self.early = True

    def install(self) -> None:
        """Take SIGINT from Python's own handler, and from no other."""
        ours = threading.current_thread() is threading.main_thread()
        if ours and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self)

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Nothing has been published, recorded or said yet when it is early."""
        if self.early:
            os._exit(0)
        signal.default_int_handler(number, frame)


interrupt = Interrupt()
