"""The function of a rig: all its members in their order, tick after tick, as one text."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..block.port import Sample
from ..block.step import Step
from .translate import GIVEN_UP, LONGEST, Program, made
from .twins import packed
from .value import Dynamic, Group, NotNative, Record, Static, Value, is_sure
from .ways import alike
from .words import TEXTS
from .writer import Writer

EDGE = 1.0 - 1e-9  # what is nearer to the bound of a port is left to the check of Python
LARGEST = 1 << 62
WORD = re.compile(r"\b\w+(?=\()")


@dataclass(frozen=True)
class RigText:
    """A rig's text.

    Attributes
    ----------
    text : str
    program : Program
    arrays : tuple of str
        What it is handed beside its state, in order: tables, random numbers, memory for calls, places for answers.
    stamped : tuple of int
        Of the steps those with delayed outputs, whose stamps are at the end of the state.
    """

    text: str
    program: Program
    arrays: tuple[str, ...]
    stamped: tuple[int, ...]


def rig_text(steps: Sequence[Step], recorded: Sequence[Step], typed: bool = True) -> RigText:
    """Make the text of the members that are native.

    Parameters
    ----------
    steps : sequence of Step
        Plants first, then the others, each after those that it reads; each has answered a tick.
    recorded : sequence of Step
        Those whose answers are written into tables.
    typed : bool
        Whether a state keeps its type and a table its shape, as numba needs it; else tables are lists of rows.

    Raises
    ------
    NotNative
        What of them native code does not know.
    """
    numbers = {id(s): k for k, s in enumerate(steps)}
    program = Program([s.block for s in steps], Writer, _ages(steps), typed)
    stride = math.gcd(*(s.schedule.every for s in steps))
    arrays: set[str] = set()
    time = steps[0].schedule
    ns = (time.clock * stride * 10**9).as_integer_ratio()
    inputs = [_inputs(s, steps, numbers, program, stride, ns) for s in steps]
    plants = [k for k, s in enumerate(steps) if s.plant]
    others = [k for k, s in enumerate(steps) if not s.plant]
    body: list[str] = []
    for k in plants:
        value = _asked(program, steps[k], k, "outputs", {}, arrays)
        body += _due(steps[k], stride, _answered(program, steps[k], k, value, None, recorded, stride, typed))
    for k in others:
        value = _asked(program, steps[k], k, "update", inputs[k], arrays)
        body += _due(steps[k], stride, _answered(program, steps[k], k, value, f"x{k}", recorded, stride, typed))
    for k in plants:
        value = _asked(program, steps[k], k, "advance", inputs[k], arrays)
        if not isinstance(value, Dynamic):
            raise NotNative(f"{steps[k].name}: its state stays as it is")
        body += _due(steps[k], stride, [_kept(f"x{k}", value, steps[k], typed)])
    stamped = tuple(k for k, s in enumerate(steps) if any(p.delayed for p in s.outputs))
    state = ", ".join([*(f"x{k}" for k, _ in enumerate(steps)), *(f"r{k}" for k, _ in enumerate(steps)),
                       *(f"z{k}" for k in stamped)])  # fmt: skip
    written = [numbers[id(s)] for s in recorded]
    handed = [*sorted(arrays), *(f"o{k}" for k in written), *(f"p{k}" for k in written if k in stamped)]
    if 2 * ns[0] * (time.ticks or 1) > LARGEST:
        raise NotNative("times beyond whole numbers of 64 bits")
    head = [f"def rig({', '.join(['first', 'last', 'n', 'c', 's', *handed])}):", f"    {state}, = s"]
    head += [f"    e{numbers[id(s)]} = (first + {s.schedule.every // stride - 1}) // {s.schedule.every // stride}"
             for s in recorded]  # fmt: skip
    head += ["    for k in range(first, last):", "        n[0] = k",
             f"        t = {_time('k', ns)}"]  # fmt: skip
    rig = "\n".join([*head, *(f"        {line}" for line in body), f"    return ({state},)"])
    words = [TEXTS[w] for w in sorted(program.words)]
    text = "\n\n".join([*words, *_reached(program.functions, rig), rig]) + "\n"
    return RigText(text, program, tuple(handed), stamped)


def _time(k: str, ns: tuple[int, int]) -> str:
    """Write the time of a tick, ns."""
    n, d = ns
    return f"{k} * {n}" if d == 1 else f"(2 * {k} * {n} + {d}) // {2 * d}"


def _reached(functions: Sequence[str], rig: str) -> list[str]:
    """Give the functions that the rig's calls, directly or not: others were tried on a way that is given up."""
    known = {text[4 : text.index("(")]: text for text in functions}
    found: dict[str, str] = {}
    open_ = [rig]
    while open_:
        for name in WORD.findall(open_.pop()):
            if name in known and name not in found:
                found[name] = known[name]
                open_.append(known[name])
    return [text for text in functions if text in found.values()]


