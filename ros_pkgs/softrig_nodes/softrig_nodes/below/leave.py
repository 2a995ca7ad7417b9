"""The end of a process with a ROS node in it."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from rclpy.node import Node

PATIENCE = 2  # s: time to leave the graph; it takes some ms

before_leaving: list[Callable[[], object]] = []  # called before the nodes are removed


def leave(nodes: Sequence[Node], status: int) -> NoReturn:
    """Remove the nodes of this process from the graph, so that peers notice immediately, and end it.

    In Fast DDS 2.14 both steps may fail. `destroy_node` waits forever if the departure of another node is announced at
    the same moment (eProsima/Fast-DDS#6513; once in some hundred runs, since nodes in lockstep finish together). It may
    also end in a segmentation fault (one of some 300 starts on a host with fifty busy processes). The static
    destructors may do the same. So the first step has a time limit, the process ends in any case, and there is no
    regular exit.

    Parameters
    ----------
    status : int
        Exit status.
    """
    for stream in (sys.stdout, sys.stderr):
        # The reader of the stream may have gone.
        with suppress(OSError, ValueError):
            stream.flush()
    if nodes:
        _exit_after(PATIENCE, status)
        broken = ctypes.CFUNCTYPE(None, ctypes.c_int)(lambda number: os._exit(status))
        # A handler of Python would run only at its next line, which a crashed thread never reaches.
        for number in (signal.SIGSEGV, signal.SIGBUS, signal.SIGABRT):
            ctypes.CDLL(None).signal(number, broken)
    for call in before_leaving:
        # Nothing more can be done for messages that cannot be published now.
        with suppress(RuntimeError):
            call()
    for node in nodes:
        if node.executor is not None:
            # The executor holds references to the entities of the node, which keep the node in the graph.
            node.executor.shutdown()
        node.destroy_node()
    os._exit(status)


class _SigEvent(ctypes.Structure):
    """Linux' struct sigevent."""

    _fields_ = (
        ("value", ctypes.c_ssize_t),
        ("signo", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("reserved", ctypes.c_ssize_t * 5),
    )


def _exit_after(seconds: int, status: int) -> None:
    """Let the C library end the process: a thread or signal handler in Python would wait for the interpreter."""
    libc = ctypes.CDLL(None)
    # It is missing in glibc before 2.34, and on other systems than Linux.
    if not hasattr(libc, "timer_create"):
        return
    sigev_thread = 2
    event = _SigEvent(value=status, notify=sigev_thread, function=ctypes.cast(libc._exit, ctypes.c_void_p))
    timer = ctypes.c_void_p()
    if libc.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0:
        once = (ctypes.c_long * 4)(0, 0, seconds, 0)
        libc.timer_settime(timer, 0, once, None)
