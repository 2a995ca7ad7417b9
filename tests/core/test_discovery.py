"""Every order of discovery that DDS allows, drawn from seeds: no start loses a message, and neither does a publisher
that is ahead.
"""

import os
import random
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from types import SimpleNamespace

import pytest
from by_hand import Listening
from conftest import differences, few, in_process, make_scenario
from simulated import Discovery, SimulatedNode, SimulatedRig, SimulatedTimer, World, some
from simulated_outside import SimulatedOutside
from softrig_core import button, rig_of
from softrig_core.block.codec import readable_stamp
from softrig_core.rig.options import Links, OverheardLink
from softrig_nodes.adapter.overheard import Overheard
from softrig_nodes.adapter.spin import conclude
from softrig_nodes.processes.peers import links
from softrig_nodes.processes.spawning import node_parameters
from softrig_nodes.processes.supervision import blamed
from softrig_nodes.ros.ros import QOS
from softrig_nodes.seam.awaited import RECORDER, left_out
from softrig_nodes.seam.endpoint import Output
from softrig_nodes.seam.tick import TICK
from test_ports import RIGS as PORT_RIGS
from test_processes import RIGS as PROCESS_RIGS

MS = 1_000_000
BASIC = {"plant": "plant", "source": "source", "gain": "gain"}


def slow(period, **entry):
    return {**entry, "parameters": {"period": period}}


KINDS = {name: make_scenario(nodes, 0.05) for name, (nodes, _) in PROCESS_RIGS.items()} | {
    name: make_scenario(nodes, min(duration, 0.1), **options) for name, (nodes, duration, options) in PORT_RIGS.items()
} | {
    "three plants": make_scenario(BASIC | {
        "second": slow(0.03, executable="plant", remap={"lag/state": "second/state", "lag/applied": "second/applied"}),
        "third": slow(0.02, executable="plant", remap={"lag/state": "third/state", "lag/applied": "third/applied",
                                                       "lag/command": "third/command"}),
        "guide": slow(0.02, executable="gain", remap={"lag/state": "third/state", "lag/command": "third/command"}),
    }, 0.1),
    "a source of one tick": make_scenario(BASIC | {"source": slow(0.1, executable="source")}, 0.05),
    "events between the ticks of who reads them": make_scenario({
        "plant": "plant", "burst": {"executable": "burst", "parameters": {"at": [0.01, 0.05, 0.13]}},
        "gain": slow(0.02, executable="burst_gain")}, 0.2),
    "faults on links": make_scenario(BASIC, 0.2, faults={
        "lost": {"link": "lag/command", "kind": "loss", "probability": 0.4},
        "noise": {"link": "lag/state -> gain", "kind": "noise", "value": [0.1]},
        "late": {"link": "lag/state -> gain", "kind": "delay", "delay": 0.02, "jitter": 0.03, "from": 0.05,
                 "holds": True}}),  # a fault that also applies if gain is external
    "three who follow": make_scenario(BASIC | {
        name: slow(0.01 * every, executable="watcher") for name, every in (("near", 1), ("half", 2), ("far", 6))}, 0.3),
    "solver": make_scenario(BASIC | {
        "planner": slow(0.05, executable="planner"),
        "gain": {"executable": "gain", "remap": {"lag/reference": "lag/inner_reference"}}}, 0.1),
}  # fmt: skip


@cache
def rig_and_record(kind):
    """The rig with all nodes ours and its expected recording."""
    rig = rig_of(KINDS[kind])
    return rig, in_process(rig)


@cache
def with_guests(kind, outside):
    """The rig with some of its nodes external."""
    nodes = {n: e.model_copy(update={"external": n in outside}) for n, e in KINDS[kind].nodes.items()}
    return rig_of(KINDS[kind].model_copy(update={"nodes": nodes}))


