"""A rig waits for outside nodes without limit, and only the steady clock decides; over simulated nodes."""

import json
import os
import random
import time
from types import SimpleNamespace

import pytest
import rclpy
from by_hand import Listening
from conftest import differences, in_process, make_scenario, until
from faultrig import COMMAND, Gain, Lag
from rclpy._rclpy_pybind11 import RCLError
from rclpy.context import Context
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from simulated import Discovery, SimulatedNode, SimulatedRig, World
from simulated_outside import SimulatedOutside
from softrig_core import rig_of
from softrig_core.rig.options import RunOptions
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.below import uses
from softrig_nodes.group import Group
from softrig_nodes.lockstep import turns
from softrig_nodes.processes import supervision
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.guests import Guests
from softrig_nodes.ros import requests
from softrig_nodes.ros.ros import RosMiddleware, ServingNode, quiet_after_shutdown
from std_srvs.srv import Trigger
from test_discovery import KINDS, rig_and_record, with_guests

MS, SECOND = 1_000_000, 1_000_000_000
HOUR = 3600 * SECOND


def lacking(run):
    return sorted({topic for adapter in run.adapters.values() for topic in adapter.lacking})


def waiting(mode, seconds):
    """A rig whose controller is external, for some time."""
    world = World()
    Discovery(world, random.Random(0))
    run = SimulatedRig(with_guests("basic", ("gain",)), world, mode, departs=True, start_timeout=0.0)
    run.run(seconds)
    assert {a.state for a in run.adapters.values()} == {"starting"}
    assert lacking(run) == ["lag/command"]
    assert {(a.t, a.ticks, a.epoch) for a in run.adapters.values()} == {(0, 0, 0)}
    return run


def test_a_controller_on_a_wrong_topic_is_reported_with_the_right_one():
    run = waiting("lockstep", 1.0)
    messages = []
    guests = Guests(with_guests("basic", ("gain",)), messages.append)

    def look():
        guests.check({name: a.account.status() for name, a in run.adapters.items()})

    look()
    assert messages == []
    node = SimulatedNode(run.world, "somebody", {})
    node.publisher("lag/comand", COMMAND.msgtype, lambda count: None)
    node.publisher("joint_states", "sensor_msgs/msg/Imu", lambda count: None)  # its type differs, so it is ignored
    run.run(1.0)
    look(), look()
    assert messages == [
        "/somebody publishes /lag/comand, which nobody in the rig reads; lag/command is awaited from gain"
    ]
    node.publisher(COMMAND.topic, COMMAND.msgtype, lambda count: None)
    run.run(1.0)
    look()
    assert messages[1:] == ["gain is there"]


def test_a_rejected_message_of_an_outside_node_is_reported_once():
    messages = []
    guests = Guests(with_guests("basic", ("gain",)), messages.append)
    for count in (1, 2):
        guests.check({"plant": {"refused": {"lag/command": [count, "u is nan"]}}})
    assert messages == ["plant refused a message on lag/command: u is nan"]


def test_in_lockstep_a_controller_may_join_after_minutes_and_nothing_is_lost():
    run = waiting("lockstep", 120.0)
    rig, expected = rig_and_record("basic")
    gain = next(m for m in rig.members if m.name == "gain")
    SimulatedOutside(rig, gain, expected, run.world, list(gain.inputs))
    assert set(run.run(100.0).values()) == {"done"}
    assert lacking(run) == []
    assert [t for t in differences(expected, run.recording) if t != "lag/command"] == []


@pytest.mark.parametrize("seed", range(3))
def test_no_node_waits_for_an_observer_that_can_never_be_matched(seed):
    """`ros2 topic echo --qos-durability transient_local`, started before the rig."""
    world = World()
    Discovery(world, random.Random(seed))
    rig, expected = rig_and_record("basic")
    person = SimulatedNode(world, "person", {})
    person.subscribe(COMMAND.topic, COMMAND.msgtype, Listening(print), fits=False)
    world.run(world.now + SECOND)
    run = SimulatedRig(rig, world, "lockstep", start_timeout=2.0)
    assert set(run.run(100.0).values()) == {"done"}, {n: str(a.error) for n, a in run.adapters.items()}
    assert differences(expected, run.recording) == []


