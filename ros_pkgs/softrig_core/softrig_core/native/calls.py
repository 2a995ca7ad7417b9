"""Calls in a function: of methods of its block, of objects made in `setup`, of the standard library."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import operator
import types
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial, reduce
from typing import Any

import numpy as np

from ..block.block import Block
from ..block.port import LONGEST
from ..kit.compiled import Compiled
from ..kit.draws import Draws
from ..kit.jit import Jit, power
from ..kit.newest import Newest
from .expressions import Expressions, may_raise
from .reports import CONVERSIONS, EXACT, spec_of, wording
from .translate import (
    GIVEN_UP,
    NUMBERS,
    TURNS,
    follow,
    is_number_slot,
    specialise,
)
from .twins import OF, class_of, is_twinned, twin, unpacked
from .value import (
    MADE_TEXT,
    NONE,
    UNKNOWN,
    Dynamic,
    GivesUp,
    Group,
    NotNative,
    Path,
    Record,
    Static,
    Value,
    computed,
    is_made_text,
    is_sure,
    kind_of,
    sample_of,
)
from .words import TEXTS, word

# In place of a sample for which a function raises: the functions of `math` are defined here.
TAME = 0.5


#: Methods of objects that can change which leave them as they are; other methods are not evaluated at translation.
READING: dict[type, str] = {
    list: "index count copy",
    dict: "get keys values items copy",
    types.MappingProxyType: "get keys values items copy",
    set: "copy union intersection difference issubset issuperset isdisjoint",
    np.ndarray: "sum mean min max argmin argmax any all copy item tolist dot astype reshape ravel flatten transpose "
    "cumsum prod round searchsorted trace nonzero",
}
#: Modules and built-in functions that read or change what is outside of the program: not evaluated at translation.
WORLD = frozenset(
    [
        "time",
        "posix",
        "io",
        "_io",
        "sys",
        "_thread",
        "gc",
        "_random",
        "uuid",
        "datetime",
        "_datetime",
        "_socket",
        "signal",
    ]
)
OUTSIDE = frozenset(
    [print, input, open, exec, eval, id, setattr, delattr, globals, locals, vars, breakpoint, __import__]
)
FIXED = (types.ModuleType, type, str, bytes, int, float, complex, tuple, frozenset, range, np.generic)  # cannot change


class Calls(Expressions):
    """Reads calls, and lists that are iterated over; see `Ways`."""

    def listed(self, node: ast.expr) -> list[Value] | None:
        """Return the values that a loop iterates over if their number is fixed; None otherwise."""
        if isinstance(node, ast.Call) and (name := self.of_builtins(node.func)):
            if name == "range":
                ends = [self.value(a) for a in node.args]
                if all(isinstance(v, Static) for v in ends):
                    turns = range(*(self.program.guard(v) for v in ends if isinstance(v, Static)))
                    # A longer one becomes a loop of native code.
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
            if name in ("enumerate", "reversed"):
                result = self.listed(node.args[0])
                if result is None or name == "reversed":
                    return result and result[::-1]
                begin: Any = self.program.guard(self.value(node.args[1])) if len(node.args) > 1 else 0  # type: ignore[arg-type]
                return [Group((Static(k), v)) for k, v in enumerate(result, begin)]
            if name == "map" and len(node.args) == 2:
                result = self.listed(node.args[1])
                function = self.value(node.args[0])
                return None if result is None else [self.call(function, [v], {}, node) for v in result]
        if isinstance(node, (ast.ListComp, ast.GeneratorExp)):
            group = self._value_listcomp(node)
            return list(group.items) if isinstance(group, Group) else self.parts(group, node)
        value = self.value(node)
        if isinstance(value, Dynamic) and isinstance(value.sample, np.ndarray):
            return None
        return self.parts(value, node)

    def _value_listcomp(self, node: ast.ListComp | ast.GeneratorExp) -> Value:
        items = self._turns(node, lambda: self.value(node.elt))
        if all(isinstance(v, Static) and v.path is None for v in items):
            return Static(tuple(v.value for v in items if isinstance(v, Static)))
        return Group(tuple(items))

    def _value_dictcomp(self, node: ast.DictComp) -> Value:
        pairs = self._turns(node, lambda: Group((self.value(node.key), self.value(node.value))))
        results: dict[str, Value] = {}
        for pair in pairs:
            assert isinstance(pair, Group)
            key, value = pair.items
            if not isinstance(key, Static) or not isinstance(key.value, str):
                raise self.unknown("a mapping whose keys are computed", node)
            results[self.program.guard(key)] = value
        return Record(results)

    def _turns(self, node: ast.ListComp | ast.GeneratorExp | ast.DictComp, read: Callable[[], Value]) -> list[Value]:
        """Iterate over the parts of a list or mapping; `read` returns one of them."""
        items: list[Value] = []
        outer = dict(self.env)
        # `:=` binds a name around the list, and the names around it are restored after the list.
        if any(isinstance(n, ast.NamedExpr) for n in ast.walk(node)):
            raise self.unknown("`:=` in a list", node)

        def turn(level: int) -> None:
            if level == len(node.generators):
                items.append(self._held(read()) if self._inside else read())
                return
            generator = node.generators[level]
            values = self.listed(generator.iter)
            if values is None:
                raise self.unknown("a list of no fixed length", node)
            for value in values:
                self.assign(generator.target, value, apart=True)
                tests = [self.test(t) for t in generator.ifs]
                if any(isinstance(t, str) for t in tests):
                    raise self.unknown("a list whose length is computed", node)
                if all(tests):
                    # The target is bound to another value in the next turn, so what was read gets names of its own.
                    before = len(items)
                    turn(level + 1)
                    items[before:] = [self._held(v) for v in items[before:]]

        turn(0)
        self.env = outer
        return items

    _value_generatorexp = _value_listcomp

    def _value_call(self, node: ast.Call) -> Value:
        if isinstance(node.func, ast.Attribute):
            if _is_super(node.func.value):
                return self._of_base(node)
            base = self.value(node.func.value)
            if isinstance(base, Static) and isinstance(base.value, Block) and node.func.attr == "report":
                return self._reported(base, node)
            if isinstance(base, Static) and self.program.inferred and hasattr(base.value, "native"):
                base = self._as_native(base)
            if not isinstance(base, Static):
                return self._method(base, node)
            if isinstance(base.value, Block) and node.func.attr == "age" and base.value.ages is not None:
                return self._age(base.value, self.value(node.args[0]))
            function: Value = self.attribute(base, node.func.attr, node)
        else:
            function = self.value(node.func)
        if isinstance(function, Static) and function.value in (tuple, list, any, all, sum) and len(node.args) == 1:
            rows = node.args[0]
            if function.value in (any, all) and isinstance(rows, ast.GeneratorExp) and may_raise(rows.elt):
                return self._until(function.value is any, rows)
            values = self.listed(rows)
            if values is None:
                raise self.unknown("something of no fixed length", node)
            return self._over(function.value, values, node)
        if isinstance(function, Static) and function.value in (zip, enumerate, reversed, map):
            values = self.listed(node)
            assert values is not None
            return Group(tuple(values))
        return self.call(function, *self._arguments(node), node)

    def _until(self, stop: bool, node: ast.GeneratorExp) -> Value:
        """Translate `any` or `all`; tests after the deciding one are not computed, because they may raise."""
        generator = node.generators[0]
        values = self.listed(generator.iter)
        if len(node.generators) > 1 or generator.ifs or values is None:
            raise self.unknown("`any` or `all` of tests that may raise, over more than one sequence", node)
        name, outer, values = self._fresh(), dict(self.env), [self._held(v) for v in values]
        self.emit(f"{name} = {not stop}")

        def turn(k: int) -> None:
            if k == len(values):
                return
            self.assign(generator.target, values[k], apart=True)
            test = self.test(node.elt)
            branches = (lambda: self.emit(f"{name} = {stop}")), (lambda: turn(k + 1))
            if isinstance(test, bool):
                branches[test is not stop]()
            else:
                self._fork(test, self.sampled, branches[not stop], branches[stop])

        turn(0)
        self.env = outer
        return Dynamic(name, stop)

    def _as_native(self, value: Static) -> Dynamic:
        """Return the value of native code that a fixed object represents."""
        result = value.value.native()
        if value.path is not None:
            self.program.objects[value.path] = result
        return Dynamic(self.program.name(result, type(result).__name__), result)

    def _made(self, kind: type, args: Sequence[Value], kwargs: Mapping[str, Value], node: ast.AST) -> Value:
        """Create an object that has another type in native code; everything that decides its size is fixed."""
        bound = inspect.signature(kind).bind(*args, **kwargs).arguments
        cls: Any = kind
        sizes = [bound[name] for name in inspect.signature(cls.rows).parameters]
        if not all(isinstance(v, Static) for v in sizes):
            raise self.unknown(f"{kind.__name__} of a size that is computed", node)
        rows = cls.rows(*(self.program.guard(v) for v in sizes))
        return specialise(self.program, cls.RING.begin, [Static(rows)], bound, self.arrays)

    def _age(self, block: Block, wanted: Value) -> Value:
        """Return the age of an input: a known value, or an expression."""
        age = self.program.age(block, self.program.guard(wanted) if isinstance(wanted, Static) else None)
        if not isinstance(age, str):
            return Static(age)
        self.arrays.add("when")
        return Dynamic(age, 0)

    def _arguments(self, node: ast.Call) -> tuple[list[Value], dict[str, Value]]:
        """Return the positional and the keyword arguments of a call."""
        args: list[Value] = []
        for item in node.args:
            if isinstance(item, ast.Starred):
                listed = self.listed(item.value)
                if listed is None:
                    raise self.unknown("something of no fixed length", node)
                args += listed
            else:
                args.append(self.value(item))
        kwargs: dict[str, Value] = {}
        for word_ in node.keywords:
            if word_.arg is None:
                more = self.value(word_.value)
                if not isinstance(more, Record):
                    raise self.unknown("** of something that is not written out", node)
                kwargs |= more.items
            else:
                kwargs[word_.arg] = self.value(word_.value)
        return args, kwargs

    def _reported(self, block: Static, node: ast.Call) -> Value:
        """Count a report, and keep the numbers of its text if that is needed."""
        reports, numbers = self.program.reports, list[str]()
        parts = wording(node.args[2]) if len(node.args) == 3 and not node.keywords else None
        if reports is None or (reports.worded and parts is None):
            # Python words such a report, so this branch discards its tick and the block stays native.
            raise GivesUp("a report whose text is not written out")
        head = [self.value(a) for a in node.args[:2]]
        level, key = (v if isinstance(v, Static) and not is_made_text(v) else None for v in head)
        if level is None or (reports.worded and key is None):
            raise GivesUp("a report whose level or key is made in the tick")
        name = self.function.__name__.strip("_") if key is None else str(key.value)
        if reports.worded and key is not None:
            self.program.guard(key)
        text = self._worded(parts or [], numbers, node) if reports.worded else _nothing
        numbers = numbers or ["0.0"]
        number = reports.add(self.program.number(block.value), self.program.guard(level), name, text, len(numbers))
        self.program.words.add("reported_")
        self.arrays.add("reports")
        self.emit(f"reported_(reports, {number}, ({''.join(f'{x}, ' for x in numbers)}))")
        return NONE

    def _worded(
        self, parts: Sequence[str | ast.FormattedValue], numbers: list[str], node: ast.Call
    ) -> Callable[[Sequence[float]], str]:
        """Return a function that writes the text of a report later, and add the numbers that it needs."""
        made_of = [p if isinstance(p, str) else (self._shown(self.value(p.value), numbers, node), p) for p in parts]
        return lambda row: "".join(
            p if isinstance(p, str) else format(CONVERSIONS[p[1].conversion](p[0](row)), spec_of(p[1])) for p in made_of
        )

    def _shown(self, value: Value, numbers: list[str], node: ast.AST) -> Callable[[Sequence[float]], Any]:
        """Return code that makes a value from its stored numbers."""
        if is_made_text(value):
            raise self.unknown("a report of a text that is made elsewhere", node)
        if isinstance(value, Static) and not (
            value.path is not None and isinstance(value.value, (*NUMBERS, tuple, list))
        ):
            result = self.program.guard(value)
            return lambda row: result
        sample = sample_of(value)
        if not is_sure(value) or isinstance(value, Record):
            raise self.unknown("a report of what may be of several kinds", node)
        if isinstance(sample, (tuple, list)):
            kind, parts = type(sample), [self._shown(v, numbers, node) for v in self.parts(value, node)]
            if hasattr(kind, "_fields"):
                return lambda row: unpacked(kind(*(p(row) for p in parts)))
            return lambda row: kind(p(row) for p in parts)
        number = type(sample)
        if number not in (float, int, bool, complex):
            raise self.unknown(f"a report of {kind_of(value)}", node)
        first, code = len(numbers), self.simple(self.dynamic(value)).code
        if number is complex:
            numbers += [f"{code}.real", f"{code}.imag"]
            return lambda row: complex(row[first], row[first + 1])
        # The table of reports holds floats, and a larger whole number would lose digits in the text.
        if number is int:
            self.emit(f"if not -{EXACT} < {code} < {EXACT}:")
            self.emit(f"    {GIVEN_UP}")
        numbers.append(f"float({code})")
        return lambda row: number(row[first])

    def _of_base(self, node: ast.Call) -> Value:
        """Call a method of a base class."""
        assert isinstance(node.func, ast.Attribute)
        # `__class__` is the cell with the class in which the method is defined; the block may be of a class derived
        # from it.
        owner, instance = self.outer("__class__", node), self.env[self.function.__code__.co_varnames[0]]
        if not isinstance(instance, Static):
            raise self.unknown("super() of something that is computed", node)
        result = getattr(super(owner, instance.value), node.func.attr)
        args, kwargs = self._arguments(node)
        return specialise(self.program, result.__func__, [instance, *args], kwargs, self.arrays)

    def _method(self, base: Value, node: ast.Call) -> Value:
        assert isinstance(node.func, ast.Attribute)
        name, sample = node.func.attr, sample_of(base)
        if name == "_replace" and isinstance(base, Dynamic) and hasattr(type(sample), "_fields"):
            by_place, changed = self._arguments(node)
            return self._replaced(base, by_place, changed, node)
        if name == "conjugate" and isinstance(sample, complex) and isinstance(base, Dynamic):
            return Dynamic(f"{base.code}.conjugate()", sample.conjugate())
        if name == "tolist" and isinstance(base, Dynamic) and isinstance(sample, np.ndarray) and sample.ndim == 1:
            if len(sample) > LONGEST:
                raise self.unknown(f"an array of {len(sample)} as a list, expected at most {LONGEST}", node)
            simple = self.simple(base)
            # The text is written out for this length.
            self.emit(f"if len({simple.code}) != {len(sample)}:")
            self.emit(f"    {GIVEN_UP}")
            return Group(tuple(self.item(simple, Static(k), node) for k in range(len(sample))))
        if name == "get" and isinstance(base, Record):
            return base.items.get(self.program.guard(self.value(node.args[0])), NONE)  # type: ignore[arg-type]
        if not self.program.typed and isinstance(base, Dynamic) and hasattr(sample, "native") and hasattr(sample, name):
            # The object is a value that Python has: with arguments of the same types it returns the same type.
            args = [self.dynamic(self.value(a)) for a in node.args]
            samples = [v.sample for v in args]
            if node.keywords or not all(map(is_sure, args)) or any(v is None for v in samples):
                raise self.unknown(f".{name}() of {kind_of(base)} with what may be None", node)
            result = computed(getattr(sample, name), *samples)
            return Dynamic(f"{base.code}.{name}({', '.join(v.code for v in args)})", result, result is not UNKNOWN)
        cls = class_of(sample)
        method = getattr(cls, name, None) if cls is not None else None
        if isinstance(method, types.FunctionType):
            by_place, kwargs = self._arguments(node)
            return specialise(self.program, method, [base, *by_place], kwargs, self.arrays)
        raise self.unknown(f".{name}() of {kind_of(base)}", node)

    def _replaced(
        self, base: Dynamic, by_place: Sequence[Value], changed: Mapping[str, Value], node: ast.AST
    ) -> Dynamic:
        """Return a named tuple with other values of some fields."""
        kind = type(base.sample)
        if by_place or not changed.keys() <= set(kind._fields):
            raise self.unknown(f"_replace of {kind_of(base)} by what is none of its fields", node)
        simple = self.simple(base)
        parts = [
            changed.get(f) or Dynamic(f"{simple.code}.{f}", getattr(base.sample, f), base.sure) for f in kind._fields
        ]
        return self.named(kind, parts, node)

    def call(self, function: Value, args: Sequence[Value], kwargs: Mapping[str, Value], node: ast.AST) -> Value:
        """Call something."""
        if not isinstance(function, Static):
            raise self.unknown("a call of something that is computed", node)
        called = function.value
        own_table = isinstance(getattr(called, "__self__", None), Mapping)  # guarded where it is read
        if function.path is not None and not isinstance(called, types.MethodType) and not own_table:
            self.program.guard(function)
        if isinstance(called, Jit):
            return self._native(called, args, node)
        if called is power:
            return self._written("power", power, args)
        if isinstance(called, Draws):
            return self._drawn(function, args[0])
        if isinstance(called, Newest) and function.path is not None:
            return self._newest(called, function.path, args[0])
        if isinstance(called, Compiled):
            return self._compiled(function, args, node)
        if isinstance(called, partial):
            # The guard of a partial contains its arguments, so they need no paths of their own.
            return self.call(
                Static(called.func),
                [*map(Static, called.args), *args],
                {k: Static(v) for k, v in called.keywords.items()} | dict(kwargs),
                node,
            )
        if isinstance(called, types.MethodType):
            return self._of_object(called, function.path, args, kwargs, node)
        if isinstance(called, types.BuiltinMethodType) and isinstance(called.__self__, Mapping):
            table = Static(called.__self__, None if function.path is None else function.path[:-1])
            return self._of_mapping(called.__name__, table, args, node)
        if called is dataclasses.replace and isinstance(args[0], Dynamic) and hasattr(type(args[0].sample), OF):
            return self._replaced(args[0], args[1:], kwargs, node)
        if isinstance(called, types.FunctionType):
            return specialise(self.program, called, args, kwargs, self.arrays)
        if isinstance(called, type) and self.program.inferred and hasattr(called, "RING"):
            return self._made(called, args, kwargs, node)
        if isinstance(called, type) and is_twinned(called):
            called = twin(called)
        if isinstance(called, type) and issubclass(called, tuple) and hasattr(called, "_fields"):
            maker = next(kind for kind in called.__mro__ if "__new__" in vars(kind))
            # Native code only fills the fields, so what a `__new__` computes would be lost.
            if "_fields" not in vars(maker):
                raise self.unknown(f"{called.__name__}, which has a __new__ of its own", node)
            defaults = {k: Static(v) for k, v in called._field_defaults.items()}  # type: ignore[attr-defined]
            bound = dict(zip(called._fields, args, strict=False)) | dict(kwargs)
            try:
                return self.named(called, [bound[f] if f in bound else defaults[f] for f in called._fields], node)
            except KeyError as error:
                raise self.unknown(f"{called.__name__} without {error}", node) from None
        if (
            callable(called)
            and not isinstance(called, (type, types.BuiltinFunctionType))
            and isinstance(getattr(type(called), "__call__", None), types.FunctionType)  # noqa: B004 - its function
        ):
            return specialise(self.program, type(called).__call__, [function, *args], kwargs, self.arrays)  # type: ignore[arg-type]
        return self._builtin(called, list(args), kwargs, node)

    def _written(self, name: str, function: Callable[..., Any], args: Sequence[Value]) -> Dynamic:
        values = [self.dynamic(v) for v in args]
        if name == "power":
            self.program.names["power"] = power
        code = f"{name}({', '.join(v.code for v in values)})"
        samples = [v.sample for v in values]
        sample = computed(function, *samples)
        # A function that raises for this sample, as `round` for infinity: only the type of its result is needed.
        if sample is UNKNOWN and self.program.inferred:
            sample = computed(function, *(TAME if isinstance(s, float) else s for s in samples))
        return Dynamic(code, sample)

    def _native(self, function: Jit, args: Sequence[Value], node: ast.AST) -> Dynamic:
        values = [self.dynamic(v) for v in args]
        # The function may write into its arguments, which are the states and constants of the blocks.
        samples = deepcopy([v.sample for v in values])
        sample = computed(function.py_func, *samples)
        name = self.program.name(function, "jit")
        return Dynamic(f"{name}({', '.join(v.code for v in values)})", _numbers(sample), sample is not UNKNOWN)

    def _drawn(self, draws: Static, k: Value) -> Dynamic:
        assert draws.path is not None
        name = self.program.draws.setdefault(draws.path, f"d{len(self.program.draws)}")
        self.program.words.add("drawn_")
        self.arrays.add(name)
        return Dynamic(f"drawn_({name}, n, {self.dynamic(k).code})", 0.5)

    def _newest(self, called: Newest[Any, Any], path: Path, key: Value) -> Static:
        """Return the newest answer, as long as no other is requested."""
        self.program.newest.add(path)
        known = self.dynamic(Static(called.key, (*path, ("attr", "key"))))
        self.emit(f"if {self.dynamic(key).code} != {known.code}:")
        self.emit(f"    {GIVEN_UP}")
        return Static(called.answer, (*path, ("attr", "answer")))

    def _compiled(self, function: Static, args: Sequence[Value], node: ast.AST) -> Dynamic:
        called = function.value
        if len(args) != 1 or called.symbol is None or function.path is None:
            raise self.unknown("a casadi function that is not compiled", node)
        values = [self.dynamic(v) for v in self.parts(args[0], node)]
        name, memory = self.program.caller(called, function.path)
        self.arrays.update(memory)
        results = computed(called, tuple(v.sample for v in values))
        sample = (0.0,) * called.n_out if results is UNKNOWN else results
        code = f"{name}({', '.join([*memory, *(v.code for v in values)])})"
        return Dynamic(code, sample)

    def _over(self, function: Any, values: Sequence[Value], node: ast.AST) -> Value:
        if function in (tuple, list):
            return Group(tuple(values))
        if function is sum:
            samples = [sample_of(v) for v in values]
            # Python's `sum` compensates floats since 3.12, which the text does not.
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
        return Dynamic(
            f"({(' or ' if stop else ' and ').join(left)})",
            computed(lambda *s: function(s), *(sample_of(v) for v in values)),
        )

    def _of_mapping(self, name: str, table: Static, args: Sequence[Value], node: ast.AST) -> Value:
        """Call a method of a mapping that is fixed: `items`, `values`, `keys` or `get`."""
        if name in ("items", "values", "keys"):
            keys = tuple(table.value)
            values = [Static(table.value[k], None if table.path is None else (*table.path, ("item", k))) for k in keys]
            if table.path is not None:
                # Only the keys and their order choose this text; each value that does has its own guard.
                self.program.guards[table.path] = ("keys", keys)
            if name == "items":
                return Group(tuple(Group((Static(k), v)) for k, v in zip(keys, values, strict=True)))
            return Group(tuple(values)) if name == "values" else Static(keys)
        if name != "get":
            raise self.unknown(f".{name}() of a mapping", node)
        if isinstance(args[0], Static):
            return Static(self.program.guard(table).get(*(self.program.guard(v) for v in args)))  # type: ignore[arg-type]
        return self._got(table, args, node)

    def _got(self, table: Static, args: Sequence[Value], node: ast.AST) -> Dynamic:
        """Look up a key that may be missing."""
        if not self.program.inferred:
            return self._table_value(table, args[0], node)
        return self._table_value(table, args[0], node, args[1] if len(args) > 1 else NONE)

    def _of_object(
        self,
        called: types.MethodType,
        path: Path | None,
        args: Sequence[Value],
        kwargs: Mapping[str, Value],
        node: ast.AST,
    ) -> Value:
        """Call a method of an object that is fixed."""
        owner = called.__self__
        if isinstance(owner, Block) and called.__func__ is Block.report:
            self._give_up()
            return NONE
        if called.__name__ == "_make" and isinstance(owner, type) and hasattr(owner, "_fields"):
            return self.named(owner, self.parts(args[0], node), node)
        home = None if path is None else path[:-1]
        if isinstance(owner, Mapping) and called.__name__ == "get":
            return self._got(Static(owner, home), args, node)
        if path is not None:
            parent = type(follow(path[:-1], self.program.roots))
            if getattr(parent, str(path[-1][1]), None) is not called.__func__:
                # A method stored under another name: a block with other parameters may have another one there.
                self.program.guard(Static(called, path))
        if path and owner is not follow(path[:-1], self.program.roots):
            home = (*path, ("attr", "__self__"))  # a method that another object has lent, or that stands in a table
        if isinstance(owner, type):
            home = None
        return specialise(self.program, called.__func__, [Static(owner, home), *args], kwargs, self.arrays)  # type: ignore[arg-type]

    def _builtin(self, called: Any, args: list[Value], kwargs: Mapping[str, Value], node: ast.AST) -> Value:
        if kwargs:
            raise self.unknown(f"{getattr(called, '__name__', called)} with keyword arguments", node)
        if called is np.array and len(args) == 1:
            numbers = [self.dynamic(v) for v in self.parts(args[0], node)]
            if not all(isinstance(v.sample, (float, int)) for v in numbers):
                raise self.unknown("an array of something else than numbers", node)
            return Dynamic(
                f"array_(({''.join(f'float({v.code}), ' for v in numbers)}))",
                np.array([float(v.sample) for v in numbers]),
            )
        if called in (min, max) and len(args) == 1:
            args = self.parts(args[0], node)
        if called is len:
            base = args[0]
            if isinstance(base, Dynamic) and isinstance(base.sample, np.ndarray):
                return Dynamic(f"len({base.code})", len(base.sample))
            return Static(len(self.parts(base, node)))
        if called is isinstance:
            if not isinstance(args[0], Static) and not is_sure(args[0]):
                raise self.unknown("isinstance of something that is computed", node)
            return Static(isinstance(sample_of(args[0]), sample_of(args[1])))
        if called is getattr and isinstance(args[0], Static) and isinstance(args[1], Static):
            return self.attribute(args[0], args[1].value, node)
        if _changes(called):
            raise self.unknown(f"{called.__name__}, which changes an object outside of the state", node)
        if _outside(called):
            raise self.unknown(f"{called.__name__}, which does not depend on its arguments alone", node)
        fixed = [v for v in args if isinstance(v, Static)]
        if len(fixed) == len(args) and not any(v.path is not None and is_number_slot(v.value) for v in fixed):
            try:
                return Static(called(*(self.program.guard(v) for v in fixed)))
            except NotNative as error:
                raise self.unknown(str(error), node) from None
            except Exception as error:
                raise self.unknown(f"{type(error).__name__}: {error}", node) from None
        return self._computed(called, args, node)

    def _computed(self, called: Any, args: list[Value], node: ast.AST) -> Value:
        """Call a function of Python's own with something that is computed."""
        samples = [sample_of(v) for v in args]
        if called in (min, max):
            return self._extreme(called, args, node)
        if called is float and isinstance(samples[0], bool):
            return Dynamic(f"(1.0 if {self.code(args[0])} else 0.0)", float(samples[0]))
        if called in (abs, float) and isinstance(samples[0], (float, int)):
            text = args[0].code if isinstance(args[0], Dynamic) and called is float else ""
            if text.startswith("floor(") and self.program.typed and not self.program.inferred:
                self.program.words.add("whole_")
                return Dynamic(f"whole_{text.removeprefix('floor')}", float(samples[0]))
            return self._written(called.__name__, called, args)
        if called is abs and isinstance(samples[0], complex):
            self.program.words.add("abs_")
            return self._written("abs_", abs, args)
        if called is bool:
            test = self.truth(args[0])
            return Static(test) if isinstance(test, bool) else Dynamic(f"({test})", self.sampled)
        if called is complex:
            return self._written("complex", complex, args)
        if called is round and len(args) > 1 and self.program.inferred:
            return MADE_TEXT  # numbers rounded to digits are for display, not for computation
        if called is round and len(args) > 1:
            raise self.unknown("round to digits", node)
        if called is int and isinstance(samples[0], bool):
            return self._written("int", int, args)
        name = word(called) if isinstance(called, (types.BuiltinFunctionType, type)) else None
        if name is not None:
            if name in TEXTS:
                self.program.words.add(name)
            return self._written(name, called, args)
        if (isinstance(called, types.BuiltinFunctionType) and getattr(called, "__module__", "") == "numpy") or (
            isinstance(called, np.ufunc)
        ):
            # Native code may compute numpy's functions with other bits; see `kit.jit`.
            raise self.unknown(f"numpy.{called.__name__}", node)
        raise self.unknown(f"{getattr(called, '__qualname__', type(called).__name__)}()", node)

    def _extreme(self, called: Any, args: Sequence[Value], node: ast.AST) -> Value:
        """Write min and max as comparisons: the first of equal ones, as in Python, including NaN."""
        values = [self.simple(self.dynamic(v)) for v in args]
        best = values[0]
        sign = "<" if called is min else ">"
        for item in values[1:]:
            sample = computed(called, best.sample, item.sample)
            if isinstance(sample, int) and not all(isinstance(v.sample, int) for v in (best, item)):
                # Python's result is one of the two objects, but native code has one type for both.
                sample = float(sample)
            code = f"({item.code} if {item.code} {sign} {best.code} else {best.code})"
            best = self.simple(Dynamic(code, sample)) if item is not values[-1] else Dynamic(code, sample)
        return best


def _nothing(row: Sequence[float]) -> str:
    return ""


def _is_super(node: ast.expr) -> bool:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "super"


def _numbers(value: Any) -> Any:
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return tuple(_numbers(v) for v in value)
    if isinstance(value, np.generic):
        return value.item()
    return value


def _outside(called: Any) -> bool:
    """Return whether a call reads or changes something outside of the program, such as the time."""
    owner = getattr(called, "__self__", None)
    homes = {getattr(item, "__module__", None) for item in (called, owner)} | {getattr(owner, "__name__", None)}
    return not WORLD.isdisjoint(homes) or (isinstance(called, types.BuiltinFunctionType) and called in OUTSIDE)


def _changes(called: Any) -> bool:
    """Return whether a call may change the object that it belongs to: such a call must not be evaluated here."""
    if called is next:
        return True
    owner = getattr(called, "__self__", None)
    if owner is None or isinstance(owner, FIXED):
        return False
    reading = next((READING[kind] for kind in type(owner).__mro__ if kind in READING), "")
    return called.__name__ not in reading.split()
