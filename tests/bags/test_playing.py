"""When and in which order a player publishes, with a clock and a graph that the test moves: no node, no wait."""

import heapq
import itertools
import random
from types import SimpleNamespace

import pytest
from rclpy._rclpy_pybind11 import RCLError
from rclpy.duration import Duration
from rclpy.node import NodeNameNonExistentError
from softrig_bags.content.stamps import stamp
from softrig_bags.content.topics import BagTopic
from softrig_bags.errors import BagError
from softrig_bags.live import player
from softrig_bags.live.player import Answers, LockstepPlayer, Player, Publishers, Span, span
from softrig_core import RunError
from softrig_core.wire import parameter_event
from softrig_core.wire.cdr import Layout
from std_srvs.srv import Trigger

CLOCK, HEADER, TEXT = "rosgraph_msgs/msg/Clock", "std_msgs/msg/Header", "std_msgs/msg/Float64"
EVENTS = "rcl_interfaces/msg/ParameterEvent"
MS = 1_000_000


class Bag:
    """Topics (name, type) and messages (topic, bag time in ns, bytes), in the order of their times."""

    path = "some.bag"

    def __init__(self, topics, messages):
        self.topics = [BagTopic(name, msgtype) for name, msgtype in topics]
        self.rows = [(i, t, data) for i, t, data in messages]
        self.is_empty = not self.rows
        self.start, self.end = (self.rows[0][1], self.rows[-1][1]) if self.rows else (0, 0)

    def messages(self, names, start):
        return (m for m in self.rows if self.topics[m[0]].name in names and m[1] >= start)


