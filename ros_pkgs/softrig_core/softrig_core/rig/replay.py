"""Open loop: feed one member of a rig with recorded inputs, tick by tick, and collect what it answers."""

from __future__ import annotations

from bisect import bisect_right
from typing import Any

from ..errors import RunError
from ..model.answer import check
from ..model.block import Block, Plant
from ..model.port import Sample
from ..wire.codec import Decoder, encoder
from ..wire.recording import Recording
from .rig import Member, Rig


def feed(rig: Rig, member: Member, seed: int, recording: Recording) -> Recording:
    """Run one block of a rig in open loop.

    Parameters
    ----------
    rig : Rig
        Says which inputs are paired and how long the run is.
    member : Member
        The block under test.
    seed : int
        Rig seed of the recording.
    recording : Recording
        Must hold every topic that the member reads from the rig.

    Returns
    -------
    Recording
        The member's outputs, stamped as in a run.

    Raises
    ------
    RunError
        The recording lacks an input.
    """
    block = member.block(seed)
    answers = Recording((p.topic, p.msgtype) for p in member.outputs)
    inputs = [_Input(member, port_name, recording) for port_name in member.links]
    idle = dict.fromkeys((p.name for p in member.inputs if p.name not in member.links), None)
    encoders = [encoder(p.layout()) for p in member.outputs]
    schedule = rig.schedule_of(member, recording)
    ticks = schedule.count()
    by_name, now = {i.name: i for i in inputs}, 0
    block.ages = lambda name: by_name[name].age(now) if name in by_name else None
    for k in range(ticks):
        t = schedule.time(k)
        advances = isinstance(block, Plant) and k + 1 < ticks
        given: dict[str, Any] = {**idle, **{i.name: i.at(t) for i in inputs if not member.is_plant or advances}}
        now = t
        last = k + 1 == ticks and block.finishes()
        found = block.finish(t, **given) if last else _answer(block, t, given)
        for number, (port, encode) in enumerate(zip(member.outputs, encoders, strict=True)):
            value = check(found, port, member.name, t)
            if value is None:
                continue
            stamp, data = value if isinstance(value, Sample) else (t, value)
            answers.add(number, t, encode(stamp, data))
        if isinstance(block, Plant) and advances:
            block.advance(t, **given)
    return answers


def _answer(block: Block, t: int, given: dict[str, Any]) -> Any:
    return block.outputs(t) if isinstance(block, Plant) else block.update(t, **given)


class _Input:
    """A recorded input: the newest message of each tick, decoded from its bytes."""

    def __init__(self, member: Member, name: str, recording: Recording) -> None:
        self.name = name
        self._port = next(p for p in member.inputs if p.name == name)
        self._link = member.links[name]
        self._topic = recording.topics.get(self._port.topic)
        if not self._link.port.sporadic and (self._topic is None or not self._topic.times):
            raise RunError(f"the recording has nothing on {self._port.topic}, which {member.name} reads")
        self._decode = Decoder(self._port)
        self._next = 0  # of a partial port: the first message that has not been merged

    def at(self, t: int) -> Any:
        index = self._newest(t)
        if index < 0 and self._link.port.sporadic:
            return self._port.initial
        assert self._topic is not None
        if self._port.partial:
            for data in self._topic.data[self._next : index + 1]:
                self._decode.kept = self._decode(data)[1]
            self._next = index + 1
            return self._decode.kept
        if index < 0:
            raise RunError(f"the recording of {self._port.topic} begins after t = {t / 1e9:.9g} s")
        stamp, values = self._decode(self._topic.data[index])
        return Sample(stamp, values) if self._port.delayed else values

    def age(self, t: int) -> int | None:
        """Age of the newest message at time `t`, ns; None before the first."""
        index = self._newest(t)
        if index < 0 or self._topic is None:
            return None
        stamp = self._topic.times[index]
        return t - (self._decode(self._topic.data[index])[0] if self._link.port.delayed else stamp)

    def _newest(self, t: int) -> int:
        return bisect_right(self._topic.times, t) - 1 if self._topic is not None else -1
