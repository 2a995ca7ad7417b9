"""ROS behind the seam, piece by piece and without a graph: messages, interfaces of a node, timers, sets, callbacks,
clients.

In place of a node of rclpy the pieces have an object with the methods that they call.
"""

import ctypes
import random
import time
from contextlib import nullcontext
from types import SimpleNamespace

import pytest
from by_hand import Hand, Listening
from faultrig import Gain, Lag
from rclpy.parameter import Parameter
from softrig_core import Block, Observer, joint_state, number
from softrig_core.block.block import Level
from softrig_core.block.params import Declaration, ParameterError
from softrig_core.block.scene import Marker, Pose
from softrig_core.rig.options import Links, RunOptions
from softrig_nodes import container as containers
from softrig_nodes.adapter.adapter import Adapter
from softrig_nodes.below import arrival, tf_message, uses
from softrig_nodes.container import Container
from softrig_nodes.face import frames
from softrig_nodes.face.faces import Faces
from softrig_nodes.face.tuning import Tuning
from softrig_nodes.ros import contained, remote, ros
from softrig_nodes.ros.contained import ContainedMiddleware
from softrig_nodes.ros.garbage import Garbage
from softrig_nodes.ros.messages import diagnostic_array, marker_array, message_class, range_descriptor
from softrig_nodes.ros.ros import RosMiddleware, ServingNode, guessed, plain, quiet_after_shutdown, with_number
from softrig_nodes.seam.exchange import Exchange
from softrig_nodes.seam.middleware import Peer
from softrig_nodes.seam.monitor import Monitor
from test_codec import STORE

NOW = 1_700_000_000_000_000_005


# ---- messages ----


def test_a_diagnostic_is_one_status_with_its_values():
    array = diagnostic_array(NOW, "/rig/law", Level.WARN, "late", {"ticks": "5", "b": ""})
    assert (array.header.stamp.sec, array.header.stamp.nanosec, array.header.frame_id) == (1_700_000_000, 5, "world")
    (status,) = array.status
    assert (status.level, status.name, status.message, status.hardware_id) == (b"\1", "/rig/law", "late", "/rig")
    assert [(v.key, v.value) for v in status.values] == [("ticks", "5"), ("b", "")]


def test_each_visible_object_is_one_marker():
    line = Marker("base", "path", "line_strip", ((0.0, 1.0, 2.0), (3.0, 4.0, 5.0)), 0.25, (0.1, 0.2, 0.3, 0.5))
    balls = Marker("tip", "balls", "sphere_list", ((1.0, 1.0, 1.0),), 0.5)
    first, second = marker_array(NOW, [line, balls]).markers
    assert (first.header.stamp.sec, first.header.stamp.nanosec, first.header.frame_id) == (1_700_000_000, 5, "base")
    assert (first.ns, first.type, first.action, first.pose.orientation.w) == ("path", first.LINE_STRIP, first.ADD, 1.0)
    assert [(p.x, p.y, p.z) for p in first.points] == [(0.0, 1.0, 2.0), (3.0, 4.0, 5.0)]
    assert (first.scale.x, first.scale.y, first.scale.z) == (0.25, 0.0, 0.0)
    assert (second.scale.x, second.scale.y, second.scale.z) == (0.5, 0.5, 0.5)
    assert (second.ns, second.type, second.header.frame_id) == ("balls", second.SPHERE_LIST, "tip")
    colour = first.color
    assert (colour.r, colour.g, colour.b, colour.a) == pytest.approx((0.1, 0.2, 0.3, 0.5))


@pytest.mark.parametrize(
    ("kind", "lower", "upper", "ranges"),
    [
        (float, 0.5, 2.0, (0.5, 2.0)),
        (float, None, 2.0, (-1.7e308, 2.0)),
        (float, 0.5, None, (0.5, 1.7e308)),
        (int, 1.0, 9.0, (1, 9)),
        (int, None, 9.0, (-(2**62), 9)),
        (int, 1.0, None, (1, 2**62)),
        (float, None, None, None),
        (str, 1.0, None, None),
    ],
)
def test_a_parameter_is_described_with_its_range(kind, lower, upper, ranges):
    for live, unit in ((True, "m"), (False, "")):
        reported = range_descriptor(Declaration("a", kind(1), kind, "gain", unit, lower, upper, live))
        assert (reported.description, reported.read_only, reported.dynamic_typing) == (
            "gain [m]" if unit else "gain",
            not live,
            True,
        )
        when = "may change while running, from the next tick on" if live else "fixed from the start on"
        assert reported.additional_constraints == when
        both = reported.floating_point_range, reported.integer_range
        results = [(r.from_value, r.to_value) for of in both for r in of]
        assert results == ([ranges] if ranges else [])
        assert len(both[kind is int]) == len(results)


def test_only_types_of_interface_packages_are_imported():
    assert message_class("std_msgs/msg/Float64").__name__ == "Float64"
    assert message_class("std_srvs/srv/Trigger").__name__ == "Trigger"
    for name in ("os/path/join", "os/msg/path", "std_msgs/Float64", "json", "std_msgs/idl/Float64"):
        with pytest.raises(ImportError, match=f"{name!r}: no installed interface package has this type"):
            message_class(name)


# ---- diagnostics, figures and markers of a node ----


class FakeNode:
    """A node that records what it offers."""

    def __init__(self):
        self.topics, self.services, self.readers = {}, {}, {}
        self.callbacks = []
        self.monitor = Monitor(lambda: None)

    def get_fully_qualified_name(self):
        return "/rig/node"

    def create_publisher(self, kind, topic, profile, **options):
        message = self.topics.setdefault(topic, [])
        made = SimpleNamespace(publish=message.append, get_subscription_count=lambda: self.readers.get(topic, 0))
        made.handle = SimpleNamespace(publish_raw=message.append)
        made.profile, made.kind = profile, kind
        self.topics[f"{topic} offered"] = made
        return made

    def create_service(self, kind, name, answer):
        self.services[name] = answer

    def add_on_set_parameters_callback(self, call):
        self.callbacks.append(call)


class Seen(Observer):
    """A block with a marker, a text, figures and a health report."""

    def first(self):
        return 3.0

    def update(self, x, t):
        return x, {}

    def status(self, x):
        return {"mean": (x / 7.0, "m"), "count": (x, "")}

    def markers(self, x):
        return [Marker("base", "path", "line_strip", (), 0.1)]

    def latched(self):
        return {"robot_description": "<robot/>"}

    def health(self, x):
        return {"solver": "fine"}


