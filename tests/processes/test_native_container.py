"""Native ticks of a container: the same bytes, with external nodes that appear, leave, pause or change something."""

import math
import threading
import time

import pytest
from conftest import differences, in_process
from simulated import Endpoint, SimulatedNode, World
from softrig_core import Recording, rig_of
from softrig_core.native import engine, fitted
from softrig_core.native.compile import plain
from softrig_core.native.engine import Engine
from softrig_core.rig.options import RunOptions
from softrig_core.run import choice
from softrig_core.wire.parameter_event import TOPIC as EVENTS
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.group import Group
from softrig_nodes.lockstep import turns
from softrig_nodes.processes.spawning import node_parameters


class Container:
    """The nodes of a rig in one process of a simulated world, which run natively while no external node takes part."""

    def __init__(self, rig, folder, monkeypatch, make=None):
        self.expected = in_process(rig, 1)
        monkeypatch.setattr(choice, "cost", lambda steps: 0.0)
        monkeypatch.setattr(choice, "unwanted", lambda steps, left, runs: "")
        # Not `plain` itself, so that the tables are those of numpy.
        monkeypatch.setattr(choice, "compiled", make or (lambda text: plain(text)))
        monkeypatch.setattr(engine, "SHORTEST", 50)
        monkeypatch.setattr(fitted, "SHORTEST", 50)
        monkeypatch.setattr(engine, "SHORT_GO", -1.0)  # so that every go ends at once
        monkeypatch.setattr(fitted, "_texts", [])
        if make is None:
            monkeypatch.setattr(Engine, "_compile_in_thread", lambda self, k: False)
        monkeypatch.setattr(engine, "LOOK", 5)
        monkeypatch.setattr(turns, "SLICE", -1)  # check the other nodes after each go
        monkeypatch.setattr(SimulatedNode, "mute", True)
        self.rig, self.world, self.folder, process = rig, World(), folder, object()
        self.adapters, self.nodes = {}, {}
        for m in rig.members:
            parameters = node_parameters(rig, m, 1, "lockstep")
            options = {k.removeprefix("run."): v for k, v in parameters.items() if k.startswith("run.")}
            self.nodes[m.name] = SimulatedNode(self.world, m.name, m.remap, process)
            shard = RunOptions(**{**options, "shard": str(folder / f"{m.name}.shard")})
            self.adapters[m.name] = Adapter(self.nodes[m.name], m.block(1), shard)
        Group(list(self.adapters.values()))
        self.world.match()
        self.clock = self.adapters[rig.clock.name]

    def on(self, ticks=math.inf):
        """Run to a number of ticks of the clock, or to the end."""

        def over():
            return self.clock.ticks >= ticks or all(a.state in ("done", "failed") for a in self.adapters.values())

        self.world.run(self.world.now + 10**12, over)

    def native(self):
        return self.adapters[self.rig.clock.name].step.native[0]

    def ends_as_in_process(self):
        self.on()
        recording = Recording((t, p.msgtype) for t, p in self.rig.topics.items())
        for name, adapter in self.adapters.items():
            assert (adapter.state, adapter.error) == ("done", None)
            adapter.record.shard.close()
            recording.read_shard(self.folder / f"{name}.shard")
        assert differences(self.expected, recording) == []
        return {name: adapter.account.status()["native"] for name, adapter in self.adapters.items()}


@pytest.mark.parametrize(
    ("name", "duration"), [("dc_motor_smc", 0.1), pytest.param("induction_dtc", 0.03, marks=pytest.mark.long)]
)
def test_without_external_nodes_native_code_answers(name, duration, tmp_path, monkeypatch):
    rig = rig_of(name, duration=duration)
    container = Container(rig, tmp_path, monkeypatch)
    reported = container.ends_as_in_process()
    ticks = rig.clock.schedule.ticks
    assert reported[rig.clock.name] == (ticks - 1, "")  # the first and the last tick run in Python
    assert container.clock.account.status()["tick_p50_ms"] > 0.0


def test_it_is_compiled_while_python_continues(tmp_path, monkeypatch):
    made, go = [], threading.Event()

    def slow(text):
        function = plain(text)

        def rig(first, last, *handed):
            if first == last:
                go.wait(10.0)
                made.append(threading.current_thread())
            return function(first, last, *handed)

        return rig

    container = Container(rig_of("dc_motor_smc", duration=0.1), tmp_path, monkeypatch, slow)
    container.on(300)
    assert (container.native(), made) == (0, [])
    go.set()
    while not made:
        time.sleep(0.001)
    made[0].join()
    container.ends_as_in_process()
    assert container.native() > 600


def test_an_external_subscriber_gets_each_message_from_its_arrival_on(tmp_path, monkeypatch):
    container = Container(rig_of("dc_motor_smc", duration=0.1), tmp_path, monkeypatch)
    container.on(200)
    before, received = container.native(), []
    assert before >= 199
    output = container.clock.outgoing.outputs[0]
    world = container.world
    person = SimulatedNode(world, "person", {})
    world.add(Endpoint(person, output.topic, output.port.msgtype, received.append, lambda count: None, world.now))
    world.match()
    first = container.clock.ticks
    container.on(400)
    world.readers.pop()
    world.match()
    last = container.clock.ticks
    reported = container.ends_as_in_process()
    world.run(world.now + 10**7)  # deliver the messages that are under way
    topic = container.expected.topics[output.topic.removeprefix("/")]
    assert received == topic.data[first : first + len(received)]
    assert last - first <= len(received) + 1
    assert before < reported[container.rig.clock.name][0] < 1000 - (last - first) + 10


def test_pauses_and_changes_by_external_nodes_take_effect(tmp_path, monkeypatch):
    rig = rig_of("dc_motor_smc", duration=0.1)
    container = Container(rig, tmp_path, monkeypatch)
    clock = container.clock
    container.on(200)
    clock.hold.ask("pause")
    world, at = container.world, clock.ticks
    world.run(world.now + 10**9)
    assert clock.ticks <= at + 1
    at = clock.ticks
    clock.hold.ask("step")
    world.run(world.now + 10**9)
    assert clock.ticks == at + 1
    clock.hold.ask("resume")
    container.on(at + 100)
    law = container.adapters["dc_motor_smc"]
    law.step.set({"delta": 0.5})
    changed = law.step.t
    container.on()
    events = Recording((t, p.msgtype) for t, p in rig.topics.items())
    law.record.shard.close()
    events.read_shard(tmp_path / "dc_motor_smc.shard")
    (t,) = events.topics[EVENTS].times
    assert changed < t <= changed + 200_000
    assert law.step.params.delta == 0.5
    assert container.native() > 800
