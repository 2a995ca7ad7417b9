"""What a recorder subscribes to, writes and reports, and how a tool's session waits: with a graph that the test
makes.
"""

import errno
from types import SimpleNamespace

import pytest
from rclpy.duration import Duration
from rclpy.event_handler import QoSSubscriptionEventType as Event
from rclpy.qos import DurabilityPolicy, HistoryPolicy, LivelinessPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import QosDurability, QosHistory, QosLiveliness, QosReliability
from softrig_bags.content.topics import BagTopic, qos
from softrig_bags.errors import BagError
from softrig_bags.files.bag import BagWriter
from softrig_bags.files.reader import BagReader
from softrig_bags.live import recorder as recorder_module, ros
from softrig_bags.live.holds import Holds
from softrig_bags.live.recorder import Recorder
from softrig_bags.live.selection import Selection
from softrig_bags.read import read_bag
from softrig_core import RunError
from softrig_core.block.params import Declaration
from softrig_core.wire.cdr import Layout, parse

HEADER, FLOAT = "std_msgs/msg/Header", "std_msgs/msg/Float64"
BEST, RELIABLE = ReliabilityPolicy.BEST_EFFORT, ReliabilityPolicy.RELIABLE
LATCHED, VOLATILE = DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE


class Handle:
    """Messages that have arrived at a subscription and were not processed."""

    def __init__(self):
        self.waiting = []

    def __enter__(self):
        return self

    def __exit__(self, *error):
        pass

    def take_message(self, kind, raw):
        assert raw
        return (self.waiting.pop(0), None) if self.waiting else None


class Node:
    """A graph of topics (name to types) with publishers (name to node and profile)."""

    def __init__(self):
        self.topics, self.publishers, self.timers, self.errors, self.infos, self.asked = {}, {}, [], [], [], []
        self.subscriptions = {}

    def create_publisher(self, kind, topic, depth):
        return SimpleNamespace(publish=lambda message: self.asked.append(parse(HEADER, message).frame_id))

    def create_timer(self, period, call, clock):
        self.timers.append((period, call))

    def get_logger(self):
        return SimpleNamespace(error=self.errors.append, info=self.infos.append)

    def get_name(self):
        return "recorder"

    def get_fully_qualified_name(self):
        return "/recorder"

    def get_topic_names_and_types(self):
        return list(self.topics.items())

    def get_publishers_info_by_topic(self, topic):
        known = self.publishers.get(topic, ())
        return [SimpleNamespace(node_name=n, qos_profile=p, topic_type=t) for n, p, t in known]

    def create_subscription(self, kind, topic, receive, profile, raw, event_callbacks):
        assert raw
        assert event_callbacks.use_default_callbacks is False
        made = SimpleNamespace(topic=topic, callback=receive, profile=profile, msg_type=kind, handle=Handle())
        self.subscriptions[topic] = made
        return made

    def destroy_subscription(self, subscription):
        del self.subscriptions[subscription.topic]

    def publish(self, topic, msgtype, node="law", profile=None):
        types = self.topics.setdefault(topic, [])
        self.topics[topic] = sorted({*types, msgtype})
        self.publishers.setdefault(topic, []).append((node, profile or QoSProfile(depth=10), msgtype))


class Events:
    """Status events, delivered when they are polled."""

    def __init__(self, node):
        self.callbacks, self.due = {}, []

    def add(self, subscription, callbacks):
        self.callbacks[subscription.topic] = callbacks

    def remove(self, subscription):
        del self.callbacks[subscription.topic]

    def poll(self):
        for topic, event, status in self.due:
            self.callbacks[topic][event](status)
        self.due.clear()


@pytest.fixture
def made(tmp_path, monkeypatch):
    """A recorder of a graph, with its writer."""
    monkeypatch.setattr(recorder_module, "EventPoll", Events)
    monkeypatch.setattr(recorder_module, "gc", SimpleNamespace(collect=lambda: None, freeze=lambda: None))

    def make(selection=("/a", "/b", "/bare", "/two", "/odd"), stamped=False, **more):
        node, writer = Node(), BagWriter(tmp_path / "bag")
        session = SimpleNamespace(node=node, stopped=False, spin=lambda seconds: None, settle=lambda: None)
        more.setdefault("holds", Holds(1.0, lambda: 0.0))
        return Recorder(session, writer, Selection.of(selection), stamped, **more), node, writer

    return make


