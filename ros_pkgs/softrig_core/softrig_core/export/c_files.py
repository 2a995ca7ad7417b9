"""The files of an exported block: header, source, golden rows, replay program, description."""

from __future__ import annotations

import hashlib
import inspect
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import resources
from typing import Any

import numpy as np

from ..block.block import Block
from ..block.params import ParameterError, build, declarations, flatten
from ..block.port import Port, Sample
from ..errors import RunError
from ..native.translate import as_slot, follow, written
from ..native.turns import Deciding
from ..native.twins import packed
from ..native.value import NotNative
from ..rig.members import Member
from ..solver.solver import Solver
from .drawn import Beyond, Raised, asks_anew, drawn_calls
from .golden import Call, Changed, keys_of, methods
from .kinds import ABSENT, INT, REAL, Absent, Kind, Maybe, Number, Table, Tuple, identifier, kind_of, leaves, remark
from .law import Form, Law, Text, as_answered, check_text, input_kind, law_of
from .reader import Reader
from .unit import Unit, Value, literal, reads

SUPPORT, DRAWS = "softrig_c.h", "softrig_draws.h"
STATES = 50  # number of calls whose result must not change with another value of a settable parameter
SHIFTS = (1.0625, 0.9375, 0.5, 2.0, -1.0)  # factors by which a parameter is tried, until one is in its bounds


@dataclass(frozen=True)
class Exported:
    """Files and functions exported for a block.

    Attributes
    ----------
    name : str
        Of the node: prefix of all names, and of the files.
    files : mapping of str to str
        Text by file name.
    libm : tuple of str
        Functions of the C library whose last bits another library may round otherwise.
    settable : tuple of str
        Parameters that `NODE_params` has.
    channels : tuple of str
        The values that it publishes, as ``topic/label``.
    discards : tuple of str
        Branches that C does not support, so that it returns SR_GAVE_UP although Python raises no error.
    ends : str
        Why the golden rows end before the run; empty if they do not, or if they have the requested number.
    end : int or None
        Time of the call at which they end for that reason, ns.
    """

    name: str
    files: Mapping[str, str]
    libm: tuple[str, ...]
    settable: tuple[str, ...]
    channels: tuple[str, ...]
    discards: tuple[str, ...]
    ends: str = ""
    end: int | None = None


def check_class(member: Member) -> None:
    """Refuse a class that cannot become C, whatever happens in the run.

    Raises
    ------
    NotNative
        It is such a class; the message names it.
    """
    cls = member.block_class
    title = _place_of(cls)
    if issubclass(cls, Solver):
        raise NotNative(f"{title}: it is a solver, whose work runs in a process of its own")
    if issubclass(cls, Deciding):
        raise NotNative(f"{title}: it leaves some ticks to Python (`decides`)")


def c_of_member(member: Member, golden: Sequence[Call | Changed], drawn: int, seed: int, single: bool) -> Exported:
    """Write a node as C and compare it with a run and with a number of random calls; see `c_files`.

    Raises
    ------
    NotNative
        Part of it has no C; the message names its class and the line.
    """
    cls = member.block_class
    title = f"{cls.__module__}.{cls.__qualname__}"
    refusal = NotNative()
    # A drawn call may lack an input that each call of the run has. If the block has no C for that, it is exported from
    # calls that have it.
    for absent in (True, False):
        block = member.block(seed)
        try:
            return c_files(
                member,
                block,
                golden,
                drawn_calls(member, member.block(seed), golden, drawn, seed, absent=absent),
                single=single,
            )
        except NotNative as reason:
            refusal = reason
    text = str(refusal)
    if text.startswith(f"{title}."):
        raise refusal
    raise NotNative(f"{_place_of(cls)}: {text}")


def _place_of(cls: type) -> str:
    """Return the name of a class, and its line if it has a file; a generated class has none."""
    title = f"{cls.__module__}.{cls.__qualname__}"
    try:
        return f"{title}, line {inspect.getsourcelines(cls)[1]}"
    except (OSError, TypeError):
        return title


def c_files(
    member: Member,
    block: Block,
    golden: Sequence[Call | Changed],
    drawn: Sequence[Sequence[Call | Raised]],
    *,
    single: bool = False,
) -> Exported:
    """Write a block as C.

    Parameters
    ----------
    block : Block
        As at the begin of the run.
    golden : sequence of Call or Changed
        Of a run, from its first tick on.
    drawn : sequence of sequences of Call or Raised
        Further calls, each sequence from the first state on.
    single : bool
        Numbers are float.

    Raises
    ------
    NotNative
        Part of it has no C; the message names the line.
    """
    return _Files(member, block, golden, drawn, single).exported()