def face(block, mode="lockstep", links=None, **options):
    node, hand = FakeNode(), Hand("node")
    block.reset(0)
    text = "" if links is None else Links(**links).model_dump_json()
    adapter = Adapter(hand, block, RunOptions(mode=mode, links=text, **options))
    adapter.drive = SimpleNamespace(
        t=5, now=lambda: NOW, statistics=lambda: {"missed": 2}, busy=lambda: False, counts=dict
    )
    return node, hand, adapter, Faces(node, adapter)


def test_an_observer_publishes_its_figures_markers_and_text_to_subscribers():
    node, hand, adapter, _ = face(Seen())
    (timer,) = hand.timers
    assert timer.asked == [(250_000_000, 0)]
    assert [t.data for t in node.topics["robot_description"]] == ["<robot/>"]
    kept = node.topics["robot_description offered"].profile
    assert (kept.depth, kept.durability.name) == (1, "TRANSIENT_LOCAL")
    for _ in range(8):
        timer.call()
    # Nothing is published without a subscriber.
    assert not any(node.topics[t] for t in ("/diagnostics", "~/metrics", "~/markers"))
    node.readers |= {"/diagnostics": 1, "~/metrics": 1, "~/markers": 2}
    for k in range(8):
        timer.call()
        # Published once a second.
        assert len(node.topics["/diagnostics"]) == len(node.topics["~/metrics"]) == (k + 1) // 4
    assert node.topics["~/markers"] == []  # the node does not run yet, so nothing is published
    adapter.state = "running"
    timer.call()
    (array,) = node.topics["~/markers"]
    assert (array.markers[0].ns, array.markers[0].header.stamp.nanosec) == ("path", 5)
    (status,) = node.topics["~/metrics"][0].status
    assert [(v.key, v.value) for v in status.values] == [("mean", "0.428571429 m"), ("count", "3")]
    assert (status.name, status.level, node.topics["~/metrics"][0].header.stamp.nanosec) == ("node", b"\0", 5)


def test_diagnostics_contain_the_worst_report_and_the_rejected_messages():
    node, _hand, adapter, shown = face(Seen())
    node.readers["/diagnostics"] = 1

    def statuses():
        shown._publish_diagnostics()
        (status,) = node.topics["/diagnostics"].pop().status
        return status.level, status.message, {v.key: v.value for v in status.values}

    usual = {"ticks": "0", "missed": "2", "solver": "fine"}
    assert statuses() == (b"\0", "starting", usual)
    adapter.step.note(Level.WARN, "late", "it is late")
    adapter.step.note(Level.WARN, "late", "it is late")
    assert statuses() == (b"\1", "starting", usual | {"late": "2 x it is late"})
    adapter.step.note(Level.ERROR, "bad", "it is bad")
    assert statuses()[0] == b"\2"
    adapter.step.reports.clear()
    one, two = (SimpleNamespace(port=SimpleNamespace(topic=t), refused=0, last_refusal="") for t in "ab")
    adapter.inputs, adapter.paces = [one], [two]
    assert statuses() == (b"\0", "starting", usual | {"refused a": "0"})
    two.refused, two.last_refusal = 3, "bad stamp"
    assert statuses() == (b"\2", "bad stamp", usual | {"refused a": "0", "refused b": "3"})
    one.refused, one.last_refusal = 1, "bad value"
    assert statuses()[1:] == ("bad value", usual | {"refused a": "1", "refused b": "3"})


def test_the_services_and_topics_of_a_node_follow_from_its_block_and_its_rig():
    node, *_ = face(Gain())
    offered = {t for t in node.topics if not t.endswith(" offered")}
    assert offered == {"/diagnostics"}
    assert node.services == {}
    plant, _, adapter, shown = face(Lag(), links={"owns_clock": True, "base": "0.01"}, frames=False)
    assert set(plant.services) >= {"~/kick", "~/pause", "~/resume", "~/step"}
    assert {"~/offset"}.isdisjoint(plant.services)
    answer = plant.services["~/kick"](None, SimpleNamespace())
    assert (answer.success, answer.message, adapter.values["kick"]) == (True, "kick pressed", (1.0,))
    answer = plant.services["~/pause"](None, SimpleNamespace())
    assert (answer.success, answer.message) == (False, "this node has not begun")
    assert shown._executor is None
    linked, *_ = face(Lag(), links={"base": "0.01", "inputs": {"kick": {"period": "0.01", "node": "other"}}})
    assert linked.services == {}  # another node has the button
    assert face(Lag(), "realtime")[3]._executor is not None


class Arm(Block):
    """A body at the end of a joint."""

    OUTPUTS = (joint_state("state", "state", ["a", "b"], position="rad", velocity="rad/s"),)

    @classmethod
    def scene(cls, params):
        return SimpleNamespace(
            port="state",
            base="base",
            description="",
            fixed=lambda: [Pose("world", "base", (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))],
            moving=lambda q: [Pose("base", "tip", (q[0], q[1], 0.0), (0.0, 0.0, 0.0, 1.0))],
        )