class World:
    """Node, session and clock in one: a spin takes the time that it asks for, and due events happen at their times."""

    def __init__(self, monkeypatch, until=1e9):
        self.now, self.stopped, self.due, self.published, self.services = 0.0, False, [], [], {}
        self.subscriptions, self.peers, self.timers, self.spun = {}, {}, [], []
        self.node, self.frozen = self, 0
        self.at(until, self.stop)
        monkeypatch.setattr(player, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(player, "gc", SimpleNamespace(collect=lambda: None, freeze=self.freeze))

    def freeze(self):
        self.frozen += 1

    def at(self, when, what):
        heapq.heappush(self.due, (when, len(self.due) + random.Random(when).random(), what))

    def spin(self, seconds):
        self.spun.append(seconds)
        end = self.now + seconds
        while self.due and self.due[0][0] <= end and not self.stopped:
            when, _, what = heapq.heappop(self.due)
            self.now = max(self.now, when)
            what()
        if not self.stopped:
            self.now = end

    def stop(self):
        self.stopped = True

    # The node as the player uses it.

    def create_publisher(self, kind, topic, profile):
        def publish(data):
            self.published.append((round(self.now, 6), topic, data))
            for received in self.subscriptions.get(topic, []):
                received(data)

        return SimpleNamespace(
            publish=publish,
            topic_name=topic,
            get_subscription_count=lambda: len(self.subscriptions.get(topic, ())),
            wait_for_all_acked=lambda patience: self.published.append((round(self.now, 6), topic, patience)),
        )

    def create_service(self, kind, name, answer):
        self.services[name] = answer

    def call(self, name):
        assert self.services[f"~/{name}"](Trigger.Request(), Trigger.Response()).success

    def create_timer(self, period, call, clock):
        self.timers.append(period)
        self.at(self.now + period, lambda: self.tick(period, call))

    def tick(self, period, call):
        self.at(self.now + period, lambda: self.tick(period, call))
        call()

    def create_subscription(self, kind, topic, receive, profile, raw):
        assert raw
        self.subscriptions.setdefault(topic, []).append(receive)
        return SimpleNamespace(topic_name=topic, get_publisher_count=lambda: len(self.peers.get(topic, ())))

    def get_topic_names_and_types(self):
        return [(topic, [HEADER]) for topic in self.peers]

    def get_publishers_info_by_topic(self, topic):
        return self.peers.get(topic, [])

    def count_publishers(self, topic):
        return len(self.peers.get(topic, ()))

    def get_subscriber_names_and_types_by_node(self, name, namespace):
        if name == "unknown":
            raise NodeNameNonExistentError
        return [(topic, [HEADER]) for topic in self.subscriptions]

    def by_stamp(self, *names):
        """The published messages: wall-clock time in ms, name of the topic, stamp in ms."""
        names = names or {topic for _, topic, _ in self.published}
        return [
            (round(t * 1e3, 3), topic, stamp(data) // MS)
            for t, topic, data in self.published
            if topic in names and isinstance(data, bytes)
        ]


def headers(topic, *times):
    return [(topic, t * MS, Layout(HEADER).encode(t * MS, ())) for t in times]


def playing(world, bag, part=None, *, rate=1.0, loop=False, clock=False, paused=False):
    publishers = Publishers(world, bag, bag.topics, {})
    return Player(
        world, bag, publishers, part or span(bag, 0.0, None), rate=rate, loop=loop, clock=clock, paused=paused
    )


# against the wall clock -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [0.5, 1.0, 4.0])
def test_each_message_is_published_when_it_is_due_and_at_no_other_time(monkeypatch, rate):
    world = World(monkeypatch)
    bag = Bag([("/a", HEADER), ("/b", HEADER)], headers(0, 500) + headers(1, 500, 507) + headers(0, 590, 1500, 1600))
    played = playing(world, bag, Span(500 * MS, 1500 * MS), rate=rate)
    played.run()
    wanted = [(0, "/a", 500), (0, "/b", 500), (7 / rate, "/b", 507), (90 / rate, "/a", 590), (1000 / rate, "/a", 1500)]
    assert world.by_stamp() == [(pytest.approx(t, abs=1e-3), topic, k) for t, topic, k in wanted]
    assert played.sent == 5
    assert max(world.spun) <= 0.025  # so a service call is never delayed by more
    assert world.frozen == 1
    # The player waits until all subscribers have the last messages.
    assert [data for _, _, data in world.published[-2:]] == [Duration(seconds=2)] * 2


def test_the_clock_is_published_before_the_messages_of_a_time_and_every_25_ms_between(monkeypatch):
    world = World(monkeypatch)
    playing(world, Bag([("/a", HEADER)], headers(0, 100, 200, 201)), clock=True).run()
    assert world.by_stamp() == [
        (0, "/clock", 100), (0, "/a", 100),
        # /clock starts at the start of this part, not of the bag.
        (25, "/clock", 100), (50, "/clock", 125), (75, "/clock", 150),
        (100, "/clock", 200), (100, "/a", 200), (101, "/clock", 201), (101, "/a", 201),
    ]  # fmt: skip
    assert "/clock" not in {topic for _, topic, data in world.published if isinstance(data, Duration)}


def test_bag_time_stops_during_a_pause_and_a_step_publishes_one_time(monkeypatch):
    """No request waits longer than 25 ms; half a second passes before the second pause, at 1.5 s."""
    world = World(monkeypatch)
    bag = Bag([("/a", HEADER), ("/b", HEADER)], headers(0, 0, 1000) + headers(1, 1000) + headers(0, 2000, 3000, 3200))
    for ms, name in ((50, "step"), (90, "step"), (110, "resume"), (610, "pause"), (700, "step"), (800, "resume")):
        world.at(ms / 1e3, lambda name=name: world.call(name))
    playing(world, bag, paused=True, clock=True).run()
    text = world.by_stamp("/a", "/b")
    assert [(topic, k) for _, topic, k in text] == [
        *(("/a", 0), ("/a", 1000), ("/b", 1000), ("/a", 2000), ("/a", 3000), ("/a", 3200))
    ]
    for (result, _, _), due in zip(text, (50, 90, 90, 700, 1800, 2000), strict=True):
        assert due - 25.001 * (due >= 1800) <= result <= due + 25.001
    clock = [(t, k) for t, _, k in world.by_stamp("/clock")]
    assert [k for t, k in clock if t < 110] == [0, 1000]
    assert [k for t, k in clock if 640 <= t < 800] == [2000]
    between = [k for _, k in clock if 1000 < k < 2000]
    assert between == pytest.approx([1025 + 25 * k for k in range(len(between))], abs=25)
    assert len(between) == pytest.approx(500 / 25, abs=1)


def test_a_step_of_a_running_player_publishes_one_more_time_and_then_pauses(monkeypatch):
    world = World(monkeypatch, until=5.0)
    world.at(0.31, lambda: world.call("step"))
    playing(world, Bag([("/a", HEADER)], headers(0, 0, 100, 200, 1000, 1100))).run()
    assert [k for _, _, k in world.by_stamp()] == [0, 100, 200, 1000]
    assert world.by_stamp()[-1][0] == pytest.approx(310, abs=25.1)
    world = World(monkeypatch, until=1.0)
    Law(world, ["/in"], ["/out"], delay=lambda data: 0.1)
    world.at(0.25, lambda: world.call("step"))
    with pytest.raises(RunError, match=r"^stopped at t = 0.003 s$"):
        replaying(world, Bag([("/in", HEADER)], headers(0, *range(8)))).run()
    assert [k for _, _, k in world.by_stamp("/in")] == [0, 1, 2, 3]


def test_a_start_time_with_a_nanosecond_is_waited_for_as_any_other(monkeypatch):
    world = World(monkeypatch)
    playing(world, Bag([("/a", HEADER)], [(0, 1, Layout(HEADER).encode(1, ()))]), clock=True).run()
    assert [topic for _, topic, data in world.published if isinstance(data, bytes)] == ["/clock", "/a"]


def test_a_player_that_is_always_late_still_answers_requests(monkeypatch):
    """Each message takes 10 ms to send and is due after 1 ms, so the player never waits."""
    world = World(monkeypatch)
    played = playing(world, Bag([("/a", HEADER)], headers(0, *range(100))))
    world.subscriptions["/a"] = [lambda data: setattr(world, "now", world.now + 0.010)]
    world.at(0.2, lambda: world.call("pause"))
    world.at(0.9, lambda: world.call("resume"))
    played.run()
    times = [t for t, _, _ in world.by_stamp("/a")]
    assert len(times) == 100
    gap = max(range(1, 100), key=lambda k: times[k] - times[k - 1])
    assert 200 <= times[gap - 1] <= 240
    assert 900 <= times[gap] <= 940
    assert world.spun.count(0) > 20


def test_it_repeats_or_ends_and_stops_immediately(monkeypatch):
    world = World(monkeypatch, until=0.0105)
    bag = Bag([("/a", HEADER)], headers(0, 3, 5, 6))
    playing(world, bag, loop=True).run()
    # Each of three loops lasts 3 ms; the end of the part cuts the last one.
    assert [k for _, _, k in world.by_stamp()] == [3, 5, 6] * 3 + [3]
    world = World(monkeypatch)
    playing(world, bag, loop=False).run()
    assert [k for _, _, k in world.by_stamp()] == [3, 5, 6]


def test_it_waits_for_a_subscriber_of_each_topic(monkeypatch):
    world = World(monkeypatch)
    played = playing(world, Bag([("/a", HEADER), ("/b", HEADER)], headers(0, 0) + headers(1, 1)))
    world.subscriptions["/a"] = [lambda data: None]
    world.at(0.5, lambda: world.subscriptions.update({"/b": [lambda data: None]}))
    played.run(wait=True)
    assert [t for t, _, _ in world.by_stamp()] == [pytest.approx(500, abs=20.1), pytest.approx(501, abs=20.1)]
    world = World(monkeypatch, until=1.0)
    nobody = playing(world, Bag([("/a", HEADER)], headers(0, 0)))
    nobody.run(wait=True)
    assert nobody.sent == 0


END = (2**63 - 1) // MS  # the player stops at the last message even if the metadata state a later end


@pytest.mark.parametrize(
    ("offset", "duration", "result"),
    [(0.0, None, (2000, END)), (1.5, None, (3500, END)), (3.0, None, (5000, END)), (0.0, 0.25, (2000, 2250)),
     (1.0, 9.0, (3000, 12000))],
)  # fmt: skip
def test_only_the_selected_part_is_played(offset, duration, result):
    part = span(Bag([("/a", HEADER)], headers(0, 2000, 5000)), offset, duration)
    assert (part.start // MS, part.end // MS) == result


def test_an_impossible_part_is_refused():
    with pytest.raises(BagError, match=r"^start offset 3.001 s: the bag is only 3 s long$"):
        span(Bag([("/a", HEADER)], headers(0, 2000, 5000)), 3.001, None)
    with pytest.raises(BagError, match=r"^some.bag is empty$"):
        span(Bag([], []), 0.0, None)


def test_played_topics_are_renamed_and_have_types_that_are_installed(monkeypatch):
    world = World(monkeypatch)
    bag = Bag([("/a", HEADER), ("/left", HEADER), ("/b", HEADER)], headers(0, 0))
    publishers = Publishers(world, bag, [bag.topics[0], bag.topics[2]], {"/b": "/c"})
    assert (publishers.names, sorted(publishers.publish)) == ({"/a": "/a", "/b": "/c"}, [0, 2])
    publishers.publish[2](b"it")
    assert world.published[-1][1:] == ("/c", b"it")
    world.subscriptions["/c"] = [None]
    assert publishers.unheard(["/c", "/a"]) == ["/a"]
    odd = Bag([("/odd", "odd_msgs/msg/Odd")], [])
    with pytest.raises(
        BagError, match="/odd is of type odd_msgs/msg/Odd, which is not installed here; leave it out wi"
    ):
        Publishers(world, odd, odd.topics, {})


def test_one_of_two_types_on_a_topic_is_played_and_bytes_that_ros_rejects_are_counted(monkeypatch):
    world = World(monkeypatch)
    bag = Bag([("/a", HEADER), ("/a", TEXT)], [(0, 0, b"it"), (1, 0, b"other"), (0, MS, b"bad"), (0, 2 * MS, b"end")])
    publishers = Publishers(world, bag, bag.topics[:1], {})
    publish = publishers.publish[0]

    def refuse(data):
        if data == b"bad":
            raise RCLError("cannot publish data")
        publish(data)

    publishers.publish[0] = refuse
    replay = Player(world, bag, publishers, span(bag, 0.0, None), rate=1.0, loop=False, clock=False, paused=False)
    replay.run(False)
    assert [data for _, _, data in world.published if isinstance(data, bytes)] == [b"it", b"end"]
    assert (replay.sent, publishers.refused) == (2, {"/a": 1})


# tick by tick ---------------------------------------------------------------------------------------------------------


class Law:
    """A node that answers each input after a delay of its own clock, or not at all."""

    def __init__(self, world, inputs, outputs, delay=lambda data: 0.001, name="law"):
        for topic in outputs:
            world.peers[topic] = [SimpleNamespace(node_name=name, node_namespace="/")]
        for topic in inputs:
            world.subscriptions[topic] = [
                lambda data: [
                    world.at(world.now + delay(data), lambda data=data, out=out: self.say(world, out, data))
                    for out in outputs
                ]
            ]

    @staticmethod
    def say(world, topic, data):
        world.published.append((round(world.now, 6), topic, data))
        for received in world.subscriptions[topic]:
            received(data)


def replaying(world, bag, answers=("/out",), remap=None, **more):
    played = [t for t in bag.topics if t.name not in (*answers, player.CHANGES)]
    publishers = Publishers(world, bag, played, {})
    return LockstepPlayer(world, bag, publishers, list(answers), remap or {}, span(bag, 0.0, None), **more)


def test_no_tick_is_sent_before_all_answers_to_the_one_before(monkeypatch):
    """Answers that take from nothing to 0.3 s; those with a tick in the bag are awaited, others are not."""
    rng = random.Random(4)
    ticks = sorted(rng.sample(range(200), 40))
    answered = [t for t in ticks if rng.random() < 0.6]
    messages = sorted(headers(0, *ticks) + headers(1, *answered) + headers(2, *answered[:9]), key=lambda m: m[1])
    world = World(monkeypatch)
    bag = Bag([("/in", HEADER), ("/out", HEADER), ("/more", HEADER)], messages)
    law = Law(world, ["/in"], ["/out", "/more"])
    world.subscriptions["/in"] = [
        lambda data: [
            world.at(world.now + rng.choice([0.0, 0.3 * rng.random()]), lambda out=out: law.say(world, out, data))
            for out, those in (("/out", answered), ("/more", answered[:9]))
            if stamp(data) // MS in those
        ]
    ]
    played = replaying(world, bag, ("/out", "/more"))
    result = played.run()
    assert {name: topic.times for name, topic in result.topics.items()} == {
        "out": [t * MS for t in answered],
        "more": [t * MS for t in answered[:9]],
    }
    assert [stamp(d) for d in result.topics["out"].data] == result.topics["out"].times
    assert (played.sent, world.stopped) == (40, True)
    # The player waits until all subscribers have the last messages.
    assert world.published[-1][1:] == ("/in", Duration(seconds=2))
    order = [(k, topic == "/in") for _, topic, k in world.by_stamp()]
    assert [k for k, asks in order if asks] == ticks
    for tick in answered:  # all messages of a tick are published before any of a later one
        last = max(i for i, (k, _) in enumerate(order) if k == tick)
        assert all(k <= tick for k, _ in order[: last + 1])


def test_a_node_that_is_not_in_the_bag_answers_each_tick(monkeypatch):
    world = World(monkeypatch)
    Law(world, ["/in"], ["/renamed"])
    result = replaying(world, Bag([("/in", HEADER)], headers(0, 0, 10, 30)), ("/out",), {"/out": "/renamed"}).run()
    assert result.topics["out"].times == [0, 10 * MS, 30 * MS]


def test_a_node_that_announces_its_ticks_is_waited_for_at_each(monkeypatch):
    world = World(monkeypatch)
    Law(world, ["/in"], ["/law/tick"], delay=lambda data: 0.2)
    world.peers["/out"] = world.peers["/law/tick"]
    result = replaying(world, Bag([("/in", HEADER), ("/out", HEADER)], headers(0, 0, 10, 20))).run()
    assert list(result.topics) == ["out"]  # messages of the ticks are not recorded as answers
    times = [t for t, topic, _ in world.by_stamp("/in")]
    assert [b - a for a, b in itertools.pairwise(times)] == pytest.approx([200, 200])


def test_a_pause_holds_the_ticks_and_a_step_is_one(monkeypatch):
    world = World(monkeypatch)
    Law(world, ["/in"], ["/out"])
    for ms, name in ((100, "step"), (200, "step"), (200.5, "step"), (300, "resume"), (300.5, "pause"), (400, "resume")):
        world.at(ms / 1e3, lambda name=name: world.call(name))
    replaying(world, Bag([("/in", HEADER)], headers(0, *range(8))), paused=True).run()
    assert [t for t, _, _ in world.by_stamp("/in")] == [100, 200, 201, 300, 400, 401, 402, 403]


def test_changes_in_the_bag_are_set_before_their_tick(monkeypatch):
    asked = []

    class Client:
        def __init__(self, node, name):
            self.name = name

        def services_are_ready(self):
            return world.now > 0.1

        def set_parameters_atomically(self, parameters):
            asked.append((round(world.now, 3), self.name, {p.name: p.value for p in parameters}))
            answer = SimpleNamespace(result=SimpleNamespace(successful=parameters[0].value < 9, reason="too much"))
            return SimpleNamespace(
                add_done_callback=lambda call: world.at(
                    world.now + 0.05, lambda: call(SimpleNamespace(result=lambda: answer))
                )
            )

    monkeypatch.setattr(player, "AsyncParameterClient", Client)

    def run(largest):
        changes = [(1, t * MS, parameter_event.encode(t * MS, node, values)) for t, node, values in (
            (0, "/other", {"k": 1}), (20, "/law", {"k": 2, "on": True}), (20, "/law", {"k": largest}))]  # fmt: skip
        messages = sorted([*headers(0, 0, 10, 20, 30), *changes], key=lambda m: m[1])
        Law(world, ["/in"], ["/out"])
        replaying(world, Bag([("/in", HEADER), ("/parameter_events", EVENTS)], messages)).run()

    world = World(monkeypatch)
    run(3)
    (t0, t1, t2, t3) = (t for t, _, _ in world.by_stamp("/in"))
    assert t0 >= 100
    assert [t - t0 for t in (t1, t2, t3)] == pytest.approx([1, 102, 103])
    assert [(name, values) for _, name, values in asked] == [("/law", {"k": 2, "on": True}), ("/law", {"k": 3})]
    world = World(monkeypatch)
    with pytest.raises(RunError, match=r"^law refuses k at t = 0.02 s: too much$"):
        run(9)


@pytest.mark.parametrize(
    ("discovered", "text"),
    [
        ({}, r"no node publishes /out"),
        ({"recorded": True}, r"no node publishes /out"),
        ({"name": "unknown"}, r"the node behind /out is not known yet"),
        ({"name": "law"}, r"the node subscribes none of /in, /too"),
        ({"name": "law", "inputs": ["/in"], "deaf": True}, r"/in is not matched"),
    ],
)
def test_missing_nodes_are_named_when_the_timeout_ends(monkeypatch, discovered, text):
    world = World(monkeypatch)
    topics = [("/in", HEADER), ("/too", HEADER), *([("/out", HEADER)] if discovered.get("recorded") else [])]
    if "name" in discovered:
        Law(world, discovered.get("inputs", ()), ["/out"], name=discovered["name"])
    played = replaying(world, Bag(topics, headers(0, 0)), timeout=2.0)
    if discovered.get("deaf"):
        monkeypatch.setattr(played._publishers, "unheard", list)
    with pytest.raises(RunError, match=rf"^no node to play to within 2 s: {text}$"):
        played.run()
    assert world.now == pytest.approx(2.5)  # the player checks every 0.25 s, first at t = 0
    assert world.timers == [0.25]


def test_a_missing_answer_ends_the_replay_and_a_pause_does_not(monkeypatch):
    world = World(monkeypatch)
    Law(world, ["/in"], ["/out"], delay=lambda data: 0.001 if stamp(data) < 20 * MS else 1e12)
    world.at(0.9, lambda: world.call("resume"))
    played = replaying(world, Bag([("/in", HEADER)], headers(0, 0, 10, 20, 30)), paused=True, timeout=0.5)
    with pytest.raises(RunError, match=r"^no answer to t = 0.02 s on /out within 0.5 s$"):
        played.run()
    # The player checks every 0.25 s; a silence of exactly 0.5 s is within the limit.
    assert world.now == pytest.approx(1.75)
    world = World(monkeypatch, until=0.1)
    Law(world, ["/in"], ["/out"], delay=lambda data: 1e12)
    with pytest.raises(RunError, match=r"^stopped at t = 0.005 s$"):
        replaying(world, Bag([("/in", HEADER)], headers(0, 5, 10))).run()


def test_an_answer_of_another_tick_is_refused_in_any_order():
    def wrong():
        return pytest.raises(RunError, match=r"^/out: answer stamped 0.002 s, expected 0.001 s$")

    late, early, bare = (Answers("/out", HEADER, True, stamped) for stamped in (True, True, False))
    (_, _, right), (_, _, other) = headers(0, 1, 2)
    for answers in (late, bare):
        answers.expect(1 * MS, 1 * MS)
        assert answers.missing
    late.receive(right)
    assert (late.missing, late.ticks, late.stamps, late.data) == (False, [1 * MS], [1 * MS], [right])
    late.expect(1 * MS, 1 * MS)
    with wrong():
        late.receive(other)
    early.receive(other)
    assert not early.missing
    with wrong():
        early.expect(1 * MS, 1 * MS)
    bare.receive(other)  # a message without a stamp counts for any tick
    assert not bare.missing


@pytest.mark.parametrize("seed", range(6))
def test_ticks_are_bag_times_that_match_stamps_or_else_stamps(seed, monkeypatch):
    """Of messages with and without a header: bag times if one of the first 200 equals its stamp, else stamps."""
    rng = random.Random(seed)
    agrees = [None, 0, 199, 200, None, 0][seed]
    messages, times = [], sorted(rng.choices(range(900), k=260))
    for k, t in enumerate(times):
        topic = rng.randrange(2) if k != agrees else 0
        mark = t if k == agrees else 5000 + 10 * rng.randrange(40)
        messages.append((topic, t * MS, Layout(HEADER).encode(mark * MS, ()) if topic == 0 else b"\0\1\0\0" + b"x" * 8))
    by_bag_time = agrees is not None and agrees < 200
    wanted, tick = [], 0
    for topic, t, data in messages:
        tick = t if by_bag_time else stamp(data) if topic == 0 else tick
        wanted.append((tick, topic, data))
    wanted.sort(key=lambda m: m[0])
    bag = Bag([("/in", HEADER), ("/bare", TEXT), ("/left", HEADER)], messages)
    part = Span(bag.start, bag.end)
    reported = LockstepPlayer(
        world := World(monkeypatch), bag, Publishers(world, bag, bag.topics[:2], {}), ["/out"], {}, part
    )
    results = [reported._following, *reported._groups]
    assert [(tick, i, data) for tick, group in results for i, data in group] == wanted
    assert [tick for tick, _ in results] == sorted({tick for tick, _, _ in wanted})
