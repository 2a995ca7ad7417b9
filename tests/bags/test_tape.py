"""External messages published again, and how much was missed before a recorder joined: both by independent code."""

import json
import random

import pytest
from softrig_bags import tape
from softrig_bags.content.stamps import is_stamped, stamp
from softrig_bags.content.topics import BagTopic
from softrig_bags.live.holds import Holds, _seconds
from softrig_bags.live.join import INTERVALS, SIMULATED, Join, missed
from softrig_bags.live.selection import Selection
from softrig_bags.tape import Tape, port_of, written
from softrig_bags.write import write_bag
from softrig_core import ByHand, Recording, Sample
from softrig_core.block.port import Port, button, scalars
from softrig_core.wire.cdr import Layout

MS, EPOCH = 1_000_000, 1_700_000_000 * 10**9
STATE, HEADER = "sensor_msgs/msg/JointState", "std_msgs/msg/Header"
PORTS = {
    "both": scalars("both", "outside/both", {"a": "V", "b": "A"}, partial=True, safe=(7.0, 8.0)),
    "late": scalars("late", "outside/late", {"a": "V"}, delayed=True),
    "push": button("push", "outside/push", held=True),
}


@pytest.fixture(scope="module", params=[0, EPOCH])
def recorded(request, tmp_path_factory):
    """A bag of three inputs; some messages name one channel, others both or none that exists."""
    epoch, rng = request.param, random.Random(3)
    recording = Recording([(p.topic, p.msgtype) for p in PORTS.values()])
    messages = {name: [] for name in PORTS}
    for k in range(60):
        t = rng.randrange(k * 5, k * 5 + 5) * MS
        kind = rng.choice(["a", "b", "ab", "late", "push", "bad"])
        if kind in ("late", "push"):
            layout = PORTS[kind].layout()
            mark = epoch + t - 2 * MS
            recording.add(list(PORTS).index(kind), epoch + t, layout.encode(mark, (float(k % 2),)))
            value = (float(k % 2),)
            messages[kind].append((t, Sample(t - 2 * MS, value) if kind == "late" else value))
        else:
            names = list(kind) if kind != "bad" else ["x"]
            values = tuple(k + 0.5 * j for j in range(len(names)))
            recording.add(0, epoch + t, Layout(STATE, "", names, {"position": len(names)}).encode(epoch + t, values))
            if kind != "bad":
                last = dict(zip("ab", messages["both"][-1][1] if messages["both"] else (7.0, 8.0), strict=True))
                messages["both"].append((t, tuple((last | dict(zip(names, values, strict=True))).values())))
    folder = tmp_path_factory.mktemp("tape") / "bag"
    write_bag(folder, recording, custom_data={"epoch": str(epoch)} if epoch else {})
    return folder, messages


@pytest.mark.parametrize("until", [0.0, 0.1])
def test_at_each_tick_the_newest_unpublished_message_is_published(recorded, until):
    folder, text = recorded
    tape._loaded.cache_clear()
    block = ByHand(Tape(bag=str(folder), until=until, inputs=tuple(map(written, PORTS.values()))))
    block.reset(0)
    before = -1
    for k in range(110):
        t = 3 * k * MS
        answer = block.update(t)
        wanted = {}
        for name, rows in text.items():
            due = [value for at, value in rows if before < at <= t and not (until and at >= round(until * 1e9))]
            if due:
                wanted[name] = due[-1]
        assert answer == wanted, t
        before = t


@pytest.mark.parametrize("at", [99, 100])
def test_a_message_at_the_very_end_is_left_out(tmp_path, at):
    recording = Recording([("outside/push", PORTS["push"].msgtype)])
    recording.add(0, at * MS, PORTS["push"].layout().encode(0, (1.0,)))
    write_bag(tmp_path / "bag", recording)
    block = ByHand(Tape(bag=str(tmp_path / "bag"), until=0.1, inputs=(written(PORTS["push"]),)))
    block.reset(0)
    assert block.update(200 * MS) == ({"push": (1.0,)} if at < 100 else {})