def test_a_node_of_the_rig_that_can_never_be_matched_is_named_with_the_reason(monkeypatch):
    subscribe = SimulatedNode.subscribe

    def strange(node, topic, *arguments):
        subscribe(node, topic, *arguments, fits=(node.name, topic) != ("plant", COMMAND.topic))

    monkeypatch.setattr(SimulatedNode, "subscribe", strange)
    world = World()
    run = SimulatedRig(rig_and_record("basic")[0], world, "lockstep", start_timeout=2.0)
    run.run(100.0)
    assert "plant can never read /lag/command: its profile" in str(run.adapters["gain"].error)
    assert run.adapters["gain"].waits_for == ["plant"]


def test_the_graph_shows_which_subscribers_request_more_than_a_writer_offers():
    context, best_effort = Context(), QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    with free_domain() as domain:
        rclpy.init(context=context, domain_id=domain)
        node = ServingNode("ours", context=context)
        try:
            for profile in (1, best_effort, latched):
                node.create_subscription(JointState, "lag/command", print, profile)
            rig = RosMiddleware(node)
            rig.publisher("lag/command", "sensor_msgs/msg/JointState", lambda count: None)
            until(lambda: len(rig.subscribers("/lag/command")) == 3)
            result = rig.unfit("/lag/command", "sensor_msgs/msg/JointState")
        finally:
            node.destroy_node()
            context.shutdown()
    assert result == [("ours", "Volatile publisher and transient local subscription")]


def test_an_answer_is_sent_to_a_present_client_and_to_none_that_has_left(monkeypatch):
    """The middleware would wait for 0.1 s at each of the others; the header of a request identifies its client."""
    monkeypatch.setattr(requests, "UNKNOWN", 0.0)
    contexts, sent, dropped = [Context() for _ in range(3)], [], []
    with free_domain() as domain:
        for context in contexts:
            rclpy.init(context=context, domain_id=domain)
        node = ServingNode("ours", context=contexts[0])
        first, left = (rclpy.create_node(f"stranger{k}", context=contexts[k]) for k in (1, 2))
        try:
            node.dropped = lambda: dropped.append(1)
            node.serve_by(lambda period, serve: SimpleNamespace(period=period))
            service = node.create_service(Trigger, "~/press", lambda request, response: response)
            monkeypatch.setattr(node._requests._offers[-1], "send", lambda response, header: sent.append(header))
            for stranger, known, count in ((first, 1, 2), (left, 2, 3)):
                client = stranger.create_client(Trigger, "/ours/press")
                assert client.wait_for_service(60.0)
                until(lambda known=known: len(uses.answer_readers(node, service)) == known)
                for _ in range(count):
                    client.call_async(Trigger.Request())
            left.destroy_node()
            until(lambda: len(uses.answer_readers(node, service)) == 1)
            until(lambda: len(sent) + len(dropped) == 5 or (node._requests.serve(), None)[1])
        finally:
            first.destroy_node()
            node.destroy_node()
            for context in contexts:
                context.shutdown()
    assert ([h.request_id.sequence_number for h in sent], len(dropped)) == ([1, 2], 3)


def test_in_real_time_the_start_is_after_the_controller_has_joined():
    run = waiting("realtime", 120.0)
    world, arrived = run.world, run.world.now
    node = SimulatedNode(world, "somebody", {})
    for port in Gain.INPUTS:
        node.subscribe(port.topic, port.msgtype, Listening(lambda data: None))
    node.publisher(COMMAND.topic, COMMAND.msgtype, lambda count: None)
    world.run(world.now + 10 * SECOND, lambda: all(a.state == "running" for a in run.adapters.values()))
    (epoch,) = {a.epoch for a in run.adapters.values()}
    assert arrived < epoch < world.now + SECOND
    assert lacking(run) == []


@pytest.mark.parametrize(
    "groups", [(), [("plant", "source", "gain")], [("plant", "gain")]], ids=["processes", "a container", "both"]
)
def test_a_run_longer_than_the_time_of_a_start_counts_as_begun(groups, monkeypatch):
    """In a container no node waits for a message of another process, which is how a beginning is noticed elsewhere."""
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.4))
    world = World(lambda *_: 20 * MS)
    monkeypatch.setattr(turns, "SLICE", 0)
    monkeypatch.setattr(SimulatedNode, "post", lambda node, call: world.at(world.now + 20 * MS, call))
    run = SimulatedRig(rig, world, "lockstep", groups=groups, start_timeout=0.3, timeout=5.0)
    began = world.now
    assert set(run.run().values()) == {"done"}, {n: str(a.error) for n, a in run.adapters.items()}
    assert world.now - began > 300 * MS  # start_timeout
    assert differences(in_process(rig), run.recording) == []


