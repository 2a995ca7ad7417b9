"""Pass the outputs that native code computed to the members that record them and to those that watch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..block.answer import Messages, ReceivedMessages, Slots, part, parted, slots_of
from ..block.block import Observer
from ..block.fill import Fill
from ..block.gathering import takes_batches
from ..block.port import Sample
from ..block.schedule import Plan, Schedule
from ..block.step import Step
from ..wire.times import once_for_times

NEVER = -1  # ns, in place of a time


@once_for_times
def _times(schedule: Schedule, first: int, last: int) -> NDArray[np.int64]:
    """Return the times of ticks as `Schedule.times` does: the same array for the runs of a study."""
    return schedule.times(first, last)


def _readings(source: Step, reader: Step) -> list[tuple[Fill, Slots]]:
    """Return the connections from one step to another, each with its part of the answer."""
    slots = slots_of(source.outputs)
    return [(fill, slots[fill.output]) for fill in reader.fed.values() if fill.source is source]


def answered(
    step: Step,
    number: int,
    numbers: tuple[float, ...],
    stamps: Sequence[int] = (),
    published: Mapping[int, int] | None = None,
) -> None:
    """Return the outputs of a step at a tick from the numbers of native code, as the step and its readers hold them.

    Parameters
    ----------
    step : Step
        The step of the tick.
    number : int
        Number among its own ticks.
    numbers : tuple of float
        All its values, one output after another.
    stamps : sequence of int
        Stamps of its delayed outputs, ns.
    published : mapping of int to int
        Time of the last message of each sporadic output, ns, by its place; `NEVER`.
    """
    step.t = step.schedule.time(number)
    answers = parted(step.outputs, numbers, stamps)
    if step.outputs:
        step.last_answer, step.numbers = answers, numbers if step.plain else ()
    if not step.plain:
        newest = [(published or {}).get(j, step.t) for j, _ in enumerate(step.outputs)]
        step.published_at = [None if t == NEVER else t for t in newest]
    for fill in step.readers:
        # A silent tick must not overwrite the held value; `Fitted.apply` fills it if something was published.
        if not (fill.checked or step.outputs[fill.output].sporadic):
            fill.set_value(answers[fill.output])  # type: ignore[arg-type]


class Answers(NamedTuple):
    """The outputs of a step in some ticks: numbers, (n, size), and stamps of its delayed outputs, (n, count)."""

    numbers: Any
    stamps: Any

    def put(self, k: int, numbers: Sequence[float], stamps: Sequence[int]) -> None:
        """Store the answer of one more tick in row k."""
        for table, row in ((self.numbers, numbers), (self.stamps, stamps)):
            if isinstance(table, list):
                table.append(row)
            else:
                table[k] = row


def nothing(count: int) -> Answers:
    """Return the answers of a step without outputs."""
    return Answers(np.empty((count, 0)), np.empty((count, 0), np.int64))


def numbers_of(step: Step) -> tuple[float, ...]:
    """Return all numbers of a step's newest answer, zeros for silent outputs, and flags of sporadic ones."""
    if step.plain:
        # The text is compiled for floats, and a block may answer with whole numbers.
        return tuple(map(float, step.numbers))
    rows: Sequence[Any] = step.last_answer or [None] * len(step.outputs)
    results = [
        (0.0,) * p.width if row is None or not p.width else row.data if isinstance(row, Sample) else row
        for p, row in zip(step.outputs, rows, strict=True)
    ]
    flags = [float(row is not None) for p, row in zip(step.outputs, rows, strict=True) if p.sporadic]
    return (*(float(v) for row in results for v in row), *flags)


def stamps_of(step: Step) -> tuple[int, ...]:
    """Return the stamps of the delayed outputs of a step, in its newest answer, ns; 0 where it is silent."""
    rows = step.last_answer or [None] * len(step.outputs)
    return tuple(getattr(row, "stamp", 0) for p, row in zip(step.outputs, rows, strict=True) if p.delayed)