def _ages(steps: Sequence[Step]) -> dict[tuple[int, str], int | None]:
    """Give the ages of inputs that are always the same: 0 of what is said at each tick of the reader."""
    found: dict[tuple[int, str], int | None] = {}
    for k, step in enumerate(steps):
        for port in step.inputs:
            source = _source(step, port.name)
            if source is None:
                found[k, port.name] = None
            elif step.schedule.every % source[0].schedule.every == 0:
                found[k, port.name] = 0
    return found


def _source(step: Step, name: str) -> tuple[Step, int, Any] | None:
    """Give whose output fills an input, which one, and how."""
    return next(((s, j, take) for s in step.sources for j, values, n, take in s.readers
                 if values is step.values and n == name), None)  # fmt: skip


def _inputs(
    step: Step, steps: Sequence[Step], numbers: Mapping[int, int], program: Program, stride: int, ns: tuple[int, int]
) -> dict[str, Value]:
    """Say where a step has its inputs from: of whom, and which numbers."""
    found: dict[str, Value] = {}
    for port in step.inputs:
        source = _source(step, port.name)
        if source is None:
            if not port.held or step.values[port.name] is not None:
                raise NotNative(f"{step.name}: {port.topic} does not come from a member of the rig")
            found[port.name] = Static(None)
            continue
        s, j, take = source
        if id(s) not in numbers:
            raise NotNative(f"{step.name} reads {port.topic} of {s.name}, which is not native")
        before = sum(p.size for p in s.outputs[:j])
        delayed = s.outputs[j].delayed
        places, _ = taken(s.outputs[j].size, delayed, take)
        if len(places) > LONGEST:
            raise NotNative(f"{step.name}: {port.topic} has {len(places)} numbers, expected at most {LONGEST}")
        values = step.values[port.name]
        data = values.data if isinstance(values, Sample) else values
        row = [Dynamic(f"r{numbers[id(s)]}[{before + p}]" if type(p) is Place else repr(float(p)), float(v))
               for p, v in zip(places, data, strict=True)]  # fmt: skip
        if not isinstance(values, Sample):
            found[port.name] = Group(tuple(row))
            continue
        every = s.schedule.every // stride
        stamp = (f"z{numbers[id(s)]}[{len([p for p in s.outputs[:j] if p.delayed])}]" if delayed
                 else _time(f"(k - k % {every})" if every > 1 else "k", ns))  # fmt: skip
        found[port.name] = Dynamic(
            f"{program.name(Sample, 'Sample')}({stamp}, ({''.join(f'{v.code}, ' for v in row)}))",
            Sample(values.stamp, tuple(float(v) for v in data)),
        )
    return found


