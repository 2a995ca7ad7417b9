"""Publish from a native thread, so that a tick in real time does not wait for the middleware.

A call that publishes takes 3 to 20 us and holds Python's lock, so a thread of Python would not help. Here a tick only
writes the place of a message into a ring. The thread empties the ring in one native loop, without Python's lock.
"""

from __future__ import annotations

import ctypes
import importlib
import os
import struct
import sys
import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from softrig_core.kit.jit import switched_off

from .arrival import SIZE, Bytes
from .leave import before_leaving
from .punctual import PUBLISHING, prefer
from .uses import RCLError, sending, works

SLOTS = 4096  # messages that may wait; a tick that finds no free slot waits for one
TAKEN = 32  # free slots that are counted together
PAUSE, NAPS = 50, 4  # us, and how many naps of that length the thread takes before it has to be woken
NICER = 5  # added to the niceness of the thread, so that ticks have priority on a shared processor
PATIENCE = 10.0  # s: for all messages at the end
# Functions of C that `_ticking` calls.
CALLS = ("clock_gettime", "clock_nanosleep", "memcpy", "sem_trywait", "sem_post", "usleep")
# Distance from the address of a bytes object to its content. The basic size includes the 0 after the content.
OFFSET = bytes.__basicsize__ - 1
SEMAPHORE = 8  # words; the C libraries of Linux need four
SLOT = struct.Struct("qqq")  # address of the publisher, address and length of the message

_PUBLISH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.POINTER(Bytes), ctypes.c_void_p)


