"""The turns of a rig's nodes as native text: the call of each, the use of its answer, and how a plant advances."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, runtime_checkable

from ..block.answer import slots_of
from ..block.fill import Fill
from ..block.loop import Act, acts
from ..block.port import LONGEST, Port, Sample
from ..block.schedule import Plan
from ..block.step import Step
from .translate import GIVEN_UP, Program, specialise
from .twins import form, packed
from .value import Dynamic, Group, NotNative, Record, Static, Value, is_sure
from .ways import alike
from .writer import Writer

EDGE = 1.0 - 1e-9  # share of the bound: the sum of squares is rounded, so Python checks what is closer
LARGEST = 1 << 62
FEW = 3  # squares of fewer numbers are written out
# Table of times, ns: of the tick, of the message in each holding, of the newest message of each sporadic output.
WHEN = "when"


@dataclass(frozen=True)
class Holding:
    """A link that does not bring a message at each tick, so that its subscriber holds the newest one.

    Attributes
    ----------
    source : int or None
        Number of the native member that publishes; None: Python runs the publisher, between native ticks.
    fill : Fill
    """

    source: int | None
    fill: Fill

    @property
    def value(self) -> Any:
        """Return the subscriber's value; an empty tuple in place of one that is too long for native code."""
        result = self.fill.reader.values[self.fill.port.name]
        return () if result is not None and self.fill.port.size > LONGEST else result

    @property
    def stamp(self) -> int:
        """Return the stamp of the held value, ns; its age counts from there."""
        return self.value.stamp if isinstance(self.value, Sample) else self.fill.last_published() or 0

    @property
    def form(self) -> Any:
        """Return the part of a text's key for this link: whether a message has arrived, and its types."""
        return form(self.value), self.fill.last_published() is None


def holdings(steps: Sequence[Step]) -> list[Holding]:
    """Return links between native nodes that are sporadic, delayed or checked, and links from other nodes."""
    result: list[Holding] = []
    for k, s in enumerate(steps):
        result += [Holding(k, fill) for fill in s.readers if fill.silent or fill.checked]
    for s in steps:
        result += [Holding(None, fill) for fill in s.fed.values() if fill.source not in steps]
    return result


def speakers(steps: Sequence[Step]) -> list[tuple[int, int]]:
    """Return the outputs that are sometimes silent, each as number of its member and its own number."""
    return [(k, j) for k, s in enumerate(steps) for j, p in enumerate(s.outputs) if p.sporadic]


def wiring(steps: Sequence[Step]) -> Any:
    """Return the links and ports that a text depends on: it fits only rigs with the same ones."""
    number = {id(s): k for k, s in enumerate(steps)}

    def link(step: Step, port: Port) -> Any:
        fill = step.fed.get(port.name)
        return fill and (number.get(id(fill.source)), fill.output, fill.pick, fill.stamp)

    return tuple(
        (
            tuple((p.name, p.held, p.size, p.limits, link(s, p)) for p in s.inputs),
            tuple((p.size, p.bound, p.sporadic, p.delayed, p.unchecked) for p in s.outputs),
        )
        for s in steps
    )


@runtime_checkable
class Deciding(Protocol):
    """A block that leaves rare ticks to Python because they are not arithmetic, such as the next step of a search.

    Native code also leaves untranslated branches to Python without this declaration, but it detects them late and
    computes the earlier ticks of the batch again.
    """

    def decides(self, x: Any, t: int) -> bool:
        """Return whether native code must leave a tick to Python."""


def decides(step: Step) -> bool:
    """Return whether a member may leave ticks to Python."""
    # `isinstance` with a protocol takes some 10 us a member, in each run of a study.
    return hasattr(type(step.block), Deciding.decides.__name__)


def fits_64_bits(steps: Sequence[Step]) -> bool:
    """Return whether whole numbers of 64 bits hold all times of a run."""
    period = Plan(s.schedule for s in steps).clock.period
    # `time` computes twice the time before it divides.
    return 2 * (period * 10**9).numerator * (steps[0].schedule.ticks or 1) <= LARGEST


