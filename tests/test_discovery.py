"""Every order of discovery that DDS allows, drawn from seeds: no start loses a message, nor does a sender ahead."""

import random
from functools import cache, partial

import pytest
from conftest import differences, in_process, make_scenario
from simulated import Discovery, SimulatedRig, World
from simulated_outside import SimulatedOutside
from softrig_core.node.endpoint import Output
from softrig_core.rig.rig import Rig
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
    "solver": make_scenario(BASIC | {
        "planner": slow(0.05, executable="planner"),
        "gain": {"executable": "gain", "remap": {"lag/reference": "lag/inner_reference"}}}, 0.1),
}  # fmt: skip


@cache
def rig_and_record(kind):
    """The rig with all nodes ours and what it must say."""
    rig = Rig.from_scenario(KINDS[kind])
    return rig, in_process(rig)


@cache
def with_guests(kind, outside):
    """The rig with some of its nodes external."""
    nodes = {n: e.model_copy(update={"external": n in outside}) for n, e in KINDS[kind].nodes.items()}
    return Rig.from_scenario(KINDS[kind].model_copy(update={"nodes": nodes}))


def start(kind, seed, outside=(), stalls=0):
    """One run whose orders are drawn; gives what is wrong with it.

    Outside nodes come when they like, make their endpoints one after the other and read what they like.
    """
    rng = random.Random(seed)
    ours, expected = rig_and_record(kind)
    rig = with_guests(kind, outside)
    longest = rng.choice((1, 5, 20)) * MS
    world = World(lambda *_: rng.randrange(1_000, longest))
    Discovery(world, rng)
    run = SimulatedRig(rig, world, "lockstep", after=lambda name: rng.randrange(300 * MS), start_timeout=0.0)
    for member in (m for m in ours.members if m.name in outside):
        reads = [p for p in member.inputs if p.name in member.links and member.links[p.name].source.name not in outside]
        calls = [p for p in reads if not member.links[p.name].port.sporadic]
        reads = [p for p in reads if p in calls[:1] or rng.random() < 0.5] if calls else []
        world.at(world.now + rng.randrange(1_000 * MS), partial(
            SimulatedOutside, ours, member, expected, world, reads, lambda: rng.randrange(100 * MS)))  # fmt: skip
    for _ in range(stalls):
        world.at(world.now + rng.randrange(1_500 * MS), lambda: stall(run, rng))
    states = run.run(100.0)
    wrong = [f"{m.name} has not come" for m in rig.members if not m.external and m.name not in states]
    wrong += [f"{n}: {a.state} at {a.t}: {a.error}" for n, a in run.adapters.items() if a.state != "done"]
    said = {p.topic for m in rig.members if not m.external for p in m.outputs}
    wrong += [t for t in differences(expected, run.recording) if t in said]
    wrong += [f"{n} refused {i.port.topic}: {i.last_refusal}" for n, a in run.adapters.items()
              for i in (*a.inputs, *a.paces) if i.refused]  # fmt: skip
    return wrong


def stall(run, rng):
    """One of the nodes is stopped for a while, its messages wait for it."""
    if not run.nodes:
        return
    node = rng.choice(list(run.nodes.values()))
    node.stalled = run.world.now + rng.randrange(3_000 * MS)


@pytest.mark.parametrize("kind", KINDS)
def test_no_start_loses_a_message(kind):
    for seed in range(20):
        assert start(kind, seed, stalls=seed % 3) == [], seed


def guests(kind, rng):
    """Draw who is outside: one plant, or any of the others.

    Outside nodes that wait for each other are their owners' business, and nobody tells for them when they are silent.
    """
    members = [m for m in rig_and_record(kind)[0].members if not m.block_class.ENDS and m.package == "faultrig"]
    members = [m for m in members if m.outputs and not any(p.sporadic for p in m.outputs)]
    plants = [m.name for m in members if m.is_plant and m.links]
    others = [m.name for m in members if not m.is_plant]
    if plants and (rng.random() < 0.3 or not others):
        return (rng.choice(plants),)
    return tuple(rng.sample(others, rng.randint(1, len(others)))) if others else ()


@pytest.mark.parametrize("kind", KINDS)
def test_any_node_may_be_outside_reading_any_subset(kind):
    for seed in range(20):
        outside = guests(kind, random.Random(seed))
        assert start(kind, seed, outside) == [], (seed, outside)


@pytest.mark.parametrize("kind", ["basic", "two plants", "delayed link"])
def test_when_a_node_dies_the_others_end_and_what_they_said_is_right(kind):
    rig, expected = rig_and_record(kind)
    for seed in range(20):
        rng = random.Random(seed)
        world = World(lambda *_, rng=rng: rng.randrange(1_000, 5 * MS))
        discovery = Discovery(world, rng)
        run = SimulatedRig(rig, world, "lockstep", after=lambda name, rng=rng: rng.randrange(300 * MS))
        victim = rng.choice(rig.members).name
        world.at(world.now + 300 * MS + rng.randrange(1_000 * MS),
                 lambda run=run, victim=victim, discovery=discovery: discovery.kill(run.nodes[victim]))  # fmt: skip
        states = run.run(100.0)
        assert all(states[n] in ("done", "failed") for n in states if n != victim), (seed, victim, states)
        for topic, record in run.recording.topics.items():
            n = len(record.times)
            assert (record.times, record.data) == (expected.topics[topic].times[:n], expected.topics[topic].data[:n])


@pytest.mark.parametrize("kind", ["basic", "two plants", "delayed link"])
def test_real_time_begins_when_all_are_up(kind):
    """Nodes come over three seconds: all have one t = 0 after the last, and nobody misses anything."""
    rig, _ = rig_and_record(kind)
    for seed in range(5):
        rng = random.Random(seed)
        world = World(lambda *_, rng=rng: rng.randrange(1_000, MS))
        Discovery(world, rng)
        began = world.now
        run = SimulatedRig(rig, world, "realtime", departs=True, after=lambda name, rng=rng: rng.randrange(3_000 * MS))
        assert set(run.run(30.0).values()) == {"done"}
        (epoch,) = {a.epoch for a in run.adapters.values()}
        assert epoch >= max(n.born for n in run.nodes.values())
        assert epoch - began < 5_000 * MS
        assert [a.missed + a.incomplete for a in run.adapters.values()] == [0] * len(run.adapters)


@pytest.mark.parametrize("kind", ["basic", "two plants", "end"])
def test_who_judges_matches_by_the_graph_alone_loses_messages(kind, monkeypatch):
    """The model shows the race that starts once had: the graph knows a reader before the writer is matched with it."""
    monkeypatch.setattr(Output, "readers", property(lambda self: 10**9, lambda self, count: None), raising=False)
    assert any(start(kind, seed) for seed in range(30))
