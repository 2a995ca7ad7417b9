"""What the translation knows about a value: whether it is fixed, its expression, and its value at the previous tick."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

Path = tuple[Any, ...]  # number of a block, then ("attr", name) or ("item", key) each
UNKNOWN: Any = type("Unknown", (), {"__repr__": lambda self: "unknown"})()  # a sample that is not known


class NotNative(Exception):
    """Something that native code does not support; the message contains what and where."""


class GivesUp(NotNative):
    """A call that never returns, because it discards the tick."""


@dataclass(frozen=True)
class Static:
    """A value that stays the same in a run; `path` leads to it from a block, None: part of the program."""

    value: Any
    path: Path | None = None


@dataclass(frozen=True)
class Dynamic:
    """A value that a tick computes.

    Parameters
    ----------
    code : str
        Its expression in native code.
    sample : object
        Its value at the previous tick, which defines its type; `UNKNOWN` if there is none.
    sure : bool
        Whether it always has the type of the sample: then it is known whether it is None, and its length.
    keys : tuple of str, or None
        Keys of a mapping, which native code writes as a tuple.
    parts : tuple of Dynamic-like, or None
        Parts of a tuple or mapping that contains mappings: what is known of each.
    """

    code: str
    sample: Any = UNKNOWN
    sure: bool = True
    keys: tuple[str, ...] | None = None
    parts: tuple[Any, ...] | None = None


@dataclass(frozen=True)
class Group:
    """A tuple written out: its parts."""

    items: tuple[Any, ...]


@dataclass(frozen=True)
class Record:
    """A mapping written out, by its keys."""

    items: Mapping[str, Any] = field(default_factory=dict)


Value = Static | Dynamic | Group | Record
NONE = Static(None)
MADE_TEXT = Static("a text that is made in a tick")  # any of them: native code has no texts


def inside(value: Group | Record) -> Iterable[Any]:
    """Return the parts of a tuple or mapping that is written out."""
    return value.items.values() if isinstance(value, Record) else value.items


def mapped(value: Group | Record, function: Callable[[Any, Any], Any]) -> Group | Record:
    """Apply a function to the place or key and the value of each part of a tuple or mapping."""
    if isinstance(value, Record):
        return Record({k: function(k, v) for k, v in value.items.items()})
    return Group(tuple(function(k, v) for k, v in enumerate(value.items)))


def sample_of(value: Value) -> Any:
    """Return the sample of a value, of a group as a tuple."""
    if isinstance(value, Static):
        return value.value
    if isinstance(value, Dynamic):
        return value.sample
    return tuple(sample_of(v) for v in inside(value))


def is_sure(value: Value) -> bool:
    """Return whether a value certainly has the type of its sample, down to its leaves."""
    if isinstance(value, Static):
        return True
    if isinstance(value, Dynamic):
        return value.sure and value.sample is not UNKNOWN
    return all(is_sure(v) for v in inside(value))


def computed(function: Callable[..., Any], *values: Any) -> Any:
    """Compute a sample; `UNKNOWN` where an operand is, or where it cannot be computed."""
    if any(_unknown(v) for v in values):
        return UNKNOWN
    try:
        return function(*values)
    # The samples are those of the branch that was taken; in another one the operation may fail.
    except Exception:
        return UNKNOWN


def _unknown(value: Any) -> bool:
    return value is UNKNOWN or (type(value) is tuple and any(_unknown(v) for v in value))


def is_made_text(value: Value) -> bool:
    """Return whether a value represents a text that is created in a tick."""
    return isinstance(value, Static) and value.value is MADE_TEXT.value


def forms(value: Dynamic) -> Any:
    """Return the keys of the parts of a value, down to its leaves."""
    return None if value.parts is None else tuple((p.keys, forms(p)) for p in value.parts)


def kind_of(value: Value) -> str:
    """Return the name of a value's type, for a person."""
    return type(sample_of(value)).__name__
