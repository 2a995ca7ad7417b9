"""The function of a rig: all its members in their order, tick after tick, as one text."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..block.block import Block
from ..block.fill import Fill
from ..block.port import Sample
from ..block.schedule import Plan
from ..block.step import Step
from .reports import Reports
from .translate import GIVEN_UP, LONGEST, Program, made
from .twins import form, packed
from .value import Dynamic, Group, NotNative, Record, Static, Value, is_sure
from .ways import alike
from .words import IN_PYTHON, OWN, TEXTS
from .writer import Writer

EDGE = 1.0 - 1e-9  # what is nearer to the bound of a port is left to the check of Python
LARGEST = 1 << 62
FEW = 3  # squares of fewer numbers are written out
WHEN = (
    "when"  # table of times, ns: of the tick, of what each link keeps, and at which each that may be silent spoke last
)
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


@dataclass(frozen=True)
class Link:
    """What brings no message of its tick at each tick of the native members: whoever reads it keeps the newest.

    Attributes
    ----------
    source : int or None
        Number of the native member that speaks; None: Python runs it, between native ticks.
    fill : Fill
    """

    source: int | None
    fill: Fill

    @property
    def value(self) -> Any:
        """What the reader has."""
        return self.fill.reader.values[self.fill.port.name]

    @property
    def stamp(self) -> int:
        """Of what the reader has, ns: its age counts from there."""
        return self.value.stamp if isinstance(self.value, Sample) else self.fill.told() or 0

    @property
    def form(self) -> Any:
        """What a text is for: whether something has come, and of which types."""
        return form(self.value), self.fill.told() is None


def links(steps: Sequence[Step]) -> list[Link]:
    """Give those between native members that are silent at times, or late, or doubted, and those from other members."""
    found: list[Link] = []
    for k, s in enumerate(steps):
        found += [Link(k, fill) for fill in (*(f for f in s.readers if f.silent), *s.doubters)]
    for s in steps:
        found += [Link(None, fill) for fill in s.fed.values() if fill.source not in steps]
    return found


def speakers(steps: Sequence[Step]) -> list[tuple[int, int]]:
    """Give the numbers of the outputs that are silent at times: of the member, and of its output."""
    return [(k, j) for k, s in enumerate(steps) for j, p in enumerate(s.outputs) if p.sporadic]


def rig_text(steps: Sequence[Step], recorded: Sequence[Step], typed: bool = True, reports: bool = True) -> RigText:
    """Make the text of the members that are native.

    Parameters
    ----------
    steps : sequence of Step
        Plants first, then the others, each after those that it reads; each has answered a tick.
    recorded : sequence of Step
        Those whose answers are written into tables.
    typed : bool
        Whether a state keeps its type and a table its shape, as numba needs it; else tables are lists of rows.
    reports : bool
        Whether ticks in which something is reported are answered, too.

    Raises
    ------
    NotNative
        What of them native code does not know.
    """
    numbers = {id(s): k for k, s in enumerate(steps)}
    kept, spoken = links(steps), speakers(steps)
    silent = [(k, steps[k].outputs[j]) for k, j in spoken]
    program = Program([s.block for s in steps], Writer, _ages(steps, kept), silent, typed)
    program.reports = Reports() if reports else None
    plan = Plan(s.schedule for s in steps)
    arrays: set[str] = set()
    time = steps[0].schedule
    ns = (plan.clock.period * 10**9).as_integer_ratio()
    inputs = [_inputs(s, numbers, kept, program, plan, ns) for s in steps]

    def answered(k: int, value: Value, state: str | None) -> list[str]:
        step = steps[k]
        lines = _answered(program, step, k, value, state, recorded, plan, typed)
        return _due(step, plan, lines + _handed_on(program, k, step, kept, spoken))

    plants = [k for k, s in enumerate(steps) if s.plant]
    others = [k for k, s in enumerate(steps) if not s.plant]
    body: list[str] = []
    for k in plants:
        value = _asked(program, steps[k], k, "outputs", {}, arrays)
        body += answered(k, value, None)
    for k in others:
        value = _asked(program, steps[k], k, "update", inputs[k], arrays)
        body += answered(k, value, f"x{k}")
    for k in plants:
        value = _asked(program, steps[k], k, "advance", inputs[k], arrays)
        if not isinstance(value, Dynamic):
            raise NotNative(f"{steps[k].name}: its state stays as it is")
        body += _due(steps[k], plan, [_kept(f"x{k}", value, steps[k], typed)])
    stamped = tuple(k for k, s in enumerate(steps) if any(p.delayed for p in s.outputs))
    state = ", ".join(
        [
            *(f"x{k}" for k, _ in enumerate(steps)),
            *(f"r{k}" for k, _ in enumerate(steps)),
            *(f"z{k}" for k in stamped),
            *(f"h{i}" for i, _ in enumerate(kept)),
        ]
    )
    written = [numbers[id(s)] for s in recorded]
    arrays |= {WHEN} if kept or spoken else set()
    handed = [*sorted(arrays), *(f"o{k}" for k in written), *(f"p{k}" for k in written if k in stamped)]
    if 2 * ns[0] * (time.ticks or 1) > LARGEST:
        raise NotNative("times beyond whole numbers of 64 bits")
    head = [f"def rig({', '.join(['first', 'last', 'n', 'c', 's', *handed])}):", f"    {state}, = s"]
    head += [
        f"    e{numbers[id(s)]} = (n[2] + {plan.every(s.schedule) - 1}) // {plan.every(s.schedule)}" for s in recorded
    ]
    head += [
        "    for k in range(first, last):",
        "        n[0] = k",
        f"        t = {_time('k', ns)}",
        *([f"        {WHEN}[0] = t"] if WHEN in arrays else []),
    ]
    body = [*_decided(program, steps, state, plan, arrays), *body]
    rig = "\n".join([*head, *(f"        {line}" for line in body), "    n[0] = last", f"    return ({state},)"])
    texts = TEXTS if typed else {w: text for w, text in IN_PYTHON.items() if w not in OWN}
    words = [texts[w] for w in sorted(program.words) if w in texts]
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


def _ages(steps: Sequence[Step], kept: Sequence[Link]) -> dict[tuple[int, str], int | str | None]:
    """Give the ages of inputs: 0 of what is said at each tick of the reader; where it is not, how they are written."""
    found: dict[tuple[int, str], int | str | None] = {}
    for k, step in enumerate(steps):
        for port in step.inputs:
            fill = step.fed.get(port.name)
            link = next((i for i, one in enumerate(kept) if one.fill is fill), None)
            if fill is None or (link is not None and fill.told() is None):
                found[k, port.name] = None
            elif link is not None:
                found[k, port.name] = f"max(int({WHEN}[0] - {WHEN}[{link + 1}]), 0)"
            elif step.schedule.every % fill.source.schedule.every == 0:
                found[k, port.name] = 0
    return found


def _inputs(
    step: Step, numbers: Mapping[int, int], kept: Sequence[Link], program: Program, plan: Plan, ns: tuple[int, int]
) -> dict[str, Value]:
    """Say where a step has its inputs from: of whom, and which numbers."""
    found: dict[str, Value] = {}
    for port in step.inputs:
        fill, values = step.fed.get(port.name), step.values[port.name]
        link = next((i for i, one in enumerate(kept) if one.fill is fill), None)
        if fill is None and (not port.held or values is not None):
            raise NotNative(f"{step.name}: {port.topic} does not come from a member of the rig")
        if fill is None or values is None:
            found[port.name] = Static(None)
        elif port.size > LONGEST:
            raise NotNative(f"{step.name}: {port.topic} has {port.size} numbers, expected at most {LONGEST}")
        elif link is not None:
            value = Dynamic(f"h{link}", packed(values))
            found[port.name] = (
                value
                if isinstance(values, Sample)
                else Group(tuple(Dynamic(f"h{link}[{p}]", float(v)) for p, v in enumerate(values)))
            )
        else:
            every, k = plan.every(fill.source.schedule), numbers[id(fill.source)]
            time = _time(f"(k - k % {every})" if every > 1 else "k", ns)
            found[port.name] = _read(program, fill, f"r{k}", f"z{k}", time, values)
    return found


def _read(program: Program, fill: Fill, numbers: str, stamps: str, time: str, values: Any) -> Value:
    """Write what a reader makes of an output, which has `values` of it now."""
    outputs, delayed = fill.source.outputs[: fill.output], fill.stamp == "own"
    before = sum(p.size for p in outputs)
    data = values.data if isinstance(values, Sample) else values
    row = [
        Dynamic(f"{numbers}[{before + p}]" if type(p) is int else repr(p), float(v))
        for p, v in zip(fill.places, data, strict=True)
    ]
    if not isinstance(values, Sample):
        return Group(tuple(row))
    stamp = f"{stamps}[{len([p for p in outputs if p.delayed])}]" if delayed else time
    return Dynamic(
        f"{program.name(Sample, 'Sample')}({stamp}, ({''.join(f'{v.code}, ' for v in row)}))",
        Sample(values.stamp, tuple(float(v) for v in data)),
    )


def _handed_on(
    program: Program, k: int, step: Step, kept: Sequence[Link], spoken: Sequence[tuple[int, int]]
) -> list[str]:
    """Hand what is said on to those who keep it, with its time; what is new in kind or not to be taken is Python's."""
    lines: list[str] = []
    flag = sum(p.size for p in step.outputs)
    for j, port in enumerate(step.outputs):
        said: list[str] = []
        for i, link in enumerate(kept):
            if (link.source, link.fill.output) != (k, j):
                continue
            if link.value is None or link.fill.told() is None:
                said.append(GIVEN_UP)
                continue
            value = _read(program, link.fill, f"q{k}", f"z{k}", "t", link.value)
            row = isinstance(value, Group)
            said.append(f"h{i} = {Writer(program, _handed_on, {}).code(value)}")  # type: ignore[arg-type]
            said.append(f"{WHEN}[{i + 1}] = {'t' if row else f'h{i}.stamp'}")
            for p, limit in enumerate(link.fill.port.limits if port.unchecked else ()):
                said += [f"if not abs(h{i}{'' if row else '.data'}[{p}]) <= {limit!r}:", f"    {GIVEN_UP}"]
        if port.sporadic:
            said.append(f"{WHEN}[{1 + len(kept) + spoken.index((k, j))}] = t")
            said = [f"if q{k}[{flag}] != 0.0:", *(f"    {line}" for line in said)]
            flag += 1
        lines += said
    return lines


