"""Two bags compared message by message by independent code: which are paired, which differ, by how much, and where
first.
"""

import json
import math
import random

import numpy as np
import pytest
from softrig_bags.compare import Comparison, Difference, Tolerance, TopicComparison, compare, plain
from softrig_bags.errors import BagError
from softrig_core import Recording, Signals
from softrig_core.wire.cdr import Layout

STATE, FLOAT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64"
JOINTS = Layout(STATE, "", ["a", "b"], {"position": 2, "velocity": 2})
NUMBER = Layout(FLOAT)
FIELDS = ("a/position", "b/position", "a/velocity", "b/velocity")
VALUES = (0.0, 1.0, 1.0, 1.125, 1.25, 2.0, -1.0, math.nan, math.inf)


def drawn(rng):
    """Messages (bag time, stamp, values) by topic: some with stamps, some stamps repeated, and topics without
    stamps.
    """
    result = {}
    for topic in ("joints", "number", "only"):
        t, mark, rows = 0, 0, []
        for _ in range(rng.randrange(1, 14)):
            t += rng.choice([1, 1, 2])
            mark = mark if rng.random() < 0.3 else t
            values = [rng.choice(VALUES) for _ in range(4 if topic != "number" else 1)]
            rows.append((t, mark if topic != "number" else t, values))
        result[topic] = rows
    return result


def changed(messages, rng):
    """The same messages with some removed, others added, values and times changed."""
    result = {}
    for topic, rows in messages.items():
        if topic == "only" and rng.random() < 0.5:
            continue
        kept = [(t, m, list(v)) for t, m, v in rows if rng.random() < 0.85]
        for k, (t, m, v) in enumerate(kept):
            if rng.random() < 0.4:
                v[rng.randrange(len(v))] = rng.choice(VALUES)
            if topic != "number" and rng.random() < 0.2:
                kept[k] = (t + 1, m, v)
        kept += [(99, 99, [7.0] * (1 if topic == "number" else 4))] * rng.randrange(2)
        result[topic] = sorted(kept, key=lambda row: row[0])
    return result


def recording(messages):
    result = Recording([(topic, FLOAT if topic == "number" else STATE) for topic in messages])
    for k, (topic, rows) in enumerate(messages.items()):
        layout = NUMBER if topic == "number" else JOINTS
        for t, mark, values in rows:
            result.add(k, t, layout.encode(mark, tuple(values)))
    return result


def keyed(rows, stamped):
    """Messages by stamp, or by bag time, and how many earlier ones have the same key."""
    result, seen = {}, {}
    for t, mark, values in rows:
        key = mark if stamped else t
        result[key, seen.get(key, 0)] = (t, values)
        seen[key] = seen.get(key, 0) + 1
    return result


def agree(x, y, tolerance):
    if math.isnan(x) or math.isnan(y):
        return math.isnan(x) and math.isnan(y)
    return x == y or abs(y - x) <= max(tolerance.absolute, tolerance.relative * abs(x))


def by_hand(one, two, tolerance, bitwise, alone):
    """The result for a topic, and the differences in the order in which a person would look for them.

    Stamps of a topic that are all equal, in one of the bags, pair nothing: the times of the bag are used instead.
    """
    (topic, rows_a), (_, rows_b) = one, two
    stamped = topic != "number" and (
        alone or not any(len(r) > 1 and len({m for _, m, _ in r}) == 1 for r in (rows_a, rows_b))
    )
    a, b = keyed(rows_a, stamped), keyed(rows_b, stamped)
    names = FIELDS if topic != "number" else ("data",)
    missing, extra = [k for k in a if k not in b], [k for k in b if k not in a]
    seen = [(k[0], "message", "present", "missing") for k in missing]
    seen += [(k[0], "message", "missing", "present") for k in extra]
    pairs = [(k, a[k], b[k]) for k in a if k in b]
    bad, largest = set(), {}
    if bitwise:
        for k, (t, _), (u, _) in pairs:
            if t != u:
                bad.add(k)
                seen.append((k[0], "bag time", t, u))
    for j, name in enumerate(names):
        for k, (_, v), (_, w) in pairs:
            off = abs(w[j] - v[j])
            if not math.isnan(off) and off > 0.0:
                largest[name] = max(off, largest.get(name, 0.0))
            if not agree(v[j], w[j], Tolerance() if bitwise else tolerance):
                bad.add(k)
                seen.append((k[0], name, v[j], w[j]))
    first = min(seen, key=lambda result: result[0], default=None)
    return (len(rows_a), len(rows_b), len(missing), len(extra), len(bad)), first, largest


