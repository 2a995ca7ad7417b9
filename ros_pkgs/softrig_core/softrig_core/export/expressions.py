"""Expressions of a function without calls, as expressions of C without side effects."""

from __future__ import annotations

import ast
import builtins
import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ..native.compile import BASE
from ..native.translate import COMPARE, outside
from .base import Base
from .kinds import (
    ABSENT,
    BOOL,
    COMPLEX,
    INT,
    REAL,
    Absent,
    Maybe,
    Number,
    Table,
    Tuple,
    identifier,
    kind_of,
    leaves,
    tuple_of,
    united,
)
from .unit import WHOLE, Value, bare, literal

ORDER = {ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!="}
ARITHMETIC = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*"}
TINY = 1e-30  # smaller numbers may become 0 in single precision
LARGE = 1 << 31
STRIDED = "@STRIDED@"  # in place of C: numbers that do not lie one after the other
BITS = {ast.BitAnd: "&", ast.BitOr: "|", ast.BitXor: "^"}


class Expressions(Base):
    """Reads expressions; see `Reader`."""

    def value(self, node: ast.expr) -> Value:
        """Read an expression."""
        method = getattr(self, f"_value_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.unknown(f"`{type(node).__name__.lower()}`", node)
        result: Value = method(node)
        return result

    def listed(self, node: ast.expr) -> list[Value]:
        """Return the elements over which a loop or a tuple of fixed length iterates."""
        name = self.of_builtins(node.func) if isinstance(node, ast.Call) else ""
        if isinstance(node, ast.Call) and name in ("zip", "enumerate", "reversed"):
            if node.keywords or (name == "enumerate" and len(node.args) > 1):
                raise self.unknown(f"{name}() with more than what it goes through", node)
            rows = [self.listed(a) for a in node.args]
            if name == "reversed":
                return rows[0][::-1]
            if name == "enumerate":
                rows = [[Value(INT, literal(k)) for k in range(len(rows[0]))], rows[0]]
            return [Value(tuple_of([v.kind for v in row]), "", tuple(row)) for row in zip(*rows, strict=False)]
        return self.parts(self.value(node), node)

    def _value_constant(self, node: ast.Constant) -> Value:
        if node.value is None:
            return Value(ABSENT, "0")
        if isinstance(node.value, (bool, int, float)):
            return Value(kind_of(node.value), literal(node.value))
        raise self.unknown(f"{type(node.value).__name__} as a value", node)

    def _value_name(self, node: ast.Name) -> Value:
        if node.id in self.env:
            if self.env[node.id].partly:
                raise self.unknown(f"{node.id.removeprefix('v_')} has no value on some paths", node)
            return self.env[node.id]
        return self.of_python(self.outer(node.id, node), node)

    def outer(self, name: str, node: ast.AST) -> Any:
        """Return the value of a name outside of the function."""
        if isinstance(self.function, str):
            if name in self.unit.texts:
                return name
            if name in self.unit.names:
                return self.unit.names[name]
            if name in BASE:
                return BASE[name]
            if hasattr(builtins, name):
                return getattr(builtins, name)
        else:
            with suppress(LookupError):
                return outside(self.function, name)
        raise self.unknown(f"{name} is not known on every path", node)

    def of_builtins(self, node: ast.expr) -> str:
        """Return the name of a function of Python's own that is called; empty: it is another one."""
        name = node.id if isinstance(node, ast.Name) and node.id not in self.env else ""
        builtin = getattr(builtins, name, None)
        return name if builtin is not None and self.outer(name, node) is builtin else ""

    def of_python(self, value: Any, node: ast.AST) -> Value:
        """Return a constant of Python in its C form; functions and modules unchanged."""
        if isinstance(value, (bool, int, float)) and not isinstance(value, np.bool_):
            return Value(kind_of(value), literal(value))
        if isinstance(value, np.ndarray):
            return self.unit.table(value, "table")
        if isinstance(value, complex):
            return self._constant_tuple(
                value, [Value(REAL, literal(part)) for part in (value.real, value.imag)], COMPLEX
            )
        if isinstance(value, tuple):
            kind = kind_of(value)
            assert isinstance(kind, Tuple)
            return self._constant_tuple(value, [self._own(self.of_python(v, node)) for v in value], kind)
        return Value(ABSENT, "0", value)

    def _constant_tuple(self, value: Any, parts: Sequence[Value], kind: Tuple) -> Value:
        """Return a constant tuple, whose parts are known when it is unpacked."""
        group = self.group(parts, kind)
        # A tuple with arrays gets copies of its own at each call, so its C is no constant.
        if not leaves(kind):
            self.unit.fixed[group.c] = value
        return group

    def parts_of(self, value: Any, node: ast.AST) -> list[Value]:
        """Return the parts of a constant tuple."""
        parts = (value.real, value.imag) if isinstance(value, complex) else value
        return [self.of_python(part, node) for part in parts]

    def _own(self, value: Value) -> Value:
        """Return a copy of a constant array whose object writes into it."""
        if value.thing is None or not isinstance(value.kind, Table):
            return value
        table = self.room(value.kind)
        self.emit(f"memcpy({table.c}, {value.c}, {value.kind.size}u * sizeof {table.c}[0]);")
        return table

    def _value_tuple(self, node: ast.Tuple | ast.List) -> Value:
        items: list[Value] = []
        for item in node.elts:
            items += self.listed(item.value) if isinstance(item, ast.Starred) else [self.value(item)]
        return self.group(items, tuple_of([v.kind for v in items]))

    _value_list = _value_tuple

    def _value_attribute(self, node: ast.Attribute) -> Value:
        base = self.value(node.value)
        if base.thing is not None and not isinstance(base.thing, (tuple, np.ndarray)):
            if not hasattr(base.thing, node.attr):
                raise self.unknown(f"no {node.attr}", node)
            return self.of_python(getattr(base.thing, node.attr), node)
        # None has no such attribute: Python raises there, so the tick is discarded.
        if isinstance(base.kind, Maybe):
            base = self.coerced(base, base.kind.item)
        if isinstance(base.kind, Tuple) and node.attr in base.kind.names:
            k = base.kind.names.index(node.attr)
            return Value(base.kind.items[k], f"{self._simple(base).c}.{identifier(node.attr)}")
        if isinstance(base.kind, Table) and node.attr in ("size", "shape", "ndim"):
            results = {"size": math.prod(base.kind.shape), "shape": base.kind.shape, "ndim": len(base.kind.shape)}
            return self.of_python(results[node.attr], node)
        raise self.unknown(f".{node.attr}", node)

    def _value_subscript(self, node: ast.Subscript) -> Value:
        if isinstance(node.value, ast.Name) and node.value.id == "c" and isinstance(self.function, str):
            assert isinstance(node.slice, ast.Constant)
            constant = self.unit.constants[node.slice.value]  # type: ignore[index]  # whole numbers, by the text
            return constant if isinstance(constant, Value) else self.of_python(constant, node)
        base = self.value(node.value)
        if isinstance(base.kind, Maybe):
            base = self.coerced(base, base.kind.item)
        if isinstance(node.slice, ast.Slice):
            return self._sliced(base, node)
        if isinstance(node.slice, ast.Tuple) and any(isinstance(e, ast.Slice) for e in node.slice.elts):
            return self._row(base, node.slice.elts, node)
        index = self.value(node.slice)
        if isinstance(base.kind, Table):
            return self.as_read(base, self.place(base, index, node))
        if not isinstance(base.kind, Tuple):
            raise self.unknown("an item of something that is not a tuple", node)
        fixed = _fixed(node.slice)
        parts = self.parts(base, node)
        if fixed is not None:
            if not -len(parts) <= fixed < len(parts):
                raise self.unknown(f"no item {fixed} of {len(parts)}", node)
            return parts[fixed]
        return self._element_at(base, parts, index, node)

    def _table_of(self, base: Value, parts: Sequence[Value], item: Number) -> Value:
        """Return the numbers of a tuple as an array, constant if they are known."""
        if base.c in self.unit.fixed:
            return self.unit.tabled(base.c, item)
        table = self.room(Table(item, (len(parts),)))
        for k, part in enumerate(parts):
            self.emit(f"{table.c}[{k}] = {self.coerced(part, item).c};")
        return table

    def _element_at(self, base: Value, parts: Sequence[Value], index: Value, node: ast.AST) -> Value:
        """Return the part of a tuple that an integer index selects."""
        first = parts[0].kind if parts else None
        for part in parts:
            first = united(first, part.kind)
        if first is None:
            raise self.unknown("an item of a tuple of several types", node)
        i = self.named(self.coerced(index, INT))
        self._check(f"({i.c} < -INT64_C({len(parts)})) || ({i.c} >= INT64_C({len(parts)}))")
        # A struct of C has no places by number, so numbers are looked up in an array.
        if isinstance(first, Number):
            table = self._table_of(base, parts, first)
            return self.fresh(first, f"{table.c}[({i.c} < 0) ? ({i.c} + INT64_C({len(parts)})) : {i.c}]")
        c = self.temporary("look", first)
        for k, part in enumerate(parts):
            self.emit(
                f"{'} else ' if k else ''}if (({i.c} == INT64_C({k})) || ({i.c} == -INT64_C({len(parts) - k}))) {{"
            )
            self.emit(f"    {c} = {self.coerced(part, first).c};")
        self.emit("} else {")
        self.emit(f"    {c} = {self.coerced(parts[0], first).c};")
        self.emit("}")
        return Value(first, c)

    def place(self, table: Value, index: Value, node: ast.AST) -> Value:
        """Return an element or a row of an array, after a check of its indices."""
        assert isinstance(table.kind, Table)
        shape = table.kind.shape
        ends = list(index.thing) if isinstance(index.thing, tuple) else None
        indices = self.parts(index, node) if isinstance(index.kind, Tuple) and ends is None else ends or [index]
        if len(indices) > len(shape):
            raise self.unknown(f"{len(indices)} indices of an array of {len(shape)} dimensions", node)
        flat = ""
        for element, size in zip(indices, shape, strict=False):
            i = self.named(self.coerced(element, INT))
            self._check(f"({i.c} < -INT64_C({size})) || ({i.c} >= INT64_C({size}))")
            wrapped = f"(({i.c} < 0) ? ({i.c} + INT64_C({size})) : {i.c})"
            flat = f"({flat} * INT64_C({size}) + {wrapped})" if flat else wrapped
        inner = Table(table.kind.item, shape[len(indices) :])
        if inner.shape:
            return Value(inner, f"(&{table.c}[{flat} * INT64_C({inner.size})])")
        return Value(inner.item, f"{table.c}[{flat}]")

    def _row(self, base: Value, elements: Sequence[ast.expr], node: ast.AST) -> Value:
        """Return the part of an array after its first indices; of another part only the shape is known."""
        if not isinstance(base.kind, Table) or len(elements) != len(base.kind.shape):
            raise self.unknown("a part of something that is not an array", node)
        full = [isinstance(e, ast.Slice) and not (e.lower or e.upper or e.step) for e in elements]
        if any(isinstance(e, ast.Slice) and not w for e, w in zip(elements, full, strict=True)):
            raise self.unknown("a part of an array", node)
        if sorted(full) != full:
            shape = tuple(size for size, w in zip(base.kind.shape, full, strict=True) if w)
            # Its shape may be asked for; a function that reads its numbers is refused when its text is complete.
            return Value(Table(base.kind.item, shape), STRIDED)
        indices = tuple(self.value(e) for e, w in zip(elements, full, strict=True) if not w)
        return self.as_read(base, self.place(base, Value(tuple_of([v.kind for v in indices]), "", indices), node))

    def _sliced(self, base: Value, node: ast.Subscript) -> Value:
        assert isinstance(node.slice, ast.Slice)
        part = self._ends(node.slice)
        if isinstance(base.kind, Table):
            return self.view(base, part, node)
        parts = self.parts(base, node)[part]
        return self.group(parts, tuple_of([p.kind for p in parts]))

    def _ends(self, node: ast.Slice) -> slice:
        """Return a slice with known ends."""
        ends: list[int | None] = []
        for end in (node.lower, node.upper, node.step):
            known = None if end is None else _fixed(end)
            if end is not None and known is None:
                match = WHOLE.fullmatch(self.value(end).c)
                if match is None:
                    raise self.unknown("a part whose ends are computed", node)
                known = int(match[1])
            ends.append(known)
        return slice(*ends)

    def view(self, table: Value, part: slice, node: ast.AST) -> Value:
        """Return rows of an array that lie one after the other, as numpy's view of them."""
        assert isinstance(table.kind, Table)
        if isinstance(table.thing, np.ndarray):
            return self.unit.part(table.c, part)
        first, stop, step = part.indices(table.kind.shape[0])
        if step != 1:
            raise self.unknown("a part of an array with a step", node)
        kind = Table(table.kind.item, (max(stop - first, 0), *table.kind.shape[1:]))
        return Value(kind, f"(&{table.c}[{first * math.prod(kind.shape[1:])}])")

    def _value_unaryop(self, node: ast.UnaryOp) -> Value:
        value = self.value(node.operand)
        if value.kind == COMPLEX and isinstance(node.op, ast.USub):
            return self.group([Value(REAL, f"(-{p.c})") for p in self.parts(value, node)], COMPLEX)
        if isinstance(node.op, ast.Not):
            test = self.truth(value, node)
            return Value(BOOL, {"true": "false", "false": "true"}.get(test, f"(!{test})"))
        if not isinstance(value.kind, Number):
            raise self.unknown("arithmetic of something that is not a number", node)
        kind = INT if value.kind == BOOL else value.kind
        value = self.coerced(value, kind)
        sign = {ast.USub: "-", ast.UAdd: "+", ast.Invert: "~"}[type(node.op)]
        return Value(kind, f"({sign}{value.c})")

    def _value_binop(self, node: ast.BinOp) -> Value:
        return self.binary(node.op, self.value(node.left), self.value(node.right), node)

    def binary(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        """Return an operation on two numbers."""
        left, right = (self.coerced(v, v.kind.item) if isinstance(v.kind, Maybe) else v for v in (left, right))
        if COMPLEX in (left.kind, right.kind):
            return self._complex(op, left, right, node)
        if isinstance(left.kind, Tuple) and isinstance(right.kind, Tuple) and isinstance(op, ast.Add):
            parts = [*self.parts(left, node), *self.parts(right, node)]
            return self.group(parts, tuple_of([p.kind for p in parts]))
        if isinstance(left.kind, Table) and left.kind.item == REAL and isinstance(right.kind, Number):
            return self._each_item(op, left, right, node)
        if not (isinstance(left.kind, Number) and isinstance(right.kind, Number)):
            raise self.unknown("arithmetic of something that is not a number", node)
        both = left.kind if left.kind.rank >= right.kind.rank else right.kind
        # Python adds truth values as whole numbers, and only `&`, `|` and `^` of two are a truth value.
        both = INT if both == BOOL and type(op) not in BITS else both
        if isinstance(op, ast.Div):
            both = REAL
        a, b = self.coerced(left, both), self.coerced(right, both)
        if type(op) in ARITHMETIC and (fixed := _folded(type(op), a.c, b.c)) is not None:
            return Value(INT, literal(fixed))
        if type(op) in ARITHMETIC:
            return Value(both, f"({a.c} {ARITHMETIC[type(op)]} {b.c})")
        if type(op) in BITS and both != REAL:
            return Value(both, f"({a.c} {BITS[type(op)]} {b.c})")
        if isinstance(op, (ast.LShift, ast.RShift)) and both == INT:
            return self._shifted(isinstance(op, ast.LShift), self._simple(a), self._simple(b))
        if isinstance(op, (ast.Div, ast.FloorDiv, ast.Mod)):
            b = self._simple(b)
            # A `jit` function divides floats by 0 without an error, as numba does; of whole numbers C leaves it
            # undefined. A constant that is not 0 needs no test.
            if (self.python or both == INT) and not abs(self.unit.number(b.c)) > TINY:
                self._check(f"{b.c} == 0")
            if isinstance(op, ast.Div):
                return Value(REAL, f"({a.c} / {b.c})")
            word = "mod" if isinstance(op, ast.Mod) else "floor_div"
            return Value(both, f"sr_{word}_{'int' if both == INT else 'real'}({a.c}, {b.c})")
        raise self.unknown(f"an operation {type(op).__name__.lower()}", node)

    def _shifted(self, left: bool, a: Value, b: Value) -> Value:
        """Return a shift of a whole number, which discards the tick where 64 bits are too few."""
        if not left:
            self._check(f"{b.c} < 0")
            n = self.fresh(INT, f"({b.c} < 63) ? {b.c} : 63").c
            # C leaves open whether a negative number is filled up with ones or with zeros.
            return Value(INT, f"(({a.c} >= 0) ? ({a.c} >> {n}) : ~(~{a.c} >> {n}))")
        self._check(f"({b.c} < 0) || ({b.c} > 62)")
        self._check(f"({a.c} > (INT64_MAX >> {b.c})) || ({a.c} < -(INT64_MAX >> {b.c}))")
        # C leaves a shift of a negative number to the left undefined.
        return Value(INT, f"({a.c} * (INT64_C(1) << {b.c}))")

    def _each_item(self, op: ast.operator, table: Value, number: Value, node: ast.AST) -> Value:
        """Return an operation on each number of an array, as numpy computes it."""
        sign = "/" if isinstance(op, ast.Div) else ARITHMETIC.get(type(op), "")
        if not sign:
            raise self.unknown(f"an operation {type(op).__name__.lower()} of an array", node)
        assert isinstance(table.kind, Table)
        x = self.named(self.coerced(number, REAL))
        return self.filled(self.room(table.kind), f"({table.c}[i] {sign} {x.c})")

    def _complex(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        """Return an operation on complex numbers, as CPython computes it."""
        left, right = (self.coerced(v, COMPLEX) for v in (left, right))
        (a, b), (c, d) = ([v.c for v in self.parts(z, node)] for z in (left, right))
        if isinstance(op, (ast.Add, ast.Sub)):
            sign = ARITHMETIC[type(op)]
            result = f"({a} {sign} {c})", f"({b} {sign} {d})"
        elif isinstance(op, ast.Mult):
            result = f"(({a} * {c}) - ({b} * {d}))", f"(({a} * {d}) + ({b} * {c}))"
        elif isinstance(op, ast.Div):
            c, d = (self.fresh(REAL, x).c for x in (c, d))
            self._check(f"({c} == 0) && ({d} == 0)")
            result = f"sr_c_quot_real({a}, {b}, {c}, {d})", f"sr_c_quot_imag({a}, {b}, {c}, {d})"
        else:
            raise self.unknown(f"an operation {type(op).__name__.lower()} of complex numbers", node)
        return self.group([Value(REAL, x) for x in result], COMPLEX)

    def _value_compare(self, node: ast.Compare) -> Value:
        left = self.value(node.left)
        tests: list[str] = []
        for op, right_node in zip(node.ops, node.comparators, strict=True):
            right = self.value(right_node)
            if len(node.ops) > 1:
                left, right = self._simple(left), self._simple(right)
            test = self._compared(op, left, right, node)
            if test == "false":
                return Value(BOOL, "false")
            if test != "true":
                tests.append(test)
            left = right
        return Value(BOOL, f"({' && '.join(tests)})" if len(tests) > 1 else (tests or ["true"])[0])

    def _compared(self, op: ast.cmpop, left: Value, right: Value, node: ast.AST) -> str:
        if isinstance(op, (ast.Is, ast.IsNot)):
            if not isinstance(right.kind, Absent):
                raise self.unknown("`is` of something other than None", node)
            if isinstance(left.kind, Maybe):
                return f"({'!' if isinstance(op, ast.Is) else ''}{self._simple(left).c}.some)"
            return "true" if isinstance(left.kind, Absent) is isinstance(op, ast.Is) else "false"
        if isinstance(op, (ast.Eq, ast.NotEq)) and {Maybe, Absent} & {type(left.kind), type(right.kind)}:
            same = self._same(left, right, node)
            return same if isinstance(op, ast.Eq) else f"(!{same})"
        left, right = (self.coerced(v, v.kind.item) if isinstance(v.kind, Maybe) else v for v in (left, right))
        if isinstance(op, (ast.In, ast.NotIn)):
            first = self.named(left)
            tests = [self._compared(ast.Eq(), first, part, node) for part in self.parts(right, node)]
            return f"({'' if isinstance(op, ast.In) else '!'}({' || '.join(tests) or 'false'}))"
        if type(op) not in ORDER:
            raise self.unknown(f"a comparison {type(op).__name__.lower()}", node)
        if COMPLEX in (left.kind, right.kind):
            left, right = (self.named(self.coerced(v, COMPLEX)) for v in (left, right))
        if isinstance(left.kind, Tuple) and isinstance(right.kind, Tuple) and isinstance(op, (ast.Eq, ast.NotEq)):
            pairs = list(zip(self.parts(left, node), self.parts(right, node), strict=True))
            each = [self._compared(ast.Eq(), a, b, node) for a, b in pairs]
            return f"({'' if isinstance(op, ast.Eq) else '!'}({' && '.join(each) or 'true'}))"
        if not (isinstance(left.kind, Number) and isinstance(right.kind, Number)):
            raise self.unknown("a comparison of something that is not a number", node)
        both = left.kind if left.kind.rank >= right.kind.rank else right.kind
        if left.c == right.c and not math.isnan(self.unit.number(left.c)):
            return str(COMPARE[type(op)][1](1, 1)).lower()
        known = [WHOLE.fullmatch(v.c) for v in (left, right)]
        if all(known):
            return str(bool(COMPARE[type(op)][1](*(int(first[1]) for first in known if first)))).lower()
        test = f"({self.coerced(left, both).c} {ORDER[type(op)]} {self.coerced(right, both).c})"
        numbers = [self.unit.number(v.c) for v in (left, right)]
        if both == REAL and isinstance(op, (ast.Eq, ast.NotEq)) and all(map(math.isnan, numbers)):
            # Two numbers that vary are compared for equality to notice a change, which most ticks do not have.
            return f"{'SR_MOSTLY' if isinstance(op, ast.Eq) else 'SR_RARELY'}{test}"
        return test

    def _same(self, left: Value, right: Value, node: ast.AST) -> str:
        """Return whether two values, one of which may be absent, are equal."""
        if isinstance(right.kind, Maybe) and not isinstance(left.kind, Maybe):
            left, right = right, left
        if not isinstance(left.kind, Maybe):
            return str(isinstance(left.kind, Absent) and isinstance(right.kind, Absent)).lower()
        a = self._simple(left)
        if isinstance(right.kind, Absent):
            return f"(!{a.c}.some)"
        inner = Value(left.kind.item, f"{a.c}.item")
        if not isinstance(right.kind, Maybe):
            return f"({a.c}.some && {self._compared(ast.Eq(), inner, right, node)})"
        b = self._simple(right)
        both = self._compared(ast.Eq(), inner, Value(right.kind.item, f"{b.c}.item"), node)
        return f"(({a.c}.some == {b.c}.some) && ((!{a.c}.some) || {both}))"

    def _value_boolop(self, node: ast.BoolOp) -> Value:
        stop = isinstance(node.op, ast.Or)
        first = self.truth(self.value(node.values[0]), node)
        remaining: ast.expr = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if first in ("true", "false"):
            return Value(BOOL, first) if (first == "true") is stop else self._as_truth(remaining, node)
        start = len(self.lines)
        second = self.truth(self.value(remaining), node)
        if len(self.lines) == start:
            if second in ("true", "false"):
                return Value(BOOL, second if (second == "true") is stop else first)
            return Value(BOOL, f"({first} {'||' if stop else '&&'} {second})")
        # Python computes the right side only if it is needed, so its statements are inside a test.
        later, self.lines[start:] = self.lines[start:], []
        c = self.temporary("b", BOOL)
        self.emit(f"{c} = {'true' if stop else 'false'};")
        self.emit(f"if (!({first})) {{" if stop else f"if ({bare(first)}) {{")
        self.lines += [f"    {line}" for line in [*later, f"{c} = {second};"]]
        self.emit("}")
        return Value(BOOL, c)

    def _as_truth(self, node: ast.expr, operand: ast.AST) -> Value:
        return Value(BOOL, self.truth(self.value(node), operand))

    def _value_ifexp(self, node: ast.IfExp) -> Value:
        test = self.truth(self.value(node.test), node)
        if test in ("true", "false"):
            return self.value(node.body if test == "true" else node.orelse)
        lines, results = self.lines, []
        env = dict(self.env)
        for branch in (node.body, node.orelse):
            self.lines, self.ended = [], False
            results.append((self.value(branch), self.lines))
        self.lines, self.env = lines, env
        (a, then), (b, orelse) = results
        kind = united(a.kind, b.kind)
        if kind is None:
            raise self.unknown("a choice of two types", node)
        if not then and not orelse and isinstance(kind, Number):
            return Value(kind, f"({test} ? {self.coerced(a, kind).c} : {self.coerced(b, kind).c})")
        c = self.temporary("i", kind)
        # An earlier reading of the function may have shown that this variable needs a wider type.
        kind = self.kinds_of[c]
        for value, body in ((a, then), (b, orelse)):
            self.lines = body
            self.emit(f"{c} = {self.coerced(value, kind).c};")
        self.lines = lines
        self.emit(f"if ({bare(test)}) {{")
        self.lines += [f"    {line}" for line in then]
        self.emit("} else {")
        self.lines += [f"    {line}" for line in orelse]
        self.emit("}")
        return Value(kind, c)


def _folded(op: type, a: str, b: str) -> int | None:
    """Return the result of an operation on two integer literals; None: it is computed at run time."""
    results = [WHOLE.fullmatch(c) for c in (a, b)]
    if not all(results):
        return None
    x, y = (int(match[1]) for match in results if match)
    result = x + y if op is ast.Add else x - y if op is ast.Sub else x * y
    return result if 0 <= result < LARGE else None


def _fixed(node: ast.expr) -> int | None:
    """Return the whole number that an expression is; None where it is computed."""
    try:
        value = ast.literal_eval(node)
    except (ValueError, SyntaxError):
        return None
    return value if isinstance(value, int) else None