def _asked(program: Program, step: Step, k: int, name: str, inputs: Mapping[str, Value], arrays: set[str]) -> Value:
    method = getattr(type(step.block), name)
    state: Value = Dynamic(f"x{k}", packed(step.x, program.typed))
    program.aside = decides(step)  # what it remembers may be what it decides by: no way is the one of most ticks
    return made(program, method, [Static(step.block, (k,)), state, Dynamic("t", step.t or 1)], inputs, arrays)


def _decided(program: Program, steps: Sequence[Step], state: str, plan: Plan, arrays: set[str]) -> list[str]:
    """Go no further where a member has its tick left to Python."""
    lines: list[str] = []
    for k, step in enumerate(steps):
        if decides(step):
            writer = Writer(program, _decided, {})  # type: ignore[arg-type]
            test = writer.truth(_asked(program, step, k, "decides", {}, arrays))
            lines += _due(step, plan, [*writer.lines, f"if {test}:", f"    return ({state},)"])
    return lines


def decides(step: Step) -> bool:
    """Whether there are ticks that a member has left to Python."""
    return type(step.block).decides is not Block.decides


def _answered(
    program: Program,
    step: Step,
    k: int,
    value: Value,
    state: str | None,
    recorded: Sequence[Step],
    plan: Plan,
    typed: bool,
) -> list[str]:
    """Take an answer: its state, its numbers checked, written into the table."""
    writer = Writer(program, _answered, {})  # type: ignore[arg-type]
    x, size = Dynamic(""), sum(p.size for p in step.outputs)
    try:
        if state is not None:
            first, value = writer.parts(value, _NOWHERE)
            x = writer.dynamic(first)
            writer.emit(f"y{k} = {x.code}")
        if isinstance(value, Dynamic) and value.keys is not None:
            value = writer.unfolded(value)
        numbers: list[str] = []
        stamps: list[str] = []
        found: Any = value.items if isinstance(value, Record) else {}
        flags: list[str] = []
        for port in step.outputs:
            said = found[port.name]
            if port.sporadic:
                flag, said = writer.parts(said, _NOWHERE)
                flags.append(writer.code(flag))
            if port.delayed:
                stamps.append(writer.code(writer.attribute(said, "stamp", _NOWHERE)))
                said = writer.attribute(said, "data", _NOWHERE)
            row = writer.parts(said, _NOWHERE)
            if len(row) != port.size:
                raise NotNative(f"{port.name} has {len(row)} values, expected {port.size}")
            whole = size >= FEW and not typed and isinstance(said, Dynamic) and type(said.sample) is tuple
            numbers += [f"*{writer.code(said)}"] if whole else [f"float({writer.code(one)})" for one in row]
    except (NotNative, AttributeError, KeyError, ValueError) as error:
        raise NotNative(f"{step.name}: its answer: {error}") from None
    lines = writer.lines
    if numbers:
        bound = min(p.bound for p in step.outputs) * EDGE
        lines += _row_of(f"q{k}", numbers, flags, size, bound, typed)
        lines.append(f"r{k} = q{k}")
    if stamps:
        lines.append(f"z{k} = ({''.join(f'{z}, ' for z in stamps)})")
    if state is not None:
        lines.append(_kept(state, replace(x, code=f"y{k}"), step, typed))
    if any(s is step for s in recorded) and not typed:
        lines += [f"o{k}.append(q{k})", *([f"p{k}.append(z{k})"] if stamps else [])]
    elif any(s is step for s in recorded):
        at = f"k // {plan.every(step.schedule)} - e{k}"
        lines += [f"o{k}[{at}, {i}] = q{k}[{i}]" for i in range(size + len(flags))]
        lines += [f"p{k}[{at}, {i}] = z{k}[{i}]" for i, _ in enumerate(stamps)]
    return lines