class _Files:
    def __init__(
        self,
        member: Member,
        block: Block,
        golden: Sequence[Call | Changed],
        drawn: Sequence[Sequence[Call | Raised]],
        single: bool,
    ) -> None:
        self.single = single
        self.member, self.block = member, block
        self.name = re.sub(r"\W", "_", member.name)
        self.inputs, self.outputs = member.inputs, member.outputs
        self.methods = methods(block)
        calls = [c for calls in (golden, *drawn) for c in calls if isinstance(c, Call)]
        # The age of an input that was late in one of the calls has no C: it depends on what the node received before.
        punctual = {p.name for p in self.inputs}.difference(*(c.late for c in calls))
        self.law: Law = law_of(block, punctual, self.inputs, self.outputs, calls)
        self.slots = list(self.law.program.slots)
        self.values = [as_slot(follow(path, [block, block])) for path in self.slots]
        self.fields = _fields([f"{'before.' * path[0]}{written(path)}" for path in self.slots])
        self.goes_on = any(form.method == "go_on" for form in self.law.roots)
        states = [] if self.goes_on else [c.x for c in calls[:: len(calls) // STATES + 1]]
        self.settable = _settable(block, self.law, self.slots, self.values, states)
        self.golden, self.ends = self._replayable(golden)
        self.end = golden[len(self.golden)].t if self.ends else None
        text = Text(block, self.law, self.inputs)
        # Before any C is written, so that a branch of the run that has no C is refused with its time and reason.
        check_text(text, self.golden, self.outputs)
        self.drawn, without = as_answered(text, drawn)
        self.held = [k for k, path in enumerate(self.slots) if self._is_held(k, path)]
        # As a literal with a name in the source the compiler folds a constant, and the RAM of a board does not hold it.
        self.words = {  # constants that are compiled in, by their names in C
            f"{self.name.upper()}_K_{self.fields[k]}": k
            for k, v in enumerate(self.values)
            if isinstance(v, float) and k not in self.held
        }
        constants: list[Any] = list(self.values)
        for k in self.held:
            constants[k] = Value(kind_of(self.values[k]), f"s->k.{self.fields[k]}")
        for word, k in self.words.items():
            constants[k] = Value(REAL, word)
        indices = {p.at: k for k, p in enumerate(self.law.reports.places)}
        program = self.law.program
        casadi = {name: program.names[f"{name}_there"] for name in program.callers.values()}
        self.draws = {name: follow(path, [block, block]) for path, name in program.draws.items()}
        self.unit = Unit(self.name, Reader, self.law.texts, program.names, constants, indices, casadi=casadi)
        self.unit.by_name |= self.draws
        self.unit.fixed |= {word: self.values[k] for word, k in self.words.items()}
        self.forms = self.law.states
        self.stores: dict[str, Table] = {}
        for form in self.forms:
            for path, table in leaves(form):
                known = self.stores.get(_store(path))
                if known is not None and known.item != table.item:
                    raise NotNative(f"{path} is an array of two types")
                # Forms of the state share the memory of an array, so it has room for the longest.
                if known is None or known.size < table.size:
                    self.stores[_store(path)] = table
        self.state_types = [self.unit.c(state) for state in self.forms]
        self.held_types = [self.unit.c(kind_of(self.values[k])) for k in self.held]
        # Types that the struct needs are in the header; those that only functions need are in the source.
        self.in_header = len(self.unit.typedefs)
        newest = {f"a value that {written(path)} is asked for later" for path in self.law.program.newest}
        self.discards = tuple(sorted({*self.law.program.seldom, *newest, *without}))
        self.roots = {form: self._root(form) for form in self.law.roots}

    def _is_held(self, k: int, path: Any) -> bool:
        """Return whether a constant is stored in the struct, because it may be set; the others are literals."""
        before = path[0] == 1 and written(path).removeprefix("p.") in self.settable
        return before or any(k in ks for ks in self.settable.values())

    def _replayable(self, golden: Sequence[Call | Changed]) -> tuple[Sequence[Call | Changed], str]:
        """Return the calls up to the first that C does not support (a change, or a kept value), and the reason."""
        at_hand = keys_of(self.block)
        for k, call in enumerate(golden):
            # C has a kept answer for one value and discards a call that asks for another one; Python's next rows would
            # follow from a state that C does not have.
            if isinstance(call, Call) and asks_anew(call, at_hand):
                paths = ", ".join(sorted(written(path) for path in self.law.program.newest))
                return golden[:k], f"the rows end at {call.t / 1e9:g} s: {paths} is asked for another value"
            if isinstance(call, Changed):
                fixed = sorted(call.names - self.settable.keys())
                if fixed or (call.moved and not self.goes_on):
                    why = (
                        f"{', '.join(fixed)} changed, which is compiled in" if fixed else "the state changed with them"
                    )
                    return golden[:k], f"the rows end at {call.t / 1e9:g} s: {why}"
        return golden, ""

    # reading ------------------------------------------------------------------------------------------------------

    def _root(self, form: Form) -> Any:
        kinds: list[Kind] = [ABSENT, ABSENT]
        handed: list[Any] = ["", ""]
        for name in self.law.arrays[form]:
            if name == "reports" or name in self.law.program.scratches.values() or name in self.draws:
                kinds.append(ABSENT)
                handed.append(name if name in self.draws else "")
                continue
            value = self.unit.table(self._array(name), name)
            kinds.append(value.kind)
            handed.append(value.c)
        kinds.append(form.state)
        if form.method != "go_on":
            kinds += [INT, *(input_kind(p) for p in self.inputs if p.name in form.present)]
        handed += [None] * (len(kinds) - len(handed))
        return self.unit.call(self.law.roots[form], tuple(kinds), tuple(handed), True)

    def _array(self, name: str) -> Any:
        program = self.law.program
        for path, known in program.arrays.items():
            if known == name:
                return np.ascontiguousarray(follow(path, [self.block, self.block]))
        raise NotNative(f"it needs {name}, which only a rig has")

    # writing ------------------------------------------------------------------------------------------------------

    def exported(self) -> Exported:
        """Return all files."""
        header, source = self.header(), self.source()
        channels = tuple(f"{p.topic}/{label}" for p in self.outputs for label in p.labels)
        # The header contains its own digest, which is computed with a placeholder in its place.
        digest = hashlib.sha256((header + source).encode()).hexdigest()[:16]
        files = {
            SUPPORT: (resources.files(__package__) / SUPPORT).read_text(),
            f"{self.name}.h": header.replace("@DIGEST@", digest),
            f"{self.name}.c": source,
            **({DRAWS: (resources.files(__package__) / DRAWS).read_text()} if self.draws else {}),
            **{f"{name}.c": _CASADI.format(n=self.name) + text for name, text in self.unit.sources.items()},
            f"{self.name}_rows.txt": self.rows(),
            f"{self.name}_replay.c": self.replay(),
            f"{self.name}_main.c": self.example(),
            f"{self.name}.json": self.description(digest),
        }
        libm = tuple(sorted(self.unit.libm))
        return Exported(self.name, files, libm, tuple(self.settable), channels, self.discards, self.ends, self.end)

    def header(self) -> str:
        """Return the header."""
        n, upper = self.name, self.name.upper()
        title = (inspect.getdoc(type(self.block)) or n).partition("\n")[0]
        period = self.member.schedule.period
        reports = self.law.reports.places
        lines = [
            f"/** @file {n}.h",
            f" * {remark(title)}",
            " *",
            f" * Written by `softrig export c`. {type(self.block).__module__}.{type(self.block).__qualname__}",
            " * No dynamic memory, no static data but constant tables, no recursion. SI units.",
            " */",
            f"#ifndef {upper}_H",
            f"#define {upper}_H",
            "",
            *(["#ifndef SR_FLOAT", "#define SR_FLOAT", "#endif"] if self.single else []),
            f'#include "{DRAWS if self.draws else SUPPORT}"',
            "",
            f'#define {upper}_DIGEST "@DIGEST@" /**< of this build */',
            f"#define {upper}_PERIOD_NUMERATOR {period.numerator} /**< period, s, as a fraction */",
            f"#define {upper}_PERIOD_DENOMINATOR {period.denominator}",
            "",
            *self._params(),
            *self._ports("in", self.inputs),
            *self._ports("out", self.outputs),
            *(t.rstrip("\n") for t in self.unit.typedefs[: self.in_header]),
            "",
        ]
        if reports:
            lines += ["/** Reports, counted in the member `reports`; their texts are in the JSON file. */", "enum {"]
            lines += [f"    {upper}_REPORT_{k} = {k}, /**< {remark(p.key)} */" for k, p in enumerate(reports)]
            lines += ["};", ""]
        lines += [
            "/** All that the node remembers; its constants. Treat the members as private. */",
            f"typedef struct {n} {{",
            "    struct {",
            *(
                f"        {t} {self.fields[k]}; /**< {remark(written(self.slots[k]))} */"
                for k, t in zip(self.held, self.held_types, strict=True)
            ),
            # C has no empty structs.
            *([] if self.held else ["        uint8_t nothing;"]),
            "    } k;",
            # A state has one of its types at a time.
            "    union {",
            *(f"        {t} f{i};" for i, t in enumerate(self.state_types)),
            "    } x;",
            "    uint8_t form; /**< which of them holds the state */",
            *self._struct("a", self.stores, "arrays of the state"),
            *self._struct("b", self.stores, "the same while a call works on them"),
            *self._struct("m", self.unit.rooms, "arrays that functions return"),
            "    bool discarded;",
            *(f"    sr_draws {name}; /**< a stream of random numbers */" for name in self.draws),
            *([f"    uint32_t reports[{len(reports)}];", f"    uint32_t pending[{len(reports)}];"] if reports else []),
            *(["    bool reported; /**< whether one is pending */"] if reports else []),
            f"}} {n};",
            "",
            "#ifdef __cplusplus",
            'extern "C" {',
            "#endif",
            "",
            "/** Go to the state before the first tick.",
            f" * @param params see {n}_params; NULL: the values of the scenario */",
            f"void {n}_init({n} *s, const {n}_params *params);",
            "",
            "/** Set other parameters between two ticks; the state stays unchanged. */",
            f"void {n}_set({n} *s, const {n}_params *params);",
            "",
        ]
        for method, head in self._heads().items():
            lines += [
                f"/** {_WORDS[method]}",
                " * @return SR_DONE, or SR_GAVE_UP where Python raises an error */",
                f"{head};",
                "",
            ]
        return "\n".join([*lines, "#ifdef __cplusplus", "}", "#endif", "", "#endif", ""])

    def _struct(self, name: str, arrays: Mapping[str, Table], purpose: str) -> list[str]:
        if not arrays:
            return []
        inner = [f"        {self.unit.c(t.item)} {n}[{max(t.size, 1)}];" for n, t in arrays.items()]
        return ["    struct {", *inner, f"    }} {name}; /**< {purpose} */"]

    def _heads(self) -> dict[str, str]:
        n = self.name
        inputs, outputs = f"const {n}_in *in", f"{n}_out *out"
        heads = {
            "update": f"int {n}_step({n} *s, {inputs}, {outputs}, int64_t t_ns)",
            "outputs": f"int {n}_outputs({n} *s, {outputs}, int64_t t_ns)",
            "advance": f"int {n}_advance({n} *s, {inputs}, int64_t t_ns)",
        }
        return {method: heads[method] for method in self.methods}

    def _params(self) -> list[str]:
        n = self.name
        known = {d.name: d for d in declarations(type(self.block.p))}
        lines = [
            "/** Parameters that may be set; the others are compiled in, since constants follow from them. */",
            f"typedef struct {n}_params {{",
        ]
        defaults = []
        for name, (k, *_) in self.settable.items():
            kind, documented = kind_of(self.values[k]), known[name]
            unit = f" {documented.unit}" if documented.unit else ""
            text = f"{documented.doc}: {documented.lower:g} to {documented.upper:g}{unit}; not checked"
            lines.append(f"    {self.unit.c(kind)} {identifier(name)}; /**< {remark(text)} */")
            defaults.append(_initial(self.values[k]))
        if not self.settable:
            lines.append("    uint8_t nothing;")
            defaults.append("0")
        lines += [
            f"}} {n}_params;",
            "",
            f"#define {n.upper()}_PARAMS {{ {', '.join(defaults)} }} /**< of the scenario */",
            "",
        ]
        return lines

    def _ports(self, kind: str, ports: Sequence[Port]) -> list[str]:
        lines = [f"/** {'Inputs' if kind == 'in' else 'Outputs'}. */", f"typedef struct {self.name}_{kind} {{"]
        for port in ports:
            if port.held if kind == "in" else port.sporadic:
                lines.append(f"    bool has_{identifier(port.name)}; /**< false: {remark(port.topic)} has no value */")
            each = ", ".join(
                f"{label} {unit}{f' up to +-{limit:g}' if math.isfinite(limit) else ''}"
                for label, unit, limit in zip(port.labels, port.units, port.limits, strict=True)
            )
            if port.delayed:
                lines.append(f"    int64_t {identifier(port.name)}_stamp_ns; /**< when it was acquired */")
            text = f"{remark(port.topic)}: {remark(each)}"
            lines.append(f"    real_t {identifier(port.name)}[{max(port.size, 1)}]; /**< {text} */")
        return [*lines, *([] if ports else ["    uint8_t nothing;"]), f"}} {self.name}_{kind};", ""]

    def source(self) -> str:
        """Return the source."""
        n = self.name
        body = [self._init(), *(self._method(method, head) for method, head in self._heads().items())]
        tables, functions = self.unit.used([root.name for root in self.roots.values()])
        parts = [
            f"/* {n}.c: see {n}.h. Written by `softrig export c`. */",
            f'#include "{n}.h"\n\n#include <stddef.h>\n#include <string.h>\n',
            *self._words("".join(functions)),
            *self.unit.typedefs[self.in_header :],
            *(
                f"int {name}(const real_t **arg, real_t **res, long long int *iw, real_t *w, int mem);"
                for name in self.unit.sources
            ),
            *tables,
            "",
            *functions,
            *([self._reported()] if self.law.reports.places else []),
            *body,
        ]
        return "\n".join(parts)

    def _words(self, text: str) -> list[str]:
        """Write the constants that are compiled in and that the functions read."""
        lines = [
            f"#define {word} {literal(self.values[k])} /* {remark(written(self.slots[k]))} */"
            for word, k in self.words.items()
            if reads(word, text)
        ]
        return [*lines, ""] if lines else []

    def _init(self) -> str:
        n = self.name
        first = packed(self.block.first())
        tables = {
            f"{n}_first_{_store(path)}": (path, np.asarray(value).ravel())
            for path, value in _arrays(first)
            # `memset` has set the others.
            if np.asarray(value).any()
        }
        lines = [
            *(
                f"static SR_TABLE {self.unit.c(kind_of(v[0].item()))} {table}[{v.size}] = "
                f"{{ {', '.join(map(literal, v.tolist()))} }};"
                for table, (_, v) in tables.items()
            ),
            f"static void {n}_take({n} *s, const {n}_params *params)",
            "{",
            *(
                f"    s->k.{self.fields[k]} = params->{identifier(name)};"
                for name, ks in self.settable.items()
                for k in ks
            ),
            "    (void)s;",
            "    (void)params;",
            "}",
            "",
            f"void {n}_set({n} *s, const {n}_params *params)",
            "{",
            *(f"    {line}" for line in self._set()),
            "}",
            "",
            f"void {n}_init({n} *s, const {n}_params *params)",
            "{",
            "    memset(s, 0, sizeof *s);",
        ]
        lines += [f"    s->k.{self.fields[k]} = {_initial(self.values[k])};" for k in self.held]
        lines.append(f"    s->x.f0 = ({self.state_types[0]}){_initial(first)};")
        lines += [f"    memcpy(s->a.{_store(path)}, {table}, sizeof {table});" for table, (path, _) in tables.items()]
        for name, draws in self.draws.items():
            # C99 has no whole numbers of 128 bits.
            words = ", ".join(f"UINT64_C({part})" for word in draws.words for part in divmod(word, 1 << 64))
            lines.append(f"    sr_draws_init(&s->{name}, {words});")
        lines += ["    if (params != NULL) {", f"        {n}_take(s, params);", "    }", "}", ""]
        return "\n".join(lines)

    def _set(self) -> list[str]:
        """Write the function that sets other parameters and adapts the state as Python does."""
        lines = []
        for k in self.held:
            # `go_on` reads the parameters from before the change, so these are copied before the new ones are taken.
            if self.slots[k][0] == 1:
                name = written(self.slots[k]).removeprefix("p.")
                lines.append(f"s->k.{self.fields[k]} = s->k.{self.fields[self.settable[name][0]]};")
        lines.append(f"{self.name}_take(s, params);")
        if self.goes_on:
            lines += ["bool known = false;", "s->discarded = false;"]
            for form, root in self.roots.items():
                if form.method == "go_on":
                    lines += self._way(form, root)
            lines.append("(void)known;")
        return lines

    def _method(self, method: str, head: str) -> str:
        """Write a function that a user calls: choose by the form, compute, check, copy the state."""
        with_out = method != "advance"
        lines = [head, "{", "    bool known = false;"]
        # The replay is compiled with warnings as errors, among them that of an unused argument.
        lines += ["    (void)in;"] * (method != "outputs") + ["    (void)out;"] * with_out
        lines += ["    (void)t_ns;", "    s->discarded = false;"]
        for form, root in self.roots.items():
            if form.method == method:
                lines += [f"    {line}" for line in self._way(form, root)]
        # Without a known form: the state and the inputs that are present did not occur together when the text was made.
        lines.append("    if (SR_RARELY(!known || s->discarded)) {")
        if with_out:
            for port in self.outputs:
                name = identifier(port.name)
                lines += [f"        out->{name}[{i}] = {literal(v)};" for i, v in enumerate(port.safe)]
                if port.delayed:
                    lines.append(f"        out->{name}_stamp_ns = t_ns;")
                if port.sporadic:
                    lines.append(f"        out->has_{name} = false;")
        if self.law.reports.places:
            lines.append(f"        {self.name}_reported(s, 0u);")
        lines += ["        return SR_GAVE_UP;", "    }"]
        if self.law.reports.places:
            lines += ["    if (SR_RARELY(s->reported)) {", f"        {self.name}_reported(s, 1u);", "    }"]
        return "\n".join([*lines, "    return SR_DONE;", "}", ""])

    def _reported(self) -> str:
        """Write code that counts the reports of an answered tick, and drops those of another one."""
        lines = [f"static void {self.name}_reported({self.name} *s, uint32_t times)", "{"]
        lines += [f"    for (unsigned i = 0; i < {len(self.law.reports.places)}u; i++) {{"]
        lines += ["        s->reports[i] += times * s->pending[i];", "        s->pending[i] = 0;", "    }"]
        return "\n".join([*lines, "    s->reported = false;", "}", ""])

    def _way(self, form: Form, root: Any) -> list[str]:
        present = [p for p in self.inputs if form.method not in ("outputs", "go_on")]
        tests = [f"s->form == {self.forms.index(form.state)}u"] if len(self.forms) > 1 else []
        for port in present:
            if port.held:
                tests.append(f"{'' if port.name in form.present else '!'}in->has_{identifier(port.name)}")
        args = ["s", *(["x"] if not isinstance(form.state, Absent) else []), *["t_ns"] * (form.method != "go_on")]
        for port in present:
            if port.name in form.present:
                name = identifier(port.name)
                numbers = ", ".join(f"in->{name}[{i}]" for i in range(port.size)) or "0"
                stamped = f"in->{name}_stamp_ns, {{ {numbers} }}" if port.delayed else numbers
                args.append(f"({self.unit.c(input_kind(port))}){{ {stamped} }}")
        # A call stores the next state, whose form a later test may fit: only the first that fits may answer.
        lines = [f"if ({' && '.join(['!known', *(f'({t})' for t in tests)])}) {{", "    known = true;"]
        k = self.forms.index(form.state)
        lines += [f"    {self.state_types[k]} x = s->x.f{k};", "    (void)x;"]
        for path, _ in leaves(form.state):
            # A call works on a copy of the arrays, because a discarded one must leave the state unchanged.
            lines.append(f"    memcpy(s->b.{_store(path)}, s->a.{_store(path)}, sizeof s->b.{_store(path)});")
            lines.append(f"    x{path} = s->b.{_store(path)};")
        lines.append(f"    {self.unit.c(root.result)} r = {root.name}({', '.join(args)});")
        inner = ["(void)r;"]
        state: Value | None = None
        if form.method in ("advance", "go_on"):
            state = Value(root.result, "r")
        elif form.method == "update":
            state = Value(root.result.items[0], "r.f0")
        if form.method not in ("advance", "go_on"):
            k = 1 if form.method == "update" else 0
            inner += self._published(*(Value(root.result.items[i], f"r.f{i}") for i in (k, k + 1)))
        lines += ["    if (SR_MOSTLY(!s->discarded)) {", *(f"        {line}" for line in inner), "    }"]
        # Another test, because the checks of the outputs may have discarded the tick.
        if state is not None:
            lines += [
                "    if (SR_MOSTLY(!s->discarded)) {",
                *(f"        {line}" for line in self._store_state(state)),
                "    }",
            ]
        lines.append("}")
        return lines

    def _published(self, row: Value, stamps: Value) -> list[str]:
        """Write the function that stores the numbers of an answer, each finite and within the limit of its port."""
        assert isinstance(row.kind, Tuple)
        assert isinstance(stamps.kind, Tuple)
        names, stamped = iter(row.kind.names), iter(stamps.kind.names)
        lines: list[str] = []
        checks: list[str] = []
        for port in self.outputs:
            name, flag_ = identifier(port.name), ""
            if port.sporadic:
                flag_ = f"{row.c}.{next(names)}"
                lines.append(f"out->has_{name} = ({flag_} != SR_REAL(0));")
            if port.delayed:
                lines.append(f"out->{name}_stamp_ns = {stamps.c}.{next(stamped)};")
            for i, limit in enumerate(port.limits):
                c = f"{row.c}.{next(names)}"
                lines.append(f"out->{name}[{i}] = {c};")
                if not port.unchecked:
                    bounded = f"SR_MATH(fabs)({c}) <= {literal(limit)}"
                    checks.append(f"(({flag_} == SR_REAL(0)) || ({bounded}))" if flag_ else f"({bounded})")
        if checks:
            # The function that the user calls replaces the outputs of a discarded tick by safe values.
            lines += [f"if (SR_RARELY(!({' && '.join(checks)}))) {{", "    s->discarded = true;", "}"]
        return lines

    def _store_state(self, state: Value) -> list[str]:
        """Write the function that stores the state in its present form."""
        if state.kind in self.forms:
            k = self.forms.index(state.kind)
            return [f"s->x.f{k} = {state.c};", *([f"s->form = {k}u;"] if len(self.forms) > 1 else []), *self._kept(k)]
        lines: list[str] = []
        for k, form in enumerate(self.forms):
            tests: list[str] = []
            code = self._as(state, form, tests)
            if code is None:
                continue
            test = " && ".join(tests) or "true"
            lines += [f"{'} else ' if lines else ''}if ({test}) {{", f"    s->x.f{k} = {code};", f"    s->form = {k}u;"]
            lines += [f"    {line}" for line in self._kept(k)]
        return [*lines, "} else {", "    s->discarded = true;", "}"] if lines else ["s->discarded = true;"]

    def _kept(self, k: int) -> list[str]:
        """Write code that copies the arrays of a state, because a copy of a node needs its own."""
        lines: list[str] = []
        for path, table in leaves(self.forms[k]):
            store = f"s->a.{_store(path)}"
            size = f"{max(table.size, 1)}u * sizeof {store}[0]"
            lines += [f"memcpy({store}, s->x.f{k}{path}, {size});", f"s->x.f{k}{path} = NULL;"]
        return lines

    def _as(self, value: Value, kind: Kind, tests: list[str]) -> str | None:
        """Return a value converted to a type, with the conditions under which it has it; None if it never has."""
        if isinstance(value.kind, Maybe):
            if isinstance(kind, Absent):
                tests.append(f"!{value.c}.some")
                return "0"
            tests.append(f"{value.c}.some")
            return self._as(Value(value.kind.item, f"{value.c}.item"), kind, tests)
        if value.kind == kind:
            return value.c
        if isinstance(kind, Number) and isinstance(value.kind, Number) and kind.rank > value.kind.rank:
            return f"({kind.c}){value.c}"
        if isinstance(kind, Tuple) and isinstance(value.kind, Tuple) and len(kind.items) == len(value.kind.items):
            parts = [
                self._as(Value(k, f"{value.c}.{identifier(n)}"), wanted, tests)
                for k, n, wanted in zip(value.kind.items, value.kind.names, kind.items, strict=True)
            ]
            if None in parts:
                return None
            inner = ", ".join(
                f".{identifier(n)} = {p}"
                for n, p, k in zip(kind.names, parts, kind.items, strict=True)
                if not isinstance(k, Absent)
            )
            return f"({self.unit.c(kind)}){{ {inner or '0'} }}"
        return None

    # rows and their replay ----------------------------------------------------------------------------------------

    def rows(self) -> str:
        """Return the golden rows, one call a line: ``method status t inputs... | outputs...``, numbers as %a.

        The status is 0, 1 if Python raises an error, and 2 if C may discard a tick that Python answers.
        """
        lines = []
        for calls in (self.golden, *self.drawn):
            if calls:
                lines.append("init")
            for call in calls:
                if isinstance(call, Changed):
                    lines.append(" ".join(["set", *(_setting_text(call.values[name]) for name in self.settable)]))
                    continue
                number = self.methods.index(call.method)
                status = 1 if isinstance(call, Raised) else 2 if isinstance(call, Beyond) else 0
                row = [f"{number} {status} {call.t}"]
                if call.method != "outputs":
                    row += numbers_of(self.inputs, call.inputs, "held")
                if call.method != "advance":
                    safe = {
                        p.name: None if p.sporadic else Sample(call.t, p.safe) if p.delayed else p.safe
                        for p in self.outputs
                    }
                    row += numbers_of(self.outputs, safe if isinstance(call, Raised) else call.outputs, "sporadic")
                lines.append(" ".join(row))
        return "\n".join(lines) + "\n"

    def replay(self) -> str:
        """Return the program that replays the rows and compares."""
        n = self.name
        cases = []
        for number, method in enumerate(self.methods):
            reads = [f"    {line}" for line in _read("in", self.inputs, "held")] if method != "outputs" else []
            call = {
                "update": f"{n}_step(&node, &in, &out, t)",
                "outputs": f"{n}_outputs(&node, &out, t)",
                "advance": f"{n}_advance(&node, &in, t)",
            }[method]
            checks = [f"    {line}" for line in compared(self.outputs)] if method != "advance" else []
            cases += [
                f"        case {number}:",
                *(f"        {line}" for line in reads),
                f"            status = {call};",
                *(["            if ((wanted != 2) || (status == SR_DONE)) {"] if checks else []),
                *(f"            {line}" for line in checks),
                *(["            }"] if checks else []),
                "            break;",
            ]
        sets = []
        for name, (k, *_) in self.settable.items():
            kind, field = self.unit.c(kind_of(self.values[k])), identifier(name)
            scanned = "number(&at)" if kind == "real_t" else f"({kind})strtoll(at, &at, 10)"
            sets.append(f"            params.{field} = {scanned};")
        channels = sum(p.size for p in self.outputs)
        words = {"n": n, "upper": n.upper(), "channels": channels}
        return _REPLAY.format(sets="\n".join(sets), cases="\n".join(cases), **words)

    def example(self) -> str:
        """Return a program that calls the node at its first ticks."""
        n, (num, den) = self.name, (self.member.schedule.period * 10**9).as_integer_ratio()
        time = f"k * INT64_C({num})" if den == 1 else f"(k * INT64_C({num})) / INT64_C({den})"
        calls = {"update": "step(&node, &in, &out, t)", "outputs": "outputs(&node, &out, t)"}
        calls["advance"] = "advance(&node, &in, t)"
        port = next((p for p in self.outputs if p.size), None)
        shown = f"(double)out.{identifier(port.name)}[0]" if port is not None else "0.0"
        acts = " || ".join(f"({n}_{calls[m]} != SR_DONE)" for m in self.methods)
        return _MAIN.format(n=n, time=time, acts=acts, shown=shown)

    def description(self, digest: str) -> str:
        """Return the JSON description."""
        m, p = self.member, flatten(self.block.p)
        ports = [
            {
                "direction": way,
                "name": port.name,
                "topic": port.topic,
                "type": port.msgtype,
                "channels": port.channels,
                "fields": port.fields,
                "frame_id": port.frame_id,
                "dims": port.dims,
                **{name: True for name in ("held", "sporadic", "delayed", "partial") if getattr(port, name)},
                "values": [
                    {"label": label, "unit": unit, "limit": limit, "safe": safe}
                    for label, unit, limit, safe in zip(port.labels, port.units, port.limits, port.safe, strict=True)
                ],
            }
            for way, ports in (("in", self.inputs), ("out", self.outputs))
            for port in ports
        ]
        results = {
            "node": m.name,
            "class": f"{type(self.block).__module__}:{type(self.block).__qualname__}",
            "digest": digest,
            "real": "float" if self.single else "double",
            "period_s": [m.schedule.period.numerator, m.schedule.period.denominator],
            "parameters": {k: v for k, v in p.items() if isinstance(v, (int, float, str, bool, list, tuple))},
            "settable": list(self.settable),
            "ports": ports,
            "constants": [
                {"path": written(path), "field": self.fields[k] if k in self.held else None, "value": self.values[k]}
                for k, path in enumerate(self.slots)
            ],
            "guards": [written(path) for path in self.law.program.guards],
            "discards": self.discards,
            "state_forms": len(self.forms),
            "reports": [
                {"code": k, "level": r.level.name, "key": r.key} for k, r in enumerate(self.law.reports.places)
            ],
            "library_functions": sorted(self.unit.libm),
            "sources": [f"{name}.c" for name in self.unit.sources],
            "golden_rows": len(self.golden),
            "drawn_rows": sum(map(len, self.drawn)),
        }
        return json.dumps(results, indent=1, default=str) + "\n"


_MAIN = """/* Example: the first ticks with all inputs zero and held ones absent. Written by `softrig export c`. */
#include "{n}.h"

#include <stddef.h>
#include <stdio.h>
#include <string.h>

static {n} node;

int main(void)
{{
    {n}_in in;
    {n}_out out;
    memset(&in, 0, sizeof in);
    memset(&out, 0, sizeof out);
    {n}_init(&node, NULL);
    for (int64_t k = 0; k < 3; k++) {{
        const int64_t t = {time};
        const int gave_up = ({acts}) ? 1 : 0;
        printf("%.9f s: %s %.17g\\n", (double)t * 1e-9, gave_up ? "gave up" : "answered", {shown});
    }}
    return 0;
}}
"""

_CASADI = """/* Written by CasADi, called by the node. Written by `softrig export c`. */
#include "{n}.h"
#if defined(__GNUC__)
#pragma GCC diagnostic ignored "-Wunused-parameter"
#pragma GCC diagnostic ignored "-Wunused-const-variable"
#pragma GCC diagnostic ignored "-Wmissing-prototypes"
#endif
#ifdef SR_FLOAT
#define casadi_real float
#endif
"""

_WORDS = {
    "update": "Answer one tick.",
    "outputs": "Compute the outputs at t.",
    "advance": "Move the state on by one period with the inputs held.",
}

# Three parts of the programs that compare golden rows, of a node here and of a rig in `rig_c`.
REPLAY_HEAD = """#include "{n}.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define CHANNELS {channels}

static unsigned long rows, differing, gave_up, wrong_status;
static int sequence;               /* the first one is of the run, the others have drawn inputs */
static double error[CHANNELS + 1]; /* of the run: largest by channel, and the largest number there */
static double scale[CHANNELS + 1];

static void compare(int channel, real_t got, real_t wanted)
{{
    if (sequence == 1) {{
        scale[channel] = fmax(scale[channel], fabs((double)wanted));
        error[channel] = fmax(error[channel], fabs((double)got - (double)wanted));
    }}
    if (!((got == wanted && (signbit(got) != 0) == (signbit(wanted) != 0)) || (got != got && wanted != wanted))) {{
        differing++;
    }}
}}

static real_t number(char **at)
{{
    return (real_t)strtod(*at, at);
}}

int main(int argc, char **argv)
{{
"""

REPLAY_OPEN = """    FILE *file = fopen(argc > 1 ? argv[1] : "{n}_rows.txt", "r");
    if (file == NULL) {{
        fprintf(stderr, "cannot read the rows\\n");
        return 2;
    }}
    (void)number; /* a node without values reads and compares none */
    (void)compare;
"""

REPLAY_END = """    fclose(file);
    printf("{{\\"rows\\": %lu, \\"differing\\": %lu, ", rows, differing);
    printf("\\"gave_up\\": %lu, \\"wrong_status\\": %lu, \\"errors\\": [", gave_up, wrong_status);
    for (int i = 0; i < CHANNELS; i++) {{
        printf("%s[%.3g, %.3g]", (i > 0) ? ", " : "", error[i], scale[i]);
    }}
    printf("]}}\\n");
    return (differing != 0 || wrong_status != 0) ? 1 : 0;
}}
"""

_REPLAY = (
    """/* Replays {n}_rows.txt and compares bit for bit; prints what differs. Written by `softrig export c`. */
"""
    + REPLAY_HEAD
    + """    static char line[1 << 16];
    {n} node;
    {n}_in in;
    {n}_out out;
    {n}_params params = {upper}_PARAMS;
"""
    + REPLAY_OPEN
    + """    memset(&in, 0, sizeof in);
    memset(&out, 0, sizeof out);
    while (fgets(line, sizeof line, file) != NULL) {{
        char *at = line;
        int status = 0;
        if (strncmp(line, "init", 4) == 0) {{
            {n}_init(&node, NULL);
            sequence++;
            continue;
        }}
        if (strncmp(line, "set", 3) == 0) {{
            at += 3;
{sets}
            {n}_set(&node, &params);
            continue;
        }}
        const long method = strtol(at, &at, 10);
        const long wanted = strtol(at, &at, 10);
        const int64_t t = (int64_t)strtoll(at, &at, 10);
        rows++;
        switch (method) {{
{cases}
        default:
            fprintf(stderr, "a row of an unknown method\\n");
            return 2;
        }}
        gave_up += (status != 0) ? 1u : 0u;
        wrong_status += ((wanted != 2) && ((status != 0) != (wanted != 0))) ? 1u : 0u;
        (void)t;
    }}
"""
    + REPLAY_END
)


def numbers_of(ports: Sequence[Port], values: Mapping[str, Any], flag: str) -> list[str]:
    """Return how the golden rows contain the values of ports; ports that may be absent have a flag."""
    row = []
    for port in ports:
        value = values.get(port.name)
        if getattr(port, flag):
            row.append(str(int(value is not None)))
        if port.delayed:
            row.append(str(0 if value is None else value.stamp))
            value = None if value is None else value.data
        row += [float(v).hex() for v in (value if value is not None else (0.0,) * port.size)]
    return row


def _read(struct: str, ports: Sequence[Port], flag: str) -> list[str]:
    lines = []
    for port in ports:
        name = identifier(port.name)
        if getattr(port, flag):
            lines.append(f"{struct}.has_{name} = strtol(at, &at, 10) != 0;")
        if port.delayed:
            lines.append(f"{struct}.{name}_stamp_ns = (int64_t)strtoll(at, &at, 10);")
        if port.size:
            lines += [f"for (int i = 0; i < {port.size}; i++) {{", f"    {struct}.{name}[i] = number(&at);", "}"]
    return lines


def compared(ports: Sequence[Port], out: str = "out", channel: int = 0) -> list[str]:
    """Return code that compares outputs with the numbers of a golden row, from a column on."""
    lines: list[str] = []
    for port in ports:
        name = identifier(port.name)
        if port.sporadic:
            lines += [
                f"if ((strtol(at, &at, 10) != 0) != {out}.has_{name}) {{",
                "    differing++;",
                "}",
            ]
        if port.delayed:
            lines += [f"if ((int64_t)strtoll(at, &at, 10) != {out}.{name}_stamp_ns) {{", "    differing++;", "}"]
        if port.size:
            test = f"{out}.has_{name}" if port.sporadic else "true"
            lines += [f"for (int i = 0; i < {port.size}; i++) {{", "    const real_t expected = number(&at);"]
            lines += [
                f"    if ({test}) {{",
                f"        compare({channel} + i, {out}.{name}[i], expected);",
                "    }",
                "}",
            ]
        channel += port.size
    return lines


def _settable(
    block: Block, law: Law, slots: Sequence[Any], values: Sequence[Any], states: Sequence[Any]
) -> dict[str, tuple[int, ...]]:
    """Return the live parameters that can be set in C, because only constants contain them: name to slots.

    This is tried, not deduced: another block with that parameter moved is created and compared.
    """
    result: dict[str, tuple[int, ...]] = {}
    first, known = block.first(), flatten(block.p)
    live = {d.name for d in declarations(type(block.p)) if d.live}
    for name, value in known.items():
        if name not in live or type(value) not in (int, float) or value not in values:
            continue
        changed, now = _moved(block, known, name)
        if changed is None or law.program.differs([changed, block]):
            continue
        altered = [as_slot(follow(p, [changed, block])) for p in slots]
        moved = tuple(k for k, (a, b) in enumerate(zip(values, altered, strict=True)) if a != b)
        repeated = all(values[k] == value and altered[k] == now and type(values[k]) is type(value) for k in moved)
        tables = all(
            np.array_equal(np.asarray(follow(p, [block, block])), np.asarray(follow(p, [changed, block])))
            for p in law.program.arrays
        )
        if moved and repeated and tables and _stay(changed, block, states) and changed.first() == first:
            result[name] = moved
    return result


def _stay(changed: Block, block: Block, states: Sequence[Any]) -> bool:
    """Return whether a block uses the same states after one of its parameters has changed."""
    try:
        # By their text, in which NaN equals NaN and 0.0 differs from -0.0.
        return all(repr(changed.go_on(x, block.p)) == repr(x) for x in states)
    # Whatever a user's code raises: a run cannot change that parameter, either.
    except Exception:
        return False


def _moved(block: Block, known: Mapping[str, Any], name: str) -> tuple[Block | None, Any]:
    """Return a block with one parameter moved within its bounds, and its value; None if no other value is accepted."""
    value = known[name]
    for factor in SHIFTS:
        changed = type(value)(value * factor) if value else type(value)(factor)
        if changed == value:
            changed = value + 1
        try:
            return type(block)(build(type(block.p), {**known, name: changed}), name=block.name), changed
        except (ParameterError, RunError, TypeError, ValueError):
            continue
    return None, value


def _fields(paths: Sequence[str]) -> list[str]:
    """Return C names for paths of Python, each name only once."""
    result: list[str] = []
    for path in paths:
        name = identifier(path.removeprefix("p.")) or "value"
        # Two paths of Python, such as `a_b` and `a.b`, may have one name in C.
        while name in result:
            name += "_"
        result.append(name)
    return result


def _store(path: str) -> str:
    return identifier(path) or "array"


def _arrays(value: Any, path: str = "") -> list[tuple[str, Any]]:
    """Return the arrays in a state, each with its path in C."""
    if isinstance(value, np.ndarray):
        return [(path, value)]
    if not isinstance(value, (tuple, list)):
        return []
    names = getattr(value, "_fields", None) or [f"f{k}" for k in range(len(value))]
    return [item for n, v in zip(names, value, strict=True) for item in _arrays(v, f"{path}.{identifier(n)}")]


def _setting_text(value: Any) -> str:
    return value.hex() if isinstance(value, float) else str(int(value))


def _initial(value: Any) -> str:
    """Return how C initialises a value."""
    if value is None:
        return "0"
    if isinstance(value, np.ndarray):
        return "NULL"
    if isinstance(value, complex):
        return f"{{ .real = {literal(value.real)}, .imag = {literal(value.imag)} }}"
    if isinstance(value, (tuple, list)):
        names = getattr(value, "_fields", None) or [f"f{k}" for k in range(len(value))]
        parts = [f".{identifier(n)} = {_initial(v)}" for n, v in zip(names, value, strict=True) if v is not None]
        return f"{{ {', '.join(parts) or '0'} }}"
    return literal(value)
