"""Frozen dataclasses as native code takes them: a named tuple with the same fields, found by its name."""

from __future__ import annotations

import dataclasses
import importlib
from collections import namedtuple
from functools import cache
from typing import Any

MARK = "__"
OF = "twin_of_"  # attribute of a twin: its dataclass


def is_twinned(kind: type) -> bool:
    """Whether a class has a twin: a frozen dataclass that any module can find."""
    frozen = dataclasses.is_dataclass(kind) and kind.__dataclass_params__.frozen  # type: ignore[attr-defined]
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


def packed(value: Any) -> Any:
    """Give a state with the twins of its dataclasses."""
    if isinstance(value, tuple):
        parts = [packed(v) for v in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if is_twinned(type(value)):
        kind: Any = type(value)
        return twin(kind)(*(packed(getattr(value, f.name)) for f in dataclasses.fields(value)))
    return value


def unpacked(value: Any) -> Any:
    """Give a state with its dataclasses again."""
    if isinstance(value, tuple):
        parts = [unpacked(v) for v in value]
        kind = getattr(type(value), OF, None)
        if kind is not None:
            return kind(*parts)
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value


def class_of(sample: Any) -> type | None:
    """Give the class of a named tuple, or the dataclass that it stands for."""
    kind = type(sample)
    return getattr(kind, OF, kind) if hasattr(kind, "_fields") else None