class Carrier:
    """A ring of messages, and the thread that publishes them; one thread of Python may use it.

    Parameters
    ----------
    publish : callable of ctypes, optional
        Takes the place of rcl's function.

    Attributes
    ----------
    handles : dict of str to int
        Publishers by the full names of their topics.
    calls : tuple of int
        Addresses of `CALLS`.
    """

    def __init__(self, publish: Any = None) -> None:
        rcl = ctypes.CDLL(importlib.import_module("rclpy._rclpy_pybind11").__file__)
        # Functions of the second one keep Python's lock, because they return immediately.
        self._c, quick = ctypes.CDLL(None), ctypes.PyDLL(None)
        self._slots, self._semaphores = np.zeros((SLOTS, 3), np.int64), np.zeros((2, SEMAPHORE), np.int64)
        self._message, self._failed = np.zeros(ctypes.sizeof(Bytes) // 8, np.int64), np.zeros(1, np.int64)
        self._full, self._free = (ctypes.c_void_p(row.ctypes.data) for row in self._semaphores)
        self._c.sem_init(self._full, 0, 0)
        self._c.sem_init(self._free, 0, SLOTS)
        self._named = [getattr(self._c, name) for name in ("sem_wait", "sem_trywait", "sem_post", "usleep")]
        self._named += [publish or rcl.rcl_publish_serialized_message, rcl.rcutils_reset_error]
        data = [array.ctypes.data for array in (self._message, *self._semaphores)]
        self.calls = tuple(_address(getattr(self._c, name)) for name in CALLS)
        self._places = (*data, *map(_address, self._named), PAUSE, NAPS)
        self._post, self._try_to_wait = quick.sem_post, quick.sem_trywait
        self._ring = memoryview(self._slots).cast("B")
        # The thread reads the bytes inside of these objects, so they must live until their slots are used again.
        self._held = [b""] * SLOTS
        self._next = self._room = 0
        self._thread = -1  # no thread: it cannot be preferred
        self.handles: dict[str, int] = {}
        # Whether native code fills the ring, and whether Python has since that ended.
        self._lent = self._filled = False
        # Memory for all messages of native code, and bytes of each message.
        self._memory, self._size = np.zeros(0, np.int64), 0

    def run(self) -> None:
        """Publish the messages of the ring until one for publisher 0."""
        loop = importlib.import_module("._carry", __package__).compiled
        loop(self._slots, self._message, self._places, self._failed)

    def start(self) -> None:
        """Publish in a thread from now on."""

        def work() -> None:
            self._thread = number = threading.get_native_id()
            prefer(number, 0)
            os.setpriority(os.PRIO_PROCESS, number, os.getpriority(os.PRIO_PROCESS, 0) + NICER)
            self.run()

        threading.Thread(target=work, daemon=True).start()

    def sender(self, publisher: Any) -> Callable[[bytes], None]:
        """Return a function that puts the bytes of a message into the ring."""
        handle, put, publish = publisher.handle.pointer, self.put, sending(publisher)
        self.handles[publisher.topic_name] = handle
        # Native code fills the ring without Python's lock, so that nothing else may do so in the meantime.
        return lambda data: publish(data) if self._lent else put(handle, data)

    def put(self, handle: int, data: bytes) -> None:
        """Put a message into the ring; wait while the ring is full.

        Raises
        ------
        RCLError
            An earlier message could not be published.
        """
        if not self._room:
            self._count_room()
        k, self._filled = self._next, True
        self._held[k] = data = bytes(data)
        SLOT.pack_into(self._ring, SLOT.size * k, handle, id(data) + OFFSET, len(data))
        self._next, self._room = (k + 1) % SLOTS, self._room - 1
        self._post(self._full)

    def _count_room(self) -> None:
        self.check()
        while self._room < TAKEN and not self._try_to_wait(self._free):
            self._room += 1
        while not self._room:
            # A signal may end the wait early.
            self._room = int(not self._c.sem_wait(self._free))

    def lend(self, size: int) -> tuple[NDArray[np.int64], tuple[int, ...], int, int]:
        """Let native code fill the ring with messages of up to `size` bytes, a multiple of 8, until `resume`.

        Returns
        -------
        slots : array of int64, shape (n, 3)
        ring : tuple of int
            Address of memory for a message in each slot, its size, addresses of the semaphores for full and free slots.
        following, room : int
            The next slot, and the number of free ones.
        """
        # What others publish in the meantime must not overtake what they have put here. Messages of native code, which
        # are alone here, may wait on, unless their memory is replaced.
        if self._filled or size > self._size:
            self.drain()
        if size > self._size:
            self._size, self._memory = size, np.full(SLOTS * size // 8, 0, np.int64)
        self._lent, self._filled = True, False
        # Ticks in Python have no priority, so that the thread has one only now.
        prefer(self._thread, PUBLISHING)
        semaphores = (row.ctypes.data for row in self._semaphores)
        return self._slots, (self._memory.ctypes.data, self._size, *semaphores), self._next, self._room

    def resume(self, following: int, room: int) -> None:
        """Fill the ring from Python again, from a slot on; native code has left `room` free ones that it found."""
        self._next, self._room, self._lent = following, room, False
        prefer(self._thread, 0)

    def drain(self) -> None:
        """Wait, for a bounded time, until all messages in the ring are published.

        Raises
        ------
        RCLError
            A message could not be published, or not in time.
        """
        limit = time.time() + PATIENCE
        until = (ctypes.c_long * 2)(int(limit))
        while self._room < SLOTS:
            if not self._c.sem_timedwait(self._free, until):
                self._room += 1
            elif time.time() > limit:  # otherwise a signal has ended the wait
                raise RCLError(f"{SLOTS - self._room} messages are not published within {PATIENCE:g} s")
        self.check()

    def check(self) -> None:
        """Raise an RCLError if a message could not be published."""
        # After a signal has shut the context down, nothing can be published, and nothing needs to be.
        if (code := int(self._failed[0])) and rclpy.ok():
            self._failed[0] = 0
            raise RCLError(f"a message cannot be published (rcl reports {code})")


def _address(function: Any) -> int:
    """Return the address of a function of C."""
    return int(ctypes.cast(function, ctypes.c_void_p).value or 0)


def tested() -> bool:
    """Return whether rcl receives messages as it expects them, tested by one turn of the loop with a function that
    checks them.
    """
    if sys.platform != "linux" or switched_off() or len(os.sched_getaffinity(0)) < 2:
        return False
    seen = []

    def publish(publisher: int, message: Any, allocation: Any) -> int:
        contents = message.contents
        seen.append((publisher, ctypes.string_at(contents.buffer, contents.length), contents.capacity, allocation))
        return len(seen) - 1

    carrier, content = Carrier(_PUBLISH(publish)), b"content"
    for handle in (7, 8, 0):
        carrier.put(handle, content)
    carrier.run()
    expected = [(7, content, len(content), None), (8, content, len(content), None)]
    return seen == expected and carrier._failed[0] == 1 and _sized()


def _sized() -> bool:
    """Return whether rcl fills its structure as `Bytes` describes it."""
    rcl, array = ctypes.CDLL(importlib.import_module("rclpy._rclpy_pybind11").__file__), Bytes()
    rcl.rcutils_get_default_allocator.restype = type(array.allocator)
    allocator = rcl.rcutils_get_default_allocator()
    if rcl.rcutils_uint8_array_init(ctypes.byref(array), ctypes.c_size_t(SIZE), ctypes.byref(allocator)):
        return False
    result = bool(array.buffer) and (array.length, array.capacity) == (0, SIZE)
    rcl.rcutils_uint8_array_fini(ctypes.byref(array))
    return result


@cache
def carrier() -> Carrier | None:
    """Return the carrier of this process; None where messages are published by calls."""
    if not works("carrier"):
        return None
    result = Carrier()
    result.start()
    before_leaving.append(result.drain)
    return result
