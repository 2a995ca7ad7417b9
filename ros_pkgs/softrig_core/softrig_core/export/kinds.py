"""Types of values in exported C: numbers, structs for tuples, tables, and optional values."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..native.value import NotNative


@dataclass(frozen=True)
class Number:
    """A number: ``real_t``, ``int64_t`` or ``bool``."""

    c: str
    rank: int  # of two operands the one with the higher rank gives the type of the result


@dataclass(frozen=True)
class Absent:
    """Python's None."""


@dataclass(frozen=True)
class Tuple:
    """A tuple, which C has as a struct.

    Parameters
    ----------
    names : tuple of str
        Fields of a named tuple; f0, f1, ... otherwise.
    title : str
        Name of the named tuple's class; empty otherwise.
    """

    items: tuple[Any, ...]
    names: tuple[str, ...]
    title: str = ""


@dataclass(frozen=True)
class Maybe:
    """A value that may be absent: a struct of a flag and the value."""

    item: Any


@dataclass(frozen=True)
class Table:
    """An array of fixed shape, which C has as a pointer: constant, on the stack, or of the state."""

    item: Any  # Number or COMPLEX
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Number of its items."""
        return math.prod(self.shape)


KEYWORDS = frozenset(
    [
        "auto",
        "break",
        "case",
        "char",
        "const",
        "continue",
        "default",
        "do",
        "double",
        "else",
        "enum",
        "extern",
        "float",
        "for",
        "goto",
        "if",
        "inline",
        "int",
        "long",
        "register",
        "restrict",
        "return",
        "short",
        "signed",
        "sizeof",
        "static",
        "struct",
        "switch",
        "typedef",
        "union",
        "unsigned",
        "void",
        "volatile",
        "while",
        "bool",
    ]
)


def ascii_name(name: str) -> str:
    """Return a name in which letters that compilers for boards and PLCs do not accept are numbers."""
    return "".join(letter if letter.isascii() else f"u{ord(letter):x}_" for letter in name)


def used_as(use: str, name: str) -> str:
    """Return C's name for one of Python, by its use; letters beyond ASCII give it a prefix that no others have."""
    return f"{use}{'' if name.isascii() else 'z'}_{ascii_name(name)}"


def identifier(text: str) -> str:
    """Return a name of C for a name of Python or ROS."""
    name = ascii_name(re.sub(r"\W+", "_", text).strip("_"))
    return f"{name}_" if name in KEYWORDS else f"n{name}" if name[:1].isdigit() else name


def one_line(text: str) -> str:
    """Return a text on one line, without non-printing characters: XML does not allow them, and some hide others."""
    return " ".join("".join(sign if sign.isprintable() else " " for sign in text).split())


def remark(text: str) -> str:
    """Return a text that is safe inside a comment of C or structured text: nothing in it ends the comment.

    Texts come from a user or from a foreign package, and after the end of a comment the rest would be code. Trigraphs,
    three characters that C reads as another one (``??/``), are also separated.
    """
    return re.sub(r"\?(?=\?)|\*(?=[/)])|[/(](?=\*)", r"\g<0> ", one_line(text)).rstrip("\\ ")


BOOL, INT, REAL = Number("bool", 0), Number("int64_t", 1), Number("real_t", 2)
ABSENT = Absent()
COMPLEX = Tuple((REAL, REAL), ("real", "imag"), "complex")
ITEMS = {"f": REAL, "i": INT, "b": BOOL, "c": COMPLEX}  # kind of number by the kind of an array's type
Kind = Number | Absent | Tuple | Maybe | Table


def kind_of(value: Any, path: tuple[Any, ...] = ("a value",)) -> Kind:
    """Return the type of a sample.

    Parameters
    ----------
    path : tuple
        Names and numbers that lead to it, for the refusal.

    Raises
    ------
    NotNative
        C has no type for it here.
    """
    if value is None:
        return ABSENT
    if isinstance(value, (bool, np.bool_)):
        return BOOL
    if isinstance(value, (int, np.integer)):
        return INT
    if isinstance(value, (float, np.floating)):
        return REAL
    if isinstance(value, (complex, np.complexfloating)):
        return COMPLEX
    if isinstance(value, (tuple, list)):
        names = getattr(value, "_fields", None)
        title = type(value).__name__.rpartition("__")[2] if names else ""
        inner = names or range(len(value))
        return tuple_of([kind_of(v, (*path, n)) for v, n in zip(value, inner, strict=True)], names, title)
    if isinstance(value, np.ndarray) and value.dtype.kind in ITEMS:
        return Table(ITEMS[value.dtype.kind], value.shape)
    label = "".join([str(path[0]), *(f"[{n}]" if isinstance(n, int) else f".{n}" for n in path[1:])])
    raise NotNative(f"{label} is of the type {type(value).__name__}, which the C does not have")


def tuple_of(items: Sequence[Kind], names: Sequence[str] | None = None, title: str = "") -> Tuple:
    """Return the type of a tuple."""
    return Tuple(tuple(items), tuple(names or (f"f{k}" for k in range(len(items)))), title)


def united(a: Kind | None, b: Kind | None) -> Kind | None:
    """Return the type that holds values of both types; None if there is none."""
    if a is None or b is None or a == b:
        return a or b
    if isinstance(a, Number) and isinstance(b, Number):
        return a if a.rank > b.rank else b
    if isinstance(a, Absent) or isinstance(b, Absent):
        present = b if isinstance(a, Absent) else a
        return present if isinstance(present, Maybe) else Maybe(present)
    if isinstance(a, Maybe) or isinstance(b, Maybe):
        inner = united(a.item if isinstance(a, Maybe) else a, b.item if isinstance(b, Maybe) else b)
        return None if inner is None else Maybe(inner)
    if COMPLEX in (a, b):
        return COMPLEX if isinstance(a, Number) or isinstance(b, Number) else None
    if isinstance(a, Tuple) and isinstance(b, Tuple) and len(a.items) == len(b.items):
        parts = [united(x, y) for x, y in zip(a.items, b.items, strict=True)]
        named = a if a.title else b
        return None if None in parts else Tuple(tuple(p for p in parts if p is not None), named.names, named.title)
    return None


def leaves(kind: Kind, path: str = "") -> list[tuple[str, Table]]:
    """Return the arrays in a value of a type, each with its path in C."""
    if isinstance(kind, Table):
        return [(path, kind)]
    if isinstance(kind, Maybe):
        return leaves(kind.item, f"{path}.item")
    if isinstance(kind, Tuple):
        return [
            leaf for n, k in zip(kind.names, kind.items, strict=True) for leaf in leaves(k, f"{path}.{identifier(n)}")
        ]
    return []


def roomy(kind: Kind, rooms: Mapping[tuple[Any, ...], int], path: str = "") -> Kind:
    """Return a type whose arrays have the capacities (rows) in `rooms`; `room_of` returns its keys."""
    if isinstance(kind, Table):
        return Table(kind.item, (rooms[room_of(path, kind)], *kind.shape[1:])) if kind.shape else kind
    if isinstance(kind, Tuple):
        parts = zip(kind.names, kind.items, strict=True)
        return Tuple(tuple(roomy(k, rooms, f"{path}.{identifier(n)}") for n, k in parts), kind.names, kind.title)
    return kind


def room_of(path: str, table: Table) -> tuple[Any, ...]:
    """Return the key shared by arrays of states that have the same capacity: path, type and columns."""
    return path, table.item, table.shape[1:]
