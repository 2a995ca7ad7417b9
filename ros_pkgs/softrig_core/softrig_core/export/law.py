"""One block's methods as the text that native code would compile, for each form of its state and inputs that occurs."""

from __future__ import annotations

import math
import traceback
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from ..block.block import Block
from ..block.port import Port, Sample
from ..kit.compiled import Compiled
from ..kit.draws import HEAD, Draws
from ..kit.jit import Jit
from ..native.compile import BASE
from ..native.reports import Reports
from ..native.translate import Program, follow, specialise
from ..native.turns import NOWHERE, rows_of
from ..native.twins import packed
from ..native.value import Dynamic, Group, NotNative, Static, Value
from ..native.words import TEXTS
from ..native.writer import Writer
from .drawn import Beyond, Drawn, Raised
from .golden import Call, Changed
from .kinds import INT, REAL, Kind, Tuple, kind_of, leaves, room_of, roomy, tuple_of


@dataclass(frozen=True)
class Form:
    """Key of a method's generated text besides its constants: name, type of the state, inputs that are present."""

    method: str
    state: Kind
    present: tuple[str, ...]


@dataclass(frozen=True)
class Law:
    """The texts of a block.

    Attributes
    ----------
    texts : mapping of str to str
        Functions by name, those of the forms among them.
    roots : mapping of Form to str
        The function of each form.
    arrays : mapping of Form to tuple of str
        Arrays that it receives in addition to time, state and inputs.
    states : list
        Types that the state has at some time, the first one first.
    """

    program: Program
    texts: Mapping[str, str]
    roots: Mapping[Form, str]
    arrays: Mapping[Form, tuple[str, ...]]
    reports: Reports
    states: list[Kind]


def states_of(block: Block, calls: Sequence[Call]) -> tuple[list[Kind], dict[Form, Call]]:
    """Return the types that the state has at some time, and the newest call of each form.

    States that store different numbers of samples at different times are one type, with room for the largest number.
    Calls of the run come before drawn ones, and these before calls with values that no port admits, because the types
    of results of such values may stay unknown.
    """
    kinds = [kind_of(packed(x), ("its state",)) for x in (block.first(), *(x for c in calls for x in (c.x, c.after)))]
    rooms: dict[tuple[Any, ...], int] = {}
    for kind in set(kinds):
        for path, table in leaves(kind):
            if table.shape:
                key = room_of(path, table)
                rooms[key] = max(rooms.get(key, 0), table.shape[0])
    kinds = [roomy(kind, rooms) for kind in kinds]
    newest: dict[Form, Call] = {}
    for call, x in zip(calls, kinds[1::2], strict=True):
        form = Form(call.method, x, present_of(call))
        if form not in newest or _oddity(call) <= _oddity(newest[form]):
            newest[form] = call
    return list(dict.fromkeys(kinds)), newest


def present_of(call: Call) -> tuple[str, ...]:
    """Return the names of the inputs that have a value in a call."""
    return tuple(sorted(name for name, value in call.inputs.items() if value is not None))


def _oddity(call: Call) -> int:
    return isinstance(call, Drawn) + isinstance(call, Beyond)


def law_of(
    block: Block, punctual: set[str], inputs: Sequence[Port], outputs: Sequence[Port], calls: Sequence[Call]
) -> Law:
    """Return the texts of a block.

    Parameters
    ----------
    punctual : set of str
        Inputs whose age is 0 at each tick.
    calls : sequence of Call
        Calls of a run; each form that occurs in them gets a text. The newest call of each form is the sample, because a
        settled state shows its types better than the first one.

    Raises
    ------
    NotNative
        Part of the block cannot be translated; the message has the construct and its line.
    """
    ages: dict[tuple[int, str], int | str | None] = {(0, name): 0 for name in punctual}
    block.ages = lambda name: 0  # as in a run: the age of an input that is not punctual has no C
    program = Program([block, block], Writer, ages, [(0, p) for p in outputs if p.sporadic], inferred=True)
    program.reports = Reports(worded=False)
    roots: dict[Form, str] = {}
    arrays: dict[Form, tuple[str, ...]] = {}
    states, newest = states_of(block, calls)
    for method in dict.fromkeys(form.method for form in newest):  # what it keeps at hand is a constant of the text
        begin = next(call for call in calls if call.method == method)
        getattr(block, method)(begin.x, begin.t, **begin.inputs)
    for k, (form, call) in enumerate(newest.items()):
        roots[form] = f"root{k}"
        handed: set[str] = set()
        values = {p.name: _input(p, call.inputs.get(p.name)) for p in inputs} if form.method != "outputs" else {}
        state = Dynamic("x", packed(call.x))
        method = getattr(type(block), form.method)
        value = specialise(program, method, [Static(block, (0,)), state, Dynamic("t", call.t or 1)], values, handed)
        lines = _answer(program, form.method, value, outputs)
        arrays[form] = tuple(sorted(handed))
        rows = [f"i_{p.name}" for p in inputs if p.name in form.present]
        head = f"def {roots[form]}({', '.join(['c', 'n', *arrays[form], 'x', 't', *rows])}):"
        program.functions.append("\n".join([head, *(f"    {line}" for line in lines)]))
    if type(block).go_on is not Block.go_on:
        with suppress(NotNative):  # a state that C cannot move on: what moves it is not settable
            _going_on(program, block, newest, roots, arrays)
    texts = {_name(text): text for text in program.functions}
    texts |= {word: TEXTS[word] for word in program.words if word in TEXTS}
    return Law(program, texts, roots, arrays, program.reports, states)


