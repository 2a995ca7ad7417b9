"""MCAP files with all optional parts in all combinations, judged by the mcap package's own reader."""

import itertools
import random
import struct
from io import BytesIO

import numpy as np
import pytest
from conftest import few
from mcap.reader import NonSeekingReader
from mcap.writer import CompressionType, IndexType, Writer
from softrig_bags.cli import main_bag, main_compare
from softrig_bags.content import known
from softrig_bags.content.topics import BagTopic, typestore
from softrig_bags.errors import BagError
from softrig_bags.files.mcap_source import McapSource, message_run
from softrig_bags.files.reader import BagReader
from softrig_bags.files.source import Damaged
from softrig_bags.read import read_bag, signals
from test_foreign_bags import number

FLOAT, TEXT = "std_msgs/msg/Float64", "std_msgs/msg/String"
PARTS = ("use_statistics", "repeat_channels", "repeat_schemas", "use_summary_offsets")
INDEXES = [IndexType.NONE, IndexType.ALL, IndexType.MESSAGE, IndexType.CHUNK]
CHUNKS = [(True, 1 << 20), (True, 90), (True, 400), (False, 0)]
COMPRESSIONS = [CompressionType.NONE, CompressionType.ZSTD, CompressionType.LZ4]
FILES = [
    (dict(zip(PARTS, flags, strict=True)), index, chunks, compression)
    for flags in itertools.product([False, True], repeat=len(PARTS))
    for index in INDEXES
    for chunks in CHUNKS
    for compression in (COMPRESSIONS if chunks[0] else COMPRESSIONS[:1])
]


def text(words):
    data = words.encode() + b"\0"
    return struct.pack("<HHI", 0x100, 0, len(data)) + data


def written(options, index, chunks, compression):
    """A file of two topics, with messages of equal and of different lengths; one message is out of order."""
    out = BytesIO()
    writer = Writer(
        out, index_types=index, use_chunking=chunks[0], chunk_size=chunks[1], compression=compression, **options
    )
    writer.start("", "")
    speed = writer.register_schema(FLOAT, "ros2msg", b"float64 data")
    note = writer.register_schema(TEXT, "ros2msg", b"string data")
    topics = writer.register_channel("/speed", "cdr", speed), None
    for k in range(7):
        writer.add_message(topics[0], 10 * k, number(k), 10 * k)
    writer.add_attachment(0, 0, "notes.txt", "text/plain", b"kept beside")
    other = writer.register_channel("/note", "cdr", note)
    for k in range(5):
        writer.add_message(other, 10 * k + 5, text("x" * k), 0)
        writer.add_message(topics[0], 100 + k, number(-k), 0)
    writer.finish()
    return out.getvalue()


def by_their_reader(content):
    """Messages by time, equal times in written order, read by the library's reader that needs no index."""
    rows = [
        (channel.topic, message.log_time, message.data)
        for _, channel, message in NonSeekingReader(BytesIO(content)).iter_messages(log_time_order=False)
    ]
    return sorted(rows, key=lambda row: row[1])


@pytest.mark.parametrize("chunks", few(map(pytest.param, CHUNKS), 2))
def test_all_optional_parts_in_all_combinations_give_the_same_messages(tmp_path, chunks):
    file, count = tmp_path / "x.mcap", 0
    for options, index, own, compression in FILES:
        if own != chunks:
            continue
        content = written(options, index, own, compression)
        file.write_bytes(content)
        with BagReader(file) as bag:
            results = [(bag.topics[i].name, t, data) for i, t, data in bag.messages()]
            assert (bag.is_whole, bag.counts) == (True, [12, 5]), options
        expected = by_their_reader(content)
        assert len(expected) == 17
        assert results == expected, (options, index, compression)
        count += 1
    assert count == 16 * 4 * (3 if chunks[0] else 1)


def test_the_counts_of_the_statistics_are_compared_with_the_messages(tmp_path, capsys):
    content = written(dict.fromkeys(PARTS, True), IndexType.ALL, (True, 400), CompressionType.NONE)
    at = content.rindex(struct.pack("<HQHQ", 1, 12, 2, 5))
    changed = bytearray(content)
    changed[at + 2] = 13
    file = tmp_path / "x.mcap"
    file.write_bytes(changed)
    assert main_bag(["info", str(file)]) == 1
    assert "/speed: 12 messages in x.mcap, its statistics claim 13" in capsys.readouterr().err
    assert main_compare([str(file), str(file)]) == 1
    assert "the messages that were read agree; the bags claim others" in capsys.readouterr().out
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 1
    assert len((tmp_path / "out/speed.csv").read_text().splitlines()) == 13


