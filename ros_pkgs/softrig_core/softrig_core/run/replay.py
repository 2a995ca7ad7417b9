"""Open loop: feed one node of a rig with recorded inputs, tick by tick, and collect its answers."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence

from ..block.codec import Decoder
from ..block.link import Link
from ..block.loop import Loop
from ..block.port import Sample
from ..block.step import Step
from ..errors import RunError
from ..rig.members import Member
from ..wire.recording import Recording
from .inprocess import keeper, step_of


def feed(member: Member, seed: int, recording: Recording) -> Recording:
    """Run one block of a rig in open loop.

    Parameters
    ----------
    member : Member
        The block under test; its links define what is paired, its schedule defines the length of the run.
    seed : int
        Rig seed of the recording.
    recording : Recording
        Must have every topic that the member reads from the rig.

    Returns
    -------
    Recording
        The member's outputs, stamped as in a run.

    Raises
    ------
    RunError
        The recording lacks an input.
    """
    step = step_of(member, member.block(seed))
    answers = Recording((p.topic, p.msgtype) for p in member.outputs)
    keeper(step, answers, step.outputs, range(len(step.outputs)))
    _Fed(step, [_Input(step, member, name, recording) for name in member.links])
    for _ in Loop([step]).run():
        pass
    return answers


class _Fed(Link):
    """A link that supplies a step with recorded messages."""

    def __init__(self, step: Step, inputs: Sequence[_Input]) -> None:
        super().__init__(step)
        self._inputs = inputs

    def lacks(self, t: int) -> bool:
        """Pass the messages recorded for a tick to the step."""
        for item in self._inputs:
            item.set_value(t)
        return False


class _Input:
    """A recorded input: the newest message of each tick, decoded from its bytes."""

    def __init__(self, step: Step, member: Member, name: str, recording: Recording) -> None:
        self._values, self._name = step.values, name
        self._port = next(p for p in member.inputs if p.name == name)
        self._source = member.links[name].port
        self._topic = recording.topics.get(self._port.topic)
        if not self._source.sporadic and (self._topic is None or not self._topic.times):
            raise RunError(f"the recording has nothing on {self._port.topic}, which {member.name} reads")
        self._decode = Decoder(self._port)
        self._next = 0  # the first message that has not been read
        self._stamp: int | None = None
        step.stamps[name] = lambda: self._stamp

    def set_value(self, t: int) -> None:
        """Let the step hold the newest values at time `t`."""
        following = self._next if self._topic is None else bisect_right(self._topic.times, t, self._next)
        if self._topic is None or following == 0:
            if not self._source.sporadic:
                raise RunError(f"the recording of {self._port.topic} begins after t = {t / 1e9:.9g} s")
            return
        # Channels that a message leaves out keep their value, so a partial input reads all messages, any other one the
        # newest.
        for k in range(self._next if self._port.partial else max(self._next, following - 1), following):
            stamp, values = self._decode(self._topic.data[k])
            self._decode.kept = values
            self._stamp = stamp if self._source.delayed else self._topic.times[k]
            self._values[self._name] = Sample(stamp, values) if self._port.delayed else values
        self._next = following