def _going_on(
    program: Program,
    block: Block,
    newest: Mapping[Form, Call],
    roots: dict[Form, str],
    arrays: dict[Form, tuple[str, ...]],
) -> None:
    """Add the functions that adapt a state when parameters change; their second root has the parameters before the
    change.
    """
    before = Static(block.p, (1, ("attr", "p")))
    move: Any = type(block).go_on
    results: dict[Form, tuple[str, tuple[str, ...]]] = {}
    for form, call in newest.items():
        key = Form("go_on", form.state, ())
        if key in results:
            continue
        name, handed = f"go{len(results)}", set[str]()
        value = specialise(program, move, [Static(block, (0,)), Dynamic("x", packed(call.x)), before], {}, handed)
        lines = _answer(program, "advance", value, ())
        results[key] = name, tuple(sorted(handed))
        head = f"def {name}({', '.join(['c', 'n', *results[key][1], 'x'])}):"
        program.functions.append("\n".join([head, *(f"    {line}" for line in lines)]))
    for key, (name, added) in results.items():
        roots[key], arrays[key] = name, added


def input_kind(port: Port) -> Kind:
    """Return the type of an input's values."""
    row = tuple_of([REAL] * port.size)
    return Tuple((INT, row), Sample._fields, Sample.__name__) if port.delayed else row


def _input(port: Port, values: Any) -> Value:
    if values is None:
        return Static(None)
    if isinstance(values, Sample):
        return Dynamic(f"i_{port.name}", Sample(values.stamp, tuple(map(float, values.data))))
    return Group(tuple(Dynamic(f"i_{port.name}[{k}]", float(v)) for k, v in enumerate(values)))


def _answer(program: Program, method: str, value: Value, outputs: Sequence[Port]) -> list[str]:
    """Write code that unpacks an answer: the state, then flags and numbers of the outputs."""
    writer = Writer(program, _answer, {})  # type: ignore[arg-type]  # it is asked for its name alone
    if method == "advance":
        writer.emit(f"return {writer.code(value)}")
        return writer.lines
    state = "x"
    if method == "update":
        first, value = writer.parts(value, NOWHERE)
        state = writer.code(writer.simple(writer.dynamic(first)))
    numbers: list[str] = []
    stamps: list[str] = []
    try:
        for flag, stamp, _, row in rows_of(writer, value, outputs):
            stamps += stamp
            numbers += [f"float({code})" for code in (*flag, *map(writer.code, row))]
    except KeyError as error:
        raise NotNative(f"{error.args[0]} is not in the answer") from None
    text = ", ".join(f"({''.join(f'{n}, ' for n in part)})" for part in (numbers, stamps))
    writer.emit(f"return ({state}, {text})" if method == "update" else f"return ({text})")
    return writer.lines


def _name(text: str) -> str:
    return text[4 : text.index("(")]


# Compared with the run: C discards what the text discards, which may be no call of the run ----------------------------


class _Row:
    """A stream of random numbers as the text reads it."""

    def __init__(self, draws: Draws) -> None:
        self.draws = draws

    def __getitem__(self, k: int) -> float:
        return self.draws(k - HEAD) if k >= HEAD else 0.0

    def __len__(self) -> int:
        # The text asks whether a number is in its table; here each one is.
        return 1 << 62


class Text:
    """The text of a block, which Python runs call by call."""

    def __init__(self, block: Block, law: Law, inputs: Sequence[Port]) -> None:
        self.law, self.inputs = law, inputs
        self.scope, self.handed = _scope(block, law)
        self.roots = {(form.method, _sizeless(form.state), form.present): form for form in law.roots}
        self.constants = law.program.constants([block, block])

    def answer(self, call: Call) -> Any:
        """Return the answer to a call; any error that this raises discards the call."""
        x = packed(call.x)
        form = self.roots[call.method, _sizeless(kind_of(x)), present_of(call)]
        ports = [] if form.method == "outputs" else [p for p in self.inputs if p.name in form.present]
        arrays = [self.handed[name] for name in self.law.arrays[form]]
        rows = [_row(call.inputs[p.name]) for p in ports]
        return self.scope[self.law.roots[form]](self.constants, [0, 0, 0], *arrays, x, call.t, *rows)