@pytest.mark.parametrize("wrong", ["short", "outside", "other", "empty"])
def test_an_index_that_is_wrong_or_lacks_messages_loses_none(tmp_path, wrong):
    """An index is only a hint: the records of the chunk decide."""
    content = bytearray(written(dict.fromkeys(PARTS, True), IndexType.ALL, (True, 1 << 20), CompressionType.NONE))
    at = content.index(struct.pack("<BQH", 7, 6 + 16 * 12, 1)) + 11
    entries = at + 4
    if wrong == "short":  # the header claims only the first six of twelve entries
        content[at : at + 4] = struct.pack("<I", 16 * 6)
    elif wrong == "outside":
        content[entries + 8 : entries + 16] = struct.pack("<Q", 1 << 40)
    elif wrong == "other":  # an offset at which no record begins
        content[entries + 8 : entries + 16] = struct.pack("<Q", 3)
    else:
        content[at : at + 4] = bytes(4)
    file = tmp_path / "x.mcap"
    file.write_bytes(content)
    recording = read_bag(file)
    assert [len(t.data) for t in recording.topics.values()] == [12, 5]


@pytest.mark.parametrize("share", [0.2, 0.5, 0.9, 0.999])
def test_a_file_that_is_cut_is_refused(tmp_path, share):
    content = written({}, IndexType.ALL, (True, 90), CompressionType.NONE)
    (tmp_path / "x.mcap").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(Damaged, match="cut off"):
        McapSource(tmp_path / "x.mcap")


def lengths(seed):
    """Lengths of messages: some repeat with a period, with others in between."""
    chance = np.random.default_rng(seed)
    pattern = chance.integers(0, 40, chance.integers(1, 9)).tolist()
    result = []
    for _ in range(int(chance.integers(1, 6))):
        result += pattern * int(chance.integers(0, 120))
        result += chance.integers(0, 60, chance.integers(0, 30)).tolist()
    return result


@pytest.mark.parametrize("seed", range(12))
def test_successive_messages_are_found_as_by_counting(seed):
    """For any lengths, with another type of record at the end, and with a truncated last message."""
    content, starts = b"", []
    for n in lengths(seed):
        starts.append(len(content))
        content += struct.pack("<BQ", 5, 22 + n) + bytes(22) + b"\5" * n
    end = len(content)
    for remaining in (b"", struct.pack("<BQ", 3, 0), struct.pack("<BQ", 5, 22) + bytes(3)):
        whole = content + remaining
        result, after = message_run(whole, np.frombuffer(whole, np.uint8), 0, len(whole))
        assert (result.tolist(), after) == (starts, end)


def test_a_second_channel_of_a_topic_that_appears_late_belongs_to_the_same_topic(tmp_path):
    out = BytesIO()
    writer = Writer(out, chunk_size=60, repeat_channels=False, use_statistics=False)
    writer.start()
    schema = writer.register_schema(FLOAT, "ros2msg", b"float64 data")
    for k, reliability in enumerate(("reliable", "best_effort")):
        # A QoS profile lists only some of its policies.
        qos = f"- history: keep_last\n  depth: 3\n  reliability: {reliability}\n"
        channel = writer.register_channel("/speed", "cdr", schema, {"offered_qos_profiles": qos})
        for i in range(5):
            writer.add_message(channel, 10 * i + k, number(10 * i + k), 0)
    writer.finish()
    (tmp_path / "x.mcap").write_bytes(out.getvalue())
    assert signals(tmp_path / "x.mcap")["speed/data"].x.tolist() == [0, 1, 10, 11, 20, 21, 30, 31, 40, 41]
    with BagReader(tmp_path / "x.mcap") as bag:
        assert [q.reliability.name for q in bag.topics[0].offered] == ["RELIABLE", "BEST_EFFORT"]
        assert {q.durability.name for q in bag.topics[0].offered} == {"VOLATILE"}


def test_two_types_on_one_topic_are_both_read(tmp_path):
    out = BytesIO()
    writer = Writer(out)
    writer.start()
    channels = [
        writer.register_channel("/x", "cdr", writer.register_schema(name, "ros2msg", definition))
        for name, definition in ((FLOAT, b"float64 data"), ("a/msg/Int", b"int8 data"))
    ]
    for k in range(4):
        writer.add_message(channels[k % 2], k, number(k) if k % 2 == 0 else struct.pack("<HHb", 0x100, 0, -k), 0)
    writer.finish()
    (tmp_path / "x.mcap").write_bytes(out.getvalue())
    result = signals(tmp_path / "x.mcap")
    assert {name: result[name].x.tolist() for name in result} == {"x/data": [0, 2], "x (a/msg/Int)/data": [-1, -3]}
    assert main_bag(["export", str(tmp_path / "x.mcap"), "--out", str(tmp_path / "out")]) == 0
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["x (a.msg.Int).csv", "x.csv"]