def header(t):
    return Layout(HEADER).encode(t, ())


def test_selected_topics_are_subscribed_as_they_appear_and_failures_are_reported(made):
    recorder, node, writer = made()
    assert [period for period, _ in node.timers] == [0.1, 0.5]
    node.publish("/a", HEADER, profile=QoSProfile(depth=3, durability=LATCHED))
    node.publish("/left", HEADER)
    node.topics["/b"] = [HEADER]  # no node publishes the topic yet
    node.publish("/two", HEADER)
    node.publish("/two", FLOAT)
    node.publish("/odd", "odd_msgs/msg/Odd")
    node.publish("/own", HEADER, node="recorder")
    recorder._discover()
    assert list(node.subscriptions) == ["/a", "/two"]
    assert (node.subscriptions["/a"].profile.durability, node.infos) == (
        LATCHED,
        [f"recording /a [{HEADER}]", f"recording /two [{HEADER}]"],
    )
    assert node.errors == [
        f"/two is not recorded as {FLOAT}: it is published as {HEADER} at the same time",
        "/odd is not recorded as odd_msgs/msg/Odd: this type is not installed here",
    ]
    assert recorder.losses() == (
        f"none counted as lost, but NOT RECORDED: /two as {FLOAT}: it is published as {HEADER} at the same time; "
        "/odd as odd_msgs/msg/Odd: this type is not installed here"
    )
    assert node.asked == [" ".join(f"/recorder:{name}" for name in ("/left", "/odd", "/own"))]
    node.publish("/b", HEADER, node="recorder")
    recorder._discover()
    assert list(node.subscriptions) == ["/a", "/two"]  # a topic that only the recorder itself publishes is not recorded
    node.publish("/b", HEADER, profile=QoSProfile(depth=10, reliability=BEST))
    recorder._discover()
    assert list(node.subscriptions) == ["/a", "/two", "/b"]
    # the reliability follows from the publishers of other nodes only
    assert node.subscriptions["/b"].profile.reliability == BEST
    assert len(node.errors) == 2
    assert [t.name for t in writer.topics] == ["/a", "/two", "/b"]
    assert writer.topics[0].offered[0].durability == QosDurability.TRANSIENT_LOCAL


def test_a_topic_whose_publisher_changes_its_type_is_subscribed_again(made, tmp_path):
    recorder, node, writer = made(stamped=True)
    node.publish("/a", HEADER)
    node.topics["/a"] = [HEADER, FLOAT]  # a subscriber expects another type
    recorder._discover()
    node.subscriptions["/a"].callback(header(0))
    node.subscriptions["/a"].handle.waiting.append(header(20))
    node.publishers["/a"] = []
    recorder._discover()
    assert recorder._types == {"/a": HEADER}
    node.publish("/a", FLOAT)
    recorder._discover()
    node.subscriptions["/a"].callback(Layout(FLOAT).encode(0, (1.0,)))
    node.publishers["/a"] = []
    node.publish("/a", "odd_msgs/msg/Odd")
    recorder._discover()  # the existing subscription stays
    node.publish("/a", HEADER)
    recorder._discover()
    node.subscriptions["/a"].callback(header(30))
    assert node.infos == [f"recording /a [{HEADER}]", f"recording /a [{FLOAT}]"]
    recorder._session.stopped = True
    recorder.run()
    assert [(t.name, t.msgtype) for t in writer.topics] == [("/a", HEADER), ("/a", FLOAT)]
    text = "/a as odd_msgs/msg/Odd: this type is not installed here"
    assert recorder.losses() == f"none counted as lost, but NOT RECORDED: {text}"
    assert writer.custom_data["not_recorded"] == text
    assert writer.count == 4


