"""States in the form of native code: named tuples down to their leaves.

A frozen dataclass has a twin with the same fields, found by its name. Another object is supported if it defines the
conversion. Its `native` returns a named tuple, which may hold arrays of its own and has methods of the same names for
the translation. The `python` of that tuple returns the object again.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections import namedtuple
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from operator import methodcaller
from typing import Any

NUMBERS = frozenset({float, int, bool})
MARK = "__"
OF = "twin_of_"  # attribute of a twin: its dataclass

Way = Callable[[Any], Any] | None  # to make another value of one; None: it stays the same


@cache
def is_twinned(kind: Hashable) -> bool:
    """Return whether a class has a twin: a frozen dataclass that any module can find, made of its fields alone."""
    if not isinstance(kind, type) or not dataclasses.is_dataclass(kind):
        return False
    about: Any = kind.__dataclass_params__  # type: ignore[attr-defined]
    # A twin is made of one value a field, in their order: nothing may be computed or left out on the way.
    plain = all(
        f.init and not f.kw_only and f.default_factory is dataclasses.MISSING for f in dataclasses.fields(kind)
    ) and not hasattr(kind, "__post_init__")
    # Only a class at the top of a module is found again by module and name.
    importable = "<" not in kind.__qualname__ and "." not in kind.__qualname__
    return bool(about.frozen and about.init and plain and kind.__new__ is object.__new__ and importable)


@cache
def twin(kind: type) -> Any:
    """Return the named tuple of a dataclass."""
    name = f"{kind.__module__.replace('.', MARK)}{MARK}{kind.__qualname__}"
    fields = dataclasses.fields(kind)
    defaults = [f.default for f in fields if f.default is not dataclasses.MISSING]
    result: Any = namedtuple(name, [f.name for f in fields], defaults=defaults)  # type: ignore[misc]
    # `__getattr__` below finds it there.
    result.__module__ = __name__
    setattr(result, OF, kind)
    return result


# Native code in the cache names its types by module and name, so a twin must be found here in another process, too.
def __getattr__(name: str) -> Any:
    module, mark, kind = name.rpartition(MARK)
    if not mark or not module or name.startswith(MARK):
        raise AttributeError(name)
    return twin(getattr(importlib.import_module(module.replace(MARK, ".")), kind))


def packed(value: Any, typed: bool = True) -> Any:
    """Return a state in the form of native code, with copies of arrays; `typed` false: objects stay as in Python."""
    return applied(packer(value, typed), value)


def unpacked(value: Any) -> Any:
    """Return a state in its Python form."""
    return applied(unpacker(value), value)


def applied(way: Way, value: Any) -> Any:
    """Apply a function of `packer` or `unpacker`."""
    return value if way is None else way(value)


def packer(sample: Any, typed: bool) -> Way:
    """Return how states of the form of a sample are packed; None: they go as they are."""
    if type(sample) in NUMBERS:
        return None
    if isinstance(sample, tuple):
        return _by_parts(type(sample), [packer(v, typed) for v in sample])
    kind: Any = type(sample)
    if is_twinned(kind):
        names = [f.name for f in dataclasses.fields(sample)]
        make, ways = twin(kind), [packer(getattr(sample, name), typed) for name in names]
        return lambda value: make(*[applied(way, getattr(value, n)) for n, way in zip(names, ways, strict=True)])
    return methodcaller("native") if typed and hasattr(sample, "native") else None


def unpacker(sample: Any) -> Way:
    """Return how a result of native code with the form of a sample is unpacked; None: it needs no unpacking."""
    if type(sample) in NUMBERS:
        return None
    if hasattr(sample, "python"):
        return methodcaller("python")
    if isinstance(sample, tuple):
        return _by_parts(type(sample), [unpacker(v) for v in sample], getattr(type(sample), OF, None))
    return None


def _by_parts(kind: Any, ways: Sequence[Way], target: Any = None) -> Way:
    """Return a function that rebuilds a tuple with a replaced part, with the same or another type."""
    factory = target or (kind if hasattr(kind, "_fields") else None)
    changed = [(k, way) for k, way in enumerate(ways) if way is not None]
    # Most states are numbers alone, which go into native code and back as they are.
    if not changed and kind is (factory or tuple):
        return None

    def again(value: Any) -> Any:
        parts = list(value)
        for k, way in changed:
            parts[k] = way(parts[k])
        return factory(*parts) if factory else tuple(parts)

    return again


ARITHMETIC, COMPARISONS, TRUTH = "add radd mul rmul", "eq ne lt le gt ge", "bool len"


@cache
def own_operator(kind: Hashable, operators: str) -> str:
    """Return which of these operators a class of named tuples or dataclasses defines itself; empty: none."""
    cls: Any = getattr(kind, OF, kind)
    for base in cls.__mro__:
        if base in (tuple, object):
            break
        for name in (f"__{operator}__" for operator in operators.split()):
            code = getattr(vars(base).get(name), "__code__", None)
            if code is not None and code.co_filename != "<string>":  # where `dataclasses` makes its own
                return name
    return ""


def form(value: Any) -> Any:
    """Return the types of a state, to its leaves."""
    if not isinstance(value, tuple):
        return type(value)
    kinds = tuple(map(type, value))
    if NUMBERS.issuperset(kinds):
        return type(value), kinds
    return type(value), tuple([form(v) if isinstance(v, tuple) else type(v) for v in value])


def class_of(sample: Any) -> type | None:
    """Return the class of a named tuple, or the dataclass that it represents."""
    kind = type(sample)
    return getattr(kind, OF, kind) if hasattr(kind, "_fields") else None
