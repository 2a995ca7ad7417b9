"""A recording written in blocks gives the same bag, byte for byte, as one written message by message."""

import random

import numpy as np
import pytest
from conftest import few
from softrig_bags.content.topics import BagTopic, absolute
from softrig_bags.errors import BagError
from softrig_bags.files.bag import BagWriter
from softrig_bags.files.mcap_file import McapFile
from softrig_bags.write import write_bag
from softrig_core import Recording
from softrig_core.wire.cdr import Layout

STATE, ARRAY, TEXT = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String"
CLOCK = "rosgraph_msgs/msg/Clock"


def mixed(seed, rows=400):
    """Topics of one rig in rows, at several rates; numbered arrays; messages as bytes, some of several lengths."""
    chance = random.Random(seed)
    kinds = [
        ("/clock", CLOCK),
        ("a", STATE),
        ("slow", STATE),
        ("array", ARRAY),
        ("text", TEXT),
        ("raw", STATE),
        ("no", STATE),
    ]
    result = Recording([*kinds, ("no", STATE)])
    layouts = {0: Layout(CLOCK), 1: Layout(STATE, "", ["x", "y"], {"position": 2, "effort": 2})}
    slow = {2: Layout(STATE, "base", ["q"], {"velocity": 1})}
    array = {3: Layout(ARRAY, counts={"data": 3}, dims=[("row", 3)], numbered=True)}
    times = np.cumsum(np.array([chance.choice([0, 10**6]) for _ in range(rows)]))
    result.rows(layouts)(times[: rows // 2], np.array([[chance.random() for _ in range(4)] for _ in range(rows // 2)]))
    result.rows(layouts)(times[rows // 2 :], np.array([[chance.random() for _ in range(4)] for _ in range(rows // 2)]))
    result.rows(slow)(times[::7], np.array([[chance.random()] for _ in times[::7]]))
    result.rows(array)(times[::3], np.array([[chance.random() for _ in range(3)] for _ in times[::3]]))
    for t in sorted(chance.choices(times.tolist(), k=60)):
        result.add(4, t, bytes(chance.randrange(4, 900)))
    for t in times[::5].tolist():
        result.add(5, t, Layout(STATE, "", ["z"], {"position": 1}).encode(t, (0.5,)))
    return result


def written(folder, recording, by_blocks, **options):
    writer = BagWriter(folder, name="bag", **options)
    numbers = {t.name: writer.add_topic(BagTopic.known(absolute(t.name), t.msgtype)) for t in recording.topics.values()}
    if by_blocks:
        writer.write_recording(recording, numbers)
    else:
        for t, topic, data in recording.messages():
            writer.write(numbers[topic.name], t, data)
    writer.close()
    return {p.name: p.read_bytes() for p in folder.iterdir()}


@pytest.mark.parametrize("seed", few(range(3), 1))
@pytest.mark.parametrize("chunk", [1, 900, 5000, 1 << 19])
@pytest.mark.parametrize("options", [{}, {"compression": "zstd"}, {"storage": "sqlite3"}])
def test_blocks_and_messages_give_the_same_bytes(tmp_path, monkeypatch, seed, chunk, options):
    monkeypatch.setattr(McapFile, "CHUNK_BYTES", chunk)
    assert written(tmp_path / "a", mixed(seed), True, **options) == written(
        tmp_path / "b", mixed(seed), False, **options
    )


def test_a_recording_without_messages_is_written(tmp_path):
    empty = Recording([("a", STATE)])
    assert written(tmp_path / "a", empty, True) == written(tmp_path / "b", empty, False)


def test_a_time_before_zero_is_refused(tmp_path):
    recording = mixed(0)
    recording.add(5, -1, bytes(8))
    with pytest.raises(BagError, match=r"raw: a message at -1 ns, expected times from 0 on"):
        write_bag(tmp_path / "bag", recording)
    assert not list(tmp_path.iterdir())
