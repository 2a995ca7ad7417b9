"""The loop of `carrier`, which runs without Python's lock; this module needs numba."""

# mypy: allow-untyped-calls, allow-untyped-defs

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from softrig_core.kit._jit_cache import Cache


def _call(typing: Any, function: Any, a: Any, b: Any, c: Any, d: Any) -> Any:
    """Call the function of C at an address, with four whole numbers or addresses; it may expect fewer."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(ir.IntType(32), [ir.IntType(64)] * 4)
        return builder.call(builder.inttoptr(args[0], kind.as_pointer()), args[1:])

    return types.int32(*[types.int64] * 5), codegen


call: Any = intrinsic(_call)


def carry(slots, message, addresses, failed):  # type: ignore[no-untyped-def] # numba compares annotations, too
    """Publish the messages of a ring, in their order, until one has no publisher.

    Parameters
    ----------
    slots : array of int64, shape (n, 3)
        Publisher, address and length of each message.
    message : array of int64, shape (8,)
        The structure in which rcl receives a message.
    addresses : tuple of int
        Address of that structure, of the semaphores of full and of free slots, of six functions; the length of a nap in
        us, and the number of naps in succession.
    failed : array of int64, shape (1,)
        Gets what rcl returns for a message that it does not publish.
    """
    address, full, free, wait, try_to_wait, post, nap, publish, reset, pause, naps = addresses
    k, idle = 0, 0
    while True:
        if call(try_to_wait, full, 0, 0, 0) != 0:
            # Waking a thread costs several us. A thread that naps need not be woken, so it waits only when little is
            # published.
            idle += 1
            if idle <= naps:
                call(nap, pause, 0, 0, 0)
                continue
            # A signal may end the wait early.
            while call(wait, full, 0, 0, 0) != 0:
                pass
        idle = 0
        if slots[k, 0] == 0:
            return
        message[0] = slots[k, 1]
        message[1] = slots[k, 2]
        message[2] = slots[k, 2]
        result = call(publish, slots[k, 0], address, 0, 0)
        if result != 0:
            failed[0] = result
            call(reset, 0, 0, 0, 0)
        call(post, free, 0, 0, 0)
        k = (k + 1) % len(slots)


# numba makes the symbol of the native code from this name; see `kit.jit`.
digest = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()
carry.__qualname__ = f"carry_{digest[:32]}"
compiled: Any = numba.njit(nogil=True)(carry)
compiled._cache = Cache("carry", digest)