def start(kind, seed, outside=(), stalls=0, bare=False):
    """One run with random orders of discovery; returns what is wrong with it.

    Outside nodes come when they like, make their endpoints one after the other and read what they like.
    """
    rng = random.Random(seed)
    rig_here, expected = rig_and_record(kind)
    rig = with_guests(kind, outside)
    longest = rng.choice((1, 5, 20)) * MS
    world = World(lambda *_: rng.randrange(1_000, longest), prompt=perhaps_prompt(seed))
    Discovery(world, rng)
    run = SimulatedRig(
        rig, world, "lockstep", after=lambda name: rng.randrange(300 * MS), start_timeout=0.0, groups=some(rig, rng)
    )
    strangers = []
    for member in (m for m in rig_here.members if m.name in outside):
        reads = [p for p in member.inputs if p.name in member.links and member.links[p.name].source.name not in outside]
        calls = [p for p in reads if not member.links[p.name].port.sporadic]
        reads = [p for p in reads if p in calls[:1] or rng.random() < 0.5] if calls else []
        about = rig_here, member, expected, world, reads, partial(rng.randrange, (300 if bare else 100) * MS)
        world.at(
            world.now + rng.randrange(1_000 * MS),
            lambda about=about: strangers.append(SimulatedOutside(*about, bare=bare)),
        )
    for _ in range(stalls):
        world.at(world.now + rng.randrange(1_500 * MS), lambda: stall(run, rng))
    states = run.run(100.0)
    wrong = [f"{m.name} has not come" for m in rig.members if not m.external and m.name not in states]
    wrong += [f"{n}: {a.state} at {a.t}: {a.error}" for n, a in run.adapters.items() if a.state != "done"]
    awaited = {p.topic for m in rig.members if not m.external for p in m.inputs}
    messages = {p.topic for m in rig.members if not m.external for p in m.outputs}
    for member in (m for m in rig.members if m.external and any(p.topic in awaited for p in m.outputs)):
        messages |= {p.topic for p in member.outputs if not p.sporadic}
    wrong += [t for t in differences(expected, run.recording) if t in messages]
    wrong += [
        f"{s.member.name} has not heard the first of {topic}"
        for s in strangers
        if any(p.topic in awaited for p in s.member.outputs)
        for topic in s.received
        if s.first.get(topic) != next(iter(expected.topics[topic].data), None)
    ]
    wrong += [
        f"{n} refused {i.port.topic}: {i.last_refusal}"
        for n, a in run.adapters.items()
        for i in (*a.inputs, *a.paces)
        if i.refused
    ]
    return wrong


def perhaps_prompt(seed):
    """Draw whether nodes answer in the receiving thread."""
    rng = random.Random(f"prompt {seed}")
    return rng if rng.random() < 0.5 else None


def stall(run, rng, longest=3_000):
    """Stop one of the nodes for a while; its messages are queued."""
    if not run.nodes:
        return
    node = rng.choice(list(run.nodes.values()))
    node.stalled = max(node.stalled, run.world.now + rng.randrange(longest * MS))


def test_a_node_that_is_stopped_while_an_outside_node_is_awaited_makes_no_request(capfd):
    """A signal has shut ROS down by then."""
    rng = random.Random(0)
    world = World(lambda *_: 1_000)
    Discovery(world, rng)
    run = SimulatedRig(with_guests("basic", ("source",)), world, "lockstep", start_timeout=0.0)
    run.run(5.0)
    waiting = [a for a in run.adapters.values() if a.lacking]
    assert waiting
    for adapter in waiting:
        assert "published" in adapter.account.status()

        def left_graph():
            raise RuntimeError

        adapter.middleware.topics = left_graph
        assert conclude(adapter, stopped=True) == 0
        assert adapter.account.status()["state"] == "done"


@pytest.mark.parametrize("kind", few(KINDS, 7))
def test_no_start_loses_a_message(kind):
    for seed in range(8):
        assert start(kind, seed, stalls=seed % 3) == [], seed


def test_an_output_that_no_node_reads_is_recorded_by_a_node_that_does_not_remap_it():
    """`second`, the clock of what is left, maps lag/applied to a topic of its own."""
    rig = with_guests("end", ("plant",))
    recorders = {k.shape["topic"]: m.name for m in rig.members if not m.external for k in links(rig, m).overheard}
    assert recorders == {"lag/state": "gain", "lag/applied": "gain"}


def test_a_boolean_of_an_external_node_is_recorded_as_one_of_the_rig():
    """DDS fills its five bytes up to eight."""
    messages, nothing = [], SimpleNamespace(restart_timeout=lambda: None)
    node = SimpleNamespace(
        peer=lambda link: None, state="running", epoch=0, t=0, ticks=0, schedule=SimpleNamespace(end=None),
        options=SimpleNamespace(mode="lockstep"),
        record=SimpleNamespace(sink=SimpleNamespace(add=lambda number, t, data: messages.append(data))),
    )  # fmt: skip
    link = OverheardLink.of(button("press", "x"), sporadic=True, delayed=False, period="1", node="x", at_end=False)
    row = Overheard(nothing, node, link, 0, False)
    for pressed in (b"\1", b"\0"):
        row.receive(b"\0\1\0\0" + pressed + b"\0\0\0")
    assert messages == [b"\0\1\0\0\1", b"\0\1\0\0\0"]