def check_text(text: Text, calls: Sequence[Call | Changed], outputs: Sequence[Port]) -> None:
    """Run the text of a block on the calls of its run, up to the first change of parameters.

    Raises
    ------
    NotNative
        The text discards a call that Python answered, or returns another answer; the message has the time and, if
        known, the reason.
    """
    for call in calls:
        if isinstance(call, Changed):
            return
        try:
            result = text.answer(call)
        except Exception as error:  # whatever it raises discards the call
            why = "; ".join(sorted(set(text.law.program.seldom))) or _reason(error, text.law)
            raise NotNative(f"its run takes a branch that has no C at {call.t / 1e9:g} s: {why}") from None
        if not _answers(result, call, outputs):
            raise NotNative(f"its text has another result than Python at {call.t / 1e9:g} s: a defect of softrig")


def as_answered(text: Text, drawn: Sequence[Sequence[Call | Raised]]) -> tuple[list[list[Call | Raised]], set[str]]:
    """Return drawn calls up to the first of each sequence that the text discards although Python answers, and why."""
    result: list[list[Call | Raised]] = []
    reasons: set[str] = set()
    for calls in drawn:
        result.append([])
        for call in calls:
            result[-1].append(call)
            if isinstance(call, Raised):
                continue
            try:
                with np.errstate(all="ignore"):
                    text.answer(call)
            except Exception as error:
                if not isinstance(call, Beyond):
                    reasons.add(_reason(error, text.law))
                result[-1][-1] = Beyond(**{f.name: getattr(call, f.name) for f in fields(call)})
                break
    return result, reasons


def _reason(error: Exception, law: Law) -> str:
    """Return the error of a text, and the Python function that raised it."""
    frames = [frame.f_code.co_name for frame, _ in traceback.walk_tb(error.__traceback__)]
    titles = [law.texts[name].partition("\n")[0].partition("  # ")[2] for name in frames if name in law.texts]
    function = next((title for title in reversed(titles) if title), "")
    text = "a whole number that has no place in 64 bits" if isinstance(error, OverflowError) else repr(error)
    return f"{text} in {function}"


def _scope(block: Block, law: Law) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the functions of a text, and the arrays that it is handed."""
    program, roots = law.program, [block, block]
    scope: dict[str, Any] = {**BASE, **program.names}
    for text in law.texts.values():
        exec(text, scope)
    for name, value in program.names.items():
        # A function that the run has not called would be compiled for these few calls alone.
        if isinstance(value, Jit):
            scope[name] = value.straight() if value.direct is value else value.direct
        elif isinstance(value, Compiled):
            scope[name.removesuffix("_there")] = lambda s, *values, value=value: value(values)
    handed: dict[str, Any] = {"reports": defaultdict(float)}
    handed |= dict.fromkeys(program.scratches.values())
    handed |= {name: _Row(follow(path, roots)) for path, name in program.draws.items()}
    handed |= {name: np.ascontiguousarray(follow(path, roots)) for path, name in program.arrays.items()}
    return scope, handed


def _sizeless(kind: Kind) -> Kind:
    return roomy(kind, defaultdict(int))


def _row(values: Any) -> Any:
    if isinstance(values, Sample):
        return Sample(values.stamp, tuple(map(float, values.data)))
    return tuple(map(float, values))


def _answers(value: Any, call: Call, outputs: Sequence[Port]) -> bool:
    """Return whether a text has answered as Python did."""
    if call.method == "advance":
        return _same(value, packed(call.after))
    state, numbers, stamps = (None, *value) if call.method == "outputs" else value
    if state is not None and not _same(state, packed(call.after)):
        return False
    row, stamped = iter(numbers), iter(stamps)
    for port in outputs:
        text = call.outputs.get(port.name)
        if port.sporadic and (next(row) != 0.0) is (text is None):
            return False
        if port.delayed:
            stamp = next(stamped)
            if text is not None and stamp != text.stamp:
                return False
            text = None if text is None else text.data
        got = tuple(next(row) for _ in range(port.size))
        if text is not None and not _same(got, tuple(map(float, text))):
            return False
    return True


def _same(a: Any, b: Any) -> bool:
    """Return whether two values have the same bits, whole numbers and floats apart."""
    if hasattr(b, "python"):  # an object of Python in another form, which does not keep what nothing reads
        return True
    if isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return np.array_equal(a, b, equal_nan=True)
    if a is None or b is None:
        return a is b
    if isinstance(a, complex) or isinstance(b, complex):
        return _same((a.real, a.imag), (b.real, b.imag))
    return (a == b and (a != 0 or math.copysign(1.0, a) == math.copysign(1.0, b))) or (a != a and b != b)
