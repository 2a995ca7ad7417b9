"""One function's text: its statements and expressions, read with what is known of its names."""

from __future__ import annotations

import ast
import builtins
import inspect
import math
import operator
import types
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from typing import Any

import numpy as np

from ..block.block import Block
from ..kit.compiled import Compiled
from ..kit.draws import Draws
from ..kit.jit import Jit, power
from .translate import (
    BINARY,
    COMPARE,
    GIVEN_UP,
    LONGEST,
    NUMBERS,
    SMALL,
    TURNS,
    UNARY,
    Program,
    as_slot,
    follow,
    is_number_slot,
    made,
    shape,
)
from .twins import OF, is_twinned, twin
from .value import UNKNOWN, Dynamic, Group, NotNative, Record, Static, Value, computed, is_sure, sample_of
from .words import TEXTS, word

NONE = Static(None)


class Writer:
    """Writes a function of Python as one of native code.

    Parameters
    ----------
    program : Program
    function : function
    env : dict of str to Value
        Its arguments.
    """

    def __init__(self, program: Program, function: types.FunctionType, env: dict[str, Value]) -> None:
        self.program, self.function, self.env = program, function, env
        self.lines: list[str] = []
        self.arrays: set[str] = set()
        self.returned: list[Value] = []
        self.ended = False  # what follows is never reached
        self._temporaries = 0
        self._inside = 0  # loops of native code
        self.sampled: Any = UNKNOWN  # what the test read last was, by the samples

    # the whole ----------------------------------------------------------------------------------------------------

    def body(self, statements: Sequence[ast.stmt]) -> list[str]:
        """Write the body of the function."""
        self.run(statements)
        if not self.ended:
            self._return(NONE)
        return self.lines

    def result(self) -> Value:
        """Give what the function gives: a fixed value where it is nothing else."""
        found = self.returned
        if not found:
            return Dynamic("", UNKNOWN, False)
        if len(self.lines) == 1 and len(found) == 1 and isinstance(found[0], Static):
            return found[0]
        values = [self._described(v) for v in found]
        first = values[0]
        for other in values[1:]:
            if (other.keys, _shapes(other)) != (first.keys, _shapes(first)):
                raise self.unknown("answers of several forms")
        known = [v for v in values if v.sample is not UNKNOWN]
        sure = len(known) == len(values) and all(is_sure(v) and _alike(v.sample, first.sample) for v in values)
        return Dynamic("", known[0].sample if known else UNKNOWN, sure, first.keys, first.parts)

    def unknown(self, what: str, node: ast.AST | None = None) -> NotNative:
        """Say what native code does not know, and where."""
        line = self.function.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
        return NotNative(f"{self.function.__module__}.{self.function.__qualname__}, line {line}: {what}")

    def emit(self, line: str) -> None:
        """Add a line."""
        self.lines.append(line)

    def temporary(self, code: str) -> str:
        """Give a value a name."""
        name = self._fresh()
        self.emit(f"{name} = {code}")
        return name

    # values as text -----------------------------------------------------------------------------------------------

    def code(self, value: Value) -> str:
        """Write a value."""
        if isinstance(value, Dynamic):
            return value.code
        if isinstance(value, Group):
            return f"({''.join(f'{self.code(v)}, ' for v in value.items)})"
        if isinstance(value, Record):
            return f"({''.join(f'{self.code(value.items[k])}, ' for k in sorted(value.items))})"
        return self._literal(value)

    def dynamic(self, value: Value) -> Dynamic:
        """Give a value as one that is computed."""
        return value if isinstance(value, Dynamic) else self._described(value)

    def _described(self, value: Value) -> Dynamic:
        if isinstance(value, Dynamic):
            return value
        if isinstance(value, Static):
            return Dynamic(self.code(value), _plain(value.value))
        if isinstance(value, Record):
            keys = tuple(sorted(value.items))
            parts = tuple(self._described(value.items[k]) for k in keys)
        else:
            keys, parts = None, tuple(self._described(v) for v in value.items)
        nested = keys is not None or any(p.keys or p.parts for p in parts)
        sample = tuple(p.sample for p in parts)
        return Dynamic(self.code(value), sample, is_sure(value), keys, parts if nested else None)

    def _literal(self, value: Static) -> str:
        found = value.value
        if value.path is not None and (
            isinstance(found, (float, complex, np.ndarray, np.floating, list))
            or (isinstance(found, tuple) and found)
            or (isinstance(found, int) and abs(found) > SMALL)
        ):
            try:
                slot = self.program.slot(value)
            except NotNative as error:
                raise self.unknown(str(error)) from None
            if isinstance(found, np.ndarray):
                self.arrays.add(slot.code)
            return slot.code
        self.program.guard(value)
        if found is None or isinstance(found, (bool, int)):
            return repr(found)
        if isinstance(found, float):
            if math.isfinite(found):
                return repr(float(found))
            return "float_nan" if found != found else "float_inf" if found > 0 else "float_less"
        if isinstance(found, complex):
            return f"complex({float(found.real)!r}, {float(found.imag)!r})"
        if isinstance(found, (tuple, list)):
            try:
                return self.program.name(as_slot(found), "table") if found else "()"
            except NotNative as error:
                raise self.unknown(str(error)) from None
        if isinstance(found, np.ndarray):
            return self.program.name(found, "array")
        raise self.unknown(f"{type(found).__name__} as a value")

    def simple(self, value: Dynamic) -> Dynamic:
        """Give a value by a name, so that it is computed once."""
        if value.code.replace("_", "").replace(".", "").replace("[", "").replace("]", "").isalnum():
            return value
        name = self.temporary(value.code)
        return Dynamic(name, value.sample, value.sure, value.keys, value.parts)

    # statements ---------------------------------------------------------------------------------------------------

    def run(self, statements: Sequence[ast.stmt]) -> None:
        """Write statements, as far as they are reached; those that surely lead to a report give the tick up at once."""
        for k, statement in enumerate(statements):
            if self.ended:
                return
            if _reporting(statements[k:]):
                self._give_up()
                return
            self.statement(statement)

    def statement(self, node: ast.stmt) -> None:
        """Write one."""
        method = getattr(self, f"_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.unknown(f"{type(node).__name__.lower()}", node)
        method(node)

    def _pass(self, node: ast.Pass) -> None:
        pass

    def _expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Constant):
            return
        call = node.value
        if (
            isinstance(call, ast.Call)
            and isinstance(call.func, ast.Attribute)
            and call.func.attr == "append"
            and (isinstance(call.func.value, ast.Name) and call.func.value.id in self.env)
        ):  # a list is written as a tuple: with one more it is another
            before = self.parts(self.env[call.func.value.id], node)
            self.assign(ast.Name(call.func.value.id, ast.Store()),
                        Group((*(self._held(v) for v in before), self.value(call.args[0]))))  # fmt: skip
            return
        found = self.value(node.value)
        if isinstance(found, Dynamic) and not self.ended:
            self.emit(found.code)

    def _raise(self, node: ast.Raise) -> None:
        self._give_up()

    def _give_up(self) -> None:
        self.emit(GIVEN_UP)
        self.ended = True

    def _assert(self, node: ast.Assert) -> None:
        test = self.test(node.test)
        if test is False:
            self._give_up()
        elif test is not True:
            self.emit(f"if not ({test}):")
            self.emit(f"    {GIVEN_UP}")

    def _return(self, node: ast.Return | Static) -> None:
        value = node if isinstance(node, Static) else NONE if node.value is None else self.value(node.value)
        if self.ended:
            return
        self.returned.append(value)
        keep = isinstance(value, Static) and not self.lines
        try:
            self.emit(f"return {self.code(value)}")
        except NotNative:
            if not keep:
                raise
            self.emit("return None")  # an object: known without a call
        self.ended = True

    def _annassign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.assign(node.target, self.value(node.value))

    def _assign(self, node: ast.Assign) -> None:
        value = self.value(node.value)
        if self.ended:
            return
        if len(node.targets) > 1 and isinstance(value, Dynamic):
            value = self.simple(value)
        for target in node.targets:
            self.assign(target, value)

    def _augassign(self, node: ast.AugAssign) -> None:
        if not isinstance(node.target, ast.Name):
            raise self.unknown("an assignment to a part of something", node)
        left = self.value(ast.Name(node.target.id, ast.Load()))
        self.assign(node.target, self.binary(node.op, left, self.value(node.value), node))

    def assign(self, target: ast.expr, value: Value, apart: bool = False) -> None:
        """Bind a value to a name or to names; `apart`: to names of a list, which are not those around it."""
        if isinstance(target, ast.Name):
            self.env[target.id] = self._held(value) if apart else self._bound(f"v_{target.id}", value)
        elif isinstance(target, (ast.Tuple, ast.List)):
            parts = self.parts(value, target)
            starred = [k for k, t in enumerate(target.elts) if isinstance(t, ast.Starred)]
            if starred:
                at, after = starred[0], len(target.elts) - starred[0] - 1
                parts = [*parts[:at], Group(tuple(parts[at : len(parts) - after])), *parts[len(parts) - after :]]
            if len(parts) != len(target.elts):
                raise self.unknown(f"{len(parts)} values for {len(target.elts)} names", target)
            parts = [self._held(p) for p in parts]
            for one, part in zip(target.elts, parts, strict=True):
                self.assign(one.value if isinstance(one, ast.Starred) else one, part, apart)
        else:
            raise self.unknown("an assignment to a part of something", target)

    def _held(self, value: Value) -> Value:
        """Give a value that stays as it is while names are bound anew."""
        if isinstance(value, Dynamic):
            name = self.temporary(value.code)
            return Dynamic(name, value.sample, value.sure, value.keys, value.parts)
        if isinstance(value, Group):
            return Group(tuple(self._held(v) for v in value.items))
        if isinstance(value, Record):
            return Record({k: self._held(v) for k, v in value.items.items()})
        return value

    def _bound(self, name: str, value: Value) -> Value:
        if isinstance(value, Static):
            return value
        if isinstance(value, Record):
            return Record({k: self._bound(f"{name}__{k}", v) for k, v in self._each(value).items()})
        if isinstance(value, Group):
            try:
                found = self._described(value)
            except NotNative:
                return Group(tuple(self._bound(f"{name}__{k}", v) for k, v in enumerate(value.items)))
            if found.parts:
                return Group(tuple(self._bound(f"{name}__{k}", v) for k, v in enumerate(value.items)))
            value = found
        self.emit(f"{name} = {value.code}")
        return Dynamic(name, value.sample, value.sure, value.keys, value.parts)

    def _each(self, value: Record) -> dict[str, Value]:
        return {k: self._held(v) for k, v in value.items.items()}

    def _if(self, node: ast.If) -> None:
        test = self.test(node.test)
        if self.ended:
            return
        if isinstance(test, bool):
            self.run(node.body if test else node.orelse)
            return
        taken = self.sampled
        self._fork(test, taken, lambda: self.run(node.body), lambda: self.run(node.orelse))

    def _fork(self, test: str, taken: Any, one: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
        """Write both ways of a test, and join what is known after them."""
        before, lines = dict(self.env), self.lines
        ways: list[tuple[list[str], dict[str, Value], bool]] = []
        found = []
        for way, wanted in ((one, True), (other, False)):
            self.env, self.lines, self.ended = dict(before), [], False
            try:
                found.append(way())
            except NotNative as reason:
                if taken is UNKNOWN or bool(taken) is wanted:  # the way that is gone, as far as anybody knows
                    raise
                self.program.seldom.append(str(reason))
                self.env, self.lines = dict(before), []
                found.append(None)
                self._give_up()
            ways.append((self.lines, self.env, self.ended))
        (then, env_then, over_then), (orelse, env_else, over_else) = ways
        if over_then and over_else:
            env = env_then
        elif over_then or over_else:
            env = env_else if over_then else env_then
        else:
            env = self._joined(env_then, env_else, then, orelse, taken)
        self.lines, self.env, self.ended = lines, env, over_then and over_else
        self.emit(f"if {test}:")
        self.lines += [f"    {line}" for line in then or ["pass"]]
        if orelse:
            self.emit("else:")
            self.lines += [f"    {line}" for line in orelse]
        return found[0], found[1]

    def _joined(
        self, one: dict[str, Value], other: dict[str, Value], then: list[str], orelse: list[str], taken: Any
    ) -> dict[str, Value]:
        env: dict[str, Value] = {}
        for name in {**one, **other}:
            a, b = one.get(name), other.get(name)
            if a is None or b is None:
                found = a or b
                assert found is not None
                if isinstance(found, Dynamic):
                    env[name] = Dynamic(found.code, found.sample, False, found.keys, found.parts)
                continue
            joined = self._join(f"v_{name}", a, b, then, orelse, taken)
            if joined is not None:
                env[name] = joined
        return env

    def _join(self, name: str, a: Value, b: Value, then: list[str], orelse: list[str], taken: Any) -> Value | None:
        if a is b or a == b or (isinstance(a, Static) and isinstance(b, Static) and a.value is b.value):
            return a
        if isinstance(a, Group) and isinstance(b, Group) and len(a.items) == len(b.items):
            parts = [self._join(f"{name}__{k}", x, y, then, orelse, taken)
                     for k, (x, y) in enumerate(zip(a.items, b.items, strict=True))]  # fmt: skip
            return None if None in parts else Group(tuple(p for p in parts if p is not None))
        if isinstance(a, Record) and isinstance(b, Record) and a.items.keys() == b.items.keys():
            items = {k: self._join(f"{name}__{k}", a.items[k], b.items[k], then, orelse, taken) for k in a.items}
            return None if None in items.values() else Record({k: v for k, v in items.items() if v is not None})
        values = []
        for value, lines in ((a, then), (b, orelse)):
            kept, self.lines = self.lines, lines
            try:
                found = self.dynamic(value)
            except NotNative:
                return None
            finally:
                self.lines = kept
            if found.code != name:
                lines.append(f"{name} = {found.code}")
            values.append(found)
        x, y = values
        if (x.keys, _shapes(x)) != (y.keys, _shapes(y)):
            return None
        first = y if taken is False else x
        sample = first.sample if first.sample is not UNKNOWN else (x if first is y else y).sample
        sure = is_sure(x) and is_sure(y) and _alike(x.sample, y.sample)
        return Dynamic(name, sample, sure, x.keys, x.parts)

    def _while(self, node: ast.While) -> None:
        if node.orelse:
            raise self.unknown("else of a loop", node)
        self._loop("while True:", node.body, node, node.test)

    def _for(self, node: ast.For) -> None:
        if node.orelse:
            raise self.unknown("else of a loop", node)
        leaves = any(isinstance(n, (ast.Break, ast.Continue)) for one in node.body for n in ast.walk(one))
        values = None if leaves else self.listed(node.iter)
        if values is not None:
            for value in [self._held(v) for v in values]:
                self.assign(node.target, value)
                self.run(node.body)
                if self.ended:
                    return
            return
        turns = self._range(node.iter)
        if turns is None or not isinstance(node.target, ast.Name):
            raise self.unknown("a loop over something of no fixed length", node)
        self.env[node.target.id] = Dynamic(f"v_{node.target.id}", 0)
        self._loop(f"for v_{node.target.id} in range({turns}):", node.body, node)

    def _range(self, node: ast.expr) -> str | None:
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "range":
            return ", ".join(self.code(self.value(a)) for a in node.args)
        return None

    def _loop(self, head: str, body: Sequence[ast.stmt], node: ast.stmt, test: ast.expr | None = None) -> None:
        names = {n.id for one in [*body, node] for n in ast.walk(one)
                 if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}  # fmt: skip
        for name in names:
            if (known := self.env.get(name)) is not None and not (
                isinstance(known, Dynamic) and known.code == f"v_{name}"
            ):
                try:
                    found = self.dynamic(known)
                except NotNative:
                    continue
                self.emit(f"v_{name} = {found.code}")
                known = Dynamic(f"v_{name}", found.sample, False, found.keys, found.parts)
            if isinstance(known, Dynamic):
                numbers = isinstance(known.sample, NUMBERS)
                self.env[name] = Dynamic(known.code, known.sample, numbers, known.keys, known.parts)
        before, lines = dict(self.env), self.lines
        self.lines, self._inside = [], self._inside + 1
        if test is not None:
            code = self.test(test)
            if code is not True:
                self.emit(f"if not ({code}):")
                self.emit("    break")
        self.run(body)
        inner, self.lines = self.lines, lines
        self._inside -= 1
        after, self.env, self.ended = self.env, before, False
        for name, value in after.items():
            if name in before:
                if name in names and not (isinstance(value, Dynamic) and value.code == f"v_{name}"):
                    raise self.unknown(f"{name} changes what it is in a loop", node)
            elif isinstance(value, Dynamic):
                self.env[name] = Dynamic(value.code, value.sample, False, value.keys, value.parts)
        self.emit(head)
        self.lines += [f"    {line}" for line in inner or ["pass"]]

    def _break(self, node: ast.Break) -> None:
        self.emit("break")
        self.ended = True

    def _continue(self, node: ast.Continue) -> None:
        self.emit("continue")
        self.ended = True

    # expressions --------------------------------------------------------------------------------------------------

    def value(self, node: ast.expr) -> Value:
        """Read an expression."""
        method = getattr(self, f"_value_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.unknown(f"{type(node).__name__.lower()}", node)
        found: Value = method(node)
        return found

    def _value_constant(self, node: ast.Constant) -> Value:
        return Static(node.value)

    def _value_joinedstr(self, node: ast.JoinedStr) -> Value:
        return Static("")

    def _value_name(self, node: ast.Name) -> Value:
        if node.id in self.env:
            return self.env[node.id]
        if node.id in self.function.__code__.co_varnames:
            raise self.unknown(f"{node.id} is not known on every way", node)
        return Static(self.outer(node.id, node))

    def outer(self, name: str, node: ast.AST | None = None) -> Any:
        """Give what the function finds under a name outside of itself."""
        cells = dict(zip(self.function.__code__.co_freevars, self.function.__closure__ or (), strict=True))
        if name in cells:
            return cells[name].cell_contents
        if name in self.function.__globals__:
            return self.function.__globals__[name]
        if hasattr(builtins, name):
            return getattr(builtins, name)
        raise self.unknown(f"{name} is not known", node)

    def _value_tuple(self, node: ast.Tuple | ast.List) -> Value:
        items: list[Value] = []
        for one in node.elts:
            if isinstance(one, ast.Starred):
                items += self.parts(self.value(one.value), one)
            else:
                items.append(self.value(one))
        if items and all(isinstance(v, Static) and v.path is None for v in items):
            return Static(tuple(v.value for v in items if isinstance(v, Static)))
        return Group(tuple(items))

    _value_list = _value_tuple

    def _value_dict(self, node: ast.Dict) -> Value:
        items: dict[str, Value] = {}
        for key, one in zip(node.keys, node.values, strict=True):
            if key is None:
                more = self.value(one)
                if isinstance(more, Dynamic) and more.keys is not None:
                    more = self._unfolded(more)
                if not isinstance(more, Record):
                    raise self.unknown("a mapping that is not written out", node)
                items |= more.items
                continue
            name = self.value(key)
            if not isinstance(name, Static) or not isinstance(name.value, str):
                raise self.unknown("a mapping whose keys are computed", node)
            items[self.program.guard(name)] = self.value(one)
        return Record(items)

    def _unfolded(self, value: Dynamic) -> Record:
        """Give a mapping that a function has answered by its parts."""
        assert value.keys is not None
        base = self.simple(value)
        return Record({key: self._part(base, k) for k, key in enumerate(value.keys)})

    def _part(self, base: Dynamic, k: int) -> Dynamic:
        code = f"{base.code}[{k}]"
        if base.parts is not None:
            part = base.parts[k]
            return Dynamic(code, part.sample, part.sure and base.sure, part.keys, part.parts)
        sample = base.sample[k] if base.sample is not UNKNOWN else UNKNOWN
        return Dynamic(code, sample, base.sure)

    def parts(self, value: Value, node: ast.AST) -> list[Value]:
        """Give the parts of a value of fixed length."""
        if isinstance(value, Group):
            return list(value.items)
        if isinstance(value, Static) and isinstance(value.value, (tuple, list)):
            if value.path is not None:
                self.program.guards[(*value.path, ("len", None))] = ("int", len(value.value))
            return [Static(v, None if value.path is None else (*value.path, ("item", k)))
                    for k, v in enumerate(value.value)]  # fmt: skip
        if isinstance(value, Static) and isinstance(value.value, (Mapping, range)):
            if value.path is not None:
                self.program.guard(value)
            return [Static(k) for k in value.value]
        if isinstance(value, Dynamic) and value.keys is None and isinstance(value.sample, tuple) and value.sure:
            if len(value.sample) > LONGEST:
                raise self.unknown(f"a tuple of {len(value.sample)}, expected at most {LONGEST}", node)
            base = self.simple(value)
            return [self._part(base, k) for k in range(len(value.sample))]
        raise self.unknown("something whose length is not fixed", node)

    def listed(self, node: ast.expr) -> list[Value] | None:
        """Give the values that a loop goes through, where their number is fixed; None where it is not."""
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id not in self.env:
            name = node.func.id
            if name == "range":
                ends = [self.value(a) for a in node.args]
                if all(isinstance(v, Static) for v in ends):
                    turns = range(*(self.program.guard(v) for v in ends if isinstance(v, Static)))
                    return [Static(k) for k in turns] if len(turns) <= TURNS else None
                return None
            if name == "zip":
                rows: list[list[Value] | None] = []
                for a in node.args:
                    if isinstance(a, ast.Starred):
                        outer = self.listed(a.value)
                        rows += [None] if outer is None else [self.parts(v, node) for v in outer]
                    else:
                        rows.append(self.listed(a))
                if any(r is None for r in rows):
                    return None
                return [Group(tuple(parts)) for parts in zip(*(r for r in rows if r is not None), strict=False)]
            if name in ("enumerate", "reversed") and len(node.args) == 1:
                found = self.listed(node.args[0])
                if found is None or name == "reversed":
                    return found and found[::-1]
                return [Group((Static(k), v)) for k, v in enumerate(found)]
            if name == "map" and len(node.args) == 2:
                found = self.listed(node.args[1])
                function = self.value(node.args[0])
                return None if found is None else [self.call(function, [v], {}, node) for v in found]
        if isinstance(node, (ast.ListComp, ast.GeneratorExp)):
            group = self._value_listcomp(node)
            return list(group.items) if isinstance(group, Group) else self.parts(group, node)
        value = self.value(node)
        if isinstance(value, Dynamic) and isinstance(value.sample, np.ndarray):
            return None
        return self.parts(value, node)

    def _value_listcomp(self, node: ast.ListComp | ast.GeneratorExp) -> Value:
        items: list[Value] = []
        outer = dict(self.env)

        def turn(level: int) -> None:
            if level == len(node.generators):
                items.append(self._held(self.value(node.elt)) if self._inside else self.value(node.elt))
                return
            part = node.generators[level]
            values = self.listed(part.iter)
            if values is None:
                raise self.unknown("a list of no fixed length", node)
            for value in values:
                self.assign(part.target, value, apart=True)
                tests = [self.test(t) for t in part.ifs]
                if any(isinstance(t, str) for t in tests):
                    raise self.unknown("a list whose length is computed", node)
                if all(tests):
                    # what the target is bound to is bound anew in the next turn
                    before = len(items)
                    turn(level + 1)
                    items[before:] = [self._held(v) for v in items[before:]]

        turn(0)
        self.env = outer
        if all(isinstance(v, Static) and v.path is None for v in items):
            return Static(tuple(v.value for v in items if isinstance(v, Static)))
        return Group(tuple(items))

    _value_generatorexp = _value_listcomp

    def _value_namedexpr(self, node: ast.NamedExpr) -> Value:
        self.assign(node.target, self.value(node.value))
        return self.env[node.target.id]

    def _value_attribute(self, node: ast.Attribute) -> Value:
        return self.attribute(self.value(node.value), node.attr, node)

    def attribute(self, base: Value, name: str, node: ast.AST) -> Value:
        """Read an attribute."""
        if isinstance(base, Static):
            try:
                found = getattr(base.value, name)
            except AttributeError as error:
                raise self.unknown(str(error), node) from None
            if base.path is None:
                return Static(found)
            return Static(found, (*base.path, ("attr", name)))
        if isinstance(base, Dynamic):
            fields = getattr(type(base.sample), "_fields", ())
            if name in fields and base.keys is None:
                base = self.simple(base)
                found = getattr(base.sample, name)
                return Dynamic(f"{base.code}.{name}", found, base.sure)
            own = _class(base.sample)
            if own is not None and base.keys is None and hasattr(own, name):
                found = inspect.getattr_static(own, name)
                if isinstance(found, property) and isinstance(found.fget, types.FunctionType):
                    return made(self.program, found.fget, [base], {}, self.arrays)
                if not callable(found):
                    return Static(getattr(own, name))
            if name in ("real", "imag") and isinstance(base.sample, (complex, float)):
                return Dynamic(f"{self.simple(base).code}.{name}", getattr(base.sample, name))
            if name in ("shape", "size") and isinstance(base.sample, np.ndarray):
                return Dynamic(f"{base.code}.{name}", getattr(base.sample, name), False)
        if isinstance(base, Group) and name in ("real", "imag"):
            raise self.unknown(f".{name} of a tuple", node)
        raise self.unknown(f".{name} of {_said(base)}", node)

    def _value_subscript(self, node: ast.Subscript) -> Value:
        base = self.value(node.value)
        if isinstance(node.slice, ast.Slice):
            return self._sliced(base, node.slice, node)
        index = self.value(node.slice)
        return self.item(base, index, node)

    def item(self, base: Value, index: Value, node: ast.AST) -> Value:
        """Read an item."""
        if isinstance(base, Dynamic) and base.keys is not None:
            base = self._unfolded(base)
        if isinstance(index, Static):
            key = index.value
            if isinstance(base, Record):
                if key not in base.items:
                    raise self.unknown(f"no {key!r} in a mapping", node)
                return base.items[self.program.guard(index)]
            if isinstance(base, Group) and isinstance(key, int):
                self.program.guard(index)
                return base.items[key]
            if isinstance(base, Static):
                self.program.guard(index)
                try:
                    found = base.value[key]
                except (LookupError, TypeError) as error:
                    raise self.unknown(f"{error!r}", node) from None
                if isinstance(base.value, np.ndarray):
                    base = self.dynamic(base)
                else:
                    return Static(found, None if base.path is None else (*base.path, ("item", key)))
            if isinstance(base, Dynamic) and isinstance(base.sample, tuple) and isinstance(key, int):
                self.program.guard(index)
                simple = self.simple(base)
                if not -len(base.sample) <= key < len(base.sample):
                    raise self.unknown(f"no item {key} of {len(base.sample)}", node)
                return self._part(simple, key % len(base.sample))
        if isinstance(base, Static) and isinstance(base.value, Mapping):
            return self._looked_up(base, index, node)
        keys = None
        if isinstance(base, Static) and isinstance(base.value, (list, tuple)):
            kinds = {tuple(sorted(v)) if isinstance(v, Mapping) else None for v in base.value}
            keys = kinds.pop() if len(kinds) == 1 else None
            if keys is not None and base.path is not None:
                self.program.guards[(*base.path, ("item", 0))] = ("keys", keys)
        table, at = self.dynamic(base), self.dynamic(index)
        if table.parts or table.sample is UNKNOWN:
            raise self.unknown("an item of something that is not a table", node)
        if isinstance(table.sample, tuple) and len({shape(v) for v in table.sample}) != 1:
            raise self.unknown("an item of a tuple of several types", node)
        sample = computed(lambda a, k: a[k], table.sample, at.sample)
        if sample is UNKNOWN and isinstance(table.sample, tuple) and table.sample:
            sample = table.sample[0]
        if isinstance(sample, np.floating):
            sample = float(sample)
        return Dynamic(f"{self.simple(table).code}[{at.code}]", sample, True, keys)

    def _looked_up(self, table: Static, key: Value, node: ast.AST) -> Dynamic:
        """Look a computed key up in a fixed mapping; without it the tick is given up."""
        entries = list(table.value.items())
        if len(entries) > LONGEST:
            raise self.unknown(f"a mapping of {len(entries)}, expected at most {LONGEST}", node)
        if table.path is not None:
            self.program.guard(table)
        at = self.simple(self.dynamic(key))
        name = f"look{len(self.program.functions)}"
        lines = [f"def {name}(k):"]
        for k, v in entries:
            parts = [f"k[{i}] == {p!r}" for i, p in enumerate(k)] if isinstance(k, tuple) else [f"k == {k!r}"]
            lines += [f"    if {' and '.join(parts)}:", f"        return {self.code(Static(v))}"]
        self.program.functions.append("\n".join([*lines, f"    {GIVEN_UP}"]))
        sample = computed(lambda k: table.value[k], at.sample)
        return Dynamic(f"{name}({at.code})", entries[0][1] if sample is UNKNOWN else sample)

    def _sliced(self, base: Value, part: ast.Slice, node: ast.AST) -> Value:
        ends = []
        for end in (part.lower, part.upper, part.step):
            value = NONE if end is None else self.value(end)
            if not isinstance(value, Static):
                raise self.unknown("a part whose ends are computed", node)
            ends.append(self.program.guard(value))
        return Group(tuple(self.parts(base, node)[slice(*ends)]))

    def _value_starred(self, node: ast.Starred) -> Value:
        raise self.unknown("* here", node)

    def _value_unaryop(self, node: ast.UnaryOp) -> Value:
        if isinstance(node.op, ast.Not):
            test = self.test(node)
            return Static(test) if isinstance(test, bool) else Dynamic(test, self.sampled)
        value = self.value(node.operand)
        text, function = UNARY[type(node.op)]
        if isinstance(value, Static) and value.path is None:
            return Static(function(value.value))
        if isinstance(value, Static) and isinstance(value.value, int) and abs(value.value) <= SMALL:
            return Static(function(self.program.guard(value)))
        value = self.dynamic(value)
        return Dynamic(f"({text}{value.code})", computed(function, value.sample), value.sure)

    def _value_binop(self, node: ast.BinOp) -> Value:
        return self.binary(node.op, self.value(node.left), self.value(node.right), node)

    def binary(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        """Compute with two values."""
        both = [v for v in (left, right) if isinstance(v, Static)]
        folded = len(both) == 2 and not any(v.path is not None and is_number_slot(v.value) for v in both)
        if folded and type(op) in (*BINARY, ast.Pow, ast.LShift, ast.RShift):
            function = BINARY[type(op)][1] if type(op) in BINARY else FOLDED[type(op)]
            try:
                return Static(function(*(self.program.guard(v) for v in both)))
            except Exception as error:
                raise self.unknown(f"{type(error).__name__}: {error}", node) from None
        if (
            isinstance(op, ast.Pow)
            and isinstance(sample_of(left), float)
            and isinstance(sample_of(right), (int, float))
        ):
            self.program.words.add("power_")
            self.program.names["power"] = power
            x, y = self.dynamic(left), self.dynamic(right)
            sample = computed(pow, x.sample, y.sample)
            return Dynamic(f"power_({x.code}, float({y.code}))", x.sample if sample is UNKNOWN else sample)
        if type(op) not in BINARY:
            raise self.unknown("** of whole or complex numbers" if isinstance(op, ast.Pow) else "an operation on bits",
                               node)  # fmt: skip
        a, b = sample_of(left), sample_of(right)
        if isinstance(a, (tuple, list)) or isinstance(b, (tuple, list)):
            return self._joined_tuples(op, left, right, node)
        if isinstance(a, str) or isinstance(b, str):
            raise self.unknown("a text that is computed", node)
        text, function = BINARY[type(op)]
        x, y = self.dynamic(left), self.dynamic(right)
        sample = computed(function, x.sample, y.sample)
        if sample is UNKNOWN and isinstance(x.sample, float) and isinstance(y.sample, (float, int)):
            sample = x.sample
        if isinstance(sample, np.ndarray):
            raise self.unknown("arithmetic of whole arrays", node)
        if text == "*" and all(isinstance(v, int) and not isinstance(v, bool) for v in (x.sample, y.sample)):
            self.program.words.add("times_")
            return Dynamic(f"times_({x.code}, {y.code})", sample)
        return Dynamic(f"({x.code} {text} {y.code})", sample, is_sure(x) and is_sure(y))

    def _joined_tuples(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        if isinstance(op, ast.Add):
            return Group((*self.parts(left, node), *self.parts(right, node)))
        if isinstance(op, ast.Mult) and isinstance(right, Static) and isinstance(right.value, int):
            return Group(tuple(self.parts(left, node)) * self.program.guard(right))
        raise self.unknown("arithmetic of tuples", node)

    def test(self, node: ast.expr) -> bool | str:
        """Read an expression of which only the truth is asked for; see `truth`."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            found = self.test(node.operand)
            if isinstance(found, bool):
                return not found
            self.sampled = computed(operator.not_, self.sampled)
            return f"(not {found})"
        if not isinstance(node, ast.BoolOp):
            return self.truth(self.value(node))
        stop = isinstance(node.op, ast.Or)
        first = self.test(node.values[0])
        rest = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if isinstance(first, bool):
            return stop if first is stop else self.test(rest)
        sampled, at, before = self.sampled, len(self.lines), dict(self.env)
        try:
            other: bool | str | None = self.test(rest)
        except NotNative:
            other = None
        if other is not None and len(self.lines) == at and not self.ended:  # nothing to be computed before it
            if isinstance(other, bool):
                self.sampled = sampled
                return stop if other is stop else first
            self.sampled = self._either(stop, sampled, self.sampled)
            return f"({first} {'or' if stop else 'and'} {other})"
        del self.lines[at:]
        self.env, self.ended = before, False
        name = self._fresh()

        def long() -> Any:
            found = self.test(rest)
            if not self.ended:
                self.emit(f"{name} = bool({found})")
            return found if isinstance(found, bool) else self.sampled

        ways: list[Callable[[], Any]] = [lambda: self.emit(f"{name} = {stop}"), long]
        pair = self._fork(first, sampled, ways[not stop], ways[stop])
        self.sampled = self._either(stop, sampled, pair[1] if stop else pair[0])
        return name

    @staticmethod
    def _either(stop: bool, one: Any, other: Any) -> Any:
        if one is not UNKNOWN and bool(one) is stop:
            return stop
        return computed(bool, other) if one is not UNKNOWN else UNKNOWN

    def _fresh(self) -> str:
        self._temporaries += 1
        return f"t{self._temporaries - 1}_"

    def _value_boolop(self, node: ast.BoolOp) -> Value:
        stop = isinstance(node.op, ast.Or)
        left = self.value(node.values[0])
        if isinstance(left, Dynamic) and isinstance(left.sample, bool):
            left = self.simple(left)
        test = self.truth(left)
        rest = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if isinstance(test, bool):
            return left if test is stop else self.value(rest)
        sampled, first = self.sampled, self.simple(self.dynamic(left))
        test = self.truth(first)
        assert isinstance(test, str)
        ways: list[Callable[[], Value]] = [lambda: first, lambda: self.value(rest)]
        return self._chosen(test, sampled, ways[not stop], ways[stop], node)

    def _chosen(
        self, test: str, taken: Any, one: Callable[[], Value], other: Callable[[], Value], node: ast.AST
    ) -> Value:
        """Write a choice of two values, of which only the one that is wanted is computed."""
        at, before = len(self.lines), dict(self.env)
        try:
            a: Value | None = one()
            b = other() if not self.ended else None
        except NotNative:  # of one way: told by `_fork` whether that is the one that is gone
            a = b = None
        if a is not None and b is not None and not self.ended and len(self.lines) == at:
            if isinstance(a, Static) and isinstance(b, Static) and a == b:
                return a
            x, y = self.dynamic(a), self.dynamic(b)
            if len(self.lines) == at:
                return self._one_of(f"({x.code} if {test} else {y.code})", x, y, taken, node)
        del self.lines[at:]
        self.env, self.ended = before, False
        name = self._fresh()

        def way(read: Callable[[], Value]) -> Dynamic | None:
            found = read()
            if self.ended:
                return None
            done = self.dynamic(found)
            self.emit(f"{name} = {done.code}")
            return done

        x_, y_ = self._fork(test, taken, lambda: way(one), lambda: way(other))
        if x_ is None or y_ is None:
            done = x_ or y_
            return NONE if done is None else Dynamic(name, done.sample, done.sure, done.keys, done.parts)
        return self._one_of(name, x_, y_, taken, node)

    def _one_of(self, code: str, x: Dynamic, y: Dynamic, taken: Any, node: ast.AST) -> Dynamic:
        if (x.keys, _shapes(x)) != (y.keys, _shapes(y)):
            raise self.unknown("answers of several forms", node)
        first, second = (y, x) if taken is False else (x, y)
        sample = second.sample if first.sample is UNKNOWN else first.sample
        return Dynamic(code, sample, is_sure(x) and is_sure(y) and _alike(x.sample, y.sample), first.keys, first.parts)

    def _value_compare(self, node: ast.Compare) -> Value:
        left = self.value(node.left)
        found: Value | None = None
        for op, right_node in zip(node.ops, node.comparators, strict=True):
            right = self.value(right_node)
            if len(node.ops) > 1 and isinstance(right, Dynamic):
                right = self.simple(right)
            one = self._compared(op, left, right, node)
            if found is None or (isinstance(found, Static) and found.value is True):
                found = one
            elif isinstance(found, Static):
                return found
            elif isinstance(one, Static):
                if one.value is False:
                    return one
            else:
                a, b = self.dynamic(found), self.dynamic(one)
                found = Dynamic(f"({a.code} and {b.code})", computed(lambda p, q: p and q, a.sample, b.sample))
            left = right
        assert found is not None
        return found

    def _compared(self, op: ast.cmpop, left: Value, right: Value, node: ast.AST) -> Value:
        if isinstance(op, (ast.Is, ast.IsNot)):
            wanted = isinstance(op, ast.Is)
            if isinstance(right, Static) and right.value is None:
                if isinstance(left, Static):
                    self.program.guard(left)
                    return Static((left.value is None) is wanted)
                if not isinstance(left, Dynamic):
                    return Static(not wanted)
                if is_sure(left):
                    return Static((left.sample is None) is wanted)
                return Dynamic(f"({left.code} is {'' if wanted else 'not '}None)",
                               computed(lambda a: (a is None) is wanted, left.sample))  # fmt: skip
            if isinstance(left, Static) and isinstance(right, Static):
                return Static((self.program.guard(left) is self.program.guard(right)) is wanted)
            raise self.unknown("`is` of something other than None", node)
        if isinstance(op, (ast.In, ast.NotIn)):
            if isinstance(left, Static) and isinstance(right, Static):
                hit = self.program.guard(left) in self.program.guard(right)
                return Static(hit is isinstance(op, ast.In))
            tests = [self._compared(ast.Eq(), left, v, node) for v in self.parts(right, node)]
            code = " or ".join(self.code(t) for t in tests)
            sample = computed(lambda *s: any(s), *map(sample_of, tests))
            return Dynamic(f"({code})" if isinstance(op, ast.In) else f"(not ({code}))", sample)
        text, function = COMPARE[type(op)]
        if isinstance(left, Static) and isinstance(right, Static):
            slots = [v for v in (left, right) if v.path is not None and is_number_slot(v.value)]
            if not slots:
                return Static(bool(function(self.program.guard(left), self.program.guard(right))))
        x, y = self.dynamic(left), self.dynamic(right)
        if x.sample is None or y.sample is None:
            raise self.unknown("a comparison with None", node)
        return Dynamic(f"({x.code} {text} {y.code})", computed(lambda a, b: bool(function(a, b)), x.sample, y.sample))

    def truth(self, value: Value) -> bool | str:
        """Give whether a value is true, or the text that tells; `sampled` is then what it was."""
        self.sampled = UNKNOWN
        if isinstance(value, Static):
            if (value.path is not None and isinstance(value.value, (float, complex))) or (
                value.path is not None and isinstance(value.value, int) and abs(value.value) > SMALL
            ):
                value = self.program.slot(value)
            else:
                return bool(self.program.guard(value))
        if isinstance(value, (Group, Record)):
            return bool(value.items)
        if isinstance(value.sample, tuple) and value.keys is None:
            if not is_sure(value):
                raise self.unknown("whether there is anything in something of no fixed length")
            return bool(value.sample)
        if value.sample is None and is_sure(value):
            return False
        self.sampled = computed(bool, value.sample)
        if isinstance(value.sample, bool):
            return value.code
        if isinstance(value.sample, (int, float, complex)) or value.sample is UNKNOWN:
            return f"({value.code} != 0)"
        raise self.unknown(f"whether {_said(value)} is true")

    def _value_ifexp(self, node: ast.IfExp) -> Value:
        test = self.test(node.test)
        if isinstance(test, bool):
            return self.value(node.body if test else node.orelse)
        return self._chosen(test, self.sampled, lambda: self.value(node.body), lambda: self.value(node.orelse), node)

    # calls --------------------------------------------------------------------------------------------------------

    def _value_call(self, node: ast.Call) -> Value:
        if isinstance(node.func, ast.Attribute):
            if _is_super(node.func.value):
                return self._of_base(node)
            base = self.value(node.func.value)
            if isinstance(base, Static) and isinstance(base.value, Block) and node.func.attr == "report":
                self._give_up()
                return NONE
            if not isinstance(base, Static):
                return self._method(base, node)
            if isinstance(base.value, Block) and node.func.attr == "age" and base.value.ages is not None:
                wanted = self.value(node.args[0])
                name = self.program.guard(wanted) if isinstance(wanted, Static) else None
                return Static(self.program.age(base.value, name))
            function: Value = self.attribute(base, node.func.attr, node)
        else:
            function = self.value(node.func)
        if isinstance(function, Static) and function.value in (tuple, list, any, all, sum) and len(node.args) == 1:
            values = self.listed(node.args[0])
            if values is None:
                raise self.unknown("something of no fixed length", node)
            return self._over(function.value, values, node)
        if isinstance(function, Static) and function.value in (zip, enumerate, reversed, map):
            values = self.listed(node)
            assert values is not None
            return Group(tuple(values))
        given: list[Value] = []
        for one in node.args:
            if isinstance(one, ast.Starred):
                listed = self.listed(one.value)
                if listed is None:
                    raise self.unknown("something of no fixed length", node)
                given += listed
            else:
                given.append(self.value(one))
        words: dict[str, Value] = {}
        for word_ in node.keywords:
            if word_.arg is None:
                more = self.value(word_.value)
                if not isinstance(more, Record):
                    raise self.unknown("** of something that is not written out", node)
                words |= more.items
            else:
                words[word_.arg] = self.value(word_.value)
        return self.call(function, given, words, node)

    def _of_base(self, node: ast.Call) -> Value:
        """Call a method of a base class."""
        assert isinstance(node.func, ast.Attribute)
        owner, own = self.outer("__class__", node), self.env[self.function.__code__.co_varnames[0]]
        if not isinstance(own, Static):
            raise self.unknown("super() of something that is computed", node)
        found = getattr(super(owner, own.value), node.func.attr)
        given = [own, *(self.value(a) for a in node.args)]
        words = {str(k.arg): self.value(k.value) for k in node.keywords}
        return made(self.program, found.__func__, given, words, self.arrays)

    def _method(self, base: Value, node: ast.Call) -> Value:
        assert isinstance(node.func, ast.Attribute)
        name, sample = node.func.attr, sample_of(base)
        if name == "_replace" and isinstance(base, Dynamic) and hasattr(type(sample), "_fields"):
            simple = self.simple(base)
            changed = {str(k.arg): self.value(k.value) for k in node.keywords}
            parts = [changed.get(f) or Dynamic(f"{simple.code}.{f}", getattr(sample, f), base.sure)
                     for f in type(sample)._fields]  # fmt: skip
            return self._named(type(sample), parts, node)
        if name == "conjugate" and isinstance(sample, complex) and isinstance(base, Dynamic):
            return Dynamic(f"{base.code}.conjugate()", sample.conjugate())
        if name == "get" and isinstance(base, Record):
            return base.items.get(self.program.guard(self.value(node.args[0])), NONE)  # type: ignore[arg-type]
        own = _class(sample)
        method = getattr(own, name, None) if own is not None else None
        if isinstance(method, types.FunctionType):
            words = {str(k.arg): self.value(k.value) for k in node.keywords}
            return made(self.program, method, [base, *(self.value(a) for a in node.args)], words, self.arrays)
        raise self.unknown(f".{name}() of {_said(base)}", node)

    def _named(self, kind: Any, parts: Sequence[Value], node: ast.AST) -> Dynamic:
        values = [self.dynamic(p) for p in parts]
        if any(v.keys or v.parts for v in values):
            raise self.unknown("a mapping in a state", node)
        sample = UNKNOWN if any(v.sample is UNKNOWN for v in values) else kind(*(v.sample for v in values))
        name = self.program.name(kind, kind.__name__)
        return Dynamic(f"{name}({', '.join(v.code for v in values)})", sample, all(is_sure(v) for v in values))

    def call(self, function: Value, given: Sequence[Value], words: Mapping[str, Value], node: ast.AST) -> Value:
        """Call something."""
        if not isinstance(function, Static):
            raise self.unknown("a call of something that is computed", node)
        called = function.value
        if function.path is not None and not isinstance(called, types.MethodType):
            self.program.guard(function)
        if isinstance(called, Jit):
            return self._native(called, given, node)
        if called is power:
            return self._written("power", power, given)
        if isinstance(called, Draws):
            return self._drawn(function, given[0])
        if isinstance(called, Compiled):
            return self._compiled(function, given, node)
        if isinstance(called, partial):
            return self.call(Static(called.func), [*map(Static, called.args), *given],
                             {k: Static(v) for k, v in called.keywords.items()} | dict(words), node)  # fmt: skip
        if isinstance(called, types.MethodType):
            own = called.__self__
            path = None if function.path is None else function.path[:-1]
            if isinstance(own, Mapping) and called.__name__ == "get":
                return self._looked_up(Static(own, path), given[0], node)
            if (
                path is not None
                and function.path is not None
                and function.path[-1][0] == "attr"
                and own is not follow(function.path[:-1], self.program.roots)
            ):  # a method that another object has lent
                path = (*function.path, ("attr", "__self__"))
            if isinstance(own, type):
                path = None
            return made(self.program, called.__func__, [Static(own, path), *given], words, self.arrays)  # type: ignore[arg-type]
        if isinstance(called, types.BuiltinMethodType) and isinstance(called.__self__, Mapping):
            table = Static(called.__self__, None if function.path is None else function.path[:-1])
            if called.__name__ in ("items", "values", "keys"):
                self.program.guard(table)
                return Static(tuple(called()))
            if isinstance(given[0], Static):
                return Static(self.program.guard(table).get(*(self.program.guard(v) for v in given)))  # type: ignore[arg-type]
            return self._looked_up(table, given[0], node)
        if isinstance(called, types.FunctionType):
            return made(self.program, called, given, words, self.arrays)
        if isinstance(called, type) and is_twinned(called):
            called = twin(called)
        if isinstance(called, type) and issubclass(called, tuple) and hasattr(called, "_fields"):
            defaults = {k: Static(v) for k, v in called._field_defaults.items()}  # type: ignore[attr-defined]
            bound = dict(zip(called._fields, given, strict=False)) | dict(words)
            try:
                return self._named(called, [bound[f] if f in bound else defaults[f] for f in called._fields], node)
            except KeyError as error:
                raise self.unknown(f"{called.__name__} without {error}", node) from None
        if (
            callable(called)
            and not isinstance(called, (type, types.BuiltinFunctionType))
            and isinstance(getattr(type(called), "__call__", None), types.FunctionType)  # noqa: B004 - its function
        ):
            return made(self.program, type(called).__call__, [function, *given], words, self.arrays)  # type: ignore[arg-type]
        return self._builtin(called, list(given), words, node)

    def _written(self, name: str, function: Callable[..., Any], given: Sequence[Value]) -> Dynamic:
        values = [self.dynamic(v) for v in given]
        if name == "power":
            self.program.names["power"] = power
        code = f"{name}({', '.join(v.code for v in values)})"
        return Dynamic(code, computed(function, *(v.sample for v in values)))

    def _native(self, function: Jit, given: Sequence[Value], node: ast.AST) -> Dynamic:
        values = [self.dynamic(v) for v in given]
        samples = [np.copy(v.sample) if isinstance(v.sample, np.ndarray) else v.sample for v in values]
        sample = computed(function.py_func, *samples)
        name = self.program.name(function, "jit")
        return Dynamic(f"{name}({', '.join(v.code for v in values)})", _numbers(sample), sample is not UNKNOWN)

    def _drawn(self, draws: Static, k: Value) -> Dynamic:
        assert draws.path is not None
        name = self.program.draws.setdefault(draws.path, f"d{len(self.program.draws)}")
        self.program.words.add("drawn_")
        self.arrays.add(name)
        return Dynamic(f"drawn_({name}, n, {self.dynamic(k).code})", 0.5)

    def _compiled(self, function: Static, given: Sequence[Value], node: ast.AST) -> Dynamic:
        called = function.value
        if len(given) != 1 or called.symbol is None or function.path is None:
            raise self.unknown("a casadi function that is not compiled", node)
        values = [self.dynamic(v) for v in self.parts(given[0], node)]
        name = self.program.scratch(function.path)
        self.arrays.add(name)
        results = computed(called, tuple(v.sample for v in values))
        sample = (0.0,) * called.n_out if results is UNKNOWN else results
        code = f"{self.program.caller(called)}({', '.join([name, *(v.code for v in values)])})"
        return Dynamic(code, sample)

    def _over(self, function: Any, values: Sequence[Value], node: ast.AST) -> Value:
        if function in (tuple, list):
            return Group(tuple(values))
        if function is sum:
            samples = [sample_of(v) for v in values]
            if any(not isinstance(s, int) for s in samples):
                raise self.unknown("sum of numbers that are no whole ones", node)
            return Dynamic(
                f"({' + '.join(['0', *(f'int({self.code(v)})' for v in values)])})", reduce(operator.add, samples, 0)
            )
        tests = [self.truth(v) for v in values]
        stop = function is any
        if any(t is stop for t in tests):
            return Static(stop)
        left = [t for t in tests if isinstance(t, str)]
        if not left:
            return Static(not stop)
        return Dynamic(f"({(' or ' if stop else ' and ').join(left)})",
                       computed(lambda *s: function(s), *(sample_of(v) for v in values)))  # fmt: skip

    def _builtin(self, called: Any, given: list[Value], words: Mapping[str, Value], node: ast.AST) -> Value:
        if words:
            raise self.unknown(f"{getattr(called, '__name__', called)} with words", node)
        if called in (min, max) and len(given) == 1:
            given = self.parts(given[0], node)
        if called is len:
            base = given[0]
            if isinstance(base, Dynamic) and isinstance(base.sample, np.ndarray):
                return Dynamic(f"len({base.code})", len(base.sample))
            return Static(len(self.parts(base, node)))
        if called is isinstance:
            if not isinstance(given[0], Static) and not is_sure(given[0]):
                raise self.unknown("isinstance of something that is computed", node)
            return Static(isinstance(sample_of(given[0]), sample_of(given[1])))
        if called is getattr and isinstance(given[0], Static) and isinstance(given[1], Static):
            return self.attribute(given[0], given[1].value, node)
        fixed = [v for v in given if isinstance(v, Static)]
        if len(fixed) == len(given) and not any(v.path is not None and is_number_slot(v.value) for v in fixed):
            try:
                return Static(called(*(self.program.guard(v) for v in fixed)))
            except Exception as error:
                raise self.unknown(f"{type(error).__name__}: {error}", node) from None
        samples = [sample_of(v) for v in given]
        if called in (min, max):
            return self._extreme(called, given, node)
        if called is abs and isinstance(samples[0], (float, int)):
            return self._written("abs", abs, given)
        if called is float and isinstance(samples[0], (float, int)):
            return self._written("float", float, given)
        if called is bool:
            test = self.truth(given[0])
            return Static(test) if isinstance(test, bool) else Dynamic(f"({test})", self.sampled)
        if called is complex:
            return self._written("complex", complex, given)
        if called is round and len(given) > 1:
            raise self.unknown("round to digits", node)
        if called is int and isinstance(samples[0], bool):
            return self._written("int", int, given)
        name = word(called) if isinstance(called, (types.BuiltinFunctionType, type)) else None
        if name is not None:
            if name in TEXTS:
                self.program.words.add(name)
            return self._written(name, called, given)
        if (isinstance(called, types.BuiltinFunctionType) and getattr(called, "__module__", "") == "numpy") or (
            isinstance(called, np.ufunc)
        ):
            raise self.unknown(f"numpy.{called.__name__}", node)
        raise self.unknown(f"{getattr(called, '__qualname__', type(called).__name__)}()", node)

    def _extreme(self, called: Any, given: Sequence[Value], node: ast.AST) -> Value:
        """Write min and max out: the first of equal ones, as Python has it, NaN included."""
        values = [self.simple(self.dynamic(v)) for v in given]
        best = values[0]
        sign = "<" if called is min else ">"
        for one in values[1:]:
            sample = computed(called, best.sample, one.sample)
            if isinstance(sample, int) and not all(isinstance(v.sample, int) for v in (best, one)):
                sample = float(sample)
            code = f"({one.code} if {one.code} {sign} {best.code} else {best.code})"
            best = self.simple(Dynamic(code, sample)) if one is not values[-1] else Dynamic(code, sample)
        return best


FOLDED: dict[type, Callable[[Any, Any], Any]] = {
    ast.Pow: lambda a, b: a**b, ast.LShift: lambda a, b: a << b, ast.RShift: lambda a, b: a >> b,
}  # fmt: skip


def _class(sample: Any) -> type | None:
    """Give the class of a named tuple, or the dataclass that it stands for."""
    kind = type(sample)
    return getattr(kind, OF, kind) if hasattr(kind, "_fields") else None


def _reports(node: ast.stmt) -> bool:
    call = node.value if isinstance(node, ast.Expr) else None
    return isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute) and call.func.attr == "report"


def _reporting(statements: Sequence[ast.stmt]) -> bool:
    """Whether something is reported, whatever the statements before that find."""
    for one in statements:
        if _reports(one):
            return True
        if any(isinstance(n, (ast.Return, ast.Break, ast.Continue)) for n in ast.walk(one)):
            return False
    return False


def _is_super(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "super"


def _plain(value: Any) -> Any:
    try:
        return as_slot(value)
    except NotNative:
        return value


def _numbers(value: Any) -> Any:
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return tuple(_numbers(v) for v in value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def _alike(a: Any, b: Any) -> bool:
    return a is not UNKNOWN and b is not UNKNOWN and shape(a) == shape(b) and type(a) is type(b)


def _shapes(value: Dynamic) -> Any:
    return None if value.parts is None else tuple((p.keys, _shapes(p)) for p in value.parts)


def _said(value: Value) -> str:
    return type(sample_of(value)).__name__