class SimulatedRecorder:
    """Subscribes to topics when the graph shows them, up to some seconds late; leaves one of them out."""

    def __init__(self, world, asks, skipped, rng):
        self.rng = rng
        self.node, self.read = SimulatedNode(world, "recorder", {}), {}
        self.skipped = skipped
        self.say = self.node.publisher(RECORDER, TICK, lambda count: None) if asks else lambda data: None
        SimulatedTimer(world, 100 * MS, self._look, self.node)

    def _look(self):
        self.say(left_out("/recorder", [self.skipped]))
        for end in list(self.node._seen(self.node.world.writers)):
            if end.topic not in (self.skipped, RECORDER) and end.topic not in self.read:
                results = self.read[end.topic] = []
                subscribe = partial(self.node.subscribe, end.topic, end.msgtype, Listening(results.append))
                self.node.world.at(self.node.world.now + self.rng.randrange(3_000 * MS), subscribe, self.node)


@pytest.mark.parametrize("seeds", [range(4), pytest.param(range(4, 100), marks=pytest.mark.long)], ids=["few", "many"])
@pytest.mark.parametrize("asks", [True, False], ids=["asks", "is named"])
def test_a_recorder_in_the_domain_of_a_rig_records_everything(asks, seeds):
    """From the first message on, whenever it discovers a topic; a topic that it leaves out delays no node."""
    rig, expected = rig_and_record("three plants")
    for seed in seeds:
        rng = random.Random(seed)
        world = World(lambda *_, rng=rng: rng.randrange(1_000, 5 * MS), prompt=perhaps_prompt(seed))
        Discovery(world, rng)
        skipped = "/third/state" if asks else "/nobody"
        recorder = SimulatedRecorder(world, asks, skipped, rng)
        run = SimulatedRig(rig, world, "lockstep", after=lambda name, rng=rng: rng.randrange(300 * MS),
                           recorders=() if asks else ["recorder"])  # fmt: skip
        assert set(run.run(100.0).values()) == {"done"}
        world.run(world.now + 100 * MS)
        for name, topic in expected.topics.items():
            full = name if name == "/clock" else f"/{name}"
            assert recorder.read.get(full, []) == (topic.data if full != skipped else []), (seed, name)


def guests(kind, rng):
    """Draw the external nodes: one plant, or any of the others.

    A plant is not drawn together with others: outside nodes that wait for each other would be silent, and no node would
    report it.
    """
    members = [m for m in rig_and_record(kind)[0].members if m.package == "faultrig"]
    members = [m for m in members if m.outputs and not any(p.sporadic for p in m.outputs)]
    # An external node does not learn of silence either, so an external plant needs a command at each tick.
    paced = [m for m in members if any(not link.port.sporadic for link in m.links.values())]
    plants = [m.name for m in paced if m.is_plant]
    others = [m.name for m in members if not m.is_plant]
    if plants and (rng.random() < 0.3 or not others):
        return (rng.choice(plants),)
    return tuple(rng.sample(others, rng.randint(1, len(others)))) if others else ()


@pytest.mark.parametrize("kind", few(KINDS, 7))
def test_any_node_may_be_external_and_read_any_subset(kind):
    for seed in range(8):
        outside = guests(kind, random.Random(seed))
        assert start(kind, seed, outside, bare=seed % 2) == [], (seed, outside)


@pytest.mark.parametrize(("kind", "seed"), [("events", 10), ("record", 54), ("solver", 54)])
def test_a_participant_without_a_ros_node_receives_the_first_message_of_all_its_topics(kind, seed):
    """Its subscriptions cannot be asked for by a node name: no node begins while its endpoints still appear."""
    assert start(kind, seed, guests(kind, random.Random(seed)), bare=True) == []


