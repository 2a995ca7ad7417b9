"""The loop of native ticks in real time, which runs without Python's lock; this module needs numba."""

# mypy: allow-untyped-calls, allow-untyped-defs

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from softrig_core.kit._jit_cache import Cache
from softrig_core.timebase import SECOND

from . import _carry
from ._carry import call

# Places in the table `live` of `ticking`. The first is written by Python, the second by both, the others by the loop.
STOP, TAKEN, REACHED, WHY, NEXT, ROOM = range(6)
# Reasons why the loop has ended: at the last tick, or as asked; the clock is too far ahead; the tables are full; native
# code discards the next tick.
ASKED, BEHIND, FULL, DISCARDED = range(4)
NAP = 10_000_000  # ns: the longest sleep, after which the loop looks whether it is asked to end
ROOM_NAP = 50  # us between two looks for a free slot of the ring


def _peek(typing: Any, address: Any) -> Any:
    """Read eight bytes at an address."""

    def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load(builder.inttoptr(values[0], ir.IntType(64).as_pointer()), align=1)

    return types.int64(types.int64), codegen


def _poke(typing: Any, address: Any, value: Any) -> Any:
    """Write eight bytes to an address."""

    def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.store(values[1], builder.inttoptr(values[0], ir.IntType(64).as_pointer()), align=1)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64), codegen


def _fence(typing: Any) -> Any:
    """Let another thread see what was written before the fence when it sees what is written after it."""

    def codegen(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        builder.fence("seq_cst")
        return context.get_dummy_value()

    return types.void(), codegen


peek: Any = intrinsic(_peek)
poke: Any = intrinsic(_poke)
fence: Any = intrinsic(_fence)
# `made` puts functions for a rig in the place of these.
rig: Any = None
run: Any = None


def run_one(k, last, n, c, s, arrays):  # type: ignore[no-untyped-def]
    """Run the rig's function; numba cannot unpack arguments in a `try`."""
    return rig(k, last, n, c, s, *arrays)


def ticking(first, last, live, grid, time, calls, slots, ring, publishers, numbers, spans, kept, head, arrays):  # type: ignore[no-untyped-def] # numba compares annotations, too
    """Run ticks of the clock from `first` up to `last`, each at its time, until something is in the way.

    Parameters
    ----------
    live : array of int64
        See `STOP` and the names after it.
    grid : tuple of int
        Time of t = 0 by the monotonic clock, ns; numerator and denominator of the period, ns; how far the clock may be
        ahead of a tick, ns; number of ticks for which the tables have rows; stamp of t = 0, ns.
    time : array of int64, shape (2,)
        A timespec of C.
    calls : tuple of int
        Addresses of clock_gettime, clock_nanosleep, memcpy, sem_trywait, sem_post, usleep.
    slots : array of int64, shape (n, 3)
        Those of the carrier.
    ring : tuple of int
        Address of memory for a message in each slot, its size, addresses of the semaphores for full and free slots.
    publishers : array of int64, shape (n, 7)
        Of each output that has subscribers: publisher, address and length of a message, place of its stamp, ticks of
        the clock in a period, its first row among `numbers`, and the row after its last.
    numbers : array of int64, shape (n, 3)
        Address of the first number of a column, bytes from one row to the next, place in the message.
    spans : array of int64, shape (n, 2)
        Gets of each tick how late it began and how long it took, ns.
    kept : tuple of arrays
        Two tables that a discarded tick may have changed, and memory for a copy of each.
    head : tuple
        The first arguments of the rig's function after the ticks: see `softrig_core.native.rig_text`.
    arrays : tuple
        The others.

    Returns
    -------
    tuple
        State and last outputs after the ticks.
    """
    n, c, before = head
    start, over, under, behind, lap, epoch = grid
    gettime, sleep, copy, try_to_wait, post, nap = calls
    messages, size, full, free = ring
    when, reported, when_before, reported_before = kept
    place = time.ctypes.data
    # A call that runs no tick: in a loop, numba needs a state whose type does not change any more.
    s = run(first, first, n, c, before, arrays)
    k, why = first, ASKED
    while k < last:
        at = start + (2 * k * over + under) // (2 * under)
        call(gettime, 1, place, 0, 0)
        now = time[0] * SECOND + time[1]
        while now < at and live[STOP] == 0:
            until = min(at, now + NAP)
            time[0] = until // SECOND
            time[1] = until % SECOND
            call(sleep, 1, 1, place, 0)  # a signal may end it early
            call(gettime, 1, place, 0, 0)
            now = time[0] * SECOND + time[1]
        if live[STOP] != 0:
            break
        if now - at > behind:
            why = BEHIND
            break
        if k - live[TAKEN] >= lap:
            why = FULL
            break
        # The rows are used again from the first one on.
        if k - n[2] >= lap:
            n[2] += lap
        when_before[:] = when
        reported_before[:] = reported
        discarded = False
        try:
            s = run(k, k + 1, n, c, s, arrays)
        except Exception:  # numba knows no other class here
            discarded = True
        if discarded:
            when[:] = when_before
            reported[:] = reported_before
            why = DISCARDED
            break
        call(gettime, 1, place, 0, 0)
        spans[k - n[2], 0] = now - at
        spans[k - n[2], 1] = time[0] * SECOND + time[1] - now
        for p in range(len(publishers)):
            every = publishers[p, 4]
            if k % every != 0:
                continue
            if live[ROOM] == 0:
                while call(try_to_wait, free, 0, 0, 0) != 0:
                    call(nap, ROOM_NAP, 0, 0, 0)
                live[ROOM] = 1
            slot = live[NEXT]
            message = messages + slot * size
            call(copy, message, publishers[p, 1], publishers[p, 2], 0)
            stamp = epoch + (2 * k * over + under) // (2 * under)
            if publishers[p, 3] >= 0:
                poke(message + publishers[p, 3], stamp // SECOND | (stamp % SECOND) << 32)
            row = k // every - (n[2] + every - 1) // every
            for i in range(publishers[p, 5], publishers[p, 6]):
                poke(message + numbers[i, 2], peek(numbers[i, 0] + row * numbers[i, 1]))
            slots[slot, 0] = publishers[p, 0]
            slots[slot, 1] = message
            slots[slot, 2] = publishers[p, 2]
            live[NEXT] = (slot + 1) % len(slots)
            live[ROOM] -= 1
            call(post, full, 0, 0, 0)
        k += 1
        fence()
        live[REACHED] = k
    live[WHY] = why
    return s


_digest = _carry.digest + hashlib.sha256(Path(__file__).read_bytes()).hexdigest()


def made(function: Any) -> Callable[..., Any]:
    """Return `ticking` for the function of a rig that numba compiles (`softrig_core.native.compile.compiled`)."""
    digest = hashlib.sha256(f"{function.py_func.__qualname__} {_digest}".encode()).hexdigest()
    scope = {**globals(), "rig": function}

    def native(python: Any) -> Any:
        result: Any = FunctionType(python.__code__, scope, python.__name__)
        # numba makes the symbol of the native code from this name; see `kit.jit`.
        result.__qualname__ = f"{python.__name__}_{digest[:32]}"
        return numba.njit(nogil=True)(result)

    scope["run"] = native(run_one)
    compiled: Any = native(ticking)
    compiled._cache = Cache("ticking", digest)
    return compiled  # type: ignore[no-any-return]
