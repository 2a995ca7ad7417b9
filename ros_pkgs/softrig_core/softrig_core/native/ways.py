"""The state of a function's text at a line: names, values as text, and the branches that a test splits and joins."""

from __future__ import annotations

import ast
import builtins
import math
import types
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ..block.port import LONGEST
from .translate import (
    GIVEN_UP,
    SMALL,
    Program,
    as_slot,
    outside,
    parsed,
    shape,
)
from .value import (
    NONE,
    UNKNOWN,
    Dynamic,
    GivesUp,
    Group,
    NotNative,
    Record,
    Static,
    Value,
    forms,
    is_sure,
    mapped,
)


class Ways:
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
        self.ended = False  # the rest of the code is never reached
        self._temporaries = 0
        self._inside = 0  # loops of native code
        self.sampled: Any = UNKNOWN  # value that the newest test read, by the samples
        self.left = False  # whether the branch of the last `if` that the samples take leaves the function or the loop

    def unknown(self, construct: str, node: ast.AST | None = None) -> NotNative:
        """Describe what native code does not support, and where."""
        line = self.function.__code__.co_firstlineno + getattr(node, "lineno", 1) - 1
        return NotNative(f"{self.function.__module__}.{self.function.__qualname__}, line {line}: {construct}")

    def emit(self, line: str) -> None:
        """Add a line."""
        self.lines.append(line)

    def _fresh(self) -> str:
        self._temporaries += 1
        return f"t{self._temporaries - 1}_"

    def as_before(self, env: Mapping[str, Value]) -> bool:
        """Return whether no expression has bound a name in the meantime, as `:=` does."""
        return self.env.keys() == env.keys() and all(self.env[name] is value for name, value in env.items())

    def temporary(self, code: str) -> str:
        """Return a value a name."""
        name = self._fresh()
        self.emit(f"{name} = {code}")
        return name

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
        """Return a value as one that is computed."""
        if isinstance(value, Dynamic):
            return value
        if isinstance(value, Static):
            kind: Any = type(value.value)
            if value.path is not None and hasattr(kind, "_fields"):
                fields = zip(kind._fields, value.value, strict=True)
                return self.named(kind, [Static(v, (*value.path, ("attr", f))) for f, v in fields], None)
            code = self.code(value)
            return Dynamic(code, np.array(value.value) if code in self.arrays else _plain(value.value))
        if isinstance(value, Record):
            keys = tuple(sorted(value.items))
            parts = tuple(self.dynamic(value.items[k]) for k in keys)
        else:
            keys, parts = None, tuple(self.dynamic(v) for v in value.items)
        # A mapping becomes a tuple without keys, so what is known of its parts has to be remembered beside it.
        nested = keys is not None or any(p.keys or p.parts for p in parts)
        sample = tuple(p.sample for p in parts)
        return Dynamic(self.code(value), sample, is_sure(value), keys, parts if nested else None)

    def named(self, kind: Any, parts: Sequence[Value], node: ast.AST | None) -> Dynamic:
        """Create a named tuple of its parts."""
        values = [self.dynamic(p) for p in parts]
        if any(v.keys or v.parts for v in values):
            raise self.unknown("a mapping in a state", node)
        sample = UNKNOWN if any(v.sample is UNKNOWN for v in values) else kind(*(v.sample for v in values))
        name = self.program.name(kind, kind.__name__)
        return Dynamic(f"{name}({', '.join(v.code for v in values)})", sample, all(is_sure(v) for v in values))

    def _literal(self, value: Static) -> str:
        result = value.value
        # Numbers and tables of a block are arguments of the text, so one compiled text serves all values of a study.
        # Small integers, texts and booleans are literals and guarded: they decide branches and lengths of loops.
        if value.path is not None and (
            isinstance(result, (float, complex, np.ndarray, np.floating, list))
            or (isinstance(result, tuple) and result)
            or (isinstance(result, int) and abs(result) > SMALL)
        ):
            try:
                slot = self.program.slot(value)
            except NotNative as error:
                raise self.unknown(str(error)) from None
            if isinstance(slot.sample, np.ndarray):
                self.arrays.add(slot.code)
            return slot.code
        self.program.guard(value)
        if result is None or isinstance(result, bool):
            return repr(result)
        if isinstance(result, int):
            return int.__repr__(result)  # a member of an enumeration shows its name
        if isinstance(result, float):
            if math.isfinite(result):
                return repr(float(result))
            # NaN and infinity have no literal in Python.
            return "float_nan" if result != result else "float_inf" if result > 0 else "float_less"
        if isinstance(result, complex):
            return f"complex({float(result.real)!r}, {float(result.imag)!r})"
        if isinstance(result, (tuple, list)):
            try:
                return self.program.name(as_slot(result), "table") if result else "()"
            except NotNative as error:
                raise self.unknown(str(error)) from None
        if isinstance(result, np.ndarray):
            return self.program.name(result, "array")
        raise self.unknown(f"{type(result).__name__} as a value")

    def simple(self, value: Dynamic) -> Dynamic:
        """Return a name for a value, so that it is computed only once."""
        # A name, or an item at a fixed place, costs nothing when it is read again.
        if value.code.replace("_", "").replace(".", "").replace("[", "").replace("]", "").isalnum():
            return value
        return replace(value, code=self.temporary(value.code))

    def outer(self, name: str, node: ast.AST | None = None) -> Any:
        """Return the object that the function finds under a name outside of itself."""
        try:
            return outside(self.function, name)
        except LookupError:
            raise self.unknown(f"{name} is not known", node) from None

    def of_builtins(self, node: ast.expr) -> str:
        """Return the name of a function of Python's own that is called; empty: it is another one."""
        # A module or a local name may hide Python's function of that name.
        name = node.id if isinstance(node, ast.Name) and node.id not in self.env else ""
        builtin = getattr(builtins, name, None)
        return name if builtin is not None and self.outer(name, node) is builtin else ""

    def unfolded(self, value: Dynamic) -> Record:
        """Return a mapping, which a function has returned as its parts, in one piece."""
        assert value.keys is not None
        base = self.simple(value)
        return Record({key: self._part(base, k) for k, key in enumerate(value.keys)})

    def _part(self, base: Dynamic, k: int) -> Dynamic:
        code = f"{base.code}[{k}]"
        if base.parts is not None:
            part: Dynamic = base.parts[k]
            return replace(part, code=code, sure=part.sure and base.sure)
        sample = base.sample[k] if base.sample is not UNKNOWN else UNKNOWN
        return Dynamic(code, sample, base.sure)

    def parts(self, value: Value, node: ast.AST) -> list[Value]:
        """Return the parts of a value of fixed length."""
        if isinstance(value, Group):
            return list(value.items)
        if isinstance(value, Static) and isinstance(value.value, (tuple, list)):
            # The text is written for each part, so it fits only values of this length.
            if value.path is not None:
                self.program.guards[(*value.path, ("len", None))] = ("int", len(value.value))
            return [
                Static(v, None if value.path is None else (*value.path, ("item", k))) for k, v in enumerate(value.value)
            ]
        if isinstance(value, Static) and isinstance(value.value, (Mapping, range)):
            if value.path is not None:
                self.program.guard(value)
            return [Static(k) for k in value.value]
        known = isinstance(value, Dynamic) and (value.sure or self.program.inferred)
        if known and isinstance(value, Dynamic) and value.keys is None and isinstance(value.sample, tuple):
            if len(value.sample) > LONGEST:
                raise self.unknown(f"a tuple of {len(value.sample)}, expected at most {LONGEST}", node)
            base = self.simple(value)
            return [self._part(base, k) for k in range(len(value.sample))]
        raise self.unknown("something whose length is not fixed", node)

    def assign(self, target: ast.expr, value: Value, apart: bool = False) -> None:
        """Bind a value to a name or to names; `apart`: to names of a list, which are separate from those around it."""
        if isinstance(target, ast.Name):
            self.env[target.id] = self._held(value) if apart else self._bound(f"v_{target.id}", value)
        elif isinstance(target, (ast.Tuple, ast.List)):
            parts = self.parts(value, target)
            starred = [k for k, t in enumerate(target.elts) if isinstance(t, ast.Starred)]
            if starred:
                star, after = starred[0], len(target.elts) - starred[0] - 1
                parts = [*parts[:star], Group(tuple(parts[star : len(parts) - after])), *parts[len(parts) - after :]]
            if len(parts) != len(target.elts):
                raise self.unknown(f"{len(parts)} values for {len(target.elts)} names", target)
            # All values are stored before any name is bound, as `a, b = b, a` needs it.
            parts = [self._held(p) for p in parts]
            for name, item in zip(target.elts, parts, strict=True):
                self.assign(name.value if isinstance(name, ast.Starred) else name, item, apart)
        elif isinstance(target, ast.Subscript):
            self._written_into(target, value)
        else:
            raise self.unknown("an assignment to a part of something", target)

    def _written_into(self, target: ast.Subscript, value: Value) -> None:
        """Write into an array; values that were read from it before are stored under names of their own."""
        table, position = self.value(target.value), self.dynamic(self.value(target.slice))
        if not isinstance(table, Dynamic) or not isinstance(table.sample, np.ndarray) or table.sample.ndim != 1:
            raise self.unknown("an assignment to a part of something", target)
        self.emit(f"{self.simple(table).code}[{position.code}] = {self.code(value)}")

    def value(self, node: ast.expr) -> Value:
        """Read an expression."""
        raise NotImplementedError

    def _held(self, value: Value) -> Value:
        """Return a value that does not change when names are bound again."""
        if isinstance(value, Dynamic):
            return replace(value, code=self.temporary(value.code))
        return value if isinstance(value, Static) else mapped(value, lambda k, v: self._held(v))

    def _bound(self, name: str, value: Value) -> Value:
        if isinstance(value, Static):
            return value
        result = value if isinstance(value, Dynamic) else None
        if isinstance(value, Group):
            with suppress(NotNative):
                result = self.dynamic(value)
        if result is None or (result.parts and isinstance(value, Group)):
            stored = self._held(value) if isinstance(value, Record) else value
            return mapped(stored, lambda k, v: self._bound(f"{name}__{k}", v))  # type: ignore[arg-type]
        self.emit(f"{name} = {result.code}")
        return replace(result, code=name)

    def has_one_name(self, name: str) -> bool:
        """Return whether no other name of this function refers to the same object, as far as can be read."""
        # Each use of the name has to be one that reads or copies the list; any other, such as an argument of a call,
        # may store it under another name.
        tree = parsed(self.function)
        if name in {a.arg for a in ast.walk(tree) if isinstance(a, ast.arg)}:
            return False
        values: list[ast.expr] = []
        uses = dict.fromkeys((n for n in ast.walk(tree) if isinstance(n, ast.Name) and n.id == name), False)
        for node in ast.walk(tree):
            inner: list[Any] = []
            if isinstance(node, ast.Assign) and len(node.targets) == 1:
                pairs = [(target, value) for target, value in _pairs(node.targets[0], node.value) if target in uses]
                values, inner = [*values, *(value for _, value in pairs)], [target for target, _ in pairs]
            elif isinstance(node, ast.AnnAssign) and node.target in uses and node.value is not None:
                values, inner = [*values, node.value], [node.target]
            elif isinstance(node, (ast.AugAssign, ast.For, ast.comprehension)):
                inner = [node.target if isinstance(node, ast.AugAssign) else node.iter]
            elif isinstance(node, (ast.Attribute, ast.Subscript, ast.Starred, ast.Return)):
                inner = [node.value]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in COPYING:
                inner = node.args
            elif isinstance(node, (ast.Compare, ast.BinOp)):
                inner = [node.left, *node.comparators] if isinstance(node, ast.Compare) else [node.left, node.right]
            uses |= dict.fromkeys((n for n in inner if n in uses), True)
        return all(uses.values()) and all(map(_is_new, values))

    def _give_up(self) -> None:
        self.emit(GIVEN_UP)
        self.ended = True

    def _fork(self, test: str, used: Any, if_true: Callable[[], Any], if_false: Callable[[], Any]) -> tuple[Any, Any]:
        """Write both branches of a test, and merge the known facts after them."""
        used = used if used is UNKNOWN else bool(used)
        before, lines = dict(self.env), self.lines
        branches: list[tuple[list[str], dict[str, Value], bool]] = []
        results = []
        aside = self.program.aside
        for branch, wanted in ((if_true, True), (if_false, False)):
            self.env, self.lines, self.ended = dict(before), [], False
            self.program.aside, returned = aside or used is (not wanted), len(self.returned)
            try:
                results.append(branch())
            except GivesUp:
                results.append(None)
                self._give_up()
            except NotNative as reason:
                # As far as is known the samples take this branch, so it has to be translated.
                if not aside and used is not (not wanted):
                    raise
                self.program.seldom.append(str(reason))
                # What was written of this branch before the unsupported line is not needed, since the whole branch
                # discards its tick.
                self.env, self.lines = dict(before), []
                del self.returned[returned:]
                results.append(None)
                self._give_up()
            finally:
                self.program.aside = aside
            branches.append((self.lines, self.env, self.ended))
        (then, env_then, over_then), (orelse, env_else, over_else) = branches
        self.left = used is not UNKNOWN and (over_then if used else over_else)
        if over_then and over_else:
            # Nothing follows, so it does not matter which one remains.
            env = env_then
        elif over_then or over_else:
            env = env_else if over_then else env_then
        else:
            env = self._joined(env_then, env_else, then, orelse, used)
        self.lines, self.env, self.ended = lines, env, over_then and over_else
        self.emit(f"if {test}:")
        self.lines += [f"    {line}" for line in then or ["pass"]]
        if orelse:
            self.emit("else:")
            self.lines += [f"    {line}" for line in orelse]
        return results[0], results[1]

    def _joined(
        self, env_then: dict[str, Value], env_else: dict[str, Value], then: list[str], orelse: list[str], used: Any
    ) -> dict[str, Value]:
        env: dict[str, Value] = {}
        for name in {**env_then, **env_else}:
            a, b = env_then.get(name), env_else.get(name)
            if a is None or b is None:
                result = a or b
                assert result is not None
                if isinstance(result, Dynamic):
                    # A name bound on one branch alone may have no value, so its type is not certain.
                    env[name] = replace(result, sure=False)
                continue
            joined = self._join(f"v_{name}", a, b, then, orelse, used)
            if joined is not None:
                env[name] = joined
        return env

    def _join(self, name: str, a: Value, b: Value, then: list[str], orelse: list[str], used: Any) -> Value | None:
        if a is b or same(a, b) or (isinstance(a, Static) and isinstance(b, Static) and a.value is b.value):
            return a
        if isinstance(a, Group) and isinstance(b, Group) and len(a.items) == len(b.items):
            parts = [
                self._join(f"{name}__{k}", x, y, then, orelse, used)
                for k, (x, y) in enumerate(zip(a.items, b.items, strict=True))
            ]
            return None if None in parts else Group(tuple(p for p in parts if p is not None))
        if isinstance(a, Record) and isinstance(b, Record) and a.items.keys() == b.items.keys():
            items = {k: self._join(f"{name}__{k}", a.items[k], b.items[k], then, orelse, used) for k in a.items}
            return None if None in items.values() else Record({k: v for k, v in items.items() if v is not None})
        values = []
        for value, lines in ((a, then), (b, orelse)):
            self.lines = lines
            try:
                result = self.dynamic(value)
            except NotNative:
                return None
            if result.code != name:
                lines.append(f"{name} = {result.code}")
            values.append(result)
        with suppress(NotNative):
            return self._one_of(name, values[0], values[1], used)
        return None

    def _one_of(self, code: str, x: Dynamic, y: Dynamic, used: Any, node: ast.AST | None = None) -> Dynamic:
        if (x.keys, forms(x)) != (y.keys, forms(y)):
            raise self.unknown("answers of several forms", node)
        # The samples have taken this branch, so its sample is the one that occurs.
        first, second = (y, x) if used is False else (x, y)
        sample = second.sample if first.sample is UNKNOWN else first.sample
        return replace(first, code=code, sample=sample, sure=is_sure(x) and is_sure(y) and alike(x.sample, y.sample))

    def _chosen(
        self, test: str, used: Any, if_true: Callable[[], Value], if_false: Callable[[], Value], node: ast.AST
    ) -> Value:
        """Write a choice of two values; only the selected one is computed."""
        start, before = len(self.lines), dict(self.env)
        try:
            a: Value | None = if_true()
            b = if_false() if not self.ended else None
        # One of the two is not known; `_fork` finds out whether it is the branch that is taken.
        except NotNative:
            a = b = None
        if a is not None and b is not None and not self.ended and len(self.lines) == start and self.as_before(before):
            if isinstance(a, Static) and isinstance(b, Static) and same(a, b):
                return a
            x, y = self.dynamic(a), self.dynamic(b)
            if len(self.lines) == start:
                return self._one_of(f"({x.code} if {test} else {y.code})", x, y, used, node)
        # Statements that one of the values needs may run only if it is selected: both are read again, each within its
        # branch.
        del self.lines[start:]
        self.env, self.ended = before, False
        name = self._fresh()

        def way(read: Callable[[], Value]) -> Dynamic | None:
            data = read()
            if self.ended:
                return None
            done = self.dynamic(data)
            self.emit(f"{name} = {done.code}")
            return done

        x_, y_ = self._fork(test, used, lambda: way(if_true), lambda: way(if_false))
        if x_ is None or y_ is None:
            done = x_ or y_
            return NONE if done is None else replace(done, code=name)
        return self._one_of(name, x_, y_, used, node)


