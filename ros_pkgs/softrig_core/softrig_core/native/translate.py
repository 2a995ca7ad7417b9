"""The text of a block's methods, specialised to the block, in the part of Python that numba compiles.

A method is read with the current values of its block. A fixed string, boolean or integer selects the text. A fixed
number or table becomes a constant argument, a *slot*, so that one text serves all variants of a block. Values that
selected the text are kept as *guards*. Objects and methods are resolved to the functions that they refer to.
`NotNative` is raised for a construct that is not supported. `raise` discards the tick, and so does `report` if its text
is not written out.
"""

from __future__ import annotations

import ast
import builtins
import inspect
import operator
import textwrap
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from typing import Any

import numpy as np

from ..block.port import LONGEST
from ..kit.compiled import Compiled
from ..kit.jit import Jit
from .reports import Reports
from .value import UNKNOWN, Dynamic, GivesUp, Group, NotNative, Path, Record, Static, Value, is_made_text, mapped

TURNS = 16  # turns up to which a loop is written out
# Statements of a casadi function that are written into the text, at most. Each takes a millisecond to compile, and
# beside more of them a call takes next to no time.
FORMULA = 500
SMALL = 4096  # smaller whole numbers (counts, places) choose the text; larger ones (times in ns) are slots
GIVEN_UP = "raise RuntimeError"

BINARY: dict[type, tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Add: ("+", operator.add),
    ast.Sub: ("-", operator.sub),
    ast.Mult: ("*", operator.mul),
    ast.Div: ("/", operator.truediv),
    ast.FloorDiv: ("//", operator.floordiv),
    ast.Mod: ("%", operator.mod),
    ast.BitAnd: ("&", operator.and_),
    ast.BitOr: ("|", operator.or_),
    ast.BitXor: ("^", operator.xor),
}
COMPARE: dict[type, tuple[str, Callable[[Any, Any], Any]]] = {
    ast.Eq: ("==", operator.eq),
    ast.NotEq: ("!=", operator.ne),
    ast.Lt: ("<", operator.lt),
    ast.LtE: ("<=", operator.le),
    ast.Gt: (">", operator.gt),
    ast.GtE: (">=", operator.ge),
}
UNARY: dict[type, tuple[str, Callable[[Any], Any]]] = {
    ast.UAdd: ("+", operator.pos),
    ast.USub: ("-", operator.neg),
    ast.Invert: ("~", operator.invert),
}
NUMBERS = (int, float, complex, bool)


@dataclass(frozen=True)
class Specialised:
    """A specialised function: its name, the arrays that it needs besides its arguments, and its result."""

    name: str
    arrays: tuple[str, ...]
    result: Value


NEVER = Specialised("", (), Dynamic("", UNKNOWN, False))  # a function that always discards the tick