@pytest.mark.parametrize("seed", range(24))
def test_two_recordings_are_compared_as_by_independent_code(seed):
    rng = random.Random(seed)
    one = drawn(rng)
    two = changed(one, rng) if seed else {topic: [(t, m, list(v)) for t, m, v in rows] for topic, rows in one.items()}
    tolerance = rng.choice([Tolerance(), Tolerance(0.125), Tolerance(0.0, 0.25), Tolerance(0.2, 0.1)])
    bitwise = seed % 3 == 1
    actual = compare(Signals(recording(one)), Signals(recording(two)), default=tolerance, bitwise=bitwise)
    assert [t.topic for t in actual.topics] == list(dict.fromkeys([*one, *two]))
    firsts = []
    for result in actual.topics:
        topic = result.topic
        counts, first, largest = by_hand(
            (topic, one.get(topic, [])), (topic, two.get(topic, [])), tolerance, bitwise, topic not in two
        )
        reported = (result.count_a, result.count_b, result.missing, result.extra, result.differing)
        assert reported == counts
        assert result.largest == largest
        assert result.equal == (not any(counts[2:]))
        assert (result.first is None) == (first is None)
        if first is not None:
            firsts.append((first[0], topic, *first[1:]))
            had = (result.first.stamp, result.first.field, result.first.a, result.first.b)
            assert had == pytest.approx(first, nan_ok=True) if isinstance(first[2], float) else had == first
    assert actual.equal == (not firsts)
    if firsts:
        assert (actual.first.stamp, actual.first.topic) == min(firsts, key=lambda f: f[0])[:2]


@pytest.mark.parametrize(
    ("a", "b", "tolerance", "off"),
    [
        (1.0, 1.25, (0.25, 0.0), False), (1.0, 1.25, (0.2499, 0.0), True), (4.0, 5.0, (0.0, 0.25), False),
        (5.0, 4.0, (0.0, 0.2), False), (4.0, 5.0, (0.0, 0.2), True),  # differences are relative to the reference
        (-4.0, -5.0, (0.0, 0.25), False), (0.0, 1e-300, (0.0, 1.0), True), (4.0, 4.5, (0.1, 0.125), False),
        (math.nan, math.nan, (0.0, 0.0), False), (math.nan, 1.0, (9.0, 9.0), True), (1.0, math.nan, (9.0, 9.0), True),
        (math.inf, math.inf, (0.0, 0.0), False), (math.inf, -math.inf, (9.0, 0.0), True),
        (1.0, math.inf, (9.0, 0.0), True),
    ],
)  # fmt: skip
def test_a_number_agrees_within_the_larger_of_two_tolerances(a, b, tolerance, off):
    assert Tolerance(*tolerance).exceeded(np.array([a, 0.0]), np.array([b, 0.0])).tolist() == [off, False]


def test_the_first_matching_pattern_counts_and_patterns_can_exclude_topics():
    pair = [Recording([("joints", STATE), ("other", STATE)]) for _ in range(2)]
    for k, result in enumerate(pair):
        result.add(0, 0, JOINTS.encode(0, (1.0, 1.0, 1.0, 1.0 + 0.5 * k)))
        result.add(1, 0, JOINTS.encode(0, (1.0, 1.0 + 0.5 * k, 1.0, 1.0)))
    a, b = map(Signals, pair)

    def differing(**options):
        return {t.topic: t.differing for t in compare(a, b, **options).topics}

    half, none = Tolerance(0.5), Tolerance()
    assert differing() == {"joints": 1, "other": 1}
    assert differing(tolerances={"joints/b/*": half}) == {"joints": 0, "other": 1}
    assert differing(tolerances={"*/velocity": none, "*": half}) == {"joints": 1, "other": 0}
    assert differing(default=half, tolerances={"other/*": none}) == {"joints": 0, "other": 1}
    assert differing(topics=["other"]) == {"other": 1}
    assert differing(topics=["other", "joints"]) == {"other": 1, "joints": 1}
    assert differing(ignore=["o*"]) == {"joints": 1}
    with pytest.raises(BagError, match="nothing to compare"):
        differing(topics=["other"], ignore=["o*"])
    with pytest.raises(BagError, match=r"^no topic none to compare; there are joints, other$"):
        compare(a, b, topics=["none"])