def test_a_topic_of_an_outside_node_is_not_remapped_for_its_observer():
    """An observer of this rig reads `other/command` in place of `lag/command`."""
    nodes = {n: e.model_dump() | {"external": n == "gain"} for n, e in KINDS["basic"].nodes.items()}
    elsewhere = {"lag/command": "other/command"}
    nodes |= {
        "other": nodes["gain"] | {"external": False, "remap": elsewhere},
        "watcher": nodes["gain"] | {"external": False, "executable": "watcher", "remap": elsewhere},
    }
    run = SimulatedRig(rig_of(make_scenario(nodes)), World(), "lockstep", start_timeout=0.0)
    run.run(100.0)
    assert {a.state for a in run.adapters.values()} == {"starting"}
    assert {tuple(a.lacking) for a in run.adapters.values()} == {("lag/command",)}


def test_a_node_started_alone_does_not_take_a_future_stamp_for_the_beginning():
    world = World()
    node = SimulatedNode(world, "gain", {})
    gain, sent = Adapter(node, Gain(), RunOptions(mode="realtime")), []
    Group([gain])
    SimulatedNode(world, "plant", {}).subscribe(COMMAND.topic, COMMAND.msgtype, Listening(sent.append))
    world.match()

    def say(stamp):
        for reader in [r for r in world.readers if r.node is node and r.topic != "/softrig/tick"]:
            port = next((p for p in Gain.INPUTS if f"/{p.topic}" == reader.topic), None)
            if port is not None:
                reader.receive(port.layout().encode(stamp, (1.0,) * port.size))

    first = gain.schedule.held(world.now)
    for k, off in enumerate((HOUR, -HOUR, 0, 0, 0)):
        world.run(first + k * 10 * MS)
        say(first + k * 10 * MS + off)
    world.run(first + 100 * MS)
    assert [i.refused for i in gain.inputs] == [2, 2]
    assert (gain.ticks, len(sent)) == (3, 3)
    assert gain.epoch == first + 20 * MS


@pytest.mark.parametrize(("lease", "state"), [(0.0, "done"), (3.0, "failed")])
def test_a_controller_started_alone_leaves_with_its_senders_and_fails_when_they_die(lease, state):
    """A killed node stays in the graph for its lease."""
    world = World()
    node, player = SimulatedNode(world, "gain", {}), SimulatedNode(world, "player", {})
    gain, sent = Adapter(node, Gain(), RunOptions(mode="lockstep")), []
    Group([gain])
    player.subscribe(COMMAND.topic, COMMAND.msgtype, Listening(sent.append))
    say = [(p, player.publisher(p.topic, p.msgtype, lambda count: None)) for p in Gain.INPUTS]
    world.match()
    world.run(world.now + 2 * SECOND)
    for k in range(3):
        for port, send in say:
            send(port.layout().encode(k * 10 * MS, (1.0,) * port.size))
    world.run(world.now + round((0.1 + lease) * SECOND))
    assert (len(sent), gain.state) == (3, "running")
    for item in gain.inputs:
        item.matched(0)
    world.run(world.now + 2 * SECOND)
    assert gain.state == state
    assert ("(gone)" in str(gain.error)) == (state == "failed")


class Needy(Lag):
    """A plant that requires commands."""

    AWAITS_COMMAND = True


