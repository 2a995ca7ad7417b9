"""One block's methods as the text that native code would compile, for each form of its state and inputs that occurs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from .golden import Call
from .kinds import INT, REAL, Kind, Tuple, kind_of, tuple_of


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
    """

    program: Program
    texts: Mapping[str, str]
    roots: Mapping[Form, str]
    arrays: Mapping[Form, tuple[str, ...]]
    reports: Reports


def form_of(call: Call) -> Form:
    """Return the form of a call."""
    there = tuple(sorted(name for name, value in call.inputs.items() if value is not None))
    return Form(call.method, kind_of(packed(call.x)), there)


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
        Of a run: the forms that occur in them get a text each. A state that has settled tells its types better than
        the first one, so the newest call of each form is the sample.

    Raises
    ------
    NotNative
        What of the block cannot be translated, and its line.
    """
    if type(block).decides is not Block.decides:
        raise NotNative("it leaves some ticks to Python (`decides`)")
    program = Program([block], Writer, {(0, name): 0 for name in punctual}, [(0, p) for p in outputs if p.sporadic])
    program.reports = Reports(worded=False)
    roots: dict[Form, str] = {}
    arrays: dict[Form, tuple[str, ...]] = {}
    newest = {form_of(call): call for call in calls}
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
    texts = {_name(text): text for text in program.functions}
    texts |= {word: TEXTS[word] for word in program.words if word in TEXTS}
    return Law(program, texts, roots, arrays, program.reports)


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
