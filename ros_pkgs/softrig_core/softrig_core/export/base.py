"""One function in translation: its names, its lines, and values converted to other types."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..native.value import NotNative
from .kinds import (
    BOOL,
    COMPLEX,
    REAL,
    Absent,
    Kind,
    Maybe,
    Number,
    Table,
    Tuple,
    identifier,
    leaves,
    united,
    used_as,
)
from .unit import FIXED, WHOLE, Unit, Value, literal

SHOWN = 60  # letters of a statement that a refusal shows
VARIANTS = 12  # types that a name of Python may have, one after the other


class Base:
    """Reads one function for given types of its arguments; see `Reader`."""

    def __init__(
        self, unit: Unit, function: Any, kinds: tuple[Kind, ...], tables: tuple[Any, ...], python: bool
    ) -> None:
        self.unit, self.kinds, self.handed, self.python = unit, kinds, tables, python
        self.function = function
        if isinstance(function, str):
            tree = ast.parse(unit.texts[function]).body[0]
            self.title = function
            self.origin = unit.texts[function].partition("\n")[0].partition("  # ")[2] or function
        else:
            tree = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
            self.title = function.__name__.strip("_")
            self.origin = f"{function.__module__}.{function.__qualname__}"
        assert isinstance(tree, ast.FunctionDef)
        self.tree = tree
        self.kinds_of: dict[str, Kind] = {}  # kinds of the variables of C
        self.result: Kind | None = None
        self.local_tables: dict[str, Table] = {}
        self.name = ""  # name of the function in C
        self.lines: list[str] = []
        self.env: dict[str, Value] = {}
        self.loops: list[list[tuple[str, bool]]] = []  # names that each loop binds, and whether they were bound before
        self.discards = self.ended = False
        self.temporaries = 0

    def unknown(self, construct: str, node: ast.AST | None = None) -> NotNative:
        """Return the part that C does not support here."""
        if not isinstance(self.function, str):
            line = self.function.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
            return NotNative(f"{self.origin}, line {line}: {construct}")
        shown = "" if node is None or isinstance(node, ast.FunctionDef) else f" in `{ast.unparse(node)[:SHOWN]}`"
        return NotNative(f"{self.origin}: {construct}{shown}")

    def emit(self, line: str) -> None:
        """Add a line of C."""
        self.lines.append(line)

    def fresh(self, kind: Kind, c: str) -> Value:
        """Return a value under a name of its own."""
        if isinstance(kind, Absent):
            return Value(kind, c)
        name = self.temporary("u", kind)
        self.emit(f"{name} = {c};")
        return Value(kind, name)

    def temporary(self, hint: str, kind: Kind) -> str:
        """Return a variable for a value that has no name in Python."""
        self.temporaries += 1
        return self._variable(f"{hint}{self.temporaries - 1}", kind, "t")

    def _c(self, name: str, use: str = "v") -> str:
        """Return C's name for one of Python, by its use: no name of Python may be that of another use.

        In the text the names of Python begin with ``v_``; others (``n``) are those of the text itself.
        """
        if use != "t" and isinstance(self.function, str):
            name, prefixed = name.removeprefix("v_"), name.startswith("v_")
            use = use if prefixed else f"n{use}"
        return used_as(use, name)

    def _carried(self, name: str) -> str:
        """Return the variable that carries a name between iterations of a loop."""
        return self._c(name, "l")

    def _variable(self, name: str, kind: Kind, use: str = "v") -> str:
        """Return C's variable for a name of Python that has a type; of another type, another variable."""
        for k in range(VARIANTS):
            c = self._c(name, f"{use}{chr(ord('a') + k - 1) if k else ''}")
            known = self.kinds_of.get(c)
            if known is None or (isinstance(known, Number) and isinstance(kind, Number)) or known == kind:
                both = united(known, kind)
                assert both is not None
                self.kinds_of[c] = both
                return c
            both = united(known, kind)
            if both is not None and not isinstance(known, Absent) and not isinstance(kind, (Absent, Number)):
                self.kinds_of[c] = both
                return c
        raise self.unknown(f"{name} has too many types")

    def give_up(self) -> None:
        """Discard the tick here."""
        self.discards = True
        self.emit("s->discarded = true;")
        self.emit("return @ZERO@;")
        self.ended = True

    def named(self, value: Value) -> Value:
        """Return a value by a name, so that it stays as it is."""
        if value.thing is not None or isinstance(value.kind, Absent) or self.is_room(value):
            return value
        return self.fresh(value.kind, value.c)

    def coerced(self, value: Value, kind: Kind) -> Value:
        """Return a value converted to another type that can hold it."""
        if isinstance(kind, Table) and value.thing is not None and value.kind == kind:
            return Value(kind, f"(({self.unit.c(kind)}){value.c})")  # a constant that nobody writes
        if value.kind == kind:
            return value
        if isinstance(kind, Number) and isinstance(value.kind, Number):
            return Value(kind, f"(({kind.c})({value.c}))")
        if kind == COMPLEX and isinstance(value.kind, Number):
            return self.group([self.coerced(value, REAL), Value(REAL, literal(0.0))], COMPLEX)
        if isinstance(kind, Maybe) and isinstance(value.kind, Absent):
            return Value(kind, f"({self.unit.c(kind)}){{ .some = false }}")
        if isinstance(kind, Maybe) and not isinstance(value.kind, Maybe):
            inner = self.coerced(value, kind.item)
            return Value(kind, f"({self.unit.c(kind)}){{ .some = true, .item = {inner.c} }}")
        if isinstance(kind, Maybe) and isinstance(value.kind, Maybe):
            v = self.named(value)
            inner = self.coerced(Value(value.kind.item, f"{v.c}.item"), kind.item)
            return Value(kind, f"({self.unit.c(kind)}){{ .some = {v.c}.some, .item = {inner.c} }}")
        if isinstance(value.kind, Maybe):  # a value that may be missing has to be present here
            v = self.named(value)
            self._check(f"!{v.c}.some")
            return self.coerced(Value(value.kind.item, f"{v.c}.item"), kind)
        if isinstance(kind, Tuple) and isinstance(value.kind, Tuple) and len(kind.items) == len(value.kind.items):
            parts = [self.coerced(p, k) for p, k in zip(self.parts(value, self.tree), kind.items, strict=True)]
            return self.group(parts, kind)
        raise self.unknown("a value that changes its type")

    def group(self, parts: Sequence[Value], kind: Tuple) -> Value:
        """Return the parts of a tuple as one value."""
        inner = ", ".join(
            f".{identifier(n)} = {self.coerced(p, p.kind).c}"
            for n, p in zip(kind.names, parts, strict=True)
            if not isinstance(p.kind, Absent)
        )
        return Value(kind, f"({self.unit.c(kind)}){{ {inner or '0'} }}")

    @staticmethod
    def item(table: Value, index: int | str) -> Value:
        """Return an item of an array, or a row of one with several dimensions."""
        assert isinstance(table.kind, Table)
        if len(table.kind.shape) == 1:
            return Value(table.kind.item, f"{table.c}[{index}]")
        row = Table(table.kind.item, table.kind.shape[1:])
        return Value(row, f"(&{table.c}[{index} * {row.size}])")

    def room(self, kind: Table) -> Value:
        """Return a new array: on the stack, or in the node's struct if the function may return it."""
        name = f"w{len(self.local_tables)}"
        if self.result is not None and leaves(self.result):
            name = f"s->m.{self.name}_{name}"
        self.local_tables[name] = kind
        return Value(kind, name)

    def filled(self, table: Value, item: str) -> Value:
        """Write a value into each place of an array; the value may depend on the place `i`."""
        assert isinstance(table.kind, Table)
        self.emit(f"for (int64_t i = 0; i < INT64_C({table.kind.size}); i++) {{")
        self.emit(f"    {table.c}[i] = {item};")
        self.emit("}")
        return table

    def is_room(self, value: Value) -> bool:
        """Return whether a value is an array that has a name of its own."""
        return isinstance(value.kind, Table) and value.c in self.local_tables

    def _check(self, wrong: str) -> None:
        """Discard the tick if a condition holds."""
        self.discards = True
        self.emit(f"if (SR_RARELY({wrong})) {{")
        self.emit("    s->discarded = true;")
        self.emit("    return @ZERO@;")
        self.emit("}")

    def parts(self, value: Value, node: ast.AST) -> list[Value]:
        """Return the parts of a tuple."""
        if isinstance(value.thing, tuple):
            return list(value.thing)
        if isinstance(value.kind, Maybe):
            value = self.coerced(value, value.kind.item)
        if isinstance(value.kind, Tuple):
            if value.c in self.unit.fixed:
                return self.parts_of(self.unit.fixed[value.c], node)
            simple = self._simple(value)
            return [
                Value(k, "0" if isinstance(k, Absent) else f"{simple.c}.{identifier(n)}")
                for k, n in zip(value.kind.items, value.kind.names, strict=True)
            ]
        if isinstance(value.kind, Table):
            return [self.as_read(value, self.item(value, k)) for k in range(value.kind.shape[0])]
        raise self.unknown("something whose length is not fixed", node)

    def as_read(self, table: Value, item: Value) -> Value:
        """Return a number of an array as it is now: a later expression may write into the array."""
        fixed = isinstance(table.thing, np.ndarray) or isinstance(item.kind, Table)
        return item if fixed else self.fresh(item.kind, item.c)

    def parts_of(self, value: Any, node: ast.AST) -> list[Value]:
        """Return the parts of a constant tuple."""
        raise NotImplementedError

    def truth(self, value: Value, node: ast.AST) -> str:
        """Return C's condition for the truth of a value."""
        if isinstance(value.kind, Absent):
            return "false"
        if value.kind == BOOL:
            return value.c
        if isinstance(value.kind, Number):
            return f"({value.c} != 0)"
        if isinstance(value.kind, Tuple):
            return "true" if value.kind.items else "false"
        raise self.unknown("the truth value of something that is not a number", node)

    def _simple(self, value: Value) -> Value:
        plain = value.c.replace("_", "").replace(".", "").replace("->", "").isalnum()
        return value if plain or FIXED.fullmatch(value.c) or WHOLE.fullmatch(value.c) else self.named(value)
