"""Expressions of a function, as known facts about their values."""

from __future__ import annotations

import ast
import inspect
import operator
import types
from collections.abc import Callable, Mapping
from dataclasses import is_dataclass, replace
from typing import Any

import numpy as np

from ..block.port import LONGEST
from ..kit.jit import power
from .translate import (
    BINARY,
    COMPARE,
    GIVEN_UP,
    SMALL,
    UNARY,
    is_number_slot,
    shape,
    specialise,
)
from .twins import ARITHMETIC, COMPARISONS, TRUTH, class_of, own_operator
from .value import (
    MADE_TEXT,
    NONE,
    UNKNOWN,
    Dynamic,
    Group,
    NotNative,
    Record,
    Static,
    Value,
    computed,
    is_sure,
    kind_of,
    sample_of,
)
from .ways import Ways


class Expressions(Ways):
    """Reads expressions without calls; see `Ways`."""

    def value(self, node: ast.expr) -> Value:
        """Read an expression."""
        method = getattr(self, f"_value_{type(node).__name__.lower()}", None)
        if method is None:
            raise self.unknown(f"{type(node).__name__.lower()}", node)
        result: Value = method(node)
        return result

    def _value_constant(self, node: ast.Constant) -> Value:
        return Static(node.value)

    def _value_joinedstr(self, node: ast.JoinedStr) -> Value:
        return MADE_TEXT

    def _value_name(self, node: ast.Name) -> Value:
        if node.id in self.env:
            return self.env[node.id]
        # A local name that is bound on one branch only. Without this check a global object of the same name would be
        # read.
        if node.id in self.function.__code__.co_varnames:
            raise self.unknown(f"{node.id} is not known on every path", node)
        return Static(self.outer(node.id, node))

    def _value_tuple(self, node: ast.Tuple | ast.List) -> Value:
        items: list[Value] = []
        for item in node.elts:
            if isinstance(item, ast.Starred):
                items += self.parts(self.value(item.value), item)
            else:
                items.append(self.value(item))
        if items and all(isinstance(v, Static) and v.path is None for v in items):
            return Static(tuple(v.value for v in items if isinstance(v, Static)))
        return Group(tuple(items))

    _value_list = _value_tuple

    def _value_dict(self, node: ast.Dict) -> Value:
        items: dict[str, Value] = {}
        for key, item in zip(node.keys, node.values, strict=True):
            if key is None:
                more = self.value(item)
                if isinstance(more, Dynamic) and more.keys is not None:
                    more = self.unfolded(more)
                if not isinstance(more, Record):
                    raise self.unknown("a mapping that is not written out", node)
                items |= more.items
                continue
            name = self.value(key)
            if not isinstance(name, Static) or not isinstance(name.value, str):
                raise self.unknown("a mapping whose keys are computed", node)
            items[self.program.guard(name)] = self.value(item)
        return Record(items)

    def _value_namedexpr(self, node: ast.NamedExpr) -> Value:
        self.assign(node.target, self.value(node.value))
        return self.env[node.target.id]

    def _value_attribute(self, node: ast.Attribute) -> Value:
        return self.attribute(self.value(node.value), node.attr, node)

    def attribute(self, base: Value, name: str, node: ast.AST) -> Value:
        """Read an attribute."""
        if isinstance(base, Static):
            try:
                result = getattr(base.value, name)
            except AttributeError as error:
                raise self.unknown(str(error), node) from None
            if base.path is None:
                return Static(result)
            return Static(result, (*base.path, ("attr", name)))
        if isinstance(base, Dynamic):
            fields = getattr(type(base.sample), "_fields", ())
            if name in fields and base.keys is None:
                base = self.simple(base)
                result = getattr(base.sample, name)
                return Dynamic(f"{base.code}.{name}", result, base.sure)
            cls = class_of(base.sample)
            if cls is not None and base.keys is None and hasattr(cls, name):
                result = inspect.getattr_static(cls, name)
                if isinstance(result, property) and isinstance(result.fget, types.FunctionType):
                    return specialise(self.program, result.fget, [base], {}, self.arrays)
                if not callable(result):
                    return Static(getattr(cls, name))
            # In a text that is not compiled such an object stays one of Python, with its own attributes.
            if not self.program.typed and hasattr(base.sample, "native") and hasattr(base.sample, name):
                return Dynamic(f"{base.code}.{name}", getattr(base.sample, name))
            if name in ("real", "imag") and isinstance(base.sample, (complex, float)):
                return Dynamic(f"{self.simple(base).code}.{name}", getattr(base.sample, name))
            if name in ("shape", "size") and isinstance(base.sample, np.ndarray):
                return Dynamic(f"{base.code}.{name}", getattr(base.sample, name), False)
        if isinstance(base, Group) and name in ("real", "imag"):
            raise self.unknown(f".{name} of a tuple", node)
        raise self.unknown(f".{name} of {kind_of(base)}", node)

    def _value_subscript(self, node: ast.Subscript) -> Value:
        base = self.value(node.value)
        if isinstance(node.slice, ast.Slice):
            return self._sliced(base, node.slice, node)
        index = self.value(node.slice)
        return self.item(base, index, node)

    def item(self, base: Value, index: Value, node: ast.AST) -> Value:
        """Read an item."""
        if isinstance(base, Dynamic) and base.keys is not None:
            base = self.unfolded(base)
        if isinstance(index, Static) and (result := self._fixed_item(base, index, node)) is not None:
            return result
        if isinstance(base, Static) and isinstance(base.value, Mapping):
            return self._table_value(base, index, node)
        keys = None
        if isinstance(base, Static) and isinstance(base.value, (list, tuple)):
            kinds = {tuple(sorted(v)) if isinstance(v, Mapping) else None for v in base.value}
            keys = kinds.pop() if len(kinds) == 1 else None
            if keys is not None and base.path is not None:
                self.program.guards[(*base.path, ("item", 0))] = ("keys", tuple(base.value[0]))
        table, position = self.dynamic(base), self.dynamic(index)
        if table.parts or table.sample is UNKNOWN:
            raise self.unknown("an item of something that is not a table", node)
        # numba needs one type for an item whose place is computed.
        if isinstance(table.sample, tuple) and len({shape(v) for v in table.sample}) != 1:
            raise self.unknown("an item of a tuple of several types", node)
        sample = computed(lambda a, k: a[k], table.sample, position.sample)
        if sample is UNKNOWN and isinstance(table.sample, tuple) and table.sample:
            sample = table.sample[0]
        code = f"{self.simple(table).code}[{position.code}]"
        if isinstance(sample, np.floating):
            code, sample = f"float({code})", float(sample)
        if isinstance(sample, np.integer):
            code, sample = f"int({code})", int(sample)
        return Dynamic(code, sample, True, keys)

    def _fixed_item(self, base: Value, index: Static, node: ast.AST) -> Value | None:
        """Read an item whose place is fixed; None: it is one of an array."""
        key = index.value
        if isinstance(base, Record):
            if key not in base.items:
                raise self.unknown(f"no {key!r} in a mapping", node)
            return base.items[self.program.guard(index)]
        if isinstance(base, Group) and isinstance(key, int):
            self.program.guard(index)
            if not -len(base.items) <= key < len(base.items):
                raise self.unknown(f"no item {key} of {len(base.items)}", node)
            return base.items[key]
        if isinstance(base, Static):
            self.program.guard(index)
            try:
                result = base.value[key]
            except (LookupError, TypeError) as error:
                raise self.unknown(f"{error!r}", node) from None
            if not isinstance(base.value, np.ndarray):
                return Static(result, None if base.path is None else (*base.path, ("item", key)))
        elif isinstance(base, Dynamic) and isinstance(base.sample, tuple) and isinstance(key, int):
            self.program.guard(index)
            simple = self.simple(base)
            if not -len(base.sample) <= key < len(base.sample):
                raise self.unknown(f"no item {key} of {len(base.sample)}", node)
            return self._part(simple, key % len(base.sample))
        return None

    def _table_value(self, table: Static, key: Value, node: ast.AST, default: Value | None = None) -> Dynamic:
        """Look up a computed key in a fixed mapping; if it is missing, use the `default` value or discard the tick."""
        entries = list(table.value.items())
        if len(entries) > LONGEST:
            raise self.unknown(f"a mapping of {len(entries)}, expected at most {LONGEST}", node)
        if table.path is not None:
            self.program.guard(table)
        key_value = self.simple(self.dynamic(key))
        name = f"look{len(self.program.functions)}"
        # Native code has no mappings, so a lookup is a chain of comparisons.
        lines = [f"def {name}(k):"]
        for k, v in entries:
            keys = k if isinstance(k, tuple) else (k,)
            items = [f"k[{i}]" for i in range(len(keys))] if isinstance(k, tuple) else ["k"]
            parts = [f"{item} == {self.code(Static(p))}" for item, p in zip(items, keys, strict=True)]
            lines += [f"    if {' and '.join(parts)}:", f"        return {self.code(Static(v))}"]
        last = GIVEN_UP if default is None else f"return {self.code(default)}"
        self.program.functions.append("\n".join([*lines, f"    {last}"]))
        sample = computed(lambda k: table.value[k], key_value.sample)
        return Dynamic(f"{name}({key_value.code})", entries[0][1] if sample is UNKNOWN else sample, default is None)

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
        # Numbers of a block are passed in, so that one text serves all its variants; only others are computed here.
        folded = len(both) == 2 and not any(v.path is not None and is_number_slot(v.value) for v in both)
        if folded and type(op) in (*BINARY, ast.Pow, ast.LShift, ast.RShift):
            function = BINARY[type(op)][1] if type(op) in BINARY else FOLDED[type(op)]
            try:
                return Static(function(*(self.program.guard(v) for v in both)))
            except NotNative as error:
                raise self.unknown(str(error), node) from None
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
        if isinstance(op, (ast.LShift, ast.RShift)) and all(_is_whole(sample_of(v)) for v in (left, right)):
            name = "left_" if isinstance(op, ast.LShift) else "right_"
            self.program.words.add(name)
            x, y = self.dynamic(left), self.dynamic(right)
            return Dynamic(f"{name}({x.code}, {y.code})", computed(FOLDED[type(op)], x.sample, y.sample))
        if type(op) not in BINARY:
            raise self.unknown(
                "** of whole or complex numbers" if isinstance(op, ast.Pow) else f"an operation {SIGNS[type(op)]}",
                node,
            )
        a, b = sample_of(left), sample_of(right)
        if isinstance(a, (tuple, list)) or isinstance(b, (tuple, list)):
            return self._joined_tuples(op, left, right, node)
        if isinstance(a, str) or isinstance(b, str):
            raise self.unknown("a text or a number that is rounded to digits in a calculation", node)
        text, function = BINARY[type(op)]
        x, y = self.dynamic(left), self.dynamic(right)
        sample = computed(function, x.sample, y.sample)
        if sample is UNKNOWN and isinstance(x.sample, float) and isinstance(y.sample, (float, int)):
            sample = x.sample
        if isinstance(sample, np.ndarray):
            raise self.unknown("arithmetic of whole arrays", node)
        integers = all(_is_whole(v.sample) for v in (x, y))
        # numba's whole numbers have 64 bits and wrap silently, Python's do not.
        wrapper = WRAPS.get(text, "") if integers and self.program.typed else ""
        # A change of sign cannot overflow in the range that `plus_` and `times_` leave.
        if text == "*" and integers and any(isinstance(v, Static) and abs(v.value) == 1 for v in (left, right)):
            wrapper = ""
        few = any(isinstance(v, Static) and abs(v.value) <= FEW for v in (left, right))
        if wrapper == "times_" or (wrapper and not few):
            self.program.words.add(wrapper)
            return Dynamic(f"{wrapper}({x.code}, {y.code})", sample)
        # Python rounds the quotient of two whole numbers once. Native code converts them to floats first, which is the
        # same only as long as both are exact.
        if text == "/" and integers and self.program.typed:
            self.program.words.add("exact_")
            x, y = (replace(v, code=f"exact_({v.code})") if _is_large(v) else v for v in (x, y))
        return Dynamic(f"({x.code} {text} {y.code})", sample, is_sure(x) and is_sure(y))

    def _check_operators(self, operators: str, *values: Value, node: ast.AST | None = None) -> None:
        """Refuse values of a class whose operators are not those of a tuple."""
        for value in values:
            kind: Any = type(sample_of(value))
            if (hasattr(kind, "_fields") or is_dataclass(kind)) and (name := own_operator(kind, operators)):
                raise self.unknown(f"{kind_of(value)}, which has {name} of its own", node)

    def _joined_tuples(self, op: ast.operator, left: Value, right: Value, node: ast.AST) -> Value:
        self._check_operators(ARITHMETIC, left, right, node=node)
        if isinstance(op, ast.Add):
            return Group((*self.parts(left, node), *self.parts(right, node)))
        if isinstance(op, ast.Mult) and isinstance(right, Static) and isinstance(right.value, int):
            return Group(tuple(self.parts(left, node)) * self.program.guard(right))
        raise self.unknown("arithmetic of tuples", node)

    def test(self, node: ast.expr) -> bool | str:
        """Read an expression whose truth value alone is needed; see `truth`."""
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            result = self.test(node.operand)
            if isinstance(result, bool):
                return not result
            self.sampled = computed(operator.not_, self.sampled)
            return f"(not {result})"
        if not isinstance(node, ast.BoolOp):
            return self.truth(self.value(node))
        stop = isinstance(node.op, ast.Or)
        first = self.test(node.values[0])
        remaining = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if isinstance(first, bool):
            return stop if first is stop else self.test(remaining)
        sampled, start, before = self.sampled, len(self.lines), dict(self.env)
        try:
            second: bool | str | None = self.test(remaining)
        except NotNative:
            second = None
        # An expression serves only if nothing has to be computed before it, and no name is bound in it.
        if second is not None and len(self.lines) == start and not self.ended and self.as_before(before):
            if isinstance(second, bool):
                self.sampled = sampled
                return stop if second is stop else first
            self.sampled = self._either(stop, sampled, self.sampled)
            return f"({first} {'or' if stop else 'and'} {second})"
        # Python computes the right side only if it is needed, so its lines must be inside a test: it is read again
        # there.
        del self.lines[start:]
        self.env, self.ended = before, False
        name = self._fresh()

        def long() -> Any:
            result = self.test(remaining)
            if not self.ended:
                self.emit(f"{name} = bool({result})")
            return result if isinstance(result, bool) else self.sampled

        branches: list[Callable[[], Any]] = [lambda: self.emit(f"{name} = {stop}"), long]
        pair = self._fork(first, sampled, branches[not stop], branches[stop])
        self.sampled = self._either(stop, sampled, pair[1] if stop else pair[0])
        return name

    @staticmethod
    def _either(stop: bool, first: Any, second: Any) -> Any:
        if first is not UNKNOWN and bool(first) is stop:
            return stop
        return computed(bool, second) if first is not UNKNOWN else UNKNOWN

    def _value_boolop(self, node: ast.BoolOp) -> Value:
        stop = isinstance(node.op, ast.Or)
        left = self.value(node.values[0])
        if isinstance(left, Dynamic) and isinstance(left.sample, bool):
            left = self.simple(left)
        test = self.truth(left)
        remaining = node.values[1] if len(node.values) == 2 else ast.BoolOp(node.op, node.values[1:])
        if isinstance(test, bool):
            return left if test is stop else self.value(remaining)
        sampled, first = self.sampled, self.simple(self.dynamic(left))
        test = self.truth(first)
        assert isinstance(test, str)
        branches: list[Callable[[], Value]] = [lambda: first, lambda: self.value(remaining)]
        return self._chosen(test, sampled, branches[not stop], branches[stop], node)

    def _value_compare(self, node: ast.Compare) -> Value:
        if any(map(may_raise, node.comparators[1:])):
            return self._in_turn(node)
        left = self.value(node.left)
        result: Value | None = None
        for op, right_node in zip(node.ops, node.comparators, strict=True):
            right = self.value(right_node)
            if len(node.ops) > 1 and isinstance(right, Dynamic):
                right = self.simple(right)
            comparison = self._compared(op, left, right, node)
            if result is None or (isinstance(result, Static) and result.value is True):
                result = comparison
            elif isinstance(result, Static):
                return result
            elif isinstance(comparison, Static):
                if comparison.value is False:
                    return comparison
            else:
                a, b = self.dynamic(result), self.dynamic(comparison)
                result = Dynamic(f"({a.code} and {b.code})", computed(lambda p, q: p and q, a.sample, b.sample))
            left = right
        assert result is not None
        return result

    def _in_turn(self, node: ast.Compare) -> Value:
        """Translate a chained comparison; later terms are computed only if the earlier comparisons are true."""
        # With spaces in them, these are no names of the function.
        first, second = (f"{side} of {self._fresh()}" for side in ("left", "right"))
        self.env[first], self.env[second] = (self._held(self.value(v)) for v in (node.left, node.comparators[0]))
        middle = ast.Name(second, ast.Load())
        head = ast.Compare(ast.Name(first, ast.Load()), node.ops[:1], [middle])
        remaining = ast.Compare(middle, node.ops[1:], node.comparators[1:])
        result = self.value(ast.copy_location(ast.BoolOp(ast.And(), [head, remaining]), node))
        for name in (first, second):
            self.env.pop(name, None)
        return result

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
                return Dynamic(
                    f"({left.code} is {'' if wanted else 'not '}None)",
                    computed(lambda a: (a is None) is wanted, left.sample),
                )
            if isinstance(left, Static) and isinstance(right, Static):
                return Static((self.program.guard(left) is self.program.guard(right)) is wanted)
            # Native code has values without an identity.
            raise self.unknown("`is` of something other than None", node)
        if isinstance(op, (ast.In, ast.NotIn)):
            if isinstance(left, Static) and isinstance(right, Static):
                hit = self.program.guard(left) in self.program.guard(right)
                return Static(hit is isinstance(op, ast.In))
            tests = [self._compared(ast.Eq(), left, v, node) for v in self.parts(right, node)]
            code = " or ".join(self.code(t) for t in tests)
            sample = computed(lambda *s: any(s), *map(sample_of, tests))
            return Dynamic(f"({code})" if isinstance(op, ast.In) else f"(not ({code}))", sample)
        self._check_operators(COMPARISONS, left, right, node=node)
        text, function = COMPARE[type(op)]
        if isinstance(left, Static) and isinstance(right, Static):
            slots = [v for v in (left, right) if v.path is not None and is_number_slot(v.value)]
            if not slots:
                return Static(bool(function(self.program.guard(left), self.program.guard(right))))
        x, y = map(self.dynamic, (left, right))
        if (x.sample is None or y.sample is None) and not self.program.inferred:
            raise self.unknown("a comparison with None", node)
        sample = computed(lambda a, b: bool(function(a, b)), x.sample, y.sample)
        for integer, real, form in ((x, y, "{} {} 0.0"), (y, x, "0.0 {1} {0}")):
            if self.program.typed and _is_whole(integer.sample) and type(real.sample) is float and _is_large(integer):
                self.program.words.add("apart_")
                return Dynamic(f"({form.format(f'apart_({integer.code}, {real.code})', text)})", sample)
        return Dynamic(f"({x.code} {text} {y.code})", sample)

    def truth(self, value: Value) -> bool | str:
        """Return whether a value is true, or the expression that decides it; `sampled` is then its last value."""
        self.sampled = UNKNOWN
        if isinstance(value, Static):
            # Such a number is an argument, also where only its truth counts: as a guard each value of a study would
            # need a text.
            if (value.path is not None and isinstance(value.value, (float, complex))) or (
                value.path is not None and isinstance(value.value, int) and abs(value.value) > SMALL
            ):
                value = self.program.slot(value)
            else:
                return bool(self.program.guard(value))
        if isinstance(value, (Group, Record)):
            return bool(value.items)
        self._check_operators(TRUTH, value)
        if isinstance(value.sample, tuple) and value.keys is None:
            if not is_sure(value) and self.program.inferred:
                self.sampled = bool(value.sample)
                return f"({value.code} is not None)"
            if not is_sure(value):
                raise self.unknown("whether there is anything in something of no fixed length")
            return bool(value.sample)
        if value.sample is None and is_sure(value):
            return False
        self.sampled = computed(bool, value.sample)
        guard = ""
        if self.program.inferred and not is_sure(value):  # None is not true, but neither is it 0
            value = self.simple(value)
            guard = f"{value.code} is not None and "
        if isinstance(value.sample, bool):
            return f"({guard}{value.code})" if guard else value.code
        if isinstance(value.sample, (int, float, complex)) or value.sample is UNKNOWN:
            return f"({guard}{value.code} != 0)"
        raise self.unknown(f"whether {kind_of(value)} is true")

    def _value_ifexp(self, node: ast.IfExp) -> Value:
        test = self.test(node.test)
        if isinstance(test, bool):
            return self.value(node.body if test else node.orelse)
        return self._chosen(test, self.sampled, lambda: self.value(node.body), lambda: self.value(node.orelse), node)


def may_raise(node: ast.expr) -> bool:
    """Return whether an expression may raise, or bind a name."""
    raising = (ast.Call, ast.Div, ast.FloorDiv, ast.Mod, ast.Pow, ast.NamedExpr)
    return any(
        isinstance(n, raising) or (isinstance(n, ast.Subscript) and not isinstance(n.slice, ast.Constant))
        for n in ast.walk(node)
    )


def _is_whole(sample: Any) -> bool:
    return isinstance(sample, int) and not isinstance(sample, bool)


FEW = 1 << 32  # no sum of so few leaves 64 bits


def _is_large(value: Dynamic) -> bool:
    """Return whether a whole number may be one that a float rounds."""
    return not (value.code.lstrip("-").isdigit() and abs(int(value.code)) <= FEW)


SIGNS = {ast.MatMult: "@", ast.LShift: "<<", ast.RShift: ">>", ast.Pow: "**"}
WRAPS = {"+": "plus_", "-": "minus_", "*": "times_"}
FOLDED: dict[type, Callable[[Any, Any], Any]] = {
    ast.Pow: lambda a, b: a**b,
    ast.LShift: lambda a, b: a << b,
    ast.RShift: lambda a, b: a >> b,
}