def death(kind, seed):
    """One run in which a node dies at any point: the others end, report why, and what they published is right."""
    rng = random.Random(seed)
    rig, expected = rig_and_record(kind)
    world = World(lambda *_: rng.randrange(1_000, 5 * MS), prompt=perhaps_prompt(seed))
    discovery = Discovery(world, rng)
    run = SimulatedRig(rig, world, "lockstep", after=lambda name: rng.randrange(300 * MS), start_timeout=2.0)
    victim = rng.choice(rig.members).name
    world.at(world.now + 300 * MS + rng.randrange(700 * MS), lambda: discovery.kill(run.nodes[victim]))
    states = run.run(100.0)
    wrong = [f"{n} goes on" for n, state in states.items() if n != victim and state not in ("done", "failed")]
    for topic, record in run.recording.topics.items():
        whole, n = expected.topics[topic], len(record.times)
        if record.times != whole.times[:n] or record.data != whole.data[:n]:
            wrong.append(f"{topic} is no prefix")
    failed = {n: a for n, a in run.adapters.items() if a.state == "failed" and n != victim}
    causes = blamed({n: a.waits_for for n, a in failed.items()})
    if failed and not any(victim in f"{failed[n].error}" for n in causes):
        wrong.append(f"{victim} died, blamed is {[str(failed[n].error) for n in causes]}")
    return wrong


def death_in_real_time(kind, seed):
    """As `death`, in real time: the others continue without the dead node to the end, and a node that waits for it
    names it.
    """
    rng = random.Random(seed)
    rig, _ = rig_and_record(kind)
    world = World(lambda *_: rng.randrange(1_000, MS))
    discovery = Discovery(world, rng)
    run = SimulatedRig(
        rig, world, "realtime", departs=True, after=lambda name: rng.randrange(300 * MS), start_timeout=3.0
    )
    victim = rng.choice(rig.members).name
    world.at(world.now + 300 * MS + rng.randrange(1_000 * MS), lambda: discovery.kill(run.nodes[victim]))
    states = run.run(30.0)
    wrong = [f"{n} goes on" for n, state in states.items() if n != victim and state not in ("done", "failed")]
    failed = [f"{a.error}" for n, a in run.adapters.items() if a.state == "failed" and n != victim]
    if failed and not any(victim in text for text in failed):
        wrong.append(f"{victim} died, blamed is {failed}")
    return wrong


def departure(kind, seed):
    """One start in real time of nodes that start over three seconds: t = 0 is after the last, and no node misses
    another.
    """
    rng = random.Random(seed)
    rig, _ = rig_and_record(kind)
    world = World(lambda *_: rng.randrange(1_000, MS))
    Discovery(world, rng)
    began = world.now
    run = SimulatedRig(rig, world, "realtime", departs=True, after=lambda name: rng.randrange(3_000 * MS))
    wrong = [f"{n} is {state}" for n, state in run.run(30.0).items() if state != "done"]
    epochs = {a.epoch for a in run.adapters.values()}
    if len(epochs) != 1 or not max(n.born for n in run.nodes.values()) <= min(epochs) < began + 5_000 * MS:
        wrong.append(f"t = 0 at {[e - began for e in epochs]}")
    return wrong + [f"{n} has missed ticks" for n, a in run.adapters.items() if a.drive.missed + a.drive.incomplete]


def called(kind, rng):
    """Draw external nodes in real time: nodes that trigger them publish stamps and are ours."""
    rig, _ = rig_and_record(kind)
    outside = set(guests(kind, rng)) if rng.random() < 0.5 else set()
    for member in rig.members:
        calls = [k for k in member.links.values() if k.source.name not in outside and k.port.stamped]
        text = all(p.stamped and not p.delayed for p in member.outputs)
        if member.is_plant or not text or not any(not k.port.sporadic and not k.port.delayed for k in calls):
            outside.discard(member.name)
    return tuple(sorted(outside))