def test_bytes_that_no_number_shows_are_named_by_position():
    """The sign of a zero, and a frame: equal numbers, different bytes."""
    pair = [Recording([("joints", STATE)]) for _ in range(2)]
    for k, actual in enumerate(pair):
        for t in (3, 5):
            zero = -0.0 if k and t == 5 else 0.0
            actual.add(0, t, JOINTS.encode(t, (1.0, zero, 2.0, 2.0)))
    a, b = map(Signals, pair)
    assert compare(a, b).equal
    result = compare(a, b, bitwise=True)
    data = [actual.topics["joints"].data[1] for actual in pair]
    at = next(k for k in range(len(data[0])) if data[0][k] != data[1][k])
    assert (result.first.stamp, result.first.field) == (5, f"byte {at}")
    assert (result.first.a, result.first.b) == tuple(d[at : at + 8].hex() for d in data)
    assert result.topics[0].differing == 1
    longer = Recording([("joints", STATE)])
    for t, d in zip((3, 5), pair[0].topics["joints"].data, strict=True):
        longer.add(0, t, d + bytes(t == 5))
    result = compare(a, Signals(longer), bitwise=True)
    assert (result.first.field, result.first.a, result.first.b) == (f"byte {len(data[0])}", "", "00")


def test_topics_with_another_type_or_without_messages_are_reported():
    a, b, empty = Recording([("x", STATE)]), Recording([("x", FLOAT)]), Recording([("x", STATE)])
    for t in (4, 6):
        a.add(0, t, JOINTS.encode(t, (0.0,) * 4))
    b.add(0, 3, NUMBER.encode(3, (1.0,)))
    (result,) = compare(Signals(a), Signals(b)).topics
    assert (result.count_a, result.count_b, result.missing, result.extra) == (2, 1, 2, 1)
    assert (result.first.stamp, result.first.field, result.first.a, result.first.b) == (3, "type", STATE, FLOAT)
    (result,) = compare(Signals(a), Signals(empty)).topics
    assert (result.missing, result.extra, result.first.stamp) == (2, 0, 4)
    for other in (empty, Recording([("x", FLOAT)]), Recording(())):
        with pytest.raises(BagError, match="nothing to compare"):
            compare(Signals(empty), Signals(other))


def test_a_comparison_in_words_and_as_data():
    equal = TopicComparison("a", STATE, 3, 3)
    other = TopicComparison("b", STATE, 3, 4, missing=1, extra=2, differing=1, largest={"x": 0.12345, "y": math.inf})
    other.note(20, "x", 1.0, math.nan)
    other.note(1_500_000_000, "y", 1, 2)  # the first difference stays the one with the earliest time
    other.note(20, "z", 1, 2)  # for equal times the earlier entry is kept
    comparison = Comparison([equal, other])
    assert str(comparison) == (
        "a: 3 messages, equal\n"
        "b: 3 against 4 messages, 1 missing, 2 extra, 1 differ\n"
        "    x: largest deviation 0.123\n"
        "    y: largest deviation inf\n"
        "first difference: t = 0.00000002 s, b x: 1.0 against nan"
    )
    assert str(Comparison([equal])) == "a: 3 messages, equal\nthe bags agree"
    about = json.loads(comparison.to_json())
    assert about["equal"] is False
    assert about["first"] == {"stamp": 20, "topic": "b", "field": "x", "a": 1.0, "b": "nan"}
    assert [t["equal"] for t in about["topics"]] == [True, False]
    assert about["topics"][1]["largest"] == {"x": 0.12345, "y": "inf"}
    assert json.loads(Comparison([equal]).to_json())["first"] is None
    assert plain({"a": [b"\x01\xff", -math.inf, 1.5, "t"]}) == {"a": ["01ff", "-inf", 1.5, "t"]}


@pytest.mark.parametrize(
    ("stamp", "text"),
    [(0, "0"), (1, "0.000000001"), (1_500_000_000, "1.5"), (10_000_000_000, "10"), (90_000_000, "0.09")],
)
def test_a_stamp_is_reported_in_seconds_to_the_nanosecond(stamp, text):
    assert str(Difference(stamp, "t", "f", 0.1, b"x")) == f"t = {text} s, t f: 0.1 against b'x'"