def test_a_port_is_written_without_defaults_and_becomes_an_output():
    port = PORTS["both"]
    assert json.loads(written(port)) == {
        "name": "both", "topic": "outside/both", "msgtype": STATE, "channels": ["a", "b"], "fields": ["position"],
        "units": ["V", "A"], "partial": True, "safe": [7.0, 8.0], "limits": [1e7, 1e7],
    }  # fmt: skip
    made = port_of(written(port))
    assert (made.partial, made.held, made.sporadic, made.channels, made.safe) == (
        False,
        False,
        True,
        ("a", "b"),
        (7.0, 8.0),
    )
    assert port_of(written(PORTS["push"])).held is False
    assert isinstance(made, Port)
    for text in ("no json", "[1]", '{"name": 1, "more": 2}'):
        with pytest.raises(ValueError, match="is not a port"):
            Tape(bag="x", inputs=(text,))


# joined late -----------------------------------------------------------------------------------------------------


STREAMS = {  # stamps, ns; periods before the first one, by hand
    "from the start": (range(0, 100, 10), 0),
    "three late": (range(30, 130, 10), 3),
    # Rounding adds 1 + 3/8 ns, which is allowed.
    "three late and a bit, as rounding adds up": (range(31, 131, 10), 3),
    "more than rounding adds up to": (range(32, 132, 10), 0),
    "between its ticks": (range(35, 135, 10), 0),
    "at each fourth tick from the third on": (range(20, 420, 40), 0),
    "two messages": ([30, 40], 0),
    "three messages": ([30, 40, 50], 3),
    "after eight it may do as it likes": ([*range(30, 120, 10), 1000], 3),
    "the eighth interval is another": ([*range(30, 110, 10), 111], 3),  # 1 ns more: the mean interval is 10 1/8 ns
    "the eighth interval is quite another": ([*range(30, 110, 10), 112], 0),
    "a nanosecond off is rounding": ([300, 400, 501, 600], 3),
    "more is not": ([300, 400, 502, 600], 0),
    "backwards": ([300, 200, 100], 0),
    "always the same": ([30, 30, 30], 0),
    "on the wall clock": ([SIMULATED, SIMULATED + 10, SIMULATED + 20], 0),
    "just not": ([SIMULATED - 10, SIMULATED, SIMULATED + 10], SIMULATED // 10 - 1),
    "before the start": ([-10, 0, 10], 0),
}


def joined(marks):
    """The facts that are known about a topic with these stamps, and how many stamps were examined."""
    join = Join(BagTopic("/x", HEADER, "std_msgs/Header h"))
    looked = 0
    for mark in marks:
        if join.open:
            join.inspect(Layout(HEADER).encode(mark, ()))
            looked += 1
    return join, looked


@pytest.mark.parametrize("name", STREAMS)
def test_a_late_subscriber_counts_what_it_missed(name):
    marks, count = STREAMS[name]
    join, looked = joined(marks)
    assert (join.periods, join.from_start) == (count, marks[0] == 0)
    assert missed([("/x", join)]) == ({"/x": count} if count else {})
    assert looked <= INTERVALS + 1
    assert looked == (1 if not 0 < marks[0] < SIMULATED else 2 if name == "backwards" else min(len(marks), 9))


@pytest.mark.parametrize("name", STREAMS)
def test_a_topic_that_is_late_beside_a_complete_one_missed_nothing(name):
    """A rig waits for its recorder on all topics or on none."""
    late, whole = joined(STREAMS[name][0])[0], joined(range(0, 100, 10))[0]
    assert missed([("/x", late), ("/whole", whole)]) == missed([("/whole", whole), ("/x", late)]) == {}


def test_a_topic_without_stamp_and_number_proves_nothing():
    assert not Join(BagTopic("/x", "std_msgs/msg/String", "string data")).open
    array = Join(BagTopic("/x", "std_msgs/msg/Float64MultiArray"))
    assert array.open
    array.inspect(b"\0\0\0\1 of another byte order")
    assert (array.open, array.number, array.periods, array.from_start) == (False, 0, 0, False)
    assert missed([("/x", array)]) == {}


# the rest of a recorder's rules ----------------------------------------------------------------------------------


def test_a_gap_longer_than_the_limit_is_a_hold():
    now, count = [10.0], iter((5, 9))
    holds = Holds(2.5, lambda: now[0])
    kept_rows = []
    for pause in (2.5, 2.625, 0.0, 100.0):
        now[0] += pause
        kept_rows.append(holds.wake(lambda: next(count)))
    assert kept_rows == [False, True, False, True]
    assert str(holds) == "2.6 s after message 5, 100.0 s after message 9"
    assert holds.gaps == [(2.625, 5), (100.0, 9)]


@pytest.mark.parametrize(
    ("text", "seconds"),
    [("<d><sec>3</sec></d>", 3.0), ("<d><sec> 1 </sec><nanosec>500000000</nanosec></d>", 1.5),
     ("<d><nanosec>250000000</nanosec></d>", 0.25), ("<d><sec>DURATION_INFINITY</sec></d>", float("inf")),
     ("<d>DURATION_INFINITE_SEC</d>", float("inf")), ("<other/>", 20.0), ("<d><sec/></d>", 0.0)],
)  # fmt: skip
def test_a_duration_of_a_profile_is_read_in_each_of_its_forms(text, seconds):
    from xml.etree import ElementTree

    root = ElementTree.fromstring(f'<p xmlns="http://www.eprosima.com">{text}</p>')
    assert _seconds(root, "d", 20.0) == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("names", "regex", "exclude", "inside", "outside"),
    [
        ((), "", "", ["/a", "/a/b"], ["/_hidden", "/a/_hidden"]),
        (("a", "/b"), "", "", ["/a", "/b"], ["/c", "/a/b"]),
        (("/_h",), "", "h", ["/_h"], ["/x"]),  # a topic requested by name is recorded although it is hidden
        ((), "b$", "", ["/a/b", "/_b"], ["/b/a"]),
        ((), "", "b", ["/a"], ["/b", "/a/b"]),
        (("/c",), "a", "b", ["/a", "/c"], ["/ab", "/d"]),
    ],
)
def test_topics_are_selected_by_name_by_pattern_or_all(names, regex, exclude, inside, outside):
    chosen = Selection.of(names, regex, exclude)
    assert [topic in chosen for topic in (*inside, *outside)] == [True] * len(inside) + [False] * len(outside)