class Turns:
    """Writes the code of the members' turns in a tick.

    In the text of a tick k at time t: for member i, x{i} is its state, q{i} its answer, r{i} its newest answer, z{i}
    the stamps of its delayed outputs; h{j} is the value of holding j.

    Parameters
    ----------
    steps : sequence of Step
        Plants first, then the others, each after those that it reads; each has answered a tick.
    recorded : sequence of Step
        Steps whose answers are written into tables o{i}, and their stamps into p{i}.
    typed : bool
        See `rig_text`.

    Attributes
    ----------
    arrays : set of str
        Arguments of the text besides states.
    kept : list of Holding
    sporadic : list of (int, int)
        Sporadic outputs, each by the number of its member and its own number.
    """

    def __init__(self, steps: Sequence[Step], recorded: Sequence[Step] = (), typed: bool = True) -> None:
        self.steps, self.recorded, self.typed = steps, recorded, typed
        self.plan = Plan(s.schedule for s in steps)
        self.kept, self.sporadic = holdings(steps), speakers(steps)
        silent = [(k, steps[k].outputs[j]) for k, j in self.sporadic]
        self.program = Program([s.block for s in steps], Writer, self._ages(), silent, typed)
        self.arrays: set[str] = set()
        self._ns = (self.plan.clock.period * 10**9).as_integer_ratio()
        self._numbers = {id(s): k for k, s in enumerate(steps)}

    def check_times(self) -> None:
        """Ensure that whole numbers of 64 bits hold all times of the run."""
        if not fits_64_bits(self.steps):
            raise NotNative("times beyond whole numbers of 64 bits")

    def time(self, k: str) -> str:
        """Write the time of a tick, ns."""
        n, d = self._ns
        # As `Schedule.time`: rounded to the nearest ns in whole numbers, because a float does not hold ns of long runs.
        return f"{k} * {n}" if d == 1 else f"(2 * {k} * {n} + {d}) // {2 * d}"

    def every(self, k: int) -> int:
        """Return how many ticks of the text lie between two ticks of a member."""
        return self.plan.every(self.steps[k].schedule)

    # the turns ----------------------------------------------------------------------------------------------------

    def acts(self) -> list[tuple[int, Act]]:
        """Return the actions of the nodes at a tick, in order, by their numbers."""
        return acts(range(len(self.steps)), lambda k: self.steps[k].plant)

    def turn(self, k: int, act: Act) -> list[str]:
        """Write the turn of a node: call its block, check and distribute the answer."""
        value = self._asked(k, act, {} if act == "outputs" else self._inputs(k))
        if act != "advance":
            return self._due(k, self._answered(k, value, f"x{k}" * (act == "update")) + self._handed_on(k))
        if not isinstance(value, Dynamic):
            raise NotNative(f"{self.steps[k].name}: its `advance` returns the state unchanged")
        return self._due(k, [self._state(k, value)])

    def given(self, k: int, texts: Sequence[str]) -> list[str]:
        """Write the code of a node with given outputs."""
        return self._due(k, [f"r{k} = ({''.join(f'{x}, ' for x in texts)})"])

    def decided(self, state: str) -> list[str]:
        """Write code that stops before a tick that a member leaves to Python."""
        lines: list[str] = []
        for k, step in enumerate(self.steps):
            if decides(step):
                writer = self._writer(k)
                test = writer.truth(self._asked(k, "decides", {}))
                lines += self._due(k, [*writer.lines, f"if {test}:", f"    return ({state},)"])
        return lines

    # its parts ----------------------------------------------------------------------------------------------------

    def _inputs(self, k: int) -> dict[str, Value]:
        """Describe the sources of a member's inputs: which members, and which numbers."""
        step = self.steps[k]
        return {port.name: self._input(step, port) for port in step.inputs}

    def _due(self, k: int, lines: list[str]) -> list[str]:
        every = self.every(k)
        return lines if every == 1 else [f"if k % {every} == 0:", *(f"    {line}" for line in lines)]

    def _writer(self, k: int) -> Writer:
        """Return a writer for a node's method, which is named in errors."""
        step = self.steps[k]
        return Writer(self.program, getattr(type(step.block), "outputs" if step.plant else "update"), {})

    def _holding(self, fill: Fill | None) -> int | None:
        """Return the number of the holding that an input is filled from; None: it gets each tick's."""
        return next((i for i, holding in enumerate(self.kept) if holding.fill is fill), None)

    def _ages(self) -> dict[tuple[int, str], int | str | None]:
        """Return the ages of inputs: 0 if published at each tick of the reader, else the expression for them."""
        result: dict[tuple[int, str], int | str | None] = {}
        for k, step in enumerate(self.steps):
            for port in step.inputs:
                fill = step.fed.get(port.name)
                number = self._holding(fill)
                if fill is None or (number is not None and fill.last_published() is None):
                    result[k, port.name] = None
                elif number is not None:
                    # As `Step.age`: a message that is ahead of the tick has the age 0.
                    result[k, port.name] = f"max(int({WHEN}[0] - {WHEN}[{number + 1}]), 0)"
                # Each tick of the reader is a tick of the publisher, too, so the value is of the same tick.
                elif step.schedule.every % fill.source.schedule.every == 0:
                    result[k, port.name] = 0
        return result

    def _input(self, step: Step, port: Port) -> Value:
        fill, values = step.fed.get(port.name), step.values[port.name]
        number = self._holding(fill)
        # A held input that nothing fills stays None; any other value would come from outside of the rig, unseen by
        # native code.
        if fill is None and (not port.held or values is not None):
            raise NotNative(f"{step.name}: {port.topic} does not come from a member of the rig")
        if fill is None or values is None:
            return Static(None)
        # No native tick brings such an array, and none reads it: it is too long to be written out.
        if (
            port.size > LONGEST
            and number is not None
            and (self.kept[number].source is None or not fill.source.outputs[fill.output].width)
        ):
            return Static(values)
        if port.size > LONGEST:
            raise NotNative(f"{step.name}: {port.topic} has {port.size} numbers, expected at most {LONGEST}")
        if number is not None:
            if isinstance(values, Sample):
                return Dynamic(f"h{number}", packed(values))
            return Group(tuple(Dynamic(f"h{number}[{p}]", float(v)) for p, v in enumerate(values)))
        k = self._numbers[id(fill.source)]
        every = self.every(k)
        return self._read(fill, f"r{k}", f"z{k}", self.time(f"(k - k % {every})" if every > 1 else "k"), values)

    def _read(self, fill: Fill, numbers: str, stamps: str, time: str, values: Any) -> Value:
        """Write the code that stores an output's present `values` in a subscriber's input."""
        before, _, flag, _ = slots_of(fill.source.outputs)[fill.output]
        data = values.data if isinstance(values, Sample) else values
        row = [
            Dynamic(f"{numbers}[{before + p}]" if type(p) is int else repr(p), float(v))
            for p, v in zip(fill.places, data, strict=True)
        ]
        if not isinstance(values, Sample):
            return Group(tuple(row))
        stamp = f"{stamps}[{flag}]" if fill.stamp == "own" else time
        return Dynamic(
            f"{self.program.name(Sample, 'Sample')}({stamp}, ({''.join(f'{v.code}, ' for v in row)}))",
            Sample(values.stamp, tuple(float(v) for v in data)),
        )

    def _asked(self, k: int, name: str, inputs: Mapping[str, Value]) -> Value:
        step, program = self.steps[k], self.program
        state: Value = Dynamic(f"x{k}", packed(step.x, program.typed))
        # The present state may decide the branch, so no branch counts as the usual one.
        program.aside = decides(step)
        # The sample of a time is never 0: a branch for the first tick would pass for the usual one.
        args = [Static(step.block, (k,)), state, Dynamic("t", step.t or 1)]
        return specialise(program, getattr(type(step.block), name), args, inputs, self.arrays)

    def _answered(self, k: int, value: Value, state: str) -> list[str]:
        """Process an answer: its state, and its checked numbers, which are written into the table."""
        step, typed, writer = self.steps[k], self.typed, self._writer(k)
        x, size = Dynamic(""), sum(p.width for p in step.outputs)
        try:
            if state:
                first, value = writer.parts(value, NOWHERE)
                x = writer.dynamic(first)
                writer.emit(f"y{k} = {x.code}")
            numbers: list[str] = []
            stamps: list[str] = []
            flags: list[str] = []
            for flag, stamp, answer, row in rows_of(writer, value, step.outputs):
                flags += flag
                stamps += stamp
                # In Python a row is stored as it is: `_row_of` checks its length and converts whole numbers, which is
                # faster than a call of `float` for each number.
                at_once = size >= FEW and not typed and isinstance(answer, Dynamic) and type(answer.sample) is tuple
                numbers += [f"*{writer.code(answer)}"] if at_once else [f"float({writer.code(item)})" for item in row]
        except (NotNative, AttributeError, KeyError, ValueError) as error:
            raise NotNative(f"{step.name}: its answer: {error}") from None
        lines = writer.lines
        if numbers:
            # One comparison checks all numbers: if their squares add up to less than the least bound, each is within
            # its limits. NaN and infinity fail it.
            bound = min(p.bound for p in step.outputs) * EDGE
            lines += _row_of(f"q{k}", numbers, flags, size, bound, typed)
            lines.append(f"r{k} = q{k}")
        if stamps:
            lines.append(f"z{k} = ({''.join(f'{z}, ' for z in stamps)})")
        if state:
            lines.append(self._state(k, replace(x, code=f"y{k}")))
        if any(s is step for s in self.recorded) and not typed:
            lines += [f"o{k}.append(q{k})", *([f"p{k}.append(z{k})"] if stamps else [])]
        elif any(s is step for s in self.recorded):
            tick = f"k // {self.every(k)} - e{k}"
            lines += [f"o{k}[{tick}, {i}] = q{k}[{i}]" for i in range(size + len(flags))]
            lines += [f"p{k}[{tick}, {i}] = z{k}[{i}]" for i, _ in enumerate(stamps)]
        return lines

    def _state(self, k: int, value: Dynamic) -> str:
        """Store a state, which must have the type of the previous one."""
        typed = self.typed
        # Where the type is certain the check of each tick is left out.
        known = not typed and is_sure(value) and alike(value.sample, packed(self.steps[k].x, typed))
        return f"x{k} = {value.code}" if known else f"x{k} = same_(x{k}, {value.code})"

    def _handed_on(self, k: int) -> list[str]:
        """Pass outputs with their time to their recorders; leave new kinds and invalid values to Python."""
        step, kept = self.steps[k], self.kept
        lines: list[str] = []
        for j, (port, (_, _, _, flag)) in enumerate(zip(step.outputs, slots_of(step.outputs), strict=True)):
            messages: list[str] = []
            for i, holding in enumerate(kept):
                if (holding.source, holding.fill.output) != (k, j):
                    continue
                # The first message changes the type of what the reader holds, so this tick is Python's and then another
                # text fits.
                if holding.value is None or holding.fill.last_published() is None or not port.width:
                    messages.append(GIVEN_UP)
                    continue
                value = self._read(holding.fill, f"q{k}", f"z{k}", "t", holding.value)
                row = isinstance(value, Group)
                messages.append(f"h{i} = {self._writer(k).code(value)}")
                messages.append(f"{WHEN}[{i + 1}] = {'t' if row else f'h{i}.stamp'}")
                for p, limit in enumerate(holding.fill.port.limits if holding.fill.checked else ()):
                    messages += [f"if not abs(h{i}{'' if row else '.data'}[{p}]) <= {limit!r}:", f"    {GIVEN_UP}"]
            if flag is not None:
                messages.append(f"{WHEN}[{1 + len(kept) + self.sporadic.index((k, j))}] = t")
                messages = [f"if q{k}[{flag}] != 0.0:", *(f"    {line}" for line in messages)]
            lines += messages
        return lines


