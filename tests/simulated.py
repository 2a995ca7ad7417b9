"""A middleware that is simulated: nodes of a rig in one process, time moved by hand, deliveries in the order of a plan.

The adapters are the real ones. A message takes as long as `latency` says; writers and readers are matched from the
start. Everything is a function of the seed.
"""

import heapq
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count

from softrig_core.node.lockstep import Lockstep
from softrig_core.node.middleware import Peer
from softrig_core.node.realtime import Realtime
from softrig_core.rig.options import RunOptions
from softrig_core.rig.processes import node_parameters
from softrig_core.wire.recording import Recording


@dataclass
class Endpoint:
    node: "SimulatedNode"
    topic: str
    msgtype: str
    receive: Callable[[bytes], None] | None
    matched: Callable[[int], None]

    @property
    def peer(self):
        return Peer(self.node.name, "/", self.msgtype)


@dataclass
class World:
    """The graph, the clock and the queue of what is to happen."""

    latency: Callable[[str, str, str], int] = lambda topic, writer, reader: 1_000
    now: int = 1_700_000_000_000_000_000
    events: list = field(default_factory=list)
    order: count = field(default_factory=count)
    writers: list = field(default_factory=list)
    readers: list = field(default_factory=list)
    last: dict = field(default_factory=dict)

    def at(self, t, call):
        heapq.heappush(self.events, (t, next(self.order), call))

    def send(self, writer, data):
        for reader in self.readers:
            if reader.topic == writer.topic and reader.msgtype == writer.msgtype:
                key = (id(writer), id(reader))  # one writer's messages never overtake each other
                when = self.now + self.latency(writer.topic, writer.node.name, reader.node.name)
                self.last[key] = when = max(when, self.last.get(key, 0))
                self.at(when, lambda reader=reader: reader.receive(data))

    def match(self):
        for here, there in ((self.writers, self.readers), (self.readers, self.writers)):
            for end in here:
                end.matched(sum(o.topic == end.topic and o.msgtype == end.msgtype for o in there))

    def run(self, until, stop=lambda: False):
        while self.events and self.events[0][0] <= until and not stop():
            self.now, _, call = heapq.heappop(self.events)
            call()


class SimulatedTimer:
    def __init__(self, world, ns, callback):
        self.world, self.callback, self.generation = world, callback, 0
        self.again(ns)

    def again(self, ns):
        self.generation += 1
        self.period = max(1000, ns)
        self._arm(self.generation)

    def cancel(self):
        self.generation += 1

    def _arm(self, generation):
        def fire():
            if generation == self.generation:
                self._arm(generation)
                self.callback()

        self.world.at(self.world.now + self.period, fire)


class SimulatedNode:
    """One node's `Middleware`."""

    def __init__(self, world, name, remap):
        self.world, self.name, self.full_name, self.remap = world, name, f"/{name}", remap
        self.logs = []

    def resolve(self, topic):
        topic = self.remap.get(topic, topic)
        topic = topic.replace("~", self.full_name)
        return topic if topic.startswith("/") else f"/{topic}"

    def publisher(self, topic, msgtype, matched):
        end = Endpoint(self, self.resolve(topic), msgtype, None, matched)
        self.world.writers.append(end)
        return lambda data: self.world.send(end, data)

    def subscribe(self, topic, msgtype, receive, matched):
        self.world.readers.append(Endpoint(self, self.resolve(topic), msgtype, receive, matched))

    def timer(self, ns, callback):
        return SimulatedTimer(self.world, ns, callback)

    def now(self):
        return self.world.now

    def steady(self):
        return self.world.now / 1e9

    def publishers(self, topic):
        return [w.peer for w in self.world.writers if w.topic == self.resolve(topic)]

    def subscribers(self, topic):
        return [r.peer for r in self.world.readers if r.topic == self.resolve(topic)]

    def subscriptions_of(self, peer):
        return [r.topic for r in self.world.readers if r.node.name == peer.name]

    def types(self, topic):
        return sorted({e.msgtype for e in self.world.writers + self.world.readers if e.topic == self.resolve(topic)})

    def log(self, level, text):
        self.logs.append((level, text))

    def drain(self):
        pass


class _Sink:
    """Writes a node's messages into the recording of the whole run."""

    def __init__(self, recording, topics):
        self.recording = recording
        self.numbers = [list(recording.topics).index(name) for name, _ in topics]

    def add(self, topic, t, data):
        self.recording.add(self.numbers[topic], t, data)


class SimulatedRig:
    """All nodes of a rig, each with its real adapter."""

    def __init__(self, rig, world, mode, seed=0, without=(), **options):
        self.rig, self.world = rig, world
        self.recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        slowest = max((m.schedule for m in rig.members), key=lambda s: s.period)
        self.epoch = slowest.held(world.now + 1_000_000_000) if mode == "realtime" else 0
        self.adapters, self.nodes = {}, {}
        for member in rig.members:
            if member.name in without:
                continue
            given = {k.removeprefix("run."): v for k, v in node_parameters(rig, member, seed, mode).items()
                     if k.startswith("run.")}  # fmt: skip
            given |= {"epoch": self.epoch, **options}
            node = self.nodes[member.name] = SimulatedNode(world, member.name, member.remap)
            kind = Lockstep if mode == "lockstep" else Realtime
            sink = _Sink.__new__(_Sink)
            adapter = kind(node, member.block(seed), RunOptions(**given), sink)
            sink.__init__(self.recording, adapter.recorded)
            self.adapters[member.name] = adapter

    def run(self, seconds=None):
        seconds = self.rig.end / 1e9 + 20.0 if seconds is None else seconds
        self.world.match()
        until = self.world.now + round(seconds * 1e9)
        self.world.run(until, lambda: all(a.state in ("done", "failed") for a in self.adapters.values()))
        return {name: a.state for name, a in self.adapters.items()}