@pytest.mark.parametrize(
    ("definition", "stamped"),
    [("std_msgs/Header header", True), ("# a\n\nstd_msgs/msg/Header h\nint8 x", True), ("Header h", True),
     ("builtin_interfaces/Time t", True), ("int8 A=1\nbyte B = 2\nHeader h", True), ("int8 x\nHeader h", False),
     ("string text # Header", False), ("", False), ("int8 A=1", False)],
)  # fmt: skip
def test_a_message_is_stamped_when_its_first_field_is_a_header_or_a_time(definition, stamped):
    assert is_stamped(BagTopic("/x", "x_msgs/msg/X", definition)) == stamped


def test_a_stamp_is_read_in_both_byte_orders_and_anywhere():
    assert stamp(b"\0\1\0\0" + bytes([2, 0, 0, 0, 3, 0, 0, 0])) == 2_000_000_003
    assert stamp(b"\0\0\0\0" + bytes([0, 0, 0, 2, 0, 0, 0, 3])) == 2_000_000_003
    assert stamp(b"\0\1\0\0" + bytes([255, 255, 255, 255, 3, 0, 0, 0])) == -999_999_997
    assert stamp(b"\0\1\0\0" + bytes(4) + bytes([1, 0, 0, 0, 5, 0, 0, 0]), 8) == 1_000_000_005
