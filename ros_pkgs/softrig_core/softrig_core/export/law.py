"""One block's methods as the text that native code would compile, for each form of its state and inputs that occurs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from ..block.block import Block
from ..block.port import Port, Sample
from ..native.reports import Reports
from ..native.translate import Program, made
from ..native.turns import NOWHERE, rows_of
from ..native.twins import packed
from ..native.value import Dynamic, Group, NotNative, Static, Value
from ..native.words import TEXTS
from ..native.writer import Writer
from .drawn import Beyond, Drawn
from .golden import Call
from .kinds import INT, REAL, Kind, Tuple, kind_of, leaves, room_of, roomy, tuple_of


@dataclass(frozen=True)
class Form:
    """What decides a method's text beside its constants: its name, the type of the state, which inputs are there."""

    method: str
    state: Kind
    there: tuple[str, ...]


@dataclass(frozen=True)
class Law:
    """The texts of a block.

    Attributes
    ----------
    program : Program
    texts : mapping of str to str
        Functions by name, those of the forms among them.
    roots : mapping of Form to str
        The function of each form.
    arrays : mapping of Form to tuple of str
        What it is handed beside time, state and inputs.
    reports : Reports
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

    What keeps more or fewer samples at another time is one type, with room for the most. Calls of the run go before
    drawn ones, and these before what no port admits: odd numbers leave types of what is computed from them unknown.
    """
    kinds = [kind_of(packed(x), ("its state",)) for x in (block.first(), *(x for c in calls for x in (c.x, c.after)))]
    rooms: dict[tuple[Any, ...], int] = {}
    for kind in set(kinds):
        for path, table in leaves(kind):
            if table.shape:
                place = room_of(path, table)
                rooms[place] = max(rooms.get(place, 0), table.shape[0])
    kinds = [roomy(kind, rooms) for kind in kinds]
    newest: dict[Form, Call] = {}
    for call, x in zip(calls, kinds[1::2], strict=True):
        there = tuple(sorted(name for name, value in call.inputs.items() if value is not None))
        form = Form(call.method, x, there)
        if form not in newest or _oddity(call) <= _oddity(newest[form]):
            newest[form] = call
    return list(dict.fromkeys(kinds)), newest


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
    inputs, outputs : sequence of Port
    calls : sequence of Call
        Calls of a run; each form that occurs in them gets a text. The newest call of each form is the sample, because a
        settled state shows its types better than the first one.

    Raises
    ------
    NotNative
        Part of the block cannot be translated; the message has the construct and its line.
    """
    ages: dict[tuple[int, str], int | str | None] = {(0, name): 0 for name in punctual}
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
        given = {p.name: _input(p, call.inputs.get(p.name)) for p in inputs} if form.method != "outputs" else {}
        state = Dynamic("x", packed(call.x))
        method = getattr(type(block), form.method)
        value = made(program, method, [Static(block, (0,)), state, Dynamic("t", call.t or 1)], given, handed)
        lines = _answer(program, form.method, value, outputs)
        arrays[form] = tuple(sorted(handed))
        rows = [f"i_{p.name}" for p in inputs if p.name in form.there]
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
    """Add the functions that move a state when parameters change between two ticks; the second root is before."""
    before = Static(block.p, (1, ("attr", "p")))
    move: Any = type(block).go_on
    found: dict[Form, tuple[str, tuple[str, ...]]] = {}
    for form, call in newest.items():
        own = Form("go_on", form.state, ())
        if own in found:
            continue
        name, handed = f"go{len(found)}", set[str]()
        value = made(program, move, [Static(block, (0,)), Dynamic("x", packed(call.x)), before], {}, handed)
        lines = _answer(program, "advance", value, ())
        found[own] = name, tuple(sorted(handed))
        head = f"def {name}({', '.join(['c', 'n', *found[own][1], 'x'])}):"
        program.functions.append("\n".join([head, *(f"    {line}" for line in lines)]))
    for own, (name, given) in found.items():
        roots[own], arrays[own] = name, given


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
    """Write what takes an answer apart: the state, then flags and numbers of the outputs."""
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
    told = ", ".join(f"({''.join(f'{n}, ' for n in part)})" for part in (numbers, stamps))
    writer.emit(f"return ({state}, {told})" if method == "update" else f"return ({told})")
    return writer.lines


def _name(text: str) -> str:
    return text[4 : text.index("(")]
