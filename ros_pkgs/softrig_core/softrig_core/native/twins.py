"""States as native code takes them: named tuples to their leaves.

A frozen dataclass has a twin with the same fields, found by its name. Of other objects those that say how take part:
`native` gives a named tuple, which may hold arrays that are its own, with methods of the same names that the
translation reads; its `python` gives the object again.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections import namedtuple
from collections.abc import Hashable
from functools import cache
from typing import Any

NUMBERS = frozenset({float, int, bool})
MARK = "__"
OF = "twin_of_"  # attribute of a twin: its dataclass


@cache
def is_twinned(kind: Hashable) -> bool:
    """Whether a class has a twin: a frozen dataclass that any module can find."""
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
        return False
    frozen: bool = kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
    return frozen and "<" not in kind.__qualname__ and "." not in kind.__qualname__


@cache
def twin(kind: type) -> Any:
    """Give the named tuple of a dataclass."""
    name = f"{kind.__module__.replace('.', MARK)}{MARK}{kind.__qualname__}"
    found: Any = namedtuple(name, [f.name for f in dataclasses.fields(kind)])  # type: ignore[misc]
    found.__module__ = __name__
    setattr(found, OF, kind)
    return found


def __getattr__(name: str) -> Any:  # native code in the cache names its types by module and name
    module, mark, kind = name.rpartition(MARK)
    if not mark or not module or name.startswith(MARK):
        raise AttributeError(name)
    return twin(getattr(importlib.import_module(module.replace(MARK, ".")), kind))


def packed(value: Any, typed: bool = True) -> Any:
    """Give a state as native code takes it, where arrays are copies; `typed` false: objects as Python has them."""
    if type(value) in NUMBERS:
        return value
    if isinstance(value, tuple):
        parts = [packed(v, typed) for v in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    kind: Any = type(value)
    if is_twinned(kind):
        return twin(kind)(*(packed(getattr(value, f.name), typed) for f in dataclasses.fields(value)))
    return value.native() if typed and hasattr(value, "native") else value


def unpacked(value: Any) -> Any:
    """Give a state as Python has it."""
    if type(value) in NUMBERS:
        return value
    if hasattr(value, "python"):
        return value.python()
    if isinstance(value, tuple):
        parts = [unpacked(v) for v in value]
        kind = getattr(type(value), OF, None)
        if kind is not None:
            return kind(*parts)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def form(value: Any) -> Any:
    """Give the types of a state, to its leaves."""
    if isinstance(value, tuple):
        return type(value), tuple(map(form, value))
    return type(value)


def class_of(sample: Any) -> type | None:
    """Give the class of a named tuple, or the dataclass that it stands for."""
    kind = type(sample)
    return getattr(kind, OF, kind) if hasattr(kind, "_fields") else None