@dataclass
class Program:
    """The text under construction for a rig: its functions, the names in them, slots and guards.

    Parameters
    ----------
    roots : sequence
        Blocks; paths begin with their numbers.
    writer : callable
        Returns the `Writer` of a function.
    ages : mapping of (number of a block, input) to int, str or None
        Result of `Block.age`, or the expression for it.
    silent : sequence of (int, Port)
        Outputs that do not publish at some ticks, with the number of the block.
    typed : bool
        Whether objects in a state have the form of native code (`twins.packed`).
    inferred : bool
        Whether the compiler of the text infers types: a value may then have several types, including None.
    reports : Reports, optional
        Stores reports; without it a report discards the tick.
    """

    roots: Sequence[Any]
    writer: Callable[..., Any]
    ages: Mapping[tuple[int, str], int | str | None] = field(default_factory=dict)
    silent: Sequence[tuple[int, Any]] = ()
    typed: bool = True
    inferred: bool = False
    functions: list[str] = field(default_factory=list)
    names: dict[str, Any] = field(default_factory=dict)
    words: set[str] = field(default_factory=set)
    slots: dict[Path, int] = field(default_factory=dict)
    shapes: dict[Path, Any] = field(default_factory=dict)
    arrays: dict[Path, str] = field(default_factory=dict)
    draws: dict[Path, str] = field(default_factory=dict)
    guards: dict[Path, Any] = field(default_factory=dict)
    scratches: dict[Path, str] = field(default_factory=dict)
    newest: set[Path] = field(default_factory=set)
    # Python's objects that native code accepts where types are inferred.
    objects: dict[Path, Any] = field(default_factory=dict)
    callers: dict[str, str] = field(default_factory=dict)
    known: dict[Any, Specialised] = field(default_factory=dict)
    seldom: list[str] = field(default_factory=list)
    aside: bool = False  # whether the branch being read is not the samples' one: what is unknown there discards a tick
    under_way: set[Any] = field(default_factory=set)
    reports: Reports | None = None

    def name(self, value: Any, hint: str) -> str:
        """Return the name of a Python object in the text."""
        # By identity: arrays have no hash, and objects that Python calls equal, such as (1,) and (1.0,), are two
        # constants.
        for name, known in self.names.items():
            if known is value:
                return name
        name = f"{hint}_{len(self.names)}"
        self.names[name] = value
        return name

    def number(self, block: Any) -> int:
        """Return the number of a block."""
        return next(k for k, root in enumerate(self.roots) if root is block)

    def age(self, block: Any, name: str | None) -> int | str | None:
        """Return the result of `Block.age`, or an expression for it."""
        number = self.number(block)
        if name is None or (number, name) not in self.ages:
            raise NotNative(f"{block.name}: the age of {name}, which is published less often than its ticks")
        return self.ages[number, name]

    def guard(self, value: Static) -> Any:
        """Return a fixed value that chooses the text."""
        if is_made_text(value):
            raise NotNative("something that depends on a text of a tick or on a number that is rounded to digits")
        if value.path is not None:
            self.guards[value.path] = signature(value.value)
        return value.value

    def slot(self, value: Static) -> Dynamic:
        """Return a fixed number, or table of numbers, as a constant argument."""
        assert value.path is not None
        if isinstance(value.value, np.ndarray):
            name = self.arrays.setdefault(value.path, f"a{len(self.arrays)}")
            return Dynamic(name, value.value)
        # A tuple has another type for each length, and `as_slot` refuses one of more than LONGEST numbers.
        if isinstance(value.value, list) and len(value.value) > TURNS and {type(v) for v in value.value} == {float}:
            name = self.arrays.setdefault(value.path, f"a{len(self.arrays)}")
            return Dynamic(name, np.array(value.value))
        result = as_slot(value.value)
        number = self.slots.setdefault(value.path, len(self.slots))
        self.shapes[value.path] = shape(result)
        return Dynamic(f"c[{number}]", result)

    def scratch(self, path: Path) -> str:
        """Return the name of the memory in which a compiled casadi function works."""
        return self.scratches.setdefault(path, f"s{len(self.scratches)}")

    def caller(self, compiled: Compiled, path: Path) -> tuple[str, tuple[str, ...]]:
        """Return the name of the function that computes one, and the memory that it needs, if any."""
        symbol = compiled.symbol
        assert symbol is not None
        # A call takes a fifth of a tick of a drive, since all numbers leave their registers, so native code contains
        # short arithmetic itself. Python calls it, and exported code has casadi's C in a file of its own.
        written_out = self.typed and not self.inferred and len(compiled.arithmetic) <= FORMULA
        formula = compiled.arithmetic if written_out else []
        memory = () if formula else (self.scratch(path),)
        if symbol not in self.callers:
            self.callers[symbol] = name = f"call{len(self.callers)}"
            arguments = [f"v{k}" for k in range(compiled.n_in)]
            results = [f"r{k}" for k in range(compiled.n_out)]
            if not formula:
                self.names[f"{name}_there"] = compiled
                results = [f"s[{compiled.n_in + k}]" for k in range(compiled.n_out)]
                formula = [
                    *(f"s[{k}] = {argument}" for k, argument in enumerate(arguments)),
                    "p = s.ctypes.data",
                    f"{name}_there({', '.join(f'p + {8 * offset}' for offset in compiled.places)}, 0)",
                ]
                arguments.insert(0, "s")
            lines = [
                f"def {name}({', '.join(arguments)}):",
                *(f"    {line}" for line in formula),
                f"    return ({''.join(f'{result}, ' for result in results)})",
            ]
            self.functions.append("\n".join(lines))
        return self.callers[symbol], memory

    def constants(self, roots: Sequence[Any]) -> tuple[Any, ...]:
        """Return the slots of blocks of the same text."""
        return tuple(as_slot(follow(path, roots)) for path in self.slots)

    def tables(self, roots: Sequence[Any]) -> tuple[Any, ...]:
        """Return their arrays; lists if nothing is typed."""
        # In one layout, because numba compiles a function again for another one.
        result = (follow(path, roots) for path in self.arrays)
        return tuple(v if isinstance(v, list) and not self.typed else np.ascontiguousarray(v) for v in result)

    def differs(self, roots: Sequence[Any]) -> str:
        """Describe which value of other blocks would need another text; empty if the text suits them."""
        for path, wanted in self.guards.items():
            try:
                value = follow(path, roots)
                result = ("keys", tuple(value)) if wanted[0] == "keys" else signature(value)
            except (AttributeError, LookupError, TypeError):
                # A value that another block does not have needs another text, too.
                return written(path)
            if result != wanted:
                return written(path)
        for path, wanted in self.shapes.items():
            if shape(as_slot(follow(path, roots))) != wanted:
                return written(path)
        return ""