def _asked(program: Program, step: Step, k: int, name: str, inputs: Mapping[str, Value], arrays: set[str]) -> Value:
    method = getattr(type(step.block), name)
    state: Value = Dynamic(f"x{k}", packed(step.x, program.typed))
    return made(program, method, [Static(step.block, (k,)), state, Dynamic("t", step.t or 1)], inputs, arrays)


def _answered(
    program: Program,
    step: Step,
    k: int,
    value: Value,
    state: str | None,
    recorded: Sequence[Step],
    stride: int,
    typed: bool,
) -> list[str]:
    """Take an answer: its state, its numbers checked, written into the table."""
    writer = Writer(program, _answered, {})  # type: ignore[arg-type]
    x = Dynamic("")
    try:
        if state is not None:
            first, value = writer.parts(value, _NOWHERE)
            x = writer.dynamic(first)
            writer.emit(f"y{k} = {x.code}")
        if isinstance(value, Dynamic) and value.keys is not None:
            value = writer._unfolded(value)
        numbers: list[str] = []
        stamps: list[str] = []
        found: Any = value.items if isinstance(value, Record) else {}
        for port in step.outputs:
            said = found[port.name]
            if port.delayed:
                stamps.append(writer.code(writer.attribute(said, "stamp", _NOWHERE)))
                said = writer.attribute(said, "data", _NOWHERE)
            row = writer.parts(said, _NOWHERE)
            if len(row) != port.size:
                raise NotNative(f"{port.name} has {len(row)} values, expected {port.size}")
            for one in row:
                numbers.append(f"float({writer.code(one)})")
    except (NotNative, AttributeError, KeyError, ValueError) as error:
        raise NotNative(f"{step.name}: its answer: {error}") from None
    lines = writer.lines
    if numbers:
        lines.append(f"q{k} = ({''.join(f'{x}, ' for x in numbers)})")
        bound = min(p.bound for p in step.outputs) * EDGE
        squares = " + ".join(f"q{k}[{i}] * q{k}[{i}]" for i, _ in enumerate(numbers))
        lines += [f"if not ({squares} <= {bound!r}):", f"    {GIVEN_UP}", f"r{k} = q{k}"]
    if stamps:
        lines.append(f"z{k} = ({''.join(f'{z}, ' for z in stamps)})")
    if state is not None:
        lines.append(_kept(state, replace(x, code=f"y{k}"), step, typed))
    if any(s is step for s in recorded) and not typed:
        lines += [f"o{k}.append(q{k})", *([f"p{k}.append(z{k})"] if stamps else [])]
    elif any(s is step for s in recorded):
        at = f"k // {step.schedule.every // stride} - e{k}"
        lines += [f"o{k}[{at}, {i}] = q{k}[{i}]" for i, _ in enumerate(numbers)]
        lines += [f"p{k}[{at}, {i}] = z{k}[{i}]" for i, _ in enumerate(stamps)]
    return lines


def _kept(state: str, value: Dynamic, step: Step, typed: bool) -> str:
    """Take a state, which must be of the type of the one before."""
    known = not typed and is_sure(value) and alike(value.sample, packed(step.x, typed))
    return f"{state} = {value.code}" if known else f"{state} = same_({state}, {value.code})"


class Place(int):
    """Number of a value in an answer: what is picked is one, or what is given where there is none."""


def taken(size: int, delayed: bool, take: Callable[[Any], Any] | None) -> tuple[tuple[float, ...], bool]:
    """Say what a reader takes of an output: places of its numbers, or numbers; and whether with a stamp."""
    row: Any = tuple(map(Place, range(size)))
    row = Sample(0, row) if delayed else row
    found = row if take is None else take(row)
    return (found.data, True) if isinstance(found, Sample) else (found, False)


class _Nowhere:
    lineno = 1


_NOWHERE: Any = _Nowhere()


def _due(step: Step, stride: int, lines: list[str]) -> list[str]:
    every = step.schedule.every // stride
    return lines if every == 1 else [f"if k % {every} == 0:", *(f"    {line}" for line in lines)]
