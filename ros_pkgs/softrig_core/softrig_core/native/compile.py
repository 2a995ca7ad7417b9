"""Text to native code: numba, with the cache of `jit`, by content."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from ..block.answer import only_floats, sum_of_products
from ..block.bound import code_of
from ..kit.compiled import Compiled
from ..kit.jit import HOW, Jit, our_numba, tokens_of
from .rig_text import RigText
from .twins import form
from .words import OWN

# Every text may name these.
BASE: dict[str, Any] = {
    "math": math,
    "array_": np.array,
    "array_floor": np.floor,
    "float_nan": math.nan,
    "float_inf": math.inf,
    "float_less": -math.inf,
}


def compiled(rig: RigText) -> Callable[..., Any]:
    """Return the function of a rig; compiled at its first call, or found in the cache.

    Returns
    -------
    callable
        ``rig(first, last, n, c, s, *arrays) -> s``: runs the ticks of the clock from `first` up to `last`. n[0] is the
        current tick, n[2] the one with which the places of answers begin. An exception discards the current tick.
    """
    numba = our_numba()
    from ..kit._borrowed import Borrowing
    from ..kit._jit_cache import Cache

    _teach(numba)
    names = rig.program.names
    scope = {"same_": same, **BASE}
    # Where Python would raise (division by zero, a wrong index) the text has to raise as well, so that the tick is
    # discarded.
    # Other threads run during a call (nogil), such as the one that reports a tick that does not return.
    options = {"error_model": "python", "boundscheck": True, "nogil": True}
    # Only the rig's function calls the others, so they need no wrappers, which take time to compile.
    inner = {"forceinline": True, "no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    content = hashlib.sha256(HOW + f"{options} {inner}\0{rig.text}".encode())
    for name, value in names.items():
        content.update(f"\0{name}\0".encode())
        if isinstance(value, Compiled):
            scope[name] = _external(numba, value)
            content.update(str(value.symbol).encode())
            continue
        scope[name] = value
        for token in tokens_of(value, set()):
            content.update(token.encode())
    # numba's cache looks for the module of the functions that it finds.
    scope["__name__"] = __name__
    exec(code_of(rig.text, "rig"), scope)
    for name, value in list(scope.items()):
        if callable(value) and getattr(value, "__globals__", None) is scope:
            # The symbol is made of this name, and two texts from the cache must not share one in a process.
            value.__qualname__ = f"{name}_{content.hexdigest()[:32]}"
            more = {} if name == "rig" else inner
            scope[name] = numba.njit(**options, **more, pipeline_class=Borrowing)(value)
    result: Any = scope["rig"]
    # A class that cannot be imported would be another one in the next process, so such a text is not cached.
    result._cache = Cache("rig", content.hexdigest(), (b"__main__", b"<locals>"))
    return result  # type: ignore[no-any-return]


def plain(rig: RigText) -> Callable[..., Any]:
    """Return the function of a rig in Python: it needs no compilation and is faster than single ticks.

    Returns
    -------
    callable
        As `compiled`, but its tables are lists.
    """
    names = rig.program.names
    scope = {"same_": same, "only_floats": only_floats, "sum_of_products": sum_of_products, **BASE, **OWN, **names}
    exec(code_of(rig.text, "rig"), scope)
    for name, value in names.items():
        if isinstance(value, Jit):
            scope[name] = value.direct
        elif isinstance(value, Compiled):
            # Python calls a casadi function with values; only native code needs the memory in which it works.
            scope[name.removesuffix("_there")] = lambda s, *values, value=value: value(values)
    return scope["rig"]  # type: ignore[no-any-return]


def same(before: Any, after: Any) -> Any:
    """Return a state, which must be of the type of the one before."""
    if form(before) != form(after):
        # A TypeError would be taken for a defect of the text.
        raise RuntimeError("a state that changes its type")
    return after


@lru_cache(maxsize=1)
def _teach(numba: Any) -> None:
    from numba.core.errors import TypingError
    from numba.extending import overload

    @overload(same)
    def _same(before, after):  # type: ignore[no-untyped-def]
        if before != after:
            raise TypingError(f"a state that changes its type, from {before} to {after}")
        return lambda before, after: after


def _external(numba: Any, compiled: Compiled) -> Any:
    from llvmlite import binding
    from numba.core import types

    binding.add_symbol(compiled.symbol, compiled.address)
    pointer = types.uintp
    return types.ExternalFunction(str(compiled.symbol), types.int32(pointer, pointer, pointer, pointer, types.int64))