def rows_of(
    writer: Writer, value: Value, outputs: Sequence[Port]
) -> Iterator[tuple[list[str], list[str], Value, list[Value]]]:
    """Split an answer: for each output its flag and stamp, if any, its row, and the row's numbers.

    Raises
    ------
    KeyError
        An output is not in the answer.
    NotNative
        A row has another length than its port, or is not of an output; the tick in Python then reports the error.
    """
    if isinstance(value, Dynamic) and value.keys is not None:
        value = writer.unfolded(value)
    result: Any = value.items if isinstance(value, Record) else {}
    if unknown := result.keys() - {port.name for port in outputs}:
        raise NotNative(f"{min(unknown)} is not an output")
    for port in outputs:
        answer, flags, stamps = result[port.name], list[str](), list[str]()
        if port.sporadic:
            flag, answer = writer.parts(answer, NOWHERE)
            flags.append(writer.code(flag))
        if port.delayed:
            stamps.append(writer.code(writer.attribute(answer, "stamp", NOWHERE)))
            answer = writer.attribute(answer, "data", NOWHERE)
        row = writer.parts(answer, NOWHERE)
        if len(row) not in (port.width, port.size):
            raise NotNative(f"{port.name} has {len(row)} values, expected {port.size}")
        yield flags, stamps, answer, row


def _row_of(q: str, numbers: Sequence[str], flags: Sequence[str], size: int, bound: float, typed: bool) -> list[str]:
    """Write code that stores the numbers of an answer and its flags of silence; beyond the bound Python does it."""
    text = "".join(f"{flag}, " for flag in flags)
    if typed or size < FEW:
        squares = " + ".join(f"{q}[{i}] * {q}[{i}]" for i in range(size))
        return [f"{q} = ({', '.join(numbers)}, {text})", f"if not ({squares} <= {bound!r}):", f"    {GIVEN_UP}"]
    return [
        f"{q} = ({', '.join(numbers)},)",
        # Integers in an answer are converted, since -0 is another number than -0.0.
        f"if not only_floats(map(type, {q})):",
        f"    {q} = tuple(map(float, {q}))",
        f"if not (sum_of_products({q}, {q}) <= {bound!r} and len({q}) == {size}):",
        f"    {GIVEN_UP}",
        *([f"{q} = (*{q}, {text})"] if flags else []),
    ]


class _Nowhere:
    lineno = 1


NOWHERE: Any = _Nowhere()  # in place of the syntax node of a construct that is in no line of a method
