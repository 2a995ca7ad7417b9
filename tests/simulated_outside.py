"""A foreign node in the simulated middleware: it knows topics, types and stamps, and nothing of softrig."""

from functools import partial

from by_hand import Listening
from simulated import SimulatedNode, SimulatedTimer
from softrig_core import Port


class SimulatedOutside:
    """A foreign node in place of ours: it publishes what ours would publish when a topic that it reads requires it.

    Parameters
    ----------
    member : Member
        The node that it replaces.
    recorded : Recording
        Of a run without it: the messages that it has to publish.
    world : World
    reads : sequence of Port
        The topics that it reads; the fastest one calls for its answers. None: /clock.
    pause : callable
        Returns the time (ns) between the creation of two endpoints.
    bare : bool
        Whether it is no ROS node: its endpoints have no name.
    realtime : bool
        Whether t = 0 is at the stamp of the first message that it reads; its own stamps then begin there.
    """

    def __init__(self, rig, member, recorded, world, reads, pause=lambda: 0, name=None, realtime=False, bare=False):
        self.member, self.world = member, world
        self.epoch = None if realtime else 0
        name = "_NODE_NAME_UNKNOWN_" if bare else name or f"others_{member.name}"
        self.node = SimulatedNode(world, name, {})
        self.first = {}  # first message received from each topic
        self.recorded = {p.topic: recorded.topics[p.topic] for p in member.outputs}
        self.next = dict.fromkeys(self.recorded, 0)
        self.writers, self.needs, self.received = {}, {}, set()
        links = {p.topic: member.links[p.name] for p in reads}
        calls = min(reads, key=lambda p: links[p.topic].source.schedule.every, default=None)
        steps = [partial(self._offer, p, len(rig.readers(member, p))) for p in member.outputs]
        if calls is None:
            self.caller, every = rig.clock.schedule, Port("clock", "/clock", "rosgraph_msgs/msg/Clock")
            steps.append(partial(self._listen, every, every))
        else:
            self.caller = links[calls.topic].source.schedule
            steps += [partial(self._listen, p, calls) for p in reads]
        at = world.now
        for step in steps:
            at += pause()
            world.at(at, step, self.node)
        if member.is_plant:
            self.starter = SimulatedTimer(world, 100_000_000, self._start, self.node)

    def _offer(self, port, readers):
        counts = self.needs.setdefault(port.topic, [readers, 0])

        def matched(count):
            counts[1] = count

        self.writers[port.topic] = self.node.publisher(port.topic, port.msgtype, matched)

    def _listen(self, port, calls):
        self.received.add(port.topic)
        count = iter(range(10**9))
        by_order = port.delayed or not (port.stamped or port.topic == "/clock")

        def receive(data):
            self.first.setdefault(port.topic, bytes(data))
            if port is calls:
                self._called(self.caller.time(next(count)) if by_order else _stamp(data))

        self.node.subscribe(port.topic, port.msgtype, Listening(receive))

    def _start(self):
        if (
            len(self.writers) == len(self.recorded)
            and all(received >= n for n, received in self.needs.values())
            and self.received
        ):
            for topic, record in self.recorded.items():  # published again until a node answers
                self.next[topic] = 1
                self.writers[topic](bytes(record.data[0]))

    def _called(self, t):
        if self.member.is_plant:
            self.starter.cancel()
        self.epoch = t if self.epoch is None else self.epoch
        t -= self.epoch
        following = self.caller.next(t)
        self._say(following if self.member.is_plant else following - 1)

    def _say(self, until):
        for topic, record in self.recorded.items():
            while self.next[topic] < len(record.times) and record.times[self.next[topic]] <= until:
                data = bytes(record.data[self.next[topic]])
                self.next[topic] += 1
                self.writers[topic](_stamped(data, _stamp(data) + self.epoch) if self.epoch else data)


def _stamp(data):
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")


def _stamped(data, t):
    seconds, nanoseconds = divmod(t, 1_000_000_000)
    return data[:4] + seconds.to_bytes(4, "little") + nanoseconds.to_bytes(4, "little") + data[12:]