@pytest.mark.parametrize("stamped", [True, False])
def test_a_message_is_written_under_its_stamp_or_its_time_of_arrival(made, tmp_path, monkeypatch, stamped):
    now = iter((100, 200, 300, 400))
    monkeypatch.setattr(recorder_module, "time", SimpleNamespace(time_ns=lambda: next(now)))
    recorder, node, writer = made(stamped=stamped)
    node.publish("/a", HEADER)
    node.publish("/bare", FLOAT)
    recorder._discover()
    bare = Layout(FLOAT).encode(0, (1.0,))
    for topic, data in (("/bare", bare), ("/a", header(70)), ("/a", header(40)), ("/bare", bare)):
        node.subscriptions[topic].callback(data)
    writer.close()
    topics = read_bag(tmp_path / "bag").topics
    assert topics["a"].times == ([40, 70] if stamped else [200, 300])
    # A message without a stamp gets the newest stamp of all topics.
    assert topics["bare"].times == ([0, 70] if stamped else [100, 400])


def test_messages_sent_before_the_start_are_counted_by_stamps_whatever_the_bag_time(made):
    for stamped in (True, False):
        recorder, node, writer = made(stamped=stamped)
        node.publish("/a", HEADER)
        recorder._discover()
        for k in range(3, 15):
            node.subscriptions["/a"].callback(header(k * 10_000))
        assert recorder.missed == {"/a": 3}
        assert recorder.losses() == "JOINED LATE, MISSED 3: /a: 3"
        writer.close()
        for file in sorted(writer.directory.iterdir()):
            file.unlink()
        writer.directory.rmdir()


def test_losses_are_added_up_over_subscriptions_and_reported(made):
    recorder, node, writer = made()
    node.publish("/a", HEADER)
    node.publish("/b", HEADER)
    recorder._discover()
    assert (recorder.lost, recorder.losses()) == ({}, "none lost")
    events = recorder._events
    lost, unfit = Event.RCL_SUBSCRIPTION_MESSAGE_LOST, Event.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS
    events.due.append(("/a", lost, SimpleNamespace(total_count=3)))
    recorder._flush()
    assert (recorder.lost, writer.custom_data["lost"]) == ({"/a": 3}, "/a: 3")
    before = node.subscriptions["/a"]
    before.handle.waiting += [header(1), header(2)]
    node.publish("/a", HEADER, profile=QoSProfile(depth=1, reliability=BEST))
    events.due.append(("/a", unfit, None))
    recorder._flush()
    assert node.subscriptions["/a"] is not before
    assert node.subscriptions["/a"].profile.reliability == BEST
    events.due += [("/a", lost, SimpleNamespace(total_count=2)), ("/b", lost, SimpleNamespace(total_count=1))]
    recorder._flush()
    recorder._flush()
    assert recorder.lost == {"/a": 5, "/b": 1}
    assert recorder.losses() == "LOST 6: /a: 5, /b: 1"
    # each number of lost messages is reported once
    assert node.errors == ["messages lost so far: /a: 3", "messages lost so far: /a: 5, /b: 1"]
    events.due.append(("/a", unfit, None))
    recorder._flush()
    events.due.append(("/a", lost, SimpleNamespace(total_count=4)))
    recorder._flush()
    assert recorder.lost == {"/a": 9, "/b": 1}
    assert [t.name for t in writer.topics] == ["/a", "/b"]  # each topic is declared once
    writer.flush()
    assert writer.count == 2  # messages that arrived before the topic was declared
    writer.close()


def test_lost_missed_and_held_messages_are_reported_in_one_line(made):
    now = [0.0]
    recorder, node, writer = made(holds=Holds(1.0, lambda: now[0]))
    node.publish("/a", HEADER)
    recorder._discover()
    for k in range(5, 9):
        node.subscriptions["/a"].callback(header(k * 10_000))
    now[0] = 3.25
    recorder._discover()
    assert node.errors == [
        "this process was held for 3.2 s after message 4: publishers may have considered it dead; messages that "
        "they published then are neither recorded nor counted"
    ]
    assert writer.custom_data["held"] == "3.2 s after message 4"
    held = "HELD for 3.2 s after message 4: what was sent then may be missing"
    assert recorder.losses() == f"JOINED LATE, MISSED 5: /a: 5; {held}"
    recorder._events.due.append(("/a", Event.RCL_SUBSCRIPTION_MESSAGE_LOST, SimpleNamespace(total_count=2)))
    recorder._flush()
    assert recorder.losses() == f"LOST 2: /a: 2; JOINED LATE, MISSED 5: /a: 5; {held}"
    writer.close()