def real_time(kind, seed, outside=(), stalls=0):
    """One run in real time with random orders: each of our nodes has counted the ticks at which it did not publish."""
    rng = random.Random(seed)
    rig_here, expected = rig_and_record(kind)
    rig = with_guests(kind, outside)
    longest = rng.choice((1, 5, 20)) * MS
    world = World(lambda *_: rng.randrange(1_000, longest))
    Discovery(world, rng)
    run = SimulatedRig(rig, world, "realtime", departs=True, after=lambda name: rng.randrange(300 * MS),
                       start_timeout=0.0, groups=some(rig, rng))  # fmt: skip
    for member in (m for m in rig_here.members if m.name in outside):
        links = {p: member.links[p.name] for p in member.inputs if p.name in member.links}
        reads = [
            p
            for p, k in links.items()
            if k.source.name not in outside and k.port.stamped and not k.port.sporadic and not k.port.delayed
        ]
        world.at(
            world.now + rng.randrange(1_000 * MS),
            partial(
                SimulatedOutside,
                rig_here,
                member,
                expected,
                world,
                reads,
                lambda: rng.randrange(100 * MS),
                realtime=True,
            ),
        )

    def strike():
        begun = max((a.epoch for a in run.adapters.values()), default=0)
        if begun:
            world.at(begun + rng.randrange(rig.end), lambda: stall(run, rng, 100))
        else:
            world.at(world.now + 50 * MS, strike)

    for k in range(stalls):  # nodes stall before the start and during the run
        world.at(world.now + rng.randrange(1_000 * MS), strike if k % 2 == 0 else lambda: stall(run, rng))
    states = run.run(60.0)
    wrong = [f"{m.name} has not come" for m in rig.members if not m.external and m.name not in states]
    wrong += [f"{n}: {a.state} at {a.t}: {a.error}" for n, a in run.adapters.items() if a.state != "done"]
    wrong += [
        f"{n} refused {i.port.topic}: {i.last_refusal}"
        for n, a in run.adapters.items()
        for i in a.inputs
        if i.refused and not i.last_refusal.startswith("stamp is -")
    ]
    epochs = {a.epoch for a in run.adapters.values()}
    if len(epochs) != 1:
        return [*wrong, f"t = 0 at {epochs}"]
    (epoch,) = epochs
    for member in (m for m in rig.members if not m.external):
        missed = run.adapters[member.name].drive.missed if member.name in run.adapters else 0
        for port in (p for p in member.outputs if not p.sporadic and p.stamped and not p.delayed):
            ticks = [member.schedule.tick(t - epoch) for t in run.recording.topics[port.topic].times]
            due = ticks[-1] - ticks[0] + 1 if ticks else 0
            if ticks != sorted(set(ticks)) or due - len(ticks) != missed:
                wrong.append(f"{port.topic}: {len(ticks)} messages in {due} ticks, {missed} counted as missed")
    whole = all(a.ticks == a.schedule.tick(a.schedule.last) + 1 for a in run.adapters.values())
    # A node that misses a tick while it sleeps may answer the next one instead.
    for member in (m for m in rig.members if m.external and whole):
        for port in (p for p in member.outputs if not p.sporadic and p.stamped and not p.delayed):
            topic, text = run.recording.topics[port.topic], expected.topics[port.topic]
            stamps = [readable_stamp(data) - epoch for data in topic.data]
            if stamps != text.times or (
                topic.times != [epoch + t for t in text.times] and not rig.readers(member, port)
            ):
                wrong.append(f"{port.topic} of an external node has the stamps {stamps}")
    return wrong


def test_a_slow_controller_misses_no_tick_at_an_end_between_two_of_its_own():
    assert real_time("three plants, one of which has a slow law", 0) == []


@pytest.mark.parametrize("kind", few(KINDS, 7))
def test_in_real_time_every_tick_is_answered_or_counted(kind):
    for seed in range(4):
        outside = called(kind, random.Random(seed))
        assert real_time(kind, seed, outside, stalls=seed % 4) == [], (seed, outside)


@pytest.mark.parametrize("kind", few(KINDS, 7))
def test_when_a_node_dies_the_others_end_and_name_it(kind):
    for seed in range(5):
        assert death(kind, seed) == [], seed
    for seed in range(2):
        assert death_in_real_time(kind, seed) == [], seed


def test_a_node_that_dies_before_it_subscribes_is_named_by_the_one_that_waits_for_it():
    """Reports about each other's silence are consequences; one of a hundred thousand seeds found this."""
    what, wrong = trial(56041)
    assert what.startswith("death"), what
    assert wrong == []