def follow(path: Path, roots: Sequence[Any]) -> Any:
    """Return the object at the end of a path."""
    value = roots[path[0]]
    for kind, key in path[1:]:
        value = getattr(value, key) if kind == "attr" else len(value) if kind == "len" else value[key]
    return value


def outside(function: types.FunctionType, name: str) -> Any:
    """Return the object that a function finds under a name outside of itself; a LookupError if there is none."""
    cells = dict(zip(function.__code__.co_freevars, function.__closure__ or (), strict=True))
    if name in cells:
        return cells[name].cell_contents
    return function.__globals__[name] if name in function.__globals__ else vars(builtins)[name]


def written(path: Path) -> str:
    """Write a path as a person would."""
    return "".join(f".{key}" if kind == "attr" else f"[{key!r}]" for kind, key in path[1:]).lstrip(".")


@dataclass(frozen=True, eq=False)
class Same:
    """An object that must be the same one."""

    thing: Any

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.thing is self.thing

    __hash__ = None  # type: ignore[assignment]


def signature(value: Any, nested: bool = False) -> Any:
    """Return the part of a value that must be equal for the same text: numbers and texts, and the type of an object.

    A value that is `nested` in another one has no separate path, so it must be the same object.
    """
    if isinstance(value, (*NUMBERS, str, bytes, type(None), type)):
        # With the type, because 1, 1.0 and True are equal in Python and are written differently.
        return type(value).__name__, value
    if isinstance(value, (tuple, list)):
        return type(value).__name__, tuple(signature(v, True) for v in value)
    if isinstance(value, Mapping):
        # In the order of the keys, because a loop over a mapping is written out in this order.
        return "mapping", tuple((k, signature(v, True)) for k, v in value.items())
    if isinstance(value, types.MethodType):
        return "method", value.__func__, *((Same(value.__self__),) if nested else ())
    if isinstance(value, (types.FunctionType, types.BuiltinFunctionType)):
        return "function", value
    if isinstance(value, partial):
        return "partial", value.func, signature(value.args), signature(value.keywords)
    if isinstance(value, Compiled):
        return "compiled", value.symbol
    if isinstance(value, Jit):
        return "jit", value
    return ("object", Same(value)) if nested else ("object", type(value))


def shape(value: Any) -> Any:
    """Return the types of a constant, to its leaves."""
    return tuple(shape(v) for v in value) if isinstance(value, tuple) else type(value)


_ATOMS = frozenset({float, int, bool, complex})  # most constants


def as_slot(value: Any) -> Any:
    """Return a number or table in the form of native code: lists as tuples.

    Raises
    ------
    NotNative
        Something else, or a table that is too long.
    """
    if type(value) in _ATOMS:
        return value
    if isinstance(value, (bool, complex, int)):
        return value
    if isinstance(value, (float, np.floating)):
        return float(value)
    if isinstance(value, (tuple, list)):
        if len(value) > LONGEST:
            raise NotNative(f"a table of {len(value)}, expected at most {LONGEST} values, or an array")
        return tuple(as_slot(v) for v in value)
    if isinstance(value, Mapping):
        # `Ways.code` writes the values of a mapping in this order, too.
        return tuple(as_slot(value[key]) for key in sorted(value))
    raise NotNative(f"{type(value).__name__} among its constants")


@cache
def parsed(function: types.FunctionType) -> ast.FunctionDef:
    """Return a function as a tree."""
    try:
        text = textwrap.dedent(inspect.getsource(function))
        tree = ast.parse(text).body[0]
    except (OSError, TypeError, SyntaxError):
        raise NotNative(f"{function.__qualname__}: its source cannot be read") from None
    if not isinstance(tree, ast.FunctionDef):
        raise NotNative(f"{function.__qualname__} is not a plain function")
    return tree