def test_at_a_signal_arrived_messages_are_recorded_and_the_bag_is_closed(made, tmp_path):
    recorder, node, writer = made(stamped=True)
    node.publish("/a", HEADER)
    done = []

    def settle():
        done.append("settled")
        node.subscriptions["/a"].handle.waiting += [header(k * 10_000) for k in range(2, 6)]

    def spin(seconds):
        done.append(seconds)
        recorder._session.stopped = len(done) == 2

    recorder._session.spin, recorder._session.settle = spin, settle
    recorder.run()
    assert done == [1.0, 1.0, "settled"]
    with BagReader(tmp_path / "bag") as bag:
        assert (bag.count, bag.custom_data) == (4, {"missed": "/a: 2"})
    assert writer.count == 4


def test_a_full_disk_ends_it_with_what_was_written(made, monkeypatch, tmp_path):
    recorder, node, writer = made()
    node.publish("/a", HEADER)
    recorder._discover()

    def spin(seconds):
        node.subscriptions["/a"].callback(header(1))
        writer.flush()
        node.subscriptions["/a"].callback(header(2))
        raise OSError(errno.ENOSPC, "No space left")

    recorder._session.spin = spin
    with pytest.raises(RunError) as ended:
        recorder.run()
    assert str(ended.value) == (
        f"recording stopped: No space left; the last 1 messages are lost, {tmp_path / 'bag'} holds 1"
    )
    assert read_bag(tmp_path / "bag").topics["a"].data == [header(1)]


# profiles --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reliability", [(RELIABLE, RELIABLE), (RELIABLE, BEST), (BEST, BEST)])
@pytest.mark.parametrize("durability", [(LATCHED, LATCHED), (LATCHED, VOLATILE), (VOLATILE, VOLATILE)])
def test_a_recorder_requests_what_all_publishers_offer_and_a_player_offers_what_one_did(reliability, durability):
    pairs = list(zip(reliability, durability, strict=True))
    profiles = [QoSProfile(depth=5 + k, reliability=r, durability=d) for k, (r, d) in enumerate(pairs)]
    asked = ros.subscription_profile(profiles)
    assert (asked.history, asked.reliability, asked.durability) == (
        HistoryPolicy.KEEP_ALL,
        BEST if BEST in reliability else RELIABLE,
        VOLATILE if VOLATILE in durability else LATCHED,
    )
    topic = BagTopic("/x", HEADER, offered=tuple(map(ros.offered, profiles)))
    profile = ros.publisher_profile(topic)
    latched = [5 + k for k, d in enumerate(durability) if d == LATCHED]
    assert (profile.history, profile.reliability, profile.durability, profile.depth) == (
        HistoryPolicy.KEEP_LAST,
        RELIABLE if RELIABLE in reliability else BEST,
        LATCHED if latched else VOLATILE,
        max(10, sum(latched)) if latched else 1000,
    )


def test_the_offer_of_a_publisher_is_stored_in_the_form_of_a_bag():
    profile = QoSProfile(
        depth=7, history=HistoryPolicy.KEEP_LAST, reliability=BEST, durability=LATCHED,
        deadline=Duration(nanoseconds=1_500_000_000), lifespan=Duration(nanoseconds=2_000_000_003),
        liveliness=LivelinessPolicy.MANUAL_BY_TOPIC, liveliness_lease_duration=Duration(seconds=4),
        avoid_ros_namespace_conventions=True,
    )  # fmt: skip
    result = ros.offered(profile)
    assert tuple(result) == (
        QosHistory.KEEP_LAST, 7, QosReliability.BEST_EFFORT, QosDurability.TRANSIENT_LOCAL, (1, 500_000_000), (2, 3),
        QosLiveliness.MANUAL_BY_TOPIC, (4, 0), True,
    )  # fmt: skip
    unknown = ros.publisher_profile(BagTopic("/x", HEADER))
    assert (unknown.reliability, unknown.durability, unknown.depth) == (RELIABLE, VOLATILE, 1000)
    zero = ros.publisher_profile(BagTopic("/x", HEADER, offered=(qos(QosDurability.TRANSIENT_LOCAL, depth=0),)))
    assert zero.depth == 10


