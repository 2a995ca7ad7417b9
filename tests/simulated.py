"""A simulated middleware: nodes of a rig in one process, time moved by the test, deliveries in the order of a plan.

The adapters are the real ones. A message takes as long as `latency` says. Without `discovery` writers and readers are
matched from the start. With it every order that DDS allows is drawn from a seed: nodes come one by one, a writer knows
a reader before or after that reader knows the writer, the graph of each node shows an endpoint before or after either,
a volatile message that is sent before its writer is matched is lost, nodes stall, leave and die. Everything is a
function of the seed. Where `World.prompt` says so, nodes answer where messages arrive, which may be at once: then the
reader's tick runs inside the `publish` of the writer, and its answer arrives while the writer's tick is under way.
"""

import heapq
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from itertools import count

from softrig_core import Recording, Solver, Work
from softrig_core.rig.options import RunOptions
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.adapter.files import Files
from softrig_nodes.group import Group
from softrig_nodes.processes.spawning import node_parameters
from softrig_nodes.seam.middleware import Middleware, Peer
from softrig_nodes.seam.monitor import LONG, SHORT_ONES, Monitor


@dataclass(eq=False)
class Endpoint:
    node: "SimulatedNode"
    topic: str
    msgtype: str
    receive: Callable[[bytes], None] | None
    matched: Callable[[int], None]
    born: int
    peers: int = 0  # number of matched peers, as this end sees it
    fits: bool = True  # whether its QoS profile is compatible with the peer's
    numbered: Callable[[int], None] | None = None
    published: int = 0  # count of messages published
    known: dict = field(default_factory=dict)  # for a publisher: from which time on each reader receives its messages

    @property
    def peer(self):
        return Peer(self.node.name, "/", self.msgtype)

    def meets(self, other):
        """Return whether the middleware connects two endpoints; not those of a process of several nodes."""
        apart = self.node.process is None or self.node.process is not other.node.process
        return apart and self.topic == other.topic and self.msgtype == other.msgtype and self.fits and other.fits


@dataclass
class World:
    """The graph, the clock and the queue of future events."""

    latency: Callable[[str, str, str], int] = lambda topic, writer, reader: 1_000
    now: int = 1_700_000_000_000_000_000
    events: list = field(default_factory=list)
    order: count = field(default_factory=count)
    writers: list = field(default_factory=list)
    readers: list = field(default_factory=list)
    last: dict = field(default_factory=dict)
    discovery: "Discovery | None" = None
    prompt: "random.Random | None" = None  # draws which messages arrive at once, and the measured durations of work

    def at(self, t, call, node=None):
        heapq.heappush(self.events, (t, next(self.order), call, node))

    def send(self, writer, data):
        if self.discovery is None:
            readers = [(r, 0) for r in self.readers if writer.meets(r)]
        else:
            readers = writer.known.items()
        writer.published += 1
        for reader, accepts in readers:
            key = (writer, reader)  # messages of one publisher keep their order
            when = max(self.now + self.latency(writer.topic, writer.node.name, reader.node.name), accepts)
            if (
                self.prompt is not None
                and reader.node.hears_now(self.last.get(key, 0), accepts)
                and self.prompt.random() < 0.5
            ):
                self.last[key] = self.now
                reader.node.deliver(reader, data, writer.published)
                continue
            self.last[key] = when = max(when, self.last.get(key, 0))
            self.at(when, partial(self._arrive, writer.node, reader, data, writer.published), reader.node)

    def _arrive(self, sender, reader, data, number):
        if not sender.lost:
            reader.node.deliver(reader, data, number)

    def add(self, end):
        ends, others = (self.readers, self.writers) if end.receive else (self.writers, self.readers)
        ends.append(end)
        if self.discovery is not None:
            for other in others:
                if other.meets(end) and not other.node.dead:
                    self.discovery.meet(*((other, end) if end.receive else (end, other)))

    def match(self):
        if self.discovery is not None:
            return
        for own_ends, other_ends in ((self.writers, self.readers), (self.readers, self.writers)):
            for end in own_ends:
                end.matched(sum(o.meets(end) for o in other_ends))

    def run(self, until, stop=lambda: False):
        while self.events and self.events[0][0] <= until and not stop():
            t, order, call, node = heapq.heappop(self.events)
            if node is not None and node.dead:
                continue
            # A stopped process gets all events in order when it continues.
            if node is not None and node.stalled > t:
                heapq.heappush(self.events, (node.stalled, order, call, node))
                continue
            self.now = t
            call()


