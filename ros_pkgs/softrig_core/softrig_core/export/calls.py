"""Calls in a function: of the text, of `jit` functions, of the standard library."""

from __future__ import annotations

import ast
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..kit.compiled import Compiled
from ..kit.draws import Draws
from ..kit.jit import Jit, power
from .expressions import Expressions
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
    tuple_of,
    united,
)
from .unit import WHOLE, Value, literal

UNARY_MATH = [
    "acos",
    "acosh",
    "asin",
    "asinh",
    "atan",
    "atanh",
    "ceil",
    "cos",
    "cosh",
    "erf",
    "exp",
    "expm1",
    "fabs",
    "floor",
    "log",
    "log10",
    "log1p",
    "log2",
    "sin",
    "sinh",
    "sqrt",
    "tan",
    "tanh",
    "trunc",
]
BINARY_MATH = {"atan2": "atan2", "copysign": "copysign", "fmod": "fmod", "pow": "pow", "power": "pow"}
MAKERS = (np.zeros, np.ones, np.empty, np.full, np.zeros_like, np.ones_like, np.empty_like, np.copy)
LONG = 4  # numbers of a tuple that are better read in a table than handed over
EXACT = {"sqrt", "fabs", "floor", "ceil", "trunc", "copysign", "fmod", "rint"}  # IEEE 754 fixes their bits


