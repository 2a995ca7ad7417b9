"""CPU time of calls."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable


def cpu(call: Callable[[], object]) -> float:
    """Return the CPU time of a call in s."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def least(call: Callable[[], object], rounds: int = 5, fresh: bool = False) -> float:
    """Return the least CPU time of several calls in s, after one that sets up and compiles.

    Parameters
    ----------
    fresh : bool
        Whether each call gets fresh memory pages, as the first one in a process (glibc).
    """
    call()
    return min(_fresh(call) if fresh else cpu(call) for _ in range(rounds))


def _fresh(call: Callable[[], object]) -> float:
    ctypes.CDLL(None).malloc_trim(0)
    return cpu(call)