class Discovery:
    """When each node learns of each other one, drawn from a seed.

    Parameters
    ----------
    rng : random.Random
    longest : int
        Longest time (ns) until a node learns of an endpoint.
    """

    def __init__(self, world, rng, longest=200_000_000):
        self.world, self.rng, self.longest = world, rng, longest
        self._shown = {}
        world.discovery = self

    def _delay(self):
        """A delay, mostly short, sometimes long, so that orders differ."""
        return self.rng.randrange(1_000, self.longest if self.rng.random() < 0.3 else self.longest // 20)

    def meet(self, writer, reader):
        now = self.world.now
        sends, accepts = now + self._delay(), now + self._delay()

        def writer_knows():
            if not reader.node.dead:
                writer.known[reader] = accepts
                self._change(writer, 1)

        def reader_knows():
            if not writer.node.dead:
                reader.known[writer] = now
                self._change(reader, 1)

        self.world.at(sends, writer_knows, writer.node)
        self.world.at(accepts, reader_knows, reader.node)

    def _change(self, end, by):
        end.peers += by
        end.node.in_turn(end.matched, end.peers)

    def shown(self, end, observer):
        """Whether the graph of a node shows an endpoint; each endpoint becomes known separately."""
        if end.node is observer:
            return True
        key = (id(end), id(observer))
        if key not in self._shown:
            self._shown[key] = max(end.born, observer.born) + self._delay()
        lease_over = end.node.dead and self.world.now > end.node.dead + self.longest
        return self._shown[key] <= self.world.now and not lease_over

    def leave(self, node):
        """A node has finished: it leaves when its messages have arrived."""
        sent = [t for (writer, _), t in self.world.last.items() if writer.node is node]
        self.world.at(max([self.world.now, *sent]) + self._delay(), partial(self.kill, node), node)

    def kill(self, node):
        """The node is gone; each other node learns of it later."""
        node.dead = self.world.now
        for end in (*self.world.writers, *self.world.readers):
            for other in [o for o in end.known if o.node is node]:
                del end.known[other]
                self.world.at(self.world.now + self._delay(), partial(self._change, end, -1), end.node)


class SimulatedTimer:
    def __init__(self, world, ns, callback, node=None):
        self.world, self.callback, self.generation = world, callback, 0
        self.node = node
        self.again(ns)

    def again(self, ns, period=0):
        self.generation += 1
        self.period = max(1000, ns)
        self._arm(self.generation)
        self.period = max(1000, period or ns)

    def cancel(self):
        self.generation += 1

    def _arm(self, generation):
        def fire():
            if generation == self.generation:
                self._arm(generation)
                self.node.in_turn(self.callback) if self.node is not None else self.callback()

        self.world.at(self.world.now + self.period, fire, self.node)


class SimulatedNode(Middleware):
    """One node's `Middleware`."""

    mute = True

    def __init__(self, world, name, remap, process=None):
        self.world, self.name, self.full_name, self.remap = world, name, f"/{name}", remap
        self.process = process
        self.logs = []
        self.dead, self.stalled, self.born = 0, 0, world.now
        self.lost = False  # whether its messages under way are lost when it dies
        self.monitor = Monitor(self._wake, self._clock)
        self.ahead = 0  # ns, offset of its clock

    def be_prompt(self, place):
        self.place = place
        self.prompt = self.world.prompt is not None and self.process is None
        if self.prompt:
            # Some monitors have already measured many calls.
            self.monitor._short = self.world.prompt.choice((0, SHORT_ONES))

    def _wake(self):
        self.world.at(self.world.now, self.monitor.serve, self)

    def _clock(self):
        """Time by which work seems short, one time in fifty long."""
        self.worked = getattr(self, "worked", 0) + (LONG if self.world.prompt.random() < 0.01 else 0)
        return self.worked

    def hears_now(self, last, accepts):
        """Return whether a message may arrive immediately: no earlier one is on its way."""
        now = self.world.now
        return self.prompt and not self.dead and max(last, accepts, self.stalled) < now

    def deliver(self, end, data, number):
        if end.numbered is not None:
            end.numbered(number)
        if self.prompt:
            self.monitor.arrive(partial(end.receive, data))
        else:
            end.receive(data)

    def in_turn(self, call, *arguments):
        """Make a call that delivers no message, within the monitor if messages arrive immediately."""
        if self.prompt:
            with self.monitor:
                call(*arguments)
        else:
            call(*arguments)

    def resolve(self, topic):
        topic = self.remap.get(topic, topic)
        topic = topic.replace("~", self.full_name)
        return topic if topic.startswith("/") else f"/{topic}"

    def publisher(self, topic, msgtype, matched):
        end = Endpoint(self, self.resolve(topic), msgtype, None, matched, self.world.now)
        self.world.add(end)
        return lambda data: self.world.send(end, data)

    def subscribe(self, topic, msgtype, reader, fits=True):
        name, now, receive = self.resolve(topic), self.world.now, reader.receive
        self.world.add(Endpoint(self, name, msgtype, receive, reader.matched, now, fits=fits, numbered=reader.numbered))

    def post(self, call):
        self.world.at(self.world.now, call)  # the call belongs to the process, which outlives the node

    def timer(self, ns, callback):
        return SimulatedTimer(self.world, ns, callback, self)

    def now(self):
        return self.world.now + self.ahead

    def steady(self):
        return self.world.now / 1e9

    def publishers(self, topic):
        return [w.peer for w in self._seen(self.world.writers) if w.topic == topic]

    def subscribers(self, topic):
        return [r.peer for r in self._seen(self.world.readers) if r.topic == topic]

    def unfit(self, topic, msgtype):
        readers = [r for r in self._seen(self.world.readers) if r.topic == topic and r.msgtype == msgtype]
        return [(r.node.name, "its profile") for r in readers if not r.fits]

    def _seen(self, ends):
        discovery = self.world.discovery
        return ends if discovery is None else [e for e in ends if discovery.shown(e, self)]

    def subscriptions_of(self, peer):
        if peer.name == "_NODE_NAME_UNKNOWN_":  # a participant that is not a ROS node
            return []
        return [r.topic for r in self._seen(self.world.readers) if r.node.name == peer.name]

    def topics(self):
        results = {}
        for end in self._seen(self.world.writers + self.world.readers):
            results.setdefault(end.topic, set()).add(end.msgtype)
        return {topic: sorted(types) for topic, types in results.items()}

    def log(self, level, text):
        self.logs.append((level, text))

    def drain(self):
        pass


class SimulatedWorker:
    """Works on requests of a solver for some simulated time; see `softrig_core.solver.worker.Worker`."""

    def __init__(self, world, solve, takes=30_000_000):
        self.world, self.solve, self.takes = world, solve, takes
        self.state, self.status, self.begun, self.struck, self.job = "idle", {}, 0, False, None

    def warm(self):
        pass

    def submit(self, request, job=None):
        self.answer = self.solve(request, Work(lambda *text: None))
        self.state, self.job, self.begun = "working", job, self.world.now
        self.world.at(self.world.now + self.takes, self._done)

    def _done(self):
        self.state = "done"

    def wait(self, seconds):
        self.state = "done" if self.state == "working" else self.state

    def elapsed(self):
        return (self.world.now - self.begun) / 1e9

    def cancel(self):
        self.state, self.job = "idle", None


class _Sink:
    """Writes a node's messages into the recording of the whole run."""

    def __init__(self, recording, topics):
        self.recording = recording
        self.numbers = [list(recording.topics).index(name) for name, _ in topics]

    def add(self, topic, t, data):
        self.recording.add(self.numbers[topic], t, data)

    def note(self, t, data):
        self.recording.note(t, data)


class SimulatedRig:
    """All nodes of a rig, each with its real adapter.

    Parameters
    ----------
    rig : Rig
    world : World
    mode : str
    seed : int
        Rig seed.
    without : sequence of str
        Nodes that are not started.
    departs : bool
        In real time: t = 0 is when all are up, as in a run, instead of a second after the start.
    after : callable, optional
        Node name to ns after which it is started.
    groups : sequence of sequences of str
        Nodes that share a process; any other has one of its own.
    recorders : sequence of str, optional
        As `node_parameters` takes them.
    returns : bool
        Whether nodes that died come back.
    **options
        ``run.*`` parameters of all nodes.
    """

    def __init__(self, rig, world, mode, seed=0, without=(), departs=False, after=None, groups=(),
                 recorders=None, returns=False, **options):  # fmt: skip
        self.rig, self.world, self.recorders, self.returns = rig, world, recorders, returns
        self.again = (mode, seed, options)
        self.coming = set()  # nodes that have died and will start again
        self.recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
        slowest = max((m.schedule for m in rig.members), key=lambda s: s.period)
        self.epoch = slowest.held(world.now + 1_000_000_000) if mode == "realtime" and not departs else 0
        self.expected = sum(m.name not in without and not m.external for m in rig.members)
        self.adapters, self.nodes = {}, {}
        left = {m.name: m for m in rig.members if m.name not in without and not m.external}
        shared = [[left.pop(name) for name in names if name in left] for names in groups]
        for members in [*filter(None, shared), *([m] for m in left.values())]:
            if after is None:
                self._start(members, mode, seed, options)
            else:
                world.at(world.now + after(members[0].name), partial(self._start, members, mode, seed, options))

    def _start(self, members, mode, seed, options, files=None):
        process = object() if len(members) > 1 else None
        Group([self._adapter(member, mode, seed, options, process, files) for member in members])

    def _adapter(self, member, mode, seed, options, process, files):
        rig, world = self.rig, self.world
        parameters = node_parameters(rig, member, seed, mode, recorders=self.recorders, returns=self.returns)
        run_options = {k.removeprefix("run."): v for k, v in parameters.items() if k.startswith("run.")}
        run_options |= {"epoch": self.epoch, **options}
        node = SimulatedNode(world, member.name, member.remap, process)
        sink = _Sink.__new__(_Sink)
        adapter = Adapter(node, member.block(seed), RunOptions(**run_options), sink)
        sink.__init__(self.recording, adapter.record.topics)
        adapter.files = files
        if world.discovery is not None:
            adapter.on_finished = partial(world.discovery.leave, node)
        if isinstance(adapter.block, Solver):
            adapter.block.worker = SimulatedWorker(world, type(adapter.block).solve)
        self.nodes[member.name], self.adapters[member.name] = node, adapter
        return adapter

    def kill(self, name, rng):
        """A node dies, with or without its last messages; it is restarted when all others wait."""
        adapter, node = self.adapters.get(name), self.nodes.get(name)
        if adapter is None or adapter.state == "done" or node.dead or name in self.coming:
            return False
        self.coming.add(name)
        node.lost = rng.random() < 0.5
        self.world.discovery.kill(node)
        self._come_back(name, None, rng)
        return True

    def _come_back(self, name, before, rng):
        others = {n: a for n, a in self.adapters.items() if n != name}
        stand = [(a.t, a.state, self.nodes[n].stalled < self.world.now) for n, a in others.items()]
        if len(self.adapters) < self.expected or stand != before or not all(awake for _, _, awake in stand):
            self.world.at(self.world.now + 250_000_000, partial(self._come_back, name, stand, rng))
            return
        own, died = self.adapters[name].record.topics, self.recording.before(1 << 62)
        for topic, _ in own:
            del self.recording.topics[topic].times[:], self.recording.topics[topic].data[:]

        def files():
            now = {n: a for n, a in self.adapters.items() if n != name}
            lease_over = frozenset(n for n, a in now.items() if a.state == "done")
            answered = {
                n: math.inf if n in lease_over else 0.0 if n in self.coming else float(a.t) for n, a in now.items()
            }
            return Files(self.recording.before(1 << 62), died, answered, lease_over)

        def start():
            self.coming.discard(name)
            self._start([next(m for m in self.rig.members if m.name == name)], *self.again, files)

        self.world.at(self.world.now + rng.randrange(2_000_000_000), start)  # meanwhile its record is removed

    def _ended(self):
        over = [self.nodes[name].dead or a.state in ("done", "failed") for name, a in self.adapters.items()]
        return len(over) == self.expected and all(over) and not self.coming

    def run(self, seconds=None):
        patience = 2.0 * self.rig.scenario.timeout + 20.0
        seconds = self.rig.end / 1e9 + patience if seconds is None else seconds
        self.world.match()
        until = self.world.now + round(seconds * 1e9)
        self.world.run(until, self._ended)
        return {name: a.state for name, a in self.adapters.items()}


def some(rig, rng):
    """Draw nodes of a rig that share processes: mostly none, otherwise two groups of any size."""
    names = [m.name for m in rig.members if not m.external]
    if rng.random() < 0.5:
        return ()
    rng.shuffle(names)
    cut = rng.randint(1, len(names))
    return names[:cut], names[cut:]