class Calls(Expressions):
    """Reads calls; see `Reader`."""

    def _value_call(self, node: ast.Call) -> Value:
        if node.keywords:
            raise self.unknown("a call with keyword arguments", node)
        if isinstance(node.func, ast.Name) and node.func.id == "reported_":
            return self._reported(node)
        if isinstance(node.func, ast.Name) and node.func.id == "drawn_":
            stream, _, index = [self.value(a) for a in node.args]
            self.unit.libm |= {"exp", "log1p"} if stream.thing.normal else set()
            k = self.coerced(index, INT).c
            return self.fresh(REAL, f"sr_draw(&s->{stream.c}, {k}, {literal(stream.thing.normal)})")
        if isinstance(node.func, ast.Attribute) and node.func.attr == "conjugate":
            real, imag = self.parts(self.value(node.func.value), node)
            return self.group([real, Value(REAL, f"(-{imag.c})")], COMPLEX)
        if isinstance(node.func, ast.Attribute) and node.func.attr == "copy":
            return self._new(np.copy, [self.value(node.func.value)], node)
        function = self.value(node.func)
        if function.thing is None:
            raise self.unknown("a call of something that is computed", node)
        called = function.thing
        if called in (tuple, list, any, all) and len(node.args) == 1:
            parts = self._generated(node.args[0])
            if called in (any, all):
                tests = [self.truth(p, node) for p in parts]
                return Value(
                    BOOL, f"({(' || ' if called is any else ' && ').join(tests) or str(called is all).lower()})"
                )
            return self.group(parts, tuple_of([p.kind for p in parts]))
        args: list[Value] = []
        for item in node.args:
            args += self.listed(item.value) if isinstance(item, ast.Starred) else [self.value(item)]
        return self.called(called, args, node)

    def _generated(self, node: ast.expr) -> list[Value]:
        if (
            isinstance(node, (ast.GeneratorExp, ast.ListComp))
            and len(node.generators) == 1
            and not node.generators[0].ifs
        ):
            result, outer = [], dict(self.env)
            for item in [self.named(v) for v in self.listed(node.generators[0].iter)]:
                self._bind_apart(node.generators[0].target, item)
                result.append(self.named(self.value(node.elt)))
            self.env = outer
            return result
        return self.listed(node)

    def _bind_apart(self, target: ast.expr, value: Value) -> None:
        if isinstance(target, ast.Name):
            self.env[target.id] = value
        elif isinstance(target, ast.Tuple):
            for name, item in zip(target.elts, self.parts(value, target), strict=True):
                self._bind_apart(name, item)
        else:
            raise self.unknown("an assignment in a list", target)

    def _reported(self, node: ast.Call) -> Value:
        """Count a report, without its text; a tick that is discarded drops the pending ones."""
        index_node = node.args[1]
        number: int = ast.literal_eval(index_node)
        self.emit(f"s->pending[{self.unit.reports[number]}]++;")
        self.emit("s->reported = true;")
        return Value(ABSENT, "0")

    def called(self, called: Any, args: list[Value], node: ast.AST) -> Value:
        """Return the result of a call."""
        if isinstance(called, str):
            return self._function(called, args, node, True)
        if isinstance(called, Jit):
            return self._function(called.py_func, args, node, False)
        if isinstance(called, Compiled):
            raise self.unknown("a casadi function", node)
        if isinstance(called, type) and issubclass(called, tuple) and hasattr(called, "_fields"):
            return self.group(
                args, Tuple(tuple(v.kind for v in args), called._fields, called.__name__.rpartition("__")[2])
            )  # type: ignore[attr-defined]
        if called is power:
            return self._math("pow", args, node)
        name = getattr(called, "__name__", "")
        if called is getattr(math, name, None):
            if name in ("isfinite", "isnan", "isinf"):
                return Value(BOOL, f"sr_{name}({self.coerced(args[0], REAL).c})")
            if name == "floor":  # in Python the result is an integer
                return Value(INT, f"sr_floor_int({self.coerced(args[0], REAL).c})")
            if name in ("ceil", "trunc"):
                return Value(INT, f"sr_int(SR_MATH({name})({self.coerced(args[0], REAL).c}))")
            if name in ("radians", "degrees"):
                # CPython multiplies by the same quotients.
                factor = literal(math.pi / 180.0 if name == "radians" else 180.0 / math.pi)
                return Value(REAL, f"({self.coerced(args[0], REAL).c} * {factor})")
            return self._math(name, args, node)
        return self._builtin(called, args, node)

    def _math(self, name: str, args: Sequence[Value], node: ast.AST) -> Value:
        c = BINARY_MATH.get(name, name)
        if name not in BINARY_MATH and name not in UNARY_MATH:
            raise self.unknown(f"math.{name}", node)
        # The last bits of the others depend on the C library: they are listed for the user.
        if c not in EXACT:
            self.unit.libm.add(c)
        return Value(REAL, f"SR_MATH({c})({', '.join(self.coerced(v, REAL).c for v in args)})")

    def _function(self, function: Any, args: list[Value], node: ast.AST, python: bool) -> Value:
        args = [self.coerced(v, v.kind.item) if isinstance(v.kind, Maybe) and not python else v for v in args]
        tables: list[Any] = []
        sized = not isinstance(function, str) and bool(
            {"zeros", "empty", "full"}.intersection(function.__code__.co_names)
        )
        for value in args:
            # C needs the sizes of its arrays when it is compiled, so a function that makes arrays is written for each
            # size.
            if sized and value.kind == INT and WHOLE.fullmatch(value.c):
                tables.append(value.c)
                continue
            named = isinstance(value.thing, (np.ndarray, Draws)) or self._is_long(value)
            tables.append(value.c if named else "" if value.thing is not None else None)
        done = self.unit.call(function, tuple(v.kind for v in args), tuple(tables), python)
        handed = [v.c for v, t in zip(args, tables, strict=True) if t is None and not isinstance(v.kind, Absent)]
        c = f"{done.name}({', '.join(['s', *handed])})"
        if isinstance(done.result, Absent):
            self.emit(f"(void){c};")
            result = Value(ABSENT, "0")
        else:
            result = self.fresh(done.result, c)
        # C has no exceptions, so each caller returns as well.
        if done.discards:
            self.discards = True
            self.emit("if (SR_RARELY(s->discarded)) {")
            self.emit("    return @ZERO@;")
            self.emit("}")
        return result

    def _is_long(self, value: Value) -> bool:
        """Return whether a value is a constant tuple so long that its function is written again, with a table in it."""
        return value.c in self.unit.fixed and isinstance(value.kind, Tuple) and len(value.kind.items) > LONG

    def _builtin(self, called: Any, args: list[Value], node: ast.AST) -> Value:
        numbers = [v.kind for v in args if isinstance(v.kind, Number)]
        if called is complex and len(args) == 1 and args[0].kind == COMPLEX:
            return args[0]
        if called is complex and len(numbers) == len(args):
            parts = [self.coerced(v, REAL) for v in args]
            return self.group([*parts, Value(REAL, literal(0.0))][:2], COMPLEX)
        if called is abs and args[0].kind == COMPLEX:
            self.unit.libm.add("hypot")
            real, imag = self.parts(args[0], node)
            return self.fresh(REAL, f"SR_MATH(hypot)({real.c}, {imag.c})")
        if called in (min, max):
            if len(args) == 1:
                args = self.parts(args[0], node)
            best = self._simple(args[0])
            for one_ in args[1:]:
                number = self._simple(one_)
                kind = united(number.kind, best.kind)
                if not isinstance(kind, Number):
                    raise self.unknown(f"{called.__name__} of something that is not a number", node)
                # In Python the first of equal ones is the result, and a NaN in the first place stays.
                a, b = self.coerced(number, kind), self.coerced(best, kind)
                best = self.fresh(kind, f"(({a.c} {'<' if called is min else '>'} {b.c}) ? {a.c} : {b.c})")
            return best
        if called is len:
            kind = args[0].kind
            size = kind.shape[0] if isinstance(kind, Table) else len(self.parts(args[0], node))
            return Value(INT, literal(size))
        if called is np.array and len(args) == 1 and not isinstance(args[0].kind, Table):
            return self._array(args[0], node)
        if called in MAKERS:
            return self._new(called, args, node)
        if len(numbers) != len(args) or not args:
            raise self.unknown(f"{getattr(called, '__name__', called)}()", node)
        number, kind = args[0], numbers[0]
        if called is float or called is np.float64:
            return self.coerced(number, REAL)
        if called is bool:
            return Value(BOOL, self.truth(number, node))
        if called in (int, np.int64):
            return self.coerced(number, INT) if kind != REAL else Value(INT, f"sr_int({number.c})")
        if called in (abs, np.abs):
            if kind == REAL:
                return Value(REAL, f"SR_MATH(fabs)({number.c})")
            number = self._simple(self.coerced(number, INT))
            return Value(INT, f"(({number.c} < 0) ? (-{number.c}) : {number.c})")
        if called is round and len(args) == 1:
            return self.coerced(number, INT) if kind != REAL else Value(INT, f"sr_int(SR_MATH(rint)({number.c}))")
        if called in (np.sqrt, np.floor, np.ceil, np.trunc):
            return Value(REAL, f"SR_MATH({called.__name__})({self.coerced(number, REAL).c})")
        if called in (np.isfinite, np.isnan, np.isinf):
            return Value(BOOL, f"sr_{called.__name__}({self.coerced(number, REAL).c})")
        raise self.unknown(f"{getattr(called, '__name__', called)}()", node)

    def _sizes(self, shape: Value, node: ast.AST) -> list[Value]:
        """Return the numbers of a shape."""
        if isinstance(node, ast.Call) and isinstance(node.args[0], ast.Tuple):
            return [self.value(size) for size in node.args[0].elts]
        return self.parts(shape, node) if isinstance(shape.kind, Tuple) else [shape]

    def _array(self, value: Value, node: ast.AST) -> Value:
        """Return an array on the stack, made from a tuple."""
        parts = [self.coerced(p, REAL) for p in self.parts(value, node)]
        table = self.room(Table(REAL, (len(parts),)))
        for k, part in enumerate(parts):
            self.emit(f"{table.c}[{k}] = {part.c};")
        return table

    def _new(self, called: Any, args: list[Value], node: ast.AST) -> Value:
        """Return an array of a fixed shape, as numpy creates it."""
        if called in (np.zeros_like, np.empty_like, np.ones_like, np.copy):
            like = args[0].kind
            if not isinstance(like, Table):
                raise self.unknown("an array like something that is none", node)
            kind = like
        else:
            sizes = self._sizes(args[0], node)
            results = [WHOLE.fullmatch(size.c) for size in sizes]
            if not all(results):
                raise self.unknown("an array of no fixed length", node)
            dtype = args[1].thing if len(args) > 1 and called is not np.full else None
            item = INT if dtype in (int, np.int64) else COMPLEX if dtype is np.complex128 else REAL
            kind = Table(item, tuple(int(size[1]) for size in results if size))
        table = self.room(kind)
        if called is np.copy:
            return self.filled(table, f"{args[0].c}[i]")
        fill = args[1].c if called is np.full else "1" if called in (np.ones, np.ones_like) else "0"
        begin = f"({self.unit.c(kind.item)}){{ 0 }}" if kind.item == COMPLEX else f"({kind.item.c})({fill})"
        return self.filled(table, begin)