def _row_of(q: str, numbers: Sequence[str], flags: Sequence[str], size: int, bound: float, typed: bool) -> list[str]:
    """Write what takes all numbers of an answer, flags of silence after them; beyond the bound they are Python's."""
    told = "".join(f"{flag}, " for flag in flags)
    if typed or size < FEW:
        squares = " + ".join(f"{q}[{i}] * {q}[{i}]" for i in range(size))
        return [f"{q} = ({', '.join(numbers)}, {told})", f"if not ({squares} <= {bound!r}):", f"    {GIVEN_UP}"]
    return [
        f"{q} = ({', '.join(numbers)},)",
        f"squares_ = sum_of_products({q}, {q})",
        "if type(squares_) is not float:",
        f"    {q} = tuple(map(float, {q}))",
        f"    squares_ = sum_of_products({q}, {q})",
        f"if not (squares_ <= {bound!r} and len({q}) == {size}):",
        f"    {GIVEN_UP}",
        *([f"{q} = (*{q}, {told})"] if flags else []),
    ]


def _kept(state: str, value: Dynamic, step: Step, typed: bool) -> str:
    """Take a state, which must be of the type of the one before."""
    known = not typed and is_sure(value) and alike(value.sample, packed(step.x, typed))
    return f"{state} = {value.code}" if known else f"{state} = same_({state}, {value.code})"


class _Nowhere:
    lineno = 1


_NOWHERE: Any = _Nowhere()


def _due(step: Step, plan: Plan, lines: list[str]) -> list[str]:
    every = plan.every(step.schedule)
    return lines if every == 1 else [f"if k % {every} == 0:", *(f"    {line}" for line in lines)]
