"""Whether a recorder was there from the start of a rig, judged by the messages it has of each topic."""

from fractions import Fraction
from itertools import islice
from pathlib import Path

import pytest
from softrig_bags.content.topics import BagTopic
from softrig_bags.files.reader import BagReader
from softrig_bags.live.join import Join, missed
from softrig_core.block.schedule import Schedule
from softrig_core.wire.cdr import Layout
from softrig_nodes.seam.tick import acknowledged

ARRAY, CLOCK, HEADER = "std_msgs/msg/Float64MultiArray", "rosgraph_msgs/msg/Clock", "std_msgs/msg/Header"
BAGS = sorted(p.parent for p in (Path(__file__).parents[2] / "bags").glob("*/bag/metadata.yaml"))


def joined(name, msgtype, messages):
    """The facts that are known about a topic after these messages."""
    join = Join(BagTopic.known(f"/{name}", msgtype, []))
    for data in messages:
        if join.open:
            join.inspect(data)
    return name, join


SENT = {
    "clock": (CLOCK, Layout(CLOCK), range(220_000_000, 320_000_000, 10_000_000)),
    "sixty": (HEADER, Layout(HEADER), [round(k * 1e9 / 60) for k in range(7, 20)]),
    "now_and_then": (HEADER, Layout(HEADER), [250_000_000, 260_000_000, 400_000_000, 410_000_000]),
    "between": (HEADER, Layout(HEADER), range(225_000_000, 320_000_000, 10_000_000)),
    "wall": (HEADER, Layout(HEADER), range(1_700_000_000 * 10**9, 1_700_000_001 * 10**9, 10**8)),
    "array": (ARRAY, Layout(ARRAY, counts={"data": 1}, dims=[("row", 1)], numbered=True), range(31, 40)),
}
WHOLE = ("whole", HEADER, [Layout(HEADER).encode(t, ()) for t in range(0, 100_000_000, 10_000_000)])


def test_a_recorder_that_joins_late_reports_what_it_missed():
    """By the stamps, or by the numbers of arrays; a topic without a steady period does not count."""
    results = [
        joined(name, kind, [layout.encode(mark, (0.0,) if kind == ARRAY else ()) for mark in marks])
        for name, (kind, layout, marks) in SENT.items()
    ]
    assert missed(results) == {"clock": 22, "sixty": 7, "array": 31}
    # A rig waits until its recorder has subscribed to all topics or to none.
    assert missed([*results, joined(*WHOLE)]) == {"array": 31}


@pytest.mark.parametrize("every", range(1, 9))
@pytest.mark.parametrize("period", ["0.001", "1/2880", "1/3"])
def test_acknowledgements_of_a_follower_alone_prove_nothing(every, period):
    """It acknowledges some ticks together, so its first one is not at t = 0."""
    schedule = Schedule(Fraction(period) * every, Fraction(period))
    ticks = [schedule.time(k) for k in range(40)]
    sent = [Layout(HEADER).encode(t, ()) for t in ticks if acknowledged(schedule, t)]
    assert missed([joined("law/tick", HEADER, sent)]) == {}


def test_a_topic_that_begins_later_is_not_counted_as_missed():
    """As the certificate of a delay system, which publishes a number from 38.4 ms on, every 0.3 ms."""
    late = joined("late", HEADER, [Layout(HEADER).encode(t, ()) for t in range(38_400_000, 42_000_000, 300_000)])
    assert missed([late]) == {"late": 128}
    assert missed([late, joined(*WHOLE)]) == {}


def test_no_message_is_missed_in_a_whole_recording_of_any_system():
    """A golden bag of each system, as far as its topics have begun."""
    results = {}
    for bag in {b.parent.name.rpartition("_")[0][:12]: b for b in BAGS}.values():
        with BagReader(bag) as reader:
            messages = {t.name: [] for t in reader.topics}
            for i, _, data in islice(reader.messages(), 1000):
                messages[reader.topics[i].name].append(bytes(data))
            topics = [joined(t.name, t.msgtype, messages[t.name]) for t in reader.topics]
        results[bag.parent.name] = missed(topics)
    assert len(results) > 12
    assert not {name: what for name, what in results.items() if what}
