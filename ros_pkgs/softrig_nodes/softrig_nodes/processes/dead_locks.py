"""Free the locks that killed processes held in ports of shared memory.

A port of Fast DDS has two mutexes, which its reader and its writers lock for some microseconds. They are not robust: if
a process ends while it holds one, each send to that port waits for 1 s and then fails. The sender holds the lock of its
own participant in the meantime, so all its messages wait. This repeats with each message until the lease of the dead
participant ends (3 s with our profile, 20 s without one), which stops a rig. Processes that end during a flood of
messages, without leaving the graph, hold such a mutex in about one of ten cases on a busy host.
"""

from __future__ import annotations

import ctypes
import math
import mmap
import os
import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from .shared_memory import FOLDER, judged, ports_of

# `PortNode::empty_cv.semaphore_lists_mutex_` and `PortNode::empty_cv_mutex` of Fast DDS 2.14 and 3.2 on 64-bit x86,
# counted from where `judged` finds the time of the last look
MUTEXES = 20_552, 20_592
# two of glibc's pthread_mutex_t: lock, count, owner (a thread), users, kind
BOTH = struct.Struct("=iiiii20xiiiii")
FIELDS = 5
BETWEEN = 0.05  # s: the shortest time between two looks; several nodes of a process look
SHARED = 0x80  # the kind of a mutex that is shared by processes and neither robust nor recursive


class HeldMutex(NamedTuple):
    """A mutex that a dead thread has locked."""

    port: str
    inode: int
    at: int
    owner: int


class DeadLocks:
    """The mutexes in the ports of a domain; `release` is called again and again.

    Parameters
    ----------
    folder : Path
        Where the ports are.
    """

    def __init__(self, folder: Path = FOLDER) -> None:
        self._folder = folder
        self._checked = -math.inf  # s, monotonic
        self._places: dict[tuple[str, int], int] = {}
        self._held: set[HeldMutex] = set()

    def release(self, domain: int) -> int:
        """Unlock each mutex whose owner was dead at two checks in a row; return how many were unlocked.

        Two checks are needed, because the owner of another PID namespace is not visible here. (A live owner would have
        to be preempted with the mutex locked at both checks. Its port would lose a notification, but no message.)
        """
        now = time.monotonic()
        if now < self._checked + BETWEEN:
            return 0
        self._checked = now
        before, self._held = self._held, set()
        offsets, self._places = self._places, {}
        released = 0
        for path in ports_of(domain, self._folder):
            try:
                file = os.open(path, os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
            # It was removed in the meantime, or it belongs to another user.
            except OSError:
                continue
            try:
                # A port may be removed and created again under the same name, so the inode is part of the key.
                key = path, os.fstat(file).st_ino
                offset = offsets[key] if key in offsets else _mutex_offset(file, Path(path))
                self._places[key] = offset
                for lock in _held_mutexes(key, file, offset):
                    if lock in before:
                        _unlock(file, lock.at)
                        released += 1
                    else:
                        self._held.add(lock)
            finally:
                os.close(file)
        return released


def _held_mutexes(key: tuple[str, int], file: int, start: int) -> Iterator[HeldMutex]:
    """Yield the mutexes of a port that dead threads hold."""
    if start < 0:
        return
    fields = BOTH.unpack(os.pread(file, BOTH.size, start + MUTEXES[0]))
    for k, offset in enumerate(MUTEXES):
        lock, _, owner, *_ = fields[k * FIELDS :]
        if lock and owner > 0 and _is_dead(owner):
            yield HeldMutex(*key, start + offset, owner)


def _mutex_offset(file: int, path: Path) -> int:
    """Return the offset of a port's description; -1 if its mutexes are not at the expected places."""
    # The port may have been removed since it was opened, so it is not opened again by its path.
    segment = os.pread(file, os.fstat(file).st_size, 0)
    start = judged(segment, path)
    if start < 0 or len(segment) < start + MUTEXES[0] + BOTH.size:
        return -1
    fields = BOTH.unpack_from(segment, start + MUTEXES[0])
    return start if {*fields[FIELDS - 1 :: FIELDS]} == {SHARED} else -1


def _is_dead(thread: int) -> bool:
    """Return whether a thread has ended, its process waited for or not."""
    try:
        return Path(f"/proc/{thread}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except OSError:
        # A missing entry shows that the thread has ended, but only on a host that has /proc at all.
        return Path("/proc/self").exists()


def _unlock(file: int, offset: int) -> None:
    """Unlock a mutex of this C library and wake the threads that wait for it."""
    with mmap.mmap(file, 0) as segment:
        mutex = ctypes.c_char.from_buffer(segment, offset)
        ctypes.CDLL(None).pthread_mutex_unlock(ctypes.byref(mutex))
        # The mapping cannot be closed while an object refers to it.
        del mutex
