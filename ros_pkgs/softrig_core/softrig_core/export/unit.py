"""The output for one block: C values, types, tables, and functions by the types of their arguments."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..kit.compiled import Compiled
from ..native.value import NotNative
from .kinds import (
    REAL,
    Absent,
    Kind,
    Maybe,
    Number,
    Table,
    ascii_name,
    identifier,
    kind_of,
    tuple_of,
)


def reached(roots: Sequence[str], known: Mapping[str, str]) -> set[str]:
    """Return the functions that some functions call, with these, by the texts of all functions."""
    result: set[str] = set()
    open_ = list(roots)
    while open_:
        name = open_.pop()
        if name in known and name not in result:
            result.add(name)
            open_ += re.findall(r"\b\w+(?=\()", known[name])
    return result


@dataclass(frozen=True)
class Value:
    """An expression of C without side effects, and its type."""

    kind: Kind
    c: str
    thing: Any = None  # the object that a name of Python denotes, if it is not a value of C
    partly: bool = False  # whether the name has it on some ways only


@dataclass(frozen=True)
class Signature:
    """A function of C: its name, the type that it returns, and whether it may discard the tick."""

    name: str
    result: Kind
    discards: bool


@dataclass
class Unit:
    """Text generated for one block: types, tables, functions.

    Parameters
    ----------
    prefix : str
        Of all names.
    reader : callable
        Makes the `Reader` of a function.
    texts : mapping of str to str
        The functions of the text, by name.
    names : mapping of str to object
        Other objects that the text names.
    constants : sequence
        The slots ``c[k]``: a `Value` if the node stores it, otherwise a Python value, which is written out.
    reports : mapping of int to int
        Place in the text's table of reports to number of the report.
    """

    prefix: str
    reader: Callable[..., Any]
    texts: Mapping[str, str]
    names: Mapping[str, Any]
    constants: Sequence[Any]
    reports: Mapping[int, int]
    structs: dict[Kind, str] = field(default_factory=dict)
    typedefs: list[str] = field(default_factory=list)
    tables: dict[str, str] = field(default_factory=dict)
    functions: list[str] = field(default_factory=list)
    done: dict[Any, Signature] = field(default_factory=dict)
    under_way: set[Any] = field(default_factory=set)
    count: int = 0  # number of functions that have begun
    libm: set[str] = field(default_factory=set)
    fixed: dict[str, Any] = field(default_factory=dict)  # constant tuples and numbers with a name, by how C writes them
    parts: dict[tuple[str, Any], np.ndarray] = field(default_factory=dict)  # arrays of constant tuples and arrays
    places: dict[int, str] = field(default_factory=dict)  # names of the C tables of Python's arrays
    by_name: dict[str, Any] = field(default_factory=dict)
    # Compiled functions of casadi by the name of the function that calls them.
    casadi: Mapping[str, Compiled] = field(default_factory=dict)
    sources: dict[str, str] = field(default_factory=dict)  # C sources of casadi by the name of their functions
    rooms: dict[str, Table] = field(default_factory=dict)  # arrays of functions that return one

    def used(self, roots: Sequence[str]) -> tuple[list[str], list[str]]:
        """Return the tables and functions that these functions need, in order; abandoned translations left others."""
        known = {_title(text): text for text in self.functions}
        needed = reached(roots, known)
        functions = [text for name, text in known.items() if name in needed]
        code = "".join(functions)
        for name in roots:
            self._check_rooms(name, known)
        return [text for name, text in self.tables.items() if reads(name, code)], functions

    def _check_rooms(self, root: str, known: Mapping[str, str]) -> None:
        """Ensure that each array that a function returns is made only once in a tick, because it has one place in
        memory.
        """
        counts: dict[str, int] = {}

        def count(name: str, times: int) -> None:
            counts[name] = counts.get(name, 0) + times
            for called in re.findall(r"\b\w+(?=\()", known[name].partition("{")[2]):
                if called in known:
                    count(called, times)

        if self.rooms:
            count(root, 1)
        for name, times in counts.items():
            if times > 1 and any(room.startswith(f"{name}_w") and reads(room, known[name]) for room in self.rooms):
                raise NotNative(f"{name} returns an array, and is called {times} times in a tick")

    def c(self, kind: Kind) -> str:
        """Return how C writes a type."""
        if isinstance(kind, Number):
            return kind.c
        if isinstance(kind, Absent):
            return "uint8_t"
        if isinstance(kind, Table):
            return f"{self.c(kind.item)} *"
        if kind not in self.structs:
            if isinstance(kind, Maybe):
                fields, title = [("bool", "some"), (self.c(kind.item), "item")], "maybe"
            else:
                pairs = zip(kind.items, kind.names, strict=True)
                # A member for None would only add padding, and clang copies a struct with padding in halves, which is
                # slower.
                fields = [(self.c(k), identifier(n)) for k, n in pairs if not isinstance(k, Absent)]
                title = ascii_name(kind.title.strip("_").lower()) or "tuple"
            name = f"{self.prefix}_{title}{len(self.structs)}_t"
            inner = "".join(f"    {c} {n};\n" for c, n in fields) or "    uint8_t nothing;\n"
            self.typedefs.append(f"typedef struct {{\n{inner}}} {name};\n")
            self.structs[kind] = name
        return self.structs[kind]

    def table(self, value: np.ndarray, hint: str) -> Value:
        """Return a constant array."""
        kind = kind_of(value)
        assert isinstance(kind, Table)
        if id(value) not in self.places:
            name = f"{self.prefix}_{hint}{len(self.tables)}"
            numbers = ", ".join(literal(v) for v in value.ravel().tolist()) or "0"
            # C has no arrays of length 0.
            size = max(value.size, 1)
            self.tables[name] = f"static SR_TABLE {self.c(kind.item)} {name}[{size}] = {{ {numbers} }};\n"
            self.places[id(value)] = name
            # Keeps the array, so that no other one can have its id.
            self.by_name[name] = value
        return Value(kind, self.places[id(value)], value)

    def number(self, c: str) -> float:
        """Return the number that a C expression spells out or names; NaN if it is not a constant."""
        result = self.fixed.get(c)
        if isinstance(result, float):
            return result
        match = FIXED.fullmatch(c) or WHOLE.fullmatch(c)
        return math.nan if match is None else float(match[1])

    def tabled(self, c: str, item: Number) -> Value:
        """Return a constant tuple, given as C expression, as a constant array of one type."""
        if (c, item) not in self.parts:
            types = {"real_t": float, "int64_t": np.int64, "bool": bool}
            self.parts[c, item] = np.array(self.fixed[c], types[item.c])
        return self.table(self.parts[c, item], "values")

    def part(self, c: str, part: slice) -> Value:
        """Return rows of a constant array, given by its C name, as an array of their own."""
        if (c, str(part)) not in self.parts:
            self.parts[c, str(part)] = np.ascontiguousarray(self.by_name[c][part])
        return self.table(self.parts[c, str(part)], "part")

    def call(self, function: Any, kinds: tuple[Kind, ...], tables: tuple[Any, ...], python: bool) -> Signature:
        """Return the C function of a function of Python for arguments of these types.

        Parameters
        ----------
        function : str or function
            A function of the text by its name, or one of Python.
        tables : tuple
            By argument: the array that is handed over, by name, or None.
        python : bool
            Whether Python's rules hold (an error discards the tick); else numba's for `jit` functions.
        """
        key = (function, kinds, tables, python)
        if key in self.done:
            return self.done[key]
        if function in self.casadi:
            text, signature = self._of_casadi(self.casadi[function])
            self.functions.append(text)
            self.done[key] = signature
            return signature
        if key in self.under_way:
            # The header promises C without recursion, whose need of memory is known.
            raise NotNative(f"{function} calls itself")
        self.under_way.add(key)
        try:
            reader = self.reader(self, function, kinds, tables, python)
            self.count += 1  # a function may call another one with the same title
            text, signature = reader.whole(f"{self.prefix}_{ascii_name(reader.title)}_{self.count}")
        finally:
            self.under_way.discard(key)
        # After its callees, so that each function of C is defined before it is used.
        self.functions.append(text)
        self.done[key] = signature
        return signature

    def _of_casadi(self, compiled: Compiled) -> tuple[str, Signature]:
        """Return a function that calls one of casadi, whose source becomes a file of its own."""
        symbol = f"{self.prefix}_casadi{len(self.sources)}"
        self.sources[symbol] = casadi_source(compiled, symbol)
        self.libm.update(set(LIBM.findall(self.sources[symbol])))
        inputs, outputs, *sizes = compiled.sizes
        result = tuple_of([REAL] * sum(outputs))
        name = f"{self.prefix}_call{len(self.done)}"
        arg, res, integers, work = sizes
        names, results = [f"p_{k}" for k in range(sum(inputs))], [f"found[{k}]" for k in range(sum(outputs))]
        heads = ", ".join([f"{self.prefix} *s", *(f"real_t {argument}" for argument in names)])
        lines = [
            f"static {self.c(result)} {name}({heads})",
            "{",
            f"    const real_t given[{max(len(names), 1)}] = {{ {', '.join(names) or '0'} }};",
            f"    real_t found[{max(len(results), 1)}] = {{ 0 }};",
            f"    const real_t *arg[{max(arg, 1)}] = {{ 0 }}; /* casadi works in the places behind its arguments */",
            f"    real_t *res[{max(res, 1)}] = {{ 0 }};",
            f"    long long int iw[{max(integers, 1)}] = {{ 0 }};",
            f"    real_t w[{max(work, 1)}] = {{ 0 }};",
            *(f"    arg[{k}] = &given[{sum(inputs[:k])}];" for k in range(len(inputs))),
            *(f"    res[{k}] = &found[{sum(outputs[:k])}];" for k in range(len(outputs))),
            f"    if ({symbol}(arg, res, iw, w, 0) != 0) {{",
            "        s->discarded = true;",
            "    }",
            f"    return ({self.c(result)}){{ {', '.join(results) or '0'} }};",
            "}",
        ]
        return "\n".join(lines) + "\n", Signature(name, result, True)


FIXED = re.compile(r"SR_REAL\((-?[\d.e+-]+)\)")  # numbers that are written out
WHOLE = re.compile(r"INT64_C\((\d+)\)")
CALLED = "acos acosh asin asinh atan atan2 atanh cos cosh erf exp expm1 hypot log log10 log1p pow sin sinh tan tanh"
LIBM = re.compile(rf"\b({CALLED.replace(' ', '|')})(?=\()")


def casadi_source(compiled: Compiled, symbol: str) -> str:
    """Return the C of a casadi function under another name, without the parts for casadi's own loader."""
    title, text = compiled.title, compiled.source
    text = re.sub(r"/\* Configuration this file.*?_real_size\(void\)[^\n]*\n", "", text, flags=re.DOTALL)
    text = text.replace(f"#define CASADI_PREFIX(ID) {title}_ ## ID", f"#define CASADI_PREFIX(ID) {symbol}_ ## ID")
    head = f"CASADI_SYMBOL_EXPORT int {title}("
    before, _, after = text.partition(head)
    body, end, _ = after.partition("\n}\n")
    return before + f"int {symbol}(" + body + end


def literal(value: Any) -> str:
    """Return how C writes a number."""
    if isinstance(value, complex):
        return f"{{ {literal(value.real)}, {literal(value.imag)} }}"
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return f"INT64_C({value})" if value >= 0 else f"(-INT64_C({-value}))"
    if math.isnan(value):
        return "SR_NAN"
    if math.isinf(value):
        return "SR_INFINITY" if value > 0 else "(-SR_INFINITY)"
    text = repr(float(value))
    return f"SR_REAL({text if any(c in text for c in '.e') else text + '.0'})"


def bare(test: str) -> str:
    """Return a condition without outer parentheses, since clang warns about them."""
    depth = 0
    for k, sign in enumerate(test):
        depth += (sign == "(") - (sign == ")")
        if depth == 0:
            return bare(test[1:-1]) if test[0] == "(" and k == len(test) - 1 else test
    return test


def reads(name: str, text: str) -> bool:
    """Return whether a C text contains a name."""
    return re.search(rf"\b{re.escape(name)}(?!\w)", text) is not None


def _title(text: str) -> str:
    return text[: text.index("(")].rpartition(" ")[2]
