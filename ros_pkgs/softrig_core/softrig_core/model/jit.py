"""Branching and delay loops as native code: numba with its cache, the plain function without it."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

from .compiled import cache_folder

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile a function of floats and arrays at its first call; kept in a cache across processes.

    No fast-math, no contraction, numpy's rules for division: the compiled function gives the bits of the plain one,
    which runs in its place, a hundred times slower, where numba is absent or ``SOFTRIG_JIT=0``.

    Parameters
    ----------
    function : callable
        Loops and branches over floats, ints, tuples and numpy arrays; calls only functions that are `jit` themselves.

    Returns
    -------
    callable
        With the same arguments; its attribute ``py_func`` is the plain function when it is compiled.
    """
    if os.environ.get("SOFTRIG_JIT", "1") == "0":
        return function
    os.environ.setdefault("NUMBA_CACHE_DIR", str(cache_folder() / "numba"))  # read when numba is imported
    try:
        import numba
    except ImportError:
        return function
    return cast(F, numba.njit(cache=True, fastmath=False, error_model="numpy")(function))
