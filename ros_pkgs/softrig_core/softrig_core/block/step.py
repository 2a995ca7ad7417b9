"""A step: one member of a rig at its ticks, the same in every runner.

It has the inputs of a tick and their ages, calls the block, and publishes only valid outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NoReturn

from ..errors import RunError, describe
from .answer import Row, Rows, answers, flat
from .block import Block, Level, Plant, finishes
from .bound import answerer, mover
from .change import Change, permit, revise
from .fill import Fill, Pick, Stamp
from .held import RunningBlock
from .link import Link
from .loop import answer, move
from .params import flatten
from .port import Port, Sample
from .scene import Marker
from .schedule import Schedule


class Step(RunningBlock):
    """One node at its ticks: its block, the block's state, and the values of its inputs.

    Parameters
    ----------
    name : str
        Node name, for errors.
    changes : iterable of Change
        Of the block's parameters, in the order of their times.

    Attributes
    ----------
    values : dict of str to value
        Value held by each input, by the keyword of the block's methods. The code that delivers a message writes it
        here.
    stamps : dict of str to callable
        By input: a function that returns the stamp of the newest message, ns, or None before the first. An input
        without publisher is missing.
    changes : tuple of Change
        Changes that have not taken effect yet.
    bad : bool
        Whether a message was rejected that the next answer would have used.
    t : int
        The tick under way, or the newest completed one, ns.
    readers : list of Fill
        Inputs in this process that its outputs fill, in order; those that check what they receive are last.
    fed : dict of str to Fill
        By input, the output in this process that fills it.
    plain : bool
        Whether every output publishes at each tick, with the stamp of the tick.
    numbers : tuple of float
        For a plain step: all numbers of the newest answer.
    answer : callable
        Called with t, ns: answers that tick, passes the answer to the readers in this process, and publishes it. A
        RunError whose `node` is the name of this step means that the block failed or returned an invalid value. The
        function is generated at the first tick (`bound.py`), so all inputs and outputs must be wired by then. It is
        generated again when the step gets another link.
    advance : callable
        Called with t, ns, and optionally the values of the inputs: advances a plant from t over one period, or raises a
        RunError.
    counts : dict of str to int
        By output: the number of arrays published; arrays are numbered.
    begun : int or None
        For a solver whose ticks have two halves: the tick that has begun and may still be unanswered, ns.
    link : Link or None
        The connection to nodes outside this process; None if there is none.
    waits : Link or None
        The link that the loop asks for missing messages; None if no message can be missing.
    native : (int, str)
        Number of ticks answered by native code, and why Python answered the others.
    """

    TABLES = (*RunningBlock.TABLES, "values", "counts")
    VALUES = ("last_answer", "numbers", "published_at", "t", "bad", "changes", "change_at", "unanswered", "begun")

    native: tuple[int, str] = (0, "")

    answer: Callable[[int], None]
    advance: Callable[..., None]

    def __init__(
        self,
        name: str,
        block: Block,
        schedule: Schedule,
        inputs: tuple[Port, ...],
        outputs: tuple[Port, ...],
        changes: Iterable[Change] = (),
    ) -> None:
        super().__init__(block)
        self.name, self.schedule = name, schedule
        self.inputs, self.outputs = inputs, outputs
        self.values: dict[str, Any] = {p.name: p.initial for p in inputs}
        self.stamps: dict[str, Callable[[], int | None]] = {}
        self.fed: dict[str, Fill] = {}
        self.bad = False
        self.t = 0
        self.begun: int | None = None
        self.counts = {p.name: 0 for p in outputs}
        self.plain = not any(p.sporadic or p.delayed for p in outputs)
        # for a step that is not plain: when each output published last
        self.published_at: list[int | None] = [None] * len(outputs)
        self.numbers: tuple[float, ...] = ()
        self.last_answer: Rows = ()  # the newest answer that was admitted; it is held when an input is rejected
        self.readers: list[Fill] = []
        self.plant = isinstance(block, Plant)
        block.ages = self.age
        self.link = None
        self.plan(changes)

    @property
    def link(self) -> Link | None:
        """The outermost link; see above."""
        return self._link

    @link.setter
    def link(self, link: Link | None) -> None:
        self._link = link
        self._asking, self.waits = self.overriding("respond"), self.overriding("lacks")
        # The text of a turn names what is wired, and more may be wired up to the first tick. Two ticks go through the
        # loop's own functions (`loop.answer`): native runs leave only the first and the last one to Python.
        self.answer, self.advance = self._first_answer, self._first_advance

    def overriding(self, method: str) -> Link | None:
        """Return the outermost link that overrides a method; None if there is none."""
        link = self._link
        # A method that no link overrides has no effect, so the generated tick leaves out its call.
        while link is not None and getattr(type(link), method) is getattr(Link, method):
            link = link.inner
        return link

    @property
    def unanswered(self) -> int:
        """Return how many of its ticks the block did not answer before this one: `Block.unanswered`."""
        return self.block.unanswered

    @unanswered.setter
    def unanswered(self, ticks: int) -> None:
        self.block.unanswered = ticks

    @property
    def respond(self) -> Callable[..., Any]:
        """Return the function that answers a tick, ``(x, t, **inputs)``: the block's, or the outermost link's."""
        link = self._asking
        return self.ask if link is None else link.respond

    @property
    def ask(self) -> Callable[..., Any]:
        """The method of the block that answers a tick: `outputs` of a plant, else `update`."""
        block = self.block
        if isinstance(block, Plant):
            return block.outputs
        return self._finish_or_update if finishes(type(block)) else block.update

    @property
    def move(self) -> Callable[..., Any]:
        """The method `advance` of a plant."""
        assert isinstance(self.block, Plant)
        return self.block.advance

    @property
    def asked_for(self) -> tuple[str, ...]:
        """Names of the inputs that `respond` gets."""
        return () if self.plant or (self._asking is not None and not self._asking.READS) else tuple(self.values)

    # what a tick is -----------------------------------------------------------------------------------------------

    def make(self) -> None:
        """Generate `answer` and `advance` once all is wired, because in real time the first tick has no time for it."""
        self.answer = answerer(self)
        if self.plant:
            self.advance = mover(self)

    def _first_answer(self, t: int) -> None:
        answer(self, t)
        self.answer = self._second_answer

    def _second_answer(self, t: int) -> None:
        answer(self, t)
        self.answer = self._third_answer

    def _third_answer(self, t: int) -> None:
        self.answer = answerer(self)
        self.answer(t)

    def _first_advance(self, t: int, values: Mapping[str, Any] | None = None) -> None:
        move(self, t, values)
        self.advance = self._second_advance

    def _second_advance(self, t: int, values: Mapping[str, Any] | None = None) -> None:
        move(self, t, values)
        self.advance = self._third_advance

    def _third_advance(self, t: int, values: Mapping[str, Any] | None = None) -> None:
        self.advance = mover(self)
        self.advance(t, *(() if values is None else (values,)))

    def asked(self, t: int) -> Any:
        """Return the block's state and answer at a tick; due parameter changes take effect."""
        if t >= self.change_at:
            self._change(t)
        if self.bad:
            x, result = self.refused(t)
            # A plant moves in `advance` alone, so the state of its answer is dropped.
            return self.x if self.plant else x, result
        result = self.respond(self.x, t, **{name: self.values[name] for name in self.asked_for})
        return (self.x, result) if self.plant else result

    def hand_on(self, t: int, rows: Rows) -> None:
        """Forward a message that is not an answer of the block to subscribers in this and other processes."""
        # This comes before any reader is filled: the age of what it gets counts from these times
        # (`Fill.last_published`).
        if not self.plain:
            self.mark(t, rows)
        for fill in self.readers:
            row = rows[fill.output]
            if row is not None and fill.checked:
                fill.reader.receive_unchecked(t, fill.port, fill.value_of(row))
            elif row is not None:
                fill.set_value(row)
        if self.link is not None:
            self.link.send(t, rows, self.numbers)

    def mark(self, t: int, rows: Rows) -> None:
        """Store when each output has published last; a plain step needs no such list."""
        self.published_at = [s if row is None else t for s, row in zip(self.published_at, rows, strict=True)]

    def settle(self) -> None:
        """Bring the state and the newest answer up to date: the link may have put off the processing of ticks."""
        if self.link is not None:
            self.link.settle()

    def status(self) -> Mapping[str, tuple[float, str]]:
        """Return the figures of an observer after it has processed all its messages; see `Observer.status`."""
        self.settle()
        return super().status()

    def health(self) -> Mapping[str, str]:
        """Return the entries of /diagnostics after all ticks; see `Block.health`."""
        self.settle()
        return super().health()

    def markers(self) -> Sequence[Marker]:
        """Return markers to display after all ticks; see `Block.markers`."""
        self.settle()
        return super().markers()

    def age(self, name: str) -> int | None:
        """Answer `Block.age`: from the stamp of an input to the current tick, ns; None before a message."""
        newest = self.stamps.get(name)
        if newest is None or (stamp := newest()) is None:
            return None
        value = self.values[name]
        # A delayed value is as old as its acquisition, not as its message.
        age = self.t - (value.stamp if type(value) is Sample else stamp)
        return age if age > 0 else 0

    def held(self) -> Mapping[str, Any]:
        """Return the newest outputs, initially the safe values; sporadic ports are left out."""
        values = self.last_answer or (None,) * len(self.outputs)
        return {
            p.name: row or (Sample(self.t, p.safe) if p.delayed else p.safe)
            for p, row in zip(self.outputs, values, strict=True)
            if not p.sporadic
        }

    def newest(self, name: str) -> Any:
        """Return the message of an output at the newest tick; None: nothing."""
        self.settle()
        return next((row for p, row in zip(self.outputs, self.last_answer, strict=False) if p.name == name), None)

    def refused(self, t: int) -> Any:
        """Answer a tick for which a message was rejected."""
        self.bad = False
        x, outputs = self.block.refused(self.x, t)
        return x, self.held() if outputs is None else outputs

    def plan(self, changes: Iterable[Change]) -> None:
        """Schedule these changes of parameters, and no others."""
        self.changes = tuple(changes)
        self.change_at = self.changes[0].at if self.changes else math.inf

    def set(self, values: Mapping[str, Any]) -> list[str]:
        """Change parameters at the next tick, all or none; names those that replace a value which is already pending.

        Raises
        ------
        ParameterError
            See `softrig_core.block.change.permit`.
        """
        waiting: dict[str, Any] = {}
        for change in self.changes:
            # Changes that wait for the next tick are checked together with the new one, as they take effect together.
            waiting |= change.values if change.at <= self.t else {}
        now = revise(self.params, waiting) if waiting else self.params
        known = flatten(permit(type(self.block), now, values, self.name))
        new = Change(self.t, waiting | {name: known[name] for name in values})
        self.plan([new, *(change for change in self.changes if change.at > self.t)])
        return [name for name in values if name in waiting]

    def _change(self, t: int) -> None:
        """Apply the changes due up to `t` as one change, so that they are recorded and repeated as one."""
        used: dict[str, Any] = {}
        for change in self.changes:
            used |= change.values if change.at <= t else {}
        self.plan([change for change in self.changes if change.at > t])
        revised = revise(self.params, used)
        self.change(revised)
        if self.link is not None:
            known = flatten(revised)
            self.link.changed(t, {name: known[name] for name in used})

    # its parts ----------------------------------------------------------------------------------------------------

    def _finish_or_update(self, x: Any, t: int, **inputs: Any) -> Any:
        block: Any = self.block
        last = self.schedule.last
        return (block.update if last is None or t < last else block.finish)(x, t, **inputs)

    def checked(self, value: Any) -> Rows:
        """Return the checked values of each output."""
        rows = answers(value, self.outputs, self.name, self.t)
        if self.plain and rows:
            self.numbers = flat(rows)
        return rows

    def hands_to(self, output: str, reader: Step, name: str, pick: Pick | None) -> None:
        """Connect an output to an input of another step in this process.

        Parameters
        ----------
        name : str
            Of its input.
        pick : tuple or None
            See `Fill`.
        """
        k = next(i for i, p in enumerate(self.outputs) if p.name == output)
        port = next(p for p in reader.inputs if p.name == name)
        stamp: Stamp = "own" if self.outputs[k].delayed else "tick" if port.delayed else "none"
        fill = reader.fed[name] = Fill(self, k, reader, port, pick, stamp)
        # A plant that rejects a value ends the run; by then all other inputs are filled.
        self.readers = sorted([*self.readers, fill], key=lambda f: f.checked)
        reader.stamps[name] = fill.last_published

    def receive_unchecked(self, t: int, port: Port, values: Row) -> None:
        """Accept a message that may be bad, such as one from DDS; a message that an input rejects never reaches the
        block.

        Raises
        ------
        RunError
            A plant has no command for its tick.
        """
        reason = port.beyond(values.data if isinstance(values, Sample) else values)
        if not reason:
            self.values[port.name] = values
        # A plant has no command for this tick then, and an old one would move it unnoticed.
        elif isinstance(self.block, Plant):
            raise RunError(f"{self.name} refuses {port.topic} at t = {t / 1e9:.9g} s: {reason}")
        else:
            self.bad = True
            self.note(Level.WARN, f"refused {port.name}", f"{port.topic}: {reason}")

    def fail(self, error: BaseException) -> NoReturn:
        """Raise the block's error as one that names the step and the time; its reports count."""
        # What the block reported before it failed may explain the failure.
        self.store_reports()
        if isinstance(error, RunError):
            error.node = self.name
            raise error
        result = RunError(f"{self.name}: failed at t = {self.t / 1e9:.9g} s: {describe(error)}")
        result.node = self.name
        raise result from error
