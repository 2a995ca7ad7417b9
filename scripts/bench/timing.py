"""CPU time of calls."""

from __future__ import annotations

import time
from collections.abc import Callable


def cpu(call: Callable[[], object]) -> float:
    """Return the CPU time of a call in s."""
    begin = time.process_time()
    call()
    return time.process_time() - begin


def least(call: Callable[[], object], rounds: int = 5) -> float:
    """Return the least CPU time of several calls in s, after one that sets up and compiles."""
    call()
    return min(cpu(call) for _ in range(rounds))