def test_moving_frames_are_published_once_a_tick_in_the_form_of_ros():
    node, hand, adapter, _ = face(Arm())

    def read(data):
        message = STORE.deserialize_cdr(bytes(data), "tf2_msgs/msg/TFMessage")
        return [
            (
                t.header.stamp.sec,
                t.header.stamp.nanosec,
                t.header.frame_id,
                t.child_frame_id,
                t.transform.translation.x,
                t.transform.translation.y,
                t.transform.translation.z,
                t.transform.rotation.w,
            )
            for t in message.transforms
        ]

    stands = [t for data in node.topics["/tf_static"] for t in read(data)]
    assert (0, 0, "world", "base", 0.0, 0.0, 1.0, 1.0) in stands
    move = next(t for t in hand.timers if t.call.__name__ == "_move")
    assert move.asked == [(1_000_000_000 // 30, 0)]
    adapter.epoch, adapter.step.t, adapter.step.last_answer = 1_700_000_000_000_000_000, 5, ((1.0, 2.0, 3.0, 4.0),)
    move.call()
    adapter.state = "running"
    move.call()
    assert node.topics["/tf"] == []  # nothing is published without a subscriber
    node.readers["/tf"] = 1
    for _ in range(2):
        move.call()
    (data,) = node.topics["/tf"]
    assert read(data) == [(1_700_000_000, 5, "base", "tip", 1.0, 2.0, 0.0, 1.0)]
    adapter.step.last_answer, adapter.step.t = (), 6
    move.call()
    assert len(node.topics["/tf"]) == 1
    two = frames.encode(7, [Pose("a", "bc", (1.0, 2.0, 3.0), (0.1, 0.2, 0.3, 0.4))] * 2)
    assert [t[:5] for t in read(two)] == [(0, 7, "a", "bc", 1.0)] * 2
    assert (
        bytes(STORE.serialize_cdr(STORE.deserialize_cdr(two, "tf2_msgs/msg/TFMessage"), "tf2_msgs/msg/TFMessage"))
        == two
    )
    for options in ({"frames": False}, {"links": {"base": "0.01"}}):  # frames are off, or the rig has other nodes
        assert "/tf_static" not in face(Arm(), **options)[0].topics
    assert "/tf_static" in face(Arm(), links={"base": "0.01", "public": True})[0].topics


# ---- parameters of a running node ----


def test_sets_are_applied_at_the_next_tick_all_or_none():
    node, _hand, adapter, _ = face(Lag(gain=2.0))
    tuning = Tuning(node, adapter)
    node.remark = ""
    (set_them,) = node.callbacks

    def set_from_outside(**values):
        result = set_them([Parameter(name.replace("__", "."), value=value) for name, value in values.items()])
        return result.successful, result.reason

    assert set_from_outside(run__seed=3) == (True, "")  # this parameter belongs to the node, not to its block
    assert set_from_outside(run__pace=2.0) == (
        False,
        "run.pace can be set only at the node of the clock, in lockstep, after the start",
    )
    done, reason = set_from_outside(gain=3.0)
    assert (done, "gain" in reason) == (False, True)  # this parameter is not live
    assert not adapter.step.changes
    adapter.step.set = lambda values: [*values] if values.get("gain") == 4.0 else []
    assert set_from_outside(gain=5.0) == (True, "")
    assert node.remark == ""
    assert set_from_outside(gain=4.0, limit=1.0) == (True, "")
    assert node.remark == "in place of gain, limit that was set before and had not taken effect"
    assert set_them([Parameter("gain", Parameter.Type.NOT_SET)]).reason == "parameter gain has no value, expected one"

    def refuse(values):
        raise ParameterError("no")

    adapter.step.set = refuse
    assert set_from_outside(gain=1.0) == (False, "no")
    for state in ("done", "failed"):
        adapter.state = state
        assert set_from_outside(gain=1.0) == (False, "the run is over")
    assert tuning is not None


class Serving(ServingNode):
    """The part of a node that accepts sets of parameters."""

    def __init__(self, **values):
        self._parameters = {n: Parameter(n, value=v) for n, v in values.items()}
        self._parameters["empty"] = Parameter("empty", Parameter.Type.NOT_SET)
        self._descriptors = {n: SimpleNamespace(floating_point_range=[], type=0) for n in self._parameters}
        self._descriptors["empty"].floating_point_range = [1]
        self.reserved, self.refuses = [], ()

    def get_name(self):
        return "law"

    def set_parameters_atomically(self, new):
        self.reserved.append({p.name: p.value for p in new})
        good = not any(p.name in self.refuses for p in new)
        return SimpleNamespace(successful=good, reason="" if good else "refused")

    def ask(self, **values):
        self.reserved.clear()
        results = self._set([Parameter(n, value=v).to_parameter_msg() for n, v in values.items()])
        return [r.successful for r in results], [r.reason for r in results], [*self.reserved]


def test_parameters_set_together_are_applied_together_or_one_by_one():
    node = Serving(k=1.0, n=3, text="a", row=[1.0, 2.0], whole=[1, 2], words=["a"])
    assert node.ask(k=2.0, n=4) == ([True, True], ["", ""], [{"k": 2.0, "n": 4}])
    assert node.ask(k=1.0) == ([True], [""], [])  # the parameter has this value already
    node.refuses = ("n",)
    assert node.ask(k=2.0, n=4) == ([True, False], ["", "refused"], [{"k": 2.0, "n": 4}, {"k": 2.0}, {"n": 4}])
    assert node.ask(n=4) == ([False], ["refused"], [{"n": 4}])
    assert node.ask(kk=4) == ([False], ["'kk' is not a parameter of law (did you mean 'k'?)"], [])
    node.refuses = ()
    clocked = Serving(use_sim_time=False)
    assert clocked.ask(use_sim_time=False) == ([True], [""], [])
    assert clocked.ask(use_sim_time=True)[1][0].startswith("parameter use_sim_time is fixed from the start on")
    for name, requested, meant in (
        ("k", 2, 2.0),
        ("k", "1e-05", 1e-05),
        ("n", 2, 2),
        ("row", [1, 3], [1.0, 3.0]),
        ("row", "[1e-05, 2]", [1e-05, 2.0]),
        ("whole", [], []),
        ("empty", 3, 3.0),
        ("text", "b", "b"),
        ("row", ["1e-3", "2"], [0.001, 2.0]),
    ):
        actual = node.ask(**{name: requested})[2]
        assert [{k: plain(Parameter(k, value=v)) if v != [] else [] for k, v in f.items()} for f in actual] == [
            {name: meant}
        ]
    node.remark = "of a set before"
    assert node.ask(k=7.0)[1] == [""]
    assert node.ask(empty="None")[2] == []  # `ros2 param dump` writes None for a parameter without a value
    assert node.ask(k="many") == ([False], ["parameter k = 'many': expected a number"], [])
    assert node.ask(n=4.0)[2] == [{"n": 4}]
    assert node.ask(n=4.5) == ([False], ["parameter n = 4.5: expected a whole number"], [])
    assert node.ask(words=["a"])[2] == []
    (result,) = node._set([Parameter("k", value=5.0).to_parameter_msg()], wait=5.0)
    assert (result.successful, result.reason) == (
        False,
        "more is set than fits between the ticks, expected a pause of 5.0 s",
    )
    assert [plain(Parameter("a", value=v)) for v in (1, 2.0, "x", True, [1.0, 2.0], [True])] == [
        1,
        2.0,
        "x",
        True,
        [1.0, 2.0],
        [True],
    ]
    assert guessed("[1, 2]").type == 7
    assert guessed(None).string_value == "None"


# ---- timers and callbacks ----


def test_a_callback_is_silent_only_after_ros_has_been_shut_down(monkeypatch):
    def fail(data):
        raise ros.RCLError("no context")

    up = [True]
    monkeypatch.setattr(ros.rclpy, "ok", lambda: up[0])
    call = quiet_after_shutdown(fail)
    with pytest.raises(ros.RCLError):
        call(b"")
    up[0] = False
    assert call(b"") is None

    def other(data):
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        quiet_after_shutdown(other)(b"")
    received = []
    accept = with_number(lambda data: received.append(data), received.append)
    accept(b"a", {"publication_sequence_number": 4})
    accept((b"b", {"publication_sequence_number": None}))
    assert received == [4, b"a", None, b"b"]
    assert [*accept.__signature__.parameters] == ["data", "info"]


class RclTimer:
    """A timer of rclpy, in a time that the test moves."""

    def __init__(self):
        self.now, self.due, self.timer_period_ns, self.resets = 0, None, 1, 0

    def reset(self):
        self.due, self.resets = self.now + self.timer_period_ns, self.resets + 1

    def cancel(self):
        self.due = None

    def time_until_next_call(self):
        return None if self.due is None else self.due - self.now


def test_a_timer_with_its_period_is_shifted_and_not_reset():
    """So that the call after the next one is at the requested time within whole periods; none is doubled."""
    inner = RclTimer()
    timer = ros.RosTimer(inner)
    timer.again(5000)
    assert (inner.due, inner.timer_period_ns, inner.resets) == (5000, 5000, 1)
    timer.again(2, 10_000)
    assert (inner.due, inner.timer_period_ns, inner.resets) == (1000, 10_000, 2)
    draw = random.Random(4)
    for _ in range(200):
        left, ns = draw.randrange(-3_000, 10_001), draw.choice([draw.randrange(20_000), 10_000, 5_000])
        inner.due = inner.now + left
        timer.again(ns, 10_000)
        assert (left + inner.timer_period_ns - ns) % 10_000 == 0
        assert 5_000 <= inner.timer_period_ns < 15_000
    assert inner.resets == 2
    for period, resets in ((20_000, 3), (0, 4), (0, 5), (20_000, 6)):
        timer.again(300, period)
        assert inner.resets == resets
    timer.cancel()
    timer.again(300, 20_000)
    assert (inner.resets, inner.due, inner.timer_period_ns) == (7, 1000, 20_000)


# ---- one node of rclpy's behind the seam ----


class Rcl:
    """The part of rclpy's node that is used."""

    def __init__(self, **overrides):
        self._parameter_overrides = {k.replace("__", "."): SimpleNamespace(value=v) for k, v in overrides.items()}
        self.monitor, self.made, self.timers, self._subscriptions, self.publishers = (
            Monitor(lambda: None),
            [],
            [],
            [],
            [],
        )
        self.waitables = []

    def get_name(self):
        return "law"

    def get_fully_qualified_name(self):
        return "/rig/law"

    def resolve_topic_name(self, topic):
        return topic if topic.startswith("/") else f"/rig/{topic}"

    def create_publisher(self, kind, topic, profile, **options):
        self.published = []
        made = SimpleNamespace(
            handle=SimpleNamespace(publish_raw=self.published.append), topic_name=topic, profile=profile, **options
        )
        self.made.append(made)
        return made

    def create_subscription(self, kind, topic, accept, profile, **options):
        made = SimpleNamespace(
            topic_name=topic, take=accept, profile=profile, event_handlers=[f"event of {topic}"], **options
        )
        self._subscriptions.append(made)
        return made

    timer = ServingNode.timer

    def serve_by(self, timer):
        """Answer no requests."""

    def create_timer(self, seconds, call, clock):
        timer = RclTimer()
        timer.seconds, timer.call = seconds, call
        self.timers.append(timer)
        return timer

    def add_waitable(self, what):
        self.waitables.append(what)

    def remove_waitable(self, what):
        self.waitables.remove(what)


def reported(qos, port):
    """What is logged of QoS parameters by a node that publishes one topic."""
    node, lines = Rcl(**qos), []
    middleware = RosMiddleware(node)
    middleware.log = lambda level, text: lines.append(text)
    middleware.sender("t", port.layout(), lines.append)
    middleware.report_ignored()
    return lines


def test_bytes_are_sent_only_while_there_is_a_subscriber_except_to_latched_topics():
    port = number("a", "t", "V")
    for options, always in (({}, False), ({"qos_overrides____rig__t__publisher__depth": 5}, True)):
        node = Rcl(**{k.replace("____", "__/").replace("/rig__t", "/rig/t"): v for k, v in options.items()})
        middleware, seen = RosMiddleware(node), []
        assert (middleware.name, middleware.full_name, middleware.mute) == ("law", "/rig/law", not always)
        send = middleware.sender("t", port.layout(), seen.append)
        (made,) = node.made
        assert (made.qos_overriding_options is not None) is always
        assert made.profile.depth == 10
        send(0, (1.5,))
        assert node.published == ([port.layout().encode(0, (1.5,))] if always else [])
        node.published.clear()
        made.event_callbacks.matched(SimpleNamespace(current_count=2))
        send(0, (2.5,))
        assert node.published == [port.layout().encode(0, (2.5,))]
        made.event_callbacks.matched(SimpleNamespace(current_count=0))
        assert seen == [2, 0]
    (line,) = reported({"qos_overrides./rig/t.publisher.depth": 5, "qos_overrides./rig/u.publisher.depth": 5}, port)
    assert line == (
        "parameter qos_overrides./rig/u.publisher.depth is ignored: it fits no topic and policy of this node "
        "(did you mean 'qos_overrides./rig/t.publisher.depth'?)"
    )
    (line,) = reported({"qos_overrides./x": 5}, port)
    assert line.endswith("of this node; this node has qos_overrides./rig/t.publisher.")
    assert reported({"qos": 5}, port) == []
    lockstep = Rcl(run__mode="lockstep")
    RosMiddleware(lockstep).publisher("t", port.msgtype, seen.append)
    assert lockstep.made[0].profile.depth == 200
    real = Rcl(run__mode="realtime")
    RosMiddleware(real).publisher("t", port.msgtype, seen.append)
    assert real.made[0].profile.depth == 10


def test_messages_are_processed_in_the_receiving_thread_on_request_and_not_after_the_end_of_the_node(monkeypatch):
    node = Rcl()
    middleware, received, arrivals = RosMiddleware(node), [], []

    class Arrives:
        def __init__(self, rcl, subscription, receive, matched, arrive):
            self.subscription, self.arguments, self.log = subscription, (rcl, receive, matched, arrive), []
            arrivals.append(self)

        def begin(self):
            self.log.append("begin")

        def end(self):
            self.log.append("end")

        def report_writers(self):
            self.log.append("report_writers")

    monkeypatch.setattr(ros, "Arrival", Arrives)
    monkeypatch.setattr(ros, "Garbage", lambda off: SimpleNamespace(step=lambda: received.append(("garbage", off))))
    processors = []

    def processor(*arguments):
        processors.append(arguments)
        return SimpleNamespace(step=lambda: received.append("processor"), number=3)

    monkeypatch.setattr(ros, "Processor", processor)
    middleware.subscribe("a", "std_msgs/msg/Float64", Listening(received.append, received.append))
    middleware.subscribe("own", "std_msgs/msg/Float64", Listening(received.append, received.append))
    first, own = node._subscriptions
    assert (first.raw, first.profile.depth) == (True, 10)
    first.take(b"x")
    first.event_callbacks.matched(SimpleNamespace(current_count=2))
    assert received == [b"x", 2]
    node.publishers = [SimpleNamespace(topic_name="own", wait_for_all_acked=lambda limit: received.append(limit))]
    node.waitables = [*first.event_handlers, *own.event_handlers]
    monkeypatch.setattr(ros, "library", lambda: None)
    middleware.be_prompt("together")
    assert (middleware.prompt, arrivals, middleware.processor) == (False, [], None)
    monkeypatch.setattr(ros, "library", lambda: "rcl")
    monkeypatch.setenv("ROS_DOMAIN_ID", "6")
    middleware.be_prompt("beside")
    (one,) = arrivals
    assert one.subscription is first
    assert one.arguments == ("rcl", received.append, received.append, node.monitor.arrive)
    assert (node._subscriptions, node.waitables) == ([own], own.event_handlers)
    assert (middleware.prompt, middleware.processor, processors[0][:2]) == (True, 3, (6, True))
    node.monitor.done = 7
    assert processors[0][2]() == 7
    assert [t.seconds for t in node.timers] == [0.02, 0.25, 0.25]
    for timer in node.timers:
        timer.call()
    assert received[2:] == [("garbage", True), "processor"]
    assert one.log == ["begin", "report_writers"]
    middleware.publisher("more", "std_msgs/msg/Float64", received.append)
    assert one.log[2:] == ["end", "begin"]  # reports pause while an endpoint is created
    middleware.close()
    assert one.log[4:] == ["end"]
    assert (node._subscriptions, node.waitables) == ([own, first], [*own.event_handlers, *first.event_handlers])
    assert node.monitor.closed
    del received[:]
    middleware.drain()
    assert received[0].nanoseconds == pytest.approx(10e9, abs=1e9)
    paused = Rcl()
    monkeypatch.setattr(paused.monitor, "close", lambda patience: received.append(patience))
    with pytest.raises(ros.RunError, match="a tick has not come to its end within 2 s"):
        RosMiddleware(paused).close()
    assert received[-1] == 2.0
    anywhere = RosMiddleware(Rcl())
    anywhere.subscribe("a", "std_msgs/msg/Float64", Listening(received.append, received.append))
    anywhere.node.waitables = ["event of a"]
    anywhere.be_prompt("anywhere")
    assert (len(processors), anywhere.prompt, len(anywhere.node.timers)) == (1, True, 2)


def test_posted_calls_are_made_by_the_executor_in_their_turn():
    """No timer makes them: with one that is always due, this executor would check all timers more and more often."""
    node, log = Rcl(), []
    tasks = []
    node.executor = SimpleNamespace(create_task=tasks.append)
    middleware = RosMiddleware(node)
    middleware.post(lambda: (log.append("a"), middleware.post(lambda: log.append("c"))))
    middleware.post(lambda: log.append("b"))
    (task,) = tasks
    task()
    assert (log, len(tasks)) == (["a", "b"], 2)
    tasks[1]()
    assert (log, len(tasks), node.timers) == (["a", "b", "c"], 2, [])
    now = time.time_ns()
    assert abs(middleware.now() - now) < 10**9
    assert abs(middleware.steady() - time.monotonic()) < 1.0


def test_the_graph_is_reported_by_endpoints_and_incompatible_subscribers_are_named(monkeypatch):
    def end(name, kind="a/msg/B", **profile):
        return {"node_name": name, "node_namespace": "/rig", "topic_type": kind, "qos_profile": profile}

    reliable, best = (ros.ReliabilityPolicy.RELIABLE, ros.ReliabilityPolicy.BEST_EFFORT)
    writers = [end("law", depth=1, reliability=best), end("other", depth=1, reliability=reliable)]
    readers = [
        end("a", depth=1, reliability=reliable),
        end("b", depth=1, reliability=best),
        end("c", "x", depth=1, reliability=reliable),
    ]
    result = SimpleNamespace(
        rclpy_get_publishers_info_by_topic=lambda handle, topic, mangled: (
            writers if (topic, mangled) == ("/t", False) else []
        ),
        rclpy_get_subscriptions_info_by_topic=lambda handle, topic, mangled: readers if topic == "/t" else [],
    )
    monkeypatch.setattr(uses, "_c", lambda: result)
    node = Rcl()
    node.handle = nullcontext()
    middleware = RosMiddleware(node)
    assert middleware.publishers("/t") == [Peer("law", "/rig", "a/msg/B"), Peer("other", "/rig", "a/msg/B")]
    node.handle = nullcontext()
    assert [p.name for p in middleware.subscribers("/t")] == ["a", "b", "c"]
    ((name, why),) = middleware.unfit("/t", "a/msg/B")
    assert (name, "reliab" in why.lower(), "ERROR" in why, why[-1] != ";") == ("a", True, False, True)
    assert middleware.unfit("/u", "a/msg/B") == []
    node.get_subscriber_names_and_types_by_node = lambda name, space: [(f"{space}/{name}", ["x"])]
    assert middleware.subscriptions_of(Peer("a", "/rig", "")) == ["/rig/a"]

    def unknown(name, space):
        raise ros.NodeNameNonExistentError

    node.get_subscriber_names_and_types_by_node = unknown
    assert middleware.subscriptions_of(Peer("a", "/rig", "")) == []
    node.get_topic_names_and_types = lambda: [("/t", ["x"])]
    assert middleware.topics() == {"/t": ["x"]}
    monkeypatch.setattr(middleware, "_ears", SimpleNamespace(lost=lambda: "fastrtps_port7"), raising=False)
    assert (
        middleware.deaf()
        == "receives no messages any more: its port fastrtps_port7 in shared memory was removed by another process"
    )
    middleware._ears = SimpleNamespace(lost=lambda: "")
    assert middleware.deaf() == ""


# ---- a container ----


def test_in_a_container_messages_pass_through_its_queue_and_are_sent_only_to_external_subscribers():
    node, exchange = Rcl(), Exchange()
    middleware, log = ContainedMiddleware(node, exchange), []
    publish = middleware.publisher("t", "std_msgs/msg/Float64", log.append)
    publish(b"a")
    node.made[0].event_callbacks.matched(SimpleNamespace(current_count=1))
    publish(b"b")
    exchange.flush()
    assert (node.published, log) == ([b"b"], [1])
    middleware.subscribe("u", "std_msgs/msg/Float64", Listening(log.append, log.append))
    (subscription,) = node._subscriptions
    subscription.event_callbacks.matched(SimpleNamespace(current_count=2))
    assert (exchange.listens, log) == (True, [1, 2])
    subscription.take(b"c")
    assert log == [1, 2]
    exchange.serve(0)
    assert log == [1, 2, b"c"]
    assert "law" in exchange.owners.values()
    middleware.post(lambda: log.append("posted"))
    exchange.serve(0)
    assert log[-1] == "posted"
    timer = middleware.timer(5000, lambda: None)
    assert timer.period == 5000
    middleware.be_prompt("together")
    assert not middleware.prompt
    assert contained._noting(log.append)([0], 4) is None
    assert log[-1] == 4


def test_in_a_container_in_real_time_a_native_thread_publishes_and_is_waited_for():
    node, set_from_outside, drained = Rcl(), [], []
    carrier = SimpleNamespace(
        sender=lambda publisher: lambda data: set_from_outside.append((publisher.topic_name, data)),
        drain=lambda: drained.append(len(set_from_outside)),
    )
    middleware = ContainedMiddleware(node, Exchange(), carrier)
    publish = middleware.publisher("t", "std_msgs/msg/Float64", lambda count: None)
    publish(b"nobody reads it")
    node.made[0].event_callbacks.matched(SimpleNamespace(current_count=1))
    publish(b"a")
    assert set_from_outside == [(node.made[0].topic_name, b"a")]
    assert node.published == []
    node.publishers = []
    middleware.drain()
    assert drained == [1]


class Turns:
    """A container in a time that the test moves; each turn of the executor takes its full limit."""

    def __init__(self, monkeypatch, listens=False):
        self.now, self.spun, self.served, self.steps, self.script = 10**9, [], [], 0, {}
        self.container = Container()
        self.container.exchange = SimpleNamespace(listens=listens, serve=self._serve)
        self.container.adapters = [SimpleNamespace(state="running", name=n) for n in "ab"]
        monkeypatch.setattr(
            containers, "time", SimpleNamespace(monotonic_ns=lambda: self.now, monotonic=lambda: self.now / 1e9)
        )
        monkeypatch.setattr(containers, "Garbage", lambda: SimpleNamespace(step=self._step))
        monkeypatch.setattr(containers, "rclpy", SimpleNamespace(ok=lambda: self.ok))
        self.ok, self.rest = True, 0

    def _step(self):
        self.steps += 1

    def _serve(self, until, awake):
        self.served.append((until - self.now, awake))
        self.now += 20_000_000
        for at in sorted(self.script):
            if self.now >= 10**9 + at:
                self.script.pop(at)()
        return self.rest

    def run(self):
        return self.container._loop(SimpleNamespace(spin_once=self.spun.append))


def test_a_container_runs_until_all_nodes_have_ended_or_one_has_failed_for_a_second(monkeypatch):
    turns = Turns(monkeypatch)
    a, b = turns.container.adapters
    turns.script = {
        300_000_000: lambda: setattr(a, "state", "done"),
        500_000_000: lambda: setattr(b, "state", "failed"),
    }
    assert turns.run()
    assert turns.now == 10**9 + 500_000_000
    assert {*turns.served} == {(100_000_000, 300_000)}
    assert {*turns.spun} == {0.0}
    assert turns.steps == 4  # ten times a second
    failed = Turns(monkeypatch, listens=True)
    failed.container.adapters[0].state, failed.rest = "failed", 300_000
    assert failed.run()
    assert failed.now == 10**9 + 20_000_000 + 1_020_000_000
    assert {*failed.served} == {(100_000_000, 0)}
    assert {*failed.spun} == {0.0}  # the next timer is so close that the loop does not sleep
    stopped = Turns(monkeypatch)
    stopped.rest = 300_002
    stopped.script = {100_000_000: lambda: setattr(stopped, "ok", False)}
    assert not stopped.run()
    assert {*stopped.spun} == {(300_002 - 150_000) / 1e9}


def test_a_container_sends_pending_messages_and_waits_for_their_acknowledgement(monkeypatch):
    log, up = [], [True]

    def adapter(name, state):
        drain = SimpleNamespace(name=name, drain=lambda: log.append(f"drain {name}"))
        return SimpleNamespace(state=state, middleware=drain)

    monkeypatch.setattr(containers, "rclpy", SimpleNamespace(ok=lambda: up[0]))
    for happens, expected in (
        (True, ["a", "b", "loop", "flush", "drain a", "ends"]),
        (False, ["a", "b", "loop", "flush", "drain a", "stopped"]),
        (KeyboardInterrupt(), ["a", "b", "loop", "stopped"]),
        (containers.ExternalShutdownException(), ["a", "b", "loop", "stopped"]),
        (ValueError("no"), ["a", "b", "loop", "broke no", "ends"]),
        # The error is that of a context which a signal has shut down.
        (OSError("late"), ["a", "b", "loop", "stopped"]),
    ):

        def loop(executor, happens=happens):
            log.append("loop")
            if isinstance(happens, BaseException):
                raise happens
            return happens

        log.clear()
        up[0] = not isinstance(happens, OSError)
        container = Container()
        container.nodes, container._loop = ["a", "b"], loop
        container.adapters = [adapter("a", "done"), adapter("b", "failed")]
        container.exchange = SimpleNamespace(flush=lambda: log.append("flush"))
        container._broke = lambda error: log.append(f"broke {error}")
        container._conclude = lambda stopped: log.append("stopped" if stopped else "ends") or 4
        monkeypatch.setattr(
            "rclpy.experimental.events_executor.EventsExecutor", lambda: SimpleNamespace(add_node=log.append)
        )
        assert container.run() == 4
        assert log == expected


def test_the_garbage_collector_runs_rarely_while_it_finds_nothing():
    class Collector:
        matched, log = 0, []

        def collect(self, of=2):
            self.log.append(f"collect {of}")
            return self.matched

        def freeze(self):
            self.log.append("freeze")

        def set_threshold(self, young):
            self.log.append(f"threshold {young}")

        def disable(self):
            self.log.append("disable")

    for off, generation in ((False, 0), (True, 2)):
        gc = Collector()
        gc.log = []
        garbage = Garbage(gc, off=off)
        assert gc.log[:2] == ["collect 2", "freeze"]
        assert ("disable" in gc.log) is off
        gc.log.clear()
        for _ in range(9):
            garbage.step()
        assert gc.log == []
        garbage.step()
        assert gc.log == [f"collect {generation}", "freeze"]
        gc.log.clear()
        for _ in range(99):
            garbage.step()
        assert gc.log == ["freeze"] * 99
        gc.matched = 1
        garbage.step()
        for _ in range(10):
            garbage.step()
        assert gc.log[99:] == [f"collect {generation}"] * 2


# ---- parameters set from outside ----


class Asked:
    """The node of a user; the test decides when its clients answer."""

    def __init__(self, monkeypatch, patience=4.0):
        self.now, self.results, self.timers, self.calls, self.ready, self.future = 50.0, [], [], [], False, None
        monkeypatch.setattr(remote, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(remote, "AsyncParameterClient", lambda node, name: self._client(name))
        node = SimpleNamespace(create_client=lambda kind, name: self._client(name), create_timer=self._timer)
        node.destroy_timer = lambda timer: self.timers.remove(timer)
        self.remote = remote.Remote(node, lambda *message: self.results.append(message), patience)

    def _timer(self, seconds, style):
        assert seconds == 0.01
        timer = SimpleNamespace(look=style)
        self.timers.append(timer)
        return timer

    def _client(self, name):
        self.calls.append(name)
        is_ready = lambda: self.ready  # noqa: E731

        def call(what):
            self.calls.append(what)
            return SimpleNamespace(done=lambda: self.future is not None, result=lambda: self.future)

        return SimpleNamespace(
            services_are_ready=is_ready,
            service_is_ready=is_ready,
            call_async=lambda request: call("press"),
            set_parameters_atomically=lambda p: call({x.name: x.value for x in p}),
        )

    def look(self, seconds=0.0):
        self.now += seconds
        for timer in [*self.timers]:
            timer.look()
        return self.results.pop() if self.results else None


def test_a_set_or_a_press_is_answered_after_the_node_and_a_silent_node_is_named(monkeypatch):
    asked = Asked(monkeypatch)
    asked.remote.ask({"id": 7, "node": "law", "set": {"k": 3.0, "n": 2}})
    assert asked.look(4.0) is None
    asked.ready = True
    assert asked.look() is None
    assert asked.calls == ["law", {"k": 3.0, "n": 2}]
    assert asked.look(9.9) is None
    asked.future = SimpleNamespace(result=SimpleNamespace(successful=False, reason="too large"))
    assert asked.look() == (7, False, "too large")
    assert asked.timers == []
    asked.future = SimpleNamespace(success=True, message="kick pressed")
    for number_ in (8, 9):
        asked.remote.ask({"id": number_, "node": "plant", "call": "kick"})
        assert asked.look() == (number_, True, "kick pressed")
    assert asked.calls[2:] == ["plant/kick", "press", "press"]  # one client serves all calls of a service
    asked.remote.ask({"id": 1, "node": "law", "set": {"k": 1.0}})
    asked.future = None
    assert asked.look() is None
    assert asked.look(10.1) == (1, None, "law does not answer")
    asked.ready = False
    asked.remote.ask({"id": 2, "node": "law", "set": {"k": 1.0}})
    assert asked.look(4.1) == (2, None, "no node law within 4 s")
    asked.ready, asked.future = True, SimpleNamespace()
    asked.remote.ask({"id": 3, "node": "law", "set": {"k": 1.0}})
    assert asked.look()[:2] == (3, False)
    for request, message in (
        ({"id": 4, "set": {}}, "'node'"),
        ({"id": 5, "node": "law"}, "'call'"),
        (
            {"id": 6, "node": "law", "set": {"k": 2**63}},
            "a whole number of 64 bits, expected at most 63, or a real one",
        ),
        (
            {"id": 6, "node": "law", "set": {"k": [1, -(2**63) - 1]}},
            "a whole number of 64 bits, expected at most 63, or a real one",
        ),
    ):
        asked.remote.ask(request)
        assert asked.results.pop() == (request["id"], False, message)
    asked.remote.ask({"id": 6, "node": "law", "set": {"k": 2**63 - 1, "n": [-(2**63)]}})
    assert len(asked.timers) == 1


# ---- below rclpy ----


class FakeRcl:
    """The functions of rcl that are called by themselves, over a queue of messages."""

    def __init__(self):
        self.queue, self.code, self.counts_reported, self.resets, self.writers, self.kept = [], 0, [], 0, 0, []

    def rcutils_get_default_allocator(self):
        return arrival._Allocator()

    def _room(self, where, size):
        self.kept.append((ctypes.c_uint8 * size)())
        where._obj.buffer, where._obj.capacity = ctypes.addressof(self.kept[-1]), size

    def rcutils_uint8_array_init(self, where, size, allocator):
        self._room(where, size.value)
        return self.code

    def rcl_take_serialized_message(self, reader, where, info, allocation):
        assert (reader.value, info, allocation) == (77, None, None)
        if self.code or not self.queue:
            return self.code or 401
        data = self.queue.pop(0)
        if len(data) > where._obj.capacity:
            self._room(where, len(data))
        ctypes.memmove(where._obj.buffer, data, len(data))
        where._obj.length = len(data)
        return 0

    def rcl_subscription_set_on_new_message_callback(self, reader, call, data):
        assert (reader.value, data) == (77, None)
        self.call = call
        return self.code

    def rcl_subscription_get_publisher_count(self, reader, counted):
        counted._obj.value = self.writers
        return self.code

    def rcutils_reset_error(self):
        self.resets += 1


def test_messages_are_passed_on_unchanged_whatever_their_length(monkeypatch):
    rcl, received, matched, ensured, up = FakeRcl(), [], [], [], [True]
    monkeypatch.setattr(arrival.ctypes.pythonapi, "PyGILState_Ensure", lambda: ensured.append(1))
    monkeypatch.setattr(arrival, "rclpy", SimpleNamespace(ok=lambda: up[0]))
    subscription = SimpleNamespace(handle=SimpleNamespace(pointer=77), topic_name="/t")
    works = []
    one = arrival.Arrival(rcl, subscription, received.append, matched.append, works.append)
    one.begin()
    # One message fills the buffer of 4096 bytes, the next exceeds it.
    messages = [b"a", b"", bytes(range(256)) * 16, bytes(range(256)) * 17, b"end"]
    rcl.queue += messages
    for count in (2, 0, 3):
        rcl.call(None, count)
    assert (len(works), len(ensured)) == (5, 1)  # checked once in each thread
    for work in works:
        work()
    works[0]()  # a newer request has replaced this one, so the call has no effect
    assert (received, rcl.resets) == (messages, 0)
    for writers, reported in ((0, []), (2, [2]), (2, [2]), (1, [2, 1])):
        rcl.writers = writers
        one.report_writers()
        assert matched == reported
    one.end()
    assert not rcl.call
    rcl.code = 5
    one.report_writers()
    assert (matched, rcl.resets) == ([2, 1], 1)
    for call, message in (
        (works[0], "a message cannot be received (rcl reports 5)"),
        (one.begin, "cannot be notified of its messages"),
    ):
        with pytest.raises(ros.RCLError) as error:
            call()
        assert str(error.value) == f"/t: {message}"
    assert rcl.resets == 3
    with pytest.raises(MemoryError, match="4096 bytes for messages on /t"):
        arrival.Arrival(rcl, subscription, received.append, matched.append, works.append)
    rcl.code = 0

    def publish(data):
        raise ros.RCLError("shut down")

    failing = arrival.Arrival(rcl, subscription, publish, matched.append, works.append)
    failing.begin()
    rcl.queue += [b"x", b"y"]
    rcl.call(None, 1)
    with pytest.raises(ros.RCLError):
        works[-1]()
    up[0] = False
    works[-1]()  # the context was shut down by a signal


def text(sequence):
    return ctypes.string_at(sequence.data, sequence.size).decode()


def test_the_type_of_frames_is_described_as_that_of_tf2_msgs():
    """From the sources of ros2/geometry2; sizes of the structures as the headers of rosidl have them on 64 bits."""
    from geometry_msgs.msg import TransformStamped

    sizes = {tf_message.Handle: 48, tf_message.Callbacks: 56, tf_message.Member: 112, tf_message.Members: 64,
             tf_message.Sequence: 24, tf_message.Field: 96, tf_message.Individual: 48, tf_message.Description: 72,
             tf_message.Source: 72, tf_message.Hash: 33}  # fmt: skip
    assert {kind: ctypes.sizeof(kind) for kind in sizes} == sizes
    made = tf_message.tf_class()
    assert tf_message.tf_class() is made
    assert (made.__name__, type(made).__name__) == ("TFMessage", "Metaclass_TFMessage")
    handle = type(made)._support.handle
    own = ctypes.cast(handle.description(0), ctypes.POINTER(tf_message.Description))[0]
    assert text(own.own.name) == "tf2_msgs/msg/TFMessage"
    (field,) = ctypes.cast(own.own.fields.data, ctypes.POINTER(tf_message.Field))[: own.own.fields.size]
    assert (text(field.name), field.type_id, field.capacity, field.string_capacity) == ("transforms", 145, 0, 0)
    assert (text(field.nested), text(field.default)) == ("geometry_msgs/msg/TransformStamped", "")
    referenced = ctypes.cast(own.referenced.data, ctypes.POINTER(tf_message.Individual))[: own.referenced.size]
    assert [text(one.name) for one in referenced] == [
        "builtin_interfaces/msg/Time",
        *(f"geometry_msgs/msg/{name}" for name in ("Quaternion", "Transform", "TransformStamped", "Vector3")),
        "std_msgs/msg/Header",
    ]
    sources = ctypes.cast(handle.sources(0), ctypes.POINTER(tf_message.Sequence))[0]
    first, *others = ctypes.cast(sources.data, ctypes.POINTER(tf_message.Source))[: sources.size]
    assert (text(first.name), text(first.encoding)) == ("tf2_msgs/msg/TFMessage", "msg")
    assert text(first.text) == "geometry_msgs/TransformStamped[] transforms\n"
    assert {text(one.name) for one in others} == {text(one.name) for one in referenced}
    reported = ctypes.cast(handle.hash(0), ctypes.POINTER(tf_message.Hash))[0]
    assert (reported.version, bytes(reported.value).hex()) == (1, tf_message.HASH)
    handle_read = tf_message.Handle.from_address(pointer_of(type(TransformStamped)._TYPE_SUPPORT))
    assert handle.identifier == handle_read.identifier

    def matched(name):
        where = handle.find(0, name)
        return None if not where else tf_message.Handle.from_address(where)

    assert matched(b"rosidl_typesupport_other") is None
    fast, introspected = (matched(f"rosidl_typesupport_{kind}".encode()) for kind in ("fastrtps_c", "introspection_c"))
    names = tf_message.Callbacks.from_address(fast.data)
    assert (names.namespace, names.name) == (b"tf2_msgs::msg", b"TFMessage")
    members = tf_message.Members.from_address(introspected.data)
    assert (members.namespace, members.name, members.count) == (b"tf2_msgs__msg", b"TFMessage", 1)
    assert (members.size, members.has_key) == (24, False)
    member = members.members[0]
    assert (member.name, member.type_id, member.string_bound, member.is_key) == (b"transforms", 18, 0, False)
    assert (member.is_array, member.array_size, member.is_bounded, member.offset) == (True, 0, False, 0)
    for use in ("_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE"):
        with pytest.raises(
            TypeError, match="tf2_msgs/msg/TFMessage without tf2_msgs: only bytes are published and taken"
        ):
            getattr(type(made), use)(None)


def pointer_of(capsule):
    name, pointer = ctypes.pythonapi.PyCapsule_GetName, ctypes.pythonapi.PyCapsule_GetPointer
    name.restype, name.argtypes = ctypes.c_char_p, [ctypes.py_object]
    pointer.restype, pointer.argtypes = ctypes.c_void_p, [ctypes.py_object, ctypes.c_char_p]
    return pointer(capsule, name(capsule))


def test_a_set_that_is_refused_for_lack_of_time_is_reported():
    node, _hand, adapter, shown = face(Lag(gain=2.0))
    node.readers["/diagnostics"] = 1
    Tuning(node, adapter)
    serving = Serving(k=1.0)
    serving.overdrawn = node.overdrawn
    assert not serving._set([Parameter("k", value=2.0).to_parameter_msg()], wait=5.0)[0].successful
    node.dropped()
    node.dropped()
    shown._publish_diagnostics()
    (status,) = node.topics["/diagnostics"].pop().status
    messages = {v.key: v.value for v in status.values}
    assert messages["services"].startswith("1 x more is set than fits between the ticks")
    assert messages["answers"] == "2 x an answer is dropped: its client has left"