class Audience:
    """The members that receive the outputs of native code.

    Parameters
    ----------
    steps : sequence of Step
        Steps of the whole rig.
    plan : Plan
        Plan of these steps.

    Attributes
    ----------
    watchers : list of Step
        Observers without readers.
    tick_by_tick : set of str
        Names of the watchers that cannot process what is recorded in one batch.
    """

    def __init__(self, steps: Sequence[Step], plan: Plan) -> None:
        self._plan = plan
        self.watchers = [s for s in steps if isinstance(s.block, Observer) and not s.readers]
        self.tick_by_tick = {w.name for w in self.watchers if not takes_batches(w.block)}

    def hand_out(self, core: Sequence[Step], first: int, last: int, rows: Mapping[int, Answers]) -> None:
        """Pass the answers of the steps to their recorders."""
        times: dict[tuple[Any, range], Any] = {}
        for s in core:
            span = self._plan.own(s.schedule, first, last)
            if s.link is None or not span:
                continue
            if (ticks := (s.schedule.period, span)) not in times:
                times[ticks] = _times(s.schedule, span.start, span.stop)
            s.link.send_all(times[ticks], *(rows[id(s)] if s.outputs else nothing(len(span))))

    def watch(self, recorded: Sequence[Step], first: int, last: int, rows: Mapping[int, Answers]) -> None:
        """Show the answers to blocks that only watch, tick after tick."""
        if not self.watchers:
            return
        watchers = [
            (w, self._plan.every(w.schedule))
            for w in self.watchers
            if not self._at_once(w, recorded, first, last, rows)
        ]
        messages = []
        for s in recorded:
            readers = [read for w, _ in watchers for read in _readings(s, w)]
            if readers:
                messages.append(
                    (
                        s,
                        self._plan.every(s.schedule),
                        self._plan.own(s.schedule, first, last).start,
                        [table.tolist() for table in rows[id(s)]],
                        readers,
                    )
                )
        for k in sorted({k for _, every in watchers for k in range(-(-first // every) * every, last, every)}):
            t = self._plan.clock.time(k)
            for s, every, begin, (numbers, stamps), readers in messages:
                # Before the first tick of a node in this stretch its subscribers still hold its message of the stretch
                # before.
                if (index := k // every - begin) >= 0:
                    s.t = s.schedule.time(k // every)
                    if not s.plain:
                        s.mark(s.t, parted(s.outputs, numbers[index], stamps[index]))
                    for fill, slots in readers:
                        row = part(numbers[index], stamps[index], slots)
                        if row is not None:
                            fill.set_value(row)
            for w, every in watchers:
                if k % every == 0:
                    w.answer(t)

    def _at_once(
        self, watcher: Step, recorded: Sequence[Step], first: int, last: int, values: Mapping[int, Answers]
    ) -> bool:
        """Pass all ticks to a watching block in one batch, if it supports that."""
        ticks = self._plan.own(watcher.schedule, first, last)
        if watcher.name in self.tick_by_tick:
            return False
        if not ticks:
            return True
        messages: dict[str, Messages] = {}
        for s in recorded:
            result = self._seen(s, watcher, self._plan.own(s.schedule, first, last), values[id(s)].numbers)
            if result is None:
                # Results that cannot be shown in one batch now cannot be later, so it is not tried again.
                self.tick_by_tick.add(watcher.name)
                return False
            messages |= result
        t = watcher.schedule.time(ticks[-1])
        watcher.x, watcher.t = watcher.block.at_once(watcher.x, t, messages), t  # type: ignore[attr-defined]
        if watcher.link is not None:
            watcher.link.send_all(watcher.schedule.times(ticks.start, ticks.stop), *nothing(len(ticks)))
        return True

    def _seen(self, source: Step, watcher: Step, ticks: range, numbers: Any) -> dict[str, Messages] | None:
        """Return a member's messages that a watcher reads, by input; None if the watcher must run at each tick."""
        result: dict[str, Messages] = {}
        every, often = self._plan.every(watcher.schedule), self._plan.every(source.schedule)
        # The watcher reads one in `step` messages.
        readings, step = _readings(source, watcher), max(1, every // often)
        # Only where one period divides the other are the messages that the watcher sees evenly spaced.
        if readings and max(every, often) % min(every, often):
            return None
        every_nth = slice(-ticks.start % step, None, step)
        for fill, (low, _, _, flag) in readings:
            # Stamps are not in the table of numbers, and with silences the newest message is not at an even spacing.
            if fill.stamp != "none" or (flag is not None and step > 1):
                return None
            stamps, table = source.schedule.times(ticks.start, ticks.stop)[every_nth], numbers[every_nth]
            if flag is not None:
                stamps, table = stamps[table[:, flag] != 0.0], table[table[:, flag] != 0.0]
            values = [table[:, low + p] if type(p) is int else np.full(len(table), p) for p in fill.places]
            result[fill.port.name] = ReceivedMessages(stamps, np.array(values).T)
        return result