@pytest.mark.parametrize("claim", [0, 1, 13, 1 << 60])
def test_wrong_counts_of_the_statistics_lose_and_invent_no_row(tmp_path, claim):
    content = bytearray(written(dict.fromkeys(PARTS, True), IndexType.ALL, (True, 400), CompressionType.NONE))
    at = content.rindex(struct.pack("<HQHQ", 1, 12, 2, 5))
    content[at : at + 10] = struct.pack("<HQ", 1, claim)
    (tmp_path / "x.mcap").write_bytes(content)
    whole = written(dict.fromkeys(PARTS, True), IndexType.ALL, (True, 400), CompressionType.NONE)
    (tmp_path / "y.mcap").write_bytes(whole)
    wrong, right = (signals(tmp_path / name) for name in ("x.mcap", "y.mcap"))
    assert [*wrong] == [*right]
    for name in right:
        assert wrong[name].t.tolist() == right[name].t.tolist()
        assert wrong[name].x.tolist() == right[name].x.tolist()


def test_a_wrong_index_of_one_chunk_changes_no_message(tmp_path):
    content = bytearray(written(dict.fromkeys(PARTS, True), IndexType.ALL, (True, 90), CompressionType.NONE))
    (tmp_path / "x.mcap").write_bytes(content)
    at = [k for k in range(len(content) - 9) if content[k] == 7 and content[k + 1 : k + 9] == struct.pack("<Q", 22)]
    assert len(at) > 3  # indexes with one entry: channel, length, time, offset
    content[at[1] + 23 : at[1] + 31] = struct.pack("<Q", 3)
    (tmp_path / "y.mcap").write_bytes(content)
    with BagReader(tmp_path / "x.mcap") as right, BagReader(tmp_path / "y.mcap") as wrong:
        assert [*wrong.messages()] == [*right.messages()]


def test_a_chunk_whose_messages_begin_before_its_stated_start_is_damaged(tmp_path):
    content = bytearray(written({}, IndexType.NONE, (True, 1 << 20), CompressionType.NONE))
    at = content.index(struct.pack("<QQ", 0, 104)) if struct.pack("<QQ", 0, 104) in content else 0
    assert at
    content[at : at + 8] = struct.pack("<Q", 50)
    (tmp_path / "x.mcap").write_bytes(content)
    assert main_bag(["info", str(tmp_path / "x.mcap")]) == 2


@pytest.mark.parametrize("chunks", [(True, 90), (False, 0)], ids=str)
def test_any_damage_gives_messages_or_a_one_line_refusal(tmp_path, chunks):
    """Without checksums, so that the reader itself must notice the damage."""
    whole = bytearray(written(dict.fromkeys(PARTS, True), IndexType.ALL, chunks, CompressionType.NONE))
    at = 8
    while at + 9 <= len(whole):
        code, n = struct.unpack_from("<BQ", whole, at)
        if code == 6:
            whole[at + 33 : at + 37] = bytes(4)
        at += 9 + n
    refused = 0
    for seed in range(150):
        chance = random.Random(seed)
        content = bytearray(whole)
        at = chance.randrange(8, len(content))
        match seed % 3:
            case 0:
                content[at] ^= 1 << chance.randrange(8)
            case 1:
                content[at : at + 8] = chance.randbytes(8)
            case _:
                content[at : at + 4] = b"\xff" * 4
        (tmp_path / "x.mcap").write_bytes(content)
        try:
            result = signals(tmp_path / "x.mcap")
            assert all(len(result[name].x) <= 17 for name in result)
        except BagError:
            refused += 1
    assert 20 < refused < 140


def test_the_types_of_our_topics_equal_those_of_the_library_of_all_types():
    """Definition and hash, which softrig has without that library."""
    for msgtype in known._HASHES:
        written, _ = typestore().generate_msgdef(msgtype, ros_version=2)
        assert known.definition_of(msgtype) == (written, typestore().hash_rihs01(msgtype)), msgtype
    assert known.definition_of("std_msgs/msg/ColorRGBA") is None  # defined only inside other definitions, or not at all
    topic = BagTopic.known("/x", "sensor_msgs/msg/JointState")
    assert (topic.definition, topic.digest) == known.definition_of("sensor_msgs/msg/JointState")