def specialise(
    program: Program, function: types.FunctionType, args: Sequence[Value], kwargs: Mapping[str, Value], arrays: set[str]
) -> Value:
    """Specialise a Python function to its fixed arguments, and return the code of the call.

    Parameters
    ----------
    program : Program
    function : function
    args, kwargs : sequence and mapping of Value
        Its arguments by place and by name.
    arrays : set of str
        Set to which the names of the arrays that the call passes on are added.
    """
    inner: dict[str, Value] = {}
    outer: list[str] = []
    # Read on trial, a function may discard ticks in unsupported parts; such a text must not serve the usual branch.
    key: list[Any] = [function, program.aside]
    parameters: list[str] = []

    def handed(value: Value, name: str) -> Value:
        """Create the known parts of an argument; computed parts become parameters."""
        if isinstance(value, Static):
            if value.path is not None and is_number_slot(value.value):
                return handed(program.slot(value), name)
            key.append(
                (
                    name,
                    "static",
                    value.path if value.path is not None else id(value.value),
                    repr(value.value) if isinstance(value.value, (*NUMBERS, str)) else "",
                )
            )
            return value
        if isinstance(value, Dynamic):
            outer.append(value.code)
            parameters.append(f"v_{name}")
            key.append((name, shape(value.sample) if value.sample is not UNKNOWN else None, value.sure, value.keys))
            return replace(value, code=f"v_{name}")
        key.append((name, len(value.items) if isinstance(value, Group) else tuple(value.items)))
        return mapped(value, lambda k, v: handed(v, f"{name}__{k}"))

    for name, value in _arguments(function, args, kwargs).items():
        inner[name] = handed(value, name)
    signature_key = tuple(key)
    # Each specialised function is written once, with the type of its result known, which a recursive call would need
    # before.
    if signature_key in program.under_way:
        raise NotNative(f"{function.__qualname__} calls itself")
    if signature_key not in program.known:
        program.under_way.add(signature_key)
        try:
            program.known[signature_key] = _specialised(program, function, inner, parameters)
        finally:
            program.under_way.discard(signature_key)
    done = program.known[signature_key]
    if done is NEVER:
        raise GivesUp(f"{function.__qualname__} discards each tick")
    # A result that is fixed needs no call.
    if not isinstance(done.result, Dynamic):
        return done.result
    arrays.update(done.arrays)
    code = f"{done.name}({', '.join(['c', 'n', *done.arrays, *outer])})"
    return replace(done.result, code=code)


def _arguments(function: types.FunctionType, args: Sequence[Value], kwargs: Mapping[str, Value]) -> dict[str, Value]:
    """Return the arguments of a call by the parameter names of the function."""
    signature = inspect.signature(function)
    try:
        bound = signature.bind(*args, **kwargs).arguments
    except TypeError as error:
        raise NotNative(f"{function.__qualname__}: {error}") from None
    result: dict[str, Value] = {}
    for name, parameter in signature.parameters.items():
        if parameter.kind is parameter.VAR_POSITIONAL:
            result[name] = Group(tuple(bound.get(name, ())))
        elif parameter.kind is parameter.VAR_KEYWORD:
            result[name] = Record(bound.get(name, {}))
        else:
            result[name] = bound[name] if name in bound else Static(parameter.default)
    return result


def is_number_slot(value: Any) -> bool:
    """Return whether a fixed number is passed as an argument; others are written into the text."""
    return isinstance(value, (float, complex)) or (isinstance(value, int) and abs(value) > SMALL)


def _specialised(
    program: Program, function: types.FunctionType, inner: dict[str, Value], parameters: list[str]
) -> Specialised:
    tree = parsed(function)
    writer = program.writer(program, function, inner)
    lines = writer.body(tree.body)
    if not writer.returned:
        return NEVER
    result = writer.result()
    if not isinstance(result, Dynamic):
        return Specialised("", (), result)
    arrays = tuple(sorted(writer.arrays))
    name = f"f{len(program.functions)}_{function.__name__.strip('_')}"
    # The comment at the end leads from a traceback, or from exported C, back to the method.
    head = (
        f"def {name}({', '.join(['c', 'n', *arrays, *parameters])}):  # {function.__module__}.{function.__qualname__}"
    )
    program.functions.append("\n".join([head, *(f"    {line}" for line in lines)]))
    return Specialised(name, arrays, result)