def test_a_plant_that_requires_commands_stays_at_the_start_until_one_arrives():
    world = World()
    node, law = SimulatedNode(world, "plant", {}), SimulatedNode(world, "law", {})
    plant, messages = Adapter(node, Needy(), RunOptions(mode="realtime", duration=0.1)), []
    Group([plant])
    state = next(p for p in Needy.OUTPUTS if p.name == "state")
    law.subscribe(state.topic, state.msgtype, Listening(messages.append))
    send = law.publisher(COMMAND.topic, COMMAND.msgtype, lambda count: None)
    world.match()
    begun = world.now
    world.run(begun + SECOND)
    assert "stays at t = 0 until it is commanded on lag/command" in [text for _, text in node.logs]
    values = {state.layout().decode(data)[1] for data in messages}
    assert (len(messages) > 50, len(values)) == (True, 1)
    stamp = state.layout().decode(messages[-1])[0]
    assert world.now - stamp < 20 * MS
    send(COMMAND.layout().encode(stamp, (1.0,)))
    world.run(world.now + 50 * MS)
    assert plant.epoch - stamp in (0, 10 * MS)
    assert plant.step.x != plant.block.first()
    assert plant.state == "running"
    world.run(world.now + 100 * MS)
    assert plant.state == "done"


def test_a_jumping_system_clock_does_not_matter_in_lockstep(monkeypatch):
    rng = random.Random(0)
    monkeypatch.setattr(SimulatedNode, "now", lambda self: self.world.now + rng.randrange(-HOUR, HOUR))
    rig = rig_of(make_scenario({"plant": "plant", "source": "source", "gain": "gain"}, 0.2))
    run = SimulatedRig(rig, World(), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(rig), run.recording) == []


def test_the_wall_clock_of_a_node_advances_steadily_whatever_the_system_clock_does(monkeypatch):
    ros = RosMiddleware(
        SimpleNamespace(
            monitor=None,
            get_name=lambda: "a",
            get_fully_qualified_name=lambda: "/a",
            _parameter_overrides={},
            serve_by=lambda timer: None,
        )
    )
    before = ros.now()
    assert abs(before - time.time_ns()) < HOUR
    monkeypatch.setattr(time, "time_ns", lambda: 0)
    monkeypatch.setattr(time, "time", lambda: 0.0)
    assert 0 <= ros.now() - before < HOUR


@pytest.mark.parametrize(("jump", "seconds"), [(0.0, 0.5), (HOUR / SECOND, 0.0), (-HOUR / SECOND, 8.0)])
def test_a_supervisor_waits_for_the_start_of_a_run_whatever_the_system_clock_does(jump, seconds, monkeypatch):
    epoch = time.time_ns() + SECOND // 2
    now = time.time() + jump
    monkeypatch.setattr(time, "time", lambda: now)
    assert supervision._to_start(epoch, 8.0) == pytest.approx(seconds, abs=0.1)


def test_a_node_that_has_reported_its_failure_is_the_cause_before_its_process_has_ended(tmp_path, monkeypatch):
    """On a busy host its process may end after those of the nodes that waited for it."""
    monkeypatch.setattr(supervision, "GRACE", 0.0)

    def child(name, code, error, waits_for):
        status = tmp_path / name
        status.write_text(json.dumps({"state": "failed", "error": error, "waits_for": waits_for}))
        process = SimpleNamespace(poll=lambda: code, returncode=code, pid=os.getpid())
        return SimpleNamespace(member=SimpleNamespace(name=name), process=process, status=status, log=status)

    source, gain = child("source", None, "hears nobody", []), child("gain", 3, "nothing from source", ["source"])
    assert supervision._reason([source, gain], [gain], None) == "node source: hears nobody"


def test_a_clock_that_was_set_back_is_named_as_a_reason(monkeypatch):
    clock, now = supervision.SystemClock(), time.time
    assert clock.set_back() == ""
    monkeypatch.setattr(time, "time", lambda: now() + HOUR / SECOND)
    assert clock.set_back() == ""  # a clock that moves forward needs no report
    monkeypatch.setattr(time, "time", now)  # set to the true time, an hour before the last reading
    text = "; the system's clock was set back by 3600 s meanwhile, and Fast DDS waits by it"
    assert clock.set_back() == text
    monkeypatch.setattr(time, "time", lambda: now() + HOUR / SECOND)
    assert clock.set_back() == text


@pytest.mark.parametrize("ok", [True, False])
def test_publishing_after_the_shutdown_of_the_context_is_no_error(ok, monkeypatch):
    """It happens between a signal and the end of the current callback; the executor would log a traceback."""

    def publish(data):
        raise RCLError("publisher's context is invalid")

    monkeypatch.setattr(rclpy, "ok", lambda: ok)
    if ok:
        with pytest.raises(RCLError):
            quiet_after_shutdown(publish)(b"")
    else:
        assert quiet_after_shutdown(publish)(b"") is None
