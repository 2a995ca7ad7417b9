"""The in-process runner: the blocks of a rig wired in memory, no DDS, the same numbers and bytes."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any

from ..errors import RunError, ScenarioError, describe
from ..model.answer import check
from ..model.block import Block, Plant
from ..model.port import CLOCK, Sample
from ..wire.codec import encoder
from ..wire.recording import Sink
from .rig import Member, Rig


class _Step:
    """One block with its prepared reads and writes."""

    def __init__(self, member: Member, block: Block, slots: dict[str, int], topics: list[str]) -> None:
        self.block = block
        self.schedule = copy(member.schedule)  # a block may end the run before its duration
        self.every = member.schedule.every
        self.name = member.name
        self.advance = block.advance if isinstance(block, Plant) else None
        self.answer = block.outputs if isinstance(block, Plant) else block.update
        if block.finishes() and self.advance is None:
            self.answer = self._last_or_update
        self.idle = {p.name: None for p in member.inputs if p.name not in member.links}
        reads = [
            (p.name, slots[p.topic], member.links[p.name].pick, p.delayed and not member.links[p.name].port.delayed,
             member.links[p.name].source.schedule.held, p.initial)
            for p in member.inputs if p.name in member.links
        ]  # fmt: skip
        silent = {p.name for p in member.inputs if p.name in member.links and member.links[p.name].port.sporadic}
        self.reads = [r for r in reads if r[0] not in silent]
        self.events = [r for r in reads if r[0] in silent]
        self.slots = {name: slot for name, slot, *_ in reads}
        self.writes = [
            (p, slots[p.topic], encoder(p.layout()), topics.index(p.topic), p.sporadic) for p in member.outputs
        ]  # fmt: skip

    def gather(self, t: int, values: list[Any]) -> dict[str, Any]:
        inputs: dict[str, Any] = dict(self.idle)
        for name, _, _, _, _, initial in self.events:
            inputs[name] = initial
        events = [event for event in self.events if values[event[1]] is not None] if self.events else self.events
        for name, slot, pick, wrap, held, _ in self.reads + events if events else self.reads:
            value = values[slot]
            if pick is not None:
                value = Sample(value.stamp, pick(value.data)) if isinstance(value, Sample) else pick(value)
            inputs[name] = Sample(held(t), value) if wrap else value
        return inputs

    def _last_or_update(self, t: int, **inputs: Any) -> Any:
        return self.block.finish(t, **inputs) if t == self.schedule.last else self.block.update(t, **inputs)


class _Ages:
    """Answers `Block.age` for one block of a run in process."""

    def __init__(self, step: _Step, member: Member, now: list[int], values: list[Any], sent: list[int | None]) -> None:
        self._links = {p.name: member.links[p.name] for p in member.inputs if p.name in member.links}
        self._slots = step.slots
        self._now, self._values, self._sent = now, values, sent

    def __call__(self, name: str) -> int | None:
        link, slot = self._links.get(name), self._slots.get(name)
        if link is None or slot is None or self._values[slot] is None:
            return None
        value = self._values[slot]
        if isinstance(value, Sample):
            return self._now[0] - value.stamp
        stamp = self._sent[slot] if link.port.sporadic else link.source.schedule.awaited(self._now[0])
        return None if stamp is None else self._now[0] - stamp


def run_inprocess(
    rig: Rig, seed: int, sink: Sink | None = None, progress: Callable[[int], object] | None = None
) -> dict[str, Block]:
    """Run a rig in this process.

    Parameters
    ----------
    rig : Rig
    seed : int
        Rig seed.
    sink : Sink, optional
        Gets every message as the bytes that DDS would carry.
    progress : callable, optional
        Called with the time in ns about a hundred times.

    Returns
    -------
    dict of str to Block
        The blocks in their final state.

    Raises
    ------
    ScenarioError
        A node of the rig is external.
    RunError
        A block raised, or gave NaN, infinity or a wrong number of values; names node, port and time.
    """
    for member in rig.members:
        if member.external:
            raise ScenarioError(f"node {member.name} is external: in-process runs have no place for it")
    topics = list(rig.topics)
    time, ticks = rig.clock.schedule.time, rig.ticks
    slots = {topic: i for i, topic in enumerate(topics)}
    values: list[Any] = [None] * len(slots)
    sent: list[int | None] = [None] * len(slots)  # stamps of what sporadic ports gave last
    now = [0]
    steps = [_Step(m, m.block(seed), slots, topics) for m in rig.members]
    for step, member in zip(steps, rig.members, strict=True):
        step.block.ages = _Ages(step, member, now, values, sent)
    enders = [s for s in steps if s.block.ENDS]
    plants = [s for s in steps if s.advance]
    others = [s for s in steps if not s.advance]
    clock = CLOCK.layout()
    add = sink.add if sink is not None else None

    def answer(step: _Step, t: int, inputs: dict[str, Any]) -> None:
        try:
            found = step.answer(t, **inputs)
        except Exception as error:
            raise RunError(f"{step.name} failed at t = {t / 1e9:.9g} s: {describe(error)}") from error
        for port, slot, encode, topic, sporadic in step.writes:
            value = check(found, port, step.name, t)
            if value is None:
                continue
            if sporadic:
                sent[slot] = t
            values[slot] = value
            if add is not None:
                add(topic, t, encode(value.stamp, value.data) if isinstance(value, Sample) else encode(t, value))

    def due(t: int, k: int) -> None:
        now[0] = t
        if add is not None:
            add(0, t, clock.encode(t, ()))
        for step in plants:
            if k % step.every == 0:
                answer(step, t, {})

    stride = max(1, ticks // 100)
    k = 0
    while k < ticks:
        t = time(k)
        due(t, k)
        for step in others:
            if k % step.every == 0:
                answer(step, t, step.gather(t, values))
        for step in enders:  # mostly none
            if k % step.every == 0 and step.block.ended:
                ticks = min(ticks, k + rig.stride - k % rig.stride)
                for each in steps:
                    each.schedule.stop(ticks)
        for step in plants:
            if k % step.every == 0 and k + step.every <= ticks:
                try:
                    step.advance(t, **step.gather(t, values))  # type: ignore[misc]
                except Exception as error:
                    raise RunError(f"{step.name} failed after t = {t / 1e9:.9g} s: {describe(error)}"
                                   ) from error  # fmt: skip
        if progress is not None and k % stride == 0:
            progress(t)
        k += 1
    end = time(ticks)
    due(end, ticks)
    for step in others:
        if step.schedule.last == end:
            answer(step, end, step.gather(end, values))
    if progress is not None:
        progress(end)
    return {s.name: s.block for s in steps}