@pytest.mark.parametrize(
    ("publishers", "kept"),
    [([(1, "last")] * 3, 10), ([(1, "last")] * 12, 12), ([(7, "last"), (8, "last")], 15), ([(0, "last")] * 11, 11),
     ([(1, "last"), (1, "all")], 1001)],
)  # fmt: skip
def test_latched_publishers_become_one_with_the_sum_of_their_depths(publishers, kept):
    """At least the 10 of rosbag2's offer, which would lose the first two of twelve static transforms."""
    offers = [qos(QosDurability.TRANSIENT_LOCAL, depth=depth) for depth, _ in publishers]
    offers = [q._replace(history=QosHistory.KEEP_ALL) if h == "all" else q for q, (_, h) in zip(offers, publishers)]
    profile = ros.publisher_profile(BagTopic("/tf_static", HEADER, offered=tuple(offers)))
    assert (profile.depth, profile.durability, profile.history) == (kept, LATCHED, HistoryPolicy.KEEP_LAST)


# sessions --------------------------------------------------------------------------------------------------------


class NodeWithOptions:
    """A node with parameters from ROS arguments."""

    def __init__(self, name, enable_rosout, automatically_declare_parameters_from_overrides):
        assert not enable_rosout
        self.name, self.declared, self.undeclared = name, [], []

    def get_parameters_by_prefix(self, prefix):
        return {name: SimpleNamespace(value=value) for name, value in self.overrides.items()}

    def undeclare_parameter(self, name):
        self.undeclared.append(name)

    def declare_parameter(self, name, value, descriptor):
        self.declared.append((name, value, descriptor.description))

    def timer(self, ns, callback):
        """Never fire."""

    def serve_by(self, timer):
        assert timer == self.timer  # a timer of the node itself serves its services


@pytest.fixture
def session(monkeypatch):
    """A session whose executor records how long it was spun."""
    spun, signals, after = [], {}, []

    def spin(future, seconds):
        spun.append((future.done(), round(seconds, 3)))
        if len(spun) == stop_at[0]:
            signals[ros.signal.SIGINT](2, None)

    stop_at = [0]
    executor = SimpleNamespace(add_node=lambda node: None, spin_until_future_complete=spin)
    monkeypatch.setattr(ros.signal, "signal", signals.__setitem__)
    monkeypatch.setattr(ros.uses, "executor", lambda: executor)
    monkeypatch.setattr(ros, "ServingNode", NodeWithOptions)
    monkeypatch.setattr(ros, "watch_ports", after.append)
    monkeypatch.setattr(ros.rclpy, "init", lambda **_: None)
    monkeypatch.setattr(ros.Session, "opened", None)

    def make(overrides=(), stop=0):
        NodeWithOptions.overrides, stop_at[0] = dict(overrides), stop
        options = [
            (Declaration("rate", 2.5, float, "how fast", "", 0.0, 9.0), 2.5),
            (Declaration("wait", True, bool, "it", "", None, None), True),
        ]
        made = ros.Session("player", [], options)
        assert set(signals) == {ros.signal.SIGINT, ros.signal.SIGTERM}
        assert after.pop() is made.node
        return made, spun

    return make


def test_a_session_waits_in_slices_of_a_tenth_of_a_second_until_a_signal(session):
    made, spun = session()
    assert ros.Session.opened is made
    made.spin(0.25)
    assert spun == [(False, 0.1), (False, 0.1), (False, 0.05)]
    spun.clear()
    made.spin(0)
    assert spun == [(False, 0.0)]
    made.settle()
    assert spun.pop() == (False, 0.0)
    made.stop()
    made.stop()
    spun.clear()
    made.spin(1.0)
    assert (spun, made.stopped) == ([], True)
    made.settle()
    assert spun == [(False, 0.0)]  # messages that arrived before the signal are still received
    made, spun = session(stop=4)
    spun.clear()
    made.spin(9.0)
    assert (len(spun), made.stopped) == (4, True)


def test_options_are_parameters_that_accept_only_their_own_value(session):
    made, _ = session(
        {"rate": 2.5, "use_sim_time": True, "start_type_description_service": False, "qos_overrides./a": 1}
    )
    assert made.node.undeclared == ["rate"]
    assert made.node.declared == [("rate", 2.5, "how fast"), ("wait", True, "it")]
    for name, value in (("rate", 2.0), ("other", 1)):
        with pytest.raises(BagError) as refused:
            session({name: value})
        assert str(refused.value) == (
            f"parameter {name} cannot be set to {value} by ROS arguments; the options that can be set are "
            "those of --help"
        )