@pytest.mark.parametrize("every", [1, 2, 3, 10])
def test_the_clock_is_ahead_of_a_follower_by_less_than_a_queue_holds(every):
    """The follower is stopped at eight ticks in a row: as many messages of a topic are then queued for it."""
    rig = rig_of(make_scenario(BASIC | {"watcher": slow(0.01 * every, executable="watcher")}, 0.6))
    waiting = set()
    for first in range(30, 38):
        world = World(lambda *_: MS)
        run = SimulatedRig(rig, world, "lockstep")
        plant, watcher = run.adapters["plant"], run.adapters["watcher"]

        def stop(world=world, run=run, plant=plant, watcher=watcher, first=first):
            if plant.ticks < first:
                world.at(world.now + MS // 2, stop)
                return
            run.nodes["watcher"].stalled = world.now + 1_000 * MS
            world.at(world.now + 900 * MS, lambda: waiting.add(plant.ticks + 1 - every * watcher.ticks))

        world.at(world.now, stop)
        assert set(run.run(30.0).values()) == {"done"}
        assert not differences(run.recording, in_process(rig))
    assert 4 < max(waiting) < QOS.depth
    assert min(waiting) > 3


@pytest.mark.parametrize(("without", "followers"), [({}, ["watcher"]), ({"source"}, []), ({"plant"}, [])])
def test_there_is_no_follower_beside_an_external_node(without, followers):
    rig = with_guests("two loops at two rates, a chain and a leaf", tuple(without))
    for member in rig.members:
        assert links(rig, member).followers == followers


def test_a_node_that_may_restart_is_waited_for_at_each_tick():
    rig, _ = rig_and_record("three who follow")
    for returns, followers in ((False, ["near", "half", "far"]), (True, [])):
        parameters = node_parameters(rig, rig.members[0], 0, "lockstep", returns=returns)
        assert Links.model_validate_json(parameters["run.links"]).followers == followers


def test_a_node_that_gets_an_answer_while_it_publishes_starts_no_tick_inside_another():
    """One of a thousand seeds that find a `Monitor` with this fault."""
    assert trial(522)[1] == []


@pytest.mark.parametrize("kind", ["basic", "two plants", "delayed link"])
def test_real_time_begins_when_all_nodes_run(kind):
    for seed in range(5):
        assert departure(kind, seed) == [], seed


def test_a_node_waits_for_one_that_cannot_begin_as_long_as_a_start_may_take_and_reports_what_is_missing():
    """The graph shows late that its topics have a subscriber: the other nodes have begun, and receive nothing
    from it.
    """
    rig, expected = rig_and_record("basic")
    world = World()
    run = SimulatedRig(rig, world, "lockstep", timeout=10.0, start_timeout=60.0)
    handshake = run.adapters["gain"].drive.handshake
    absent, begun = handshake.absent, world.now
    handshake.absent = lambda: absent() if world.now > begun + 40_000 * MS else ["plant does not subscribe lag/command"]
    assert set(run.run().values()) == {"done"}, {n: str(a.error) for n, a in run.adapters.items()}
    assert differences(expected, run.recording) == []
    assert [text for _, text in run.nodes["gain"].logs] == ["cannot begin yet: plant does not subscribe lag/command"]


@pytest.mark.parametrize("kind", ["basic", "two plants", "end"])
def test_a_node_that_judges_matches_only_by_the_graph_loses_messages(kind, monkeypatch):
    """The model shows an earlier race of starts: the graph shows a subscriber before the writer is matched with it."""
    monkeypatch.setattr(Output, "readers", property(lambda self: 10**9, lambda self, count: None), raising=False)
    assert any(start(kind, seed) for seed in range(30))


def trial(seed):
    """One run of every kind: returns what is wrong, with the kind of rig."""
    kind = list(KINDS)[seed % len(KINDS)]
    what = random.Random(-seed).random()
    if what < 0.1 and kind in ("basic", "two plants", "delayed link"):
        return f"departure of {kind}", departure(kind, seed)
    if what < 0.25:
        return f"death in {kind}", death(kind, seed)
    if what < 0.3:
        return f"death in {kind} in real time", death_in_real_time(kind, seed)
    if what < 0.45:
        outside = called(kind, random.Random(seed))
        return f"{kind} in real time with {outside} outside", real_time(kind, seed, outside, stalls=seed % 4)
    if what < 0.6:
        outside = guests(kind, random.Random(seed))
        return f"{kind} with {outside} outside", start(kind, seed, outside)
    return f"start of {kind}", start(kind, seed, stalls=seed % 4)


def share(first, last):
    """Some seeds; returns a line for each that shows something wrong."""
    result = ((seed, *trial(seed)) for seed in range(first, last))
    return [f"seed {seed}, {what}: {wrong}" for seed, what, wrong in result if wrong]


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_hundred_thousand_starts():
    """Six CPU minutes on each of two cores; `SOFTRIG_STARTS` sets another number, `trial(seed)` repeats one."""
    number = int(os.environ.get("SOFTRIG_STARTS", "100000"))
    firsts = range(0, number, 500)
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:  # spawn, because this process has threads of DDS
        results = [line for lines in pool.map(share, firsts, (min(f + 500, number) for f in firsts)) for line in lines]
    assert results == []