#: functions that do not keep the list that they are given
COPYING = ("len", "tuple", "list", "sum", "min", "max", "any", "all", "zip", "enumerate", "reversed", "sorted", "map")


def _pairs(target: ast.expr, value: ast.expr) -> list[tuple[ast.expr, ast.expr]]:
    """Return the targets of an assignment, and their values."""
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple) and len(target.elts) == len(value.elts):
        return list(zip(target.elts, value.elts, strict=True))
    return [(target, value)]


def _is_new(node: ast.expr) -> bool:
    """Return whether an expression makes a new list or tuple without other references."""
    if isinstance(node, ast.BinOp):
        return isinstance(node.op, (ast.Add, ast.Mult))
    if isinstance(node, ast.Subscript):
        return isinstance(node.slice, ast.Slice)
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id in COPYING
    return isinstance(node, (ast.List, ast.ListComp, ast.Tuple, ast.Constant))


def _plain(value: Any) -> Any:
    try:
        return as_slot(value)
    except NotNative:
        return value


def same(a: Value, b: Value) -> bool:
    """Return whether two values are one; those with arrays in their samples count as two.

    Numbers that are equal in Python may differ here: 0.0 and -0.0, 1 and True.
    """
    try:
        return a == b and repr(a) == repr(b)
    except ValueError:
        return False


def alike(a: Any, b: Any) -> bool:
    """Return whether two samples are known, and of the same type to their leaves."""
    return a is not UNKNOWN and b is not UNKNOWN and shape(a) == shape(b) and type(a) is type(b)
