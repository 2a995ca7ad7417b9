"""A bad message in each input of each node of each system: the run continues, and outputs stay finite."""

import importlib.metadata
import math

import pytest
from simulated import SimulatedRig, World
from softrig_core import SECOND, ByHand, Observer, Signals
from softrig_core.rig.installed import block_of, load_main
from softrig_core.wire.cdr import parse
from test_outside import SYSTEMS, short

DAILY = ("dc_motor_smc_b2", "induction_dtc", "rehab_impedance")


def spoilt(rig, member, port, at):
    """Run in lockstep with NaN in place of one message that a node reads; return what is wrong."""
    link = member.links[port.name]
    world = World()
    run = SimulatedRig(rig, world, "lockstep", seed=rig.scenario.seed)
    writer = next(w for w in world.writers if w.node.name == link.source.name and w.topic == f"/{port.topic}")
    reader = next(r for r in world.readers if r.node.name == member.name and r.topic == writer.topic)
    receive, count = reader.receive, [0]

    def spoil(data):
        count[0] += 1
        if count[0] == at + 1:
            stamp = max(0, parse(port.msgtype, data).mark)
            data = link.port.layout().encode(stamp, (math.nan,) * link.port.size)
        receive(data)

    reader.receive = spoil
    states = run.run(1000.0)
    wrong = [f"{n} is {states[n]}: {a.error}" for n, a in run.adapters.items() if states[n] != "done"]
    adapter = run.adapters[member.name]
    refused = {i.name: i.refused for i in adapter.inputs}
    if count[0] > at and refused[port.name] != 1:
        wrong.append(f"refused {refused}, last {[i.last_refusal for i in adapter.inputs]}")
    signals = Signals(run.recording)
    return wrong + [name for name in signals if not all(map(math.isfinite, signals[name].x))]


@pytest.mark.parametrize("system", [s if s in DAILY else pytest.param(s, marks=pytest.mark.long) for s in SYSTEMS])
def test_a_controller_continues_after_a_bad_message(system):
    rig = short(system)
    results = {
        f"{member.name} {port.name}": spoilt(rig, member, port, 7)
        for member in rig.members
        if not member.is_plant
        for port in member.inputs
        if port.name in member.links and not port.msgtype.endswith("/Bool")
    }
    assert results
    assert {n: wrong for n, wrong in results.items() if wrong} == {}


def in_real_time(rig, member=None, port=None):
    """Run in real time, with a message from the future to an input if one is given; return ticks and rejections."""
    world = World()
    run = SimulatedRig(rig, world, "realtime", seed=rig.scenario.seed)
    world.match()
    if port is not None:
        world.run(run.epoch + rig.end // 3)
        link = member.links[port.name]
        reader = next(r for r in world.readers if r.node.name == member.name and r.topic == f"/{link.port.topic}")
        reader.receive(link.port.layout().encode(world.now + 3600 * SECOND, link.port.safe))
    states = run.run()
    return {n: (states[n], a.ticks, a.drive.missed, a.drive.incomplete) for n, a in run.adapters.items()}, {
        (n, i.name): i.refused for n, a in run.adapters.items() for i in a.inputs if i.refused
    }


@pytest.mark.parametrize("system", [s if s in DAILY[::2] else pytest.param(s, marks=pytest.mark.long) for s in SYSTEMS])
def test_every_node_still_receives_after_a_message_from_the_future(system):
    rig = short(system)
    undisturbed, refused = in_real_time(rig)
    assert refused == {}
    asked = 0
    for member in rig.members:
        for port in member.inputs:
            if port.name in member.links and port.stamped:
                assert in_real_time(rig, member, port) == (undisturbed, {(member.name, port.name): 1})
                asked += 1
    assert asked


def test_every_observer_can_be_asked_before_its_first_tick():
    """Its node answers /diagnostics while it waits for others."""
    asked = set()  # a search path may list a package twice
    for distribution in importlib.metadata.distributions():
        package = distribution.metadata["Name"]
        for point in distribution.entry_points if package.startswith("softrig") else ():
            block = block_of(load_main(package, point.name))
            if block is not None and issubclass(block, Observer):
                ByHand(block()).status()
                asked.add(block)
    assert len(asked) == 3
