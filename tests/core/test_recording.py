"""Recordings, shards and signals against lists of messages: for any order of arrival, and for files cut at any byte."""

import json
import pickle
import struct
from itertools import pairwise

import numpy as np
import pytest
from softrig_core import Recording, Signals, array, button, joint_state, number
from softrig_core.wire import recording as module
from softrig_core.wire.cdr import Layout, parse
from softrig_core.wire.columns import HUGE, Columns, Stored, spacious
from softrig_core.wire.long import is_long
from softrig_core.wire.parameter_event import TOPIC as EVENTS, TYPE as EVENT
from softrig_core.wire.recording import ShardTail, ShardWriter, Topic, read_shards, relative, shard_topics
from softrig_core.wire.shards import Shards
from softrig_core.wire.signals import full_name, short_name, topic_of

PORTS = {  # two topics that may be recorded as numbers (one of them numbered), a flag, and one recorded as bytes only
    "rig/state": joint_state("a", "rig/state", ["x", "y"], position="m"),
    "rig/rows": array("b", "rig/rows", {"row": 2}, "V"),
    "rig/stop": button("c", "rig/stop"),
    "/clock": number("d", "/clock", "s"),
}
LAYOUTS = [port.layout() for port in PORTS.values()]
TOPICS = [(topic, port.msgtype) for topic, port in PORTS.items()]
ROW = {0: LAYOUTS[0], 1: LAYOUTS[1], 2: LAYOUTS[2]}
SIZE = sum(layout.size for layout in ROW.values())


class Plain:
    """The content of a recording, as lists: (time, bytes) by topic, changes of parameters by time and content."""

    def __init__(self):
        self.added = {topic: [] for topic in PORTS}
        self.notes = []

    def row(self, t, values):
        first = 0
        for (k, layout), topic in zip(ROW.items(), PORTS, strict=False):
            mark = len(self.added[topic]) if layout.numbered else t
            self.added[topic].append((t, LAYOUTS[k].encode(mark, values[first : first + layout.size])))
            first += layout.size

    def add(self, k, t, data):
        self.added[list(PORTS)[k]].append((t, data))

    def note(self, t, data):
        self.notes = sorted([*self.notes, (t, data)])

    def all(self):
        return self.added | ({EVENTS: self.notes} if self.notes else {})

    def now(self):
        return {name: list(topic) for name, topic in self.all().items()}


def drawn(seed, turns):
    """The calls on a recording, one after the other: method and arguments."""
    draw, t = np.random.default_rng(seed), 0
    for _ in range(turns):
        t += int(draw.integers(0, 3))
        what = draw.choice(["row", "rows", "add", "note"], p=[0.4, 0.2, 0.25, 0.15])
        values = draw.normal(size=SIZE)
        values[-1] = draw.integers(0, 2)  # the value of the flag
        if what == "rows":
            n = int(draw.integers(1, 5))
            yield what, t, np.arange(t, t + n), np.tile(values, (n, 1))
            t += n
        else:
            yield what, t, values.tolist(), bytes(draw.integers(0, 256, int(draw.integers(0, 6)), dtype=np.uint8))


def holds(recording, plain):
    """Check that a recording has what the lists have, by every way to read it."""
    assert {name: list(zip(t.times, t.data, strict=True)) for name, t in recording.topics.items()} == plain
    for topic in recording.topics.values():
        assert list(topic.stream()) == plain[topic.name]
        assert topic.ticks().tolist() == topic.times
    order = list(recording.topics)
    merged = [(t, order.index(name), k, data) for name, of in plain.items() for k, (t, data) in enumerate(of)]
    assert [(t, order.index(topic.name), data) for t, topic, data in recording.messages()] == [
        (t, rank, data) for t, rank, _, data in sorted(merged)
    ]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("style", [1, 5, 100], ids=["each", "now and then", "at the end"])
def test_a_recording_contains_messages_in_order_of_arrival_however_they_were_added(seed, style, monkeypatch):
    monkeypatch.setattr(module, "CHUNK", 3)
    recording, plain = Recording(TOPICS), Plain()
    row, rows = recording.row(ROW), recording.rows(ROW)
    for turn, (what, t, values, data) in enumerate(drawn(seed, 25), 1):
        if what == "row":
            row(t, values)
            plain.row(t, values)
        elif what == "rows":
            rows(values, data)
            for k, own in zip(values.tolist(), data.tolist(), strict=True):
                plain.row(k, own)
        elif what == "add":
            recording.add(3, t, data)
            plain.add(3, t, data)
        else:
            recording.note(t, data)
            plain.note(t, data)
        if turn % style == 0:
            holds(recording, plain.all())
    holds(recording, plain.all())
    for t in (0, 7, 20, 10**6):
        before = recording.before(t)
        earlier = {name: [m for m in each if m[0] < t] for name, each in plain.all().items()}
        holds(before, {name: each for name, each in earlier.items() if each or name != EVENTS})
        before.add(3, t, b"new")
        before.note(t, b"new")
        assert recording.topics["/clock"].data == [data for _, data in plain.added["/clock"]]
    for name, topic in recording.topics.items():
        for n in (0, 1, 6, 10**6):
            remaining = topic.since(n)
            assert (remaining.name, remaining.msgtype) == (topic.name, topic.msgtype)
            assert list(zip(remaining.times, remaining.data, strict=True)) == plain.all()[name][n:]


@pytest.mark.parametrize("seed", range(4))
def test_shards_of_a_run_in_process_are_the_same_in_memory_and_on_the_disk(seed, tmp_path, monkeypatch):
    """Random messages: the files are read back whole, or a few bytes at a time and left where they are."""
    shards, plain = Shards(tmp_path / "log", TOPICS), Plain()
    row, rows = shards.row(ROW), shards.rows(ROW)
    for what, t, values, data in drawn(seed, 60):
        if what == "row":
            row(t, values)
            plain.row(t, values)
        elif what == "rows":
            rows(values, data)
            for k, own in zip(values.tolist(), data.tolist(), strict=True):
                plain.row(k, own)
        elif what == "add":
            shards.add(3, t, data)
            plain.add(3, t, data)
        else:
            shards.note(t, data)
            plain.note(t, data)
    shards.flush()
    tables: dict = {}
    for held in (1 << 20, 0):
        for style in (1 << 20, 700, 37):
            for name, value in (("HELD", held), ("_LOOK", style), ("ORDERED", 7), ("CHUNK", 3)):
                monkeypatch.setattr(module, name, value)
            monkeypatch.setattr("softrig_core.wire.columns.READ", 5)
            recording = shards.recording()
            kinds = {type(part) for topic in recording.topics.values() for part in topic.parts()}
            assert kinds == ({Stored} if held == 0 else {Columns})
            assert [topic.number for topic in recording.topics.values()] == [len(text) for text in plain.all().values()]
            for topic in list(PORTS)[:3]:
                signals = Signals(recording).table(topic)
                columns = {label: x.tolist() for label, x in signals.columns.items()}
                assert tables.setdefault(topic, (signals.t.tolist(), columns)) == (signals.t.tolist(), columns)
            holds(shards.recording(), plain.all())
    recording.release()
    assert not (tmp_path / "log").exists()
    holds(recording, plain.all())  # the open files are still readable although their names are removed


def test_even_times_are_computed_and_others_are_read(tmp_path):
    for times in ([0, 5, 10, 15], [0, 5, 11], [7], [0, 5, 5, 10]):
        shards = Shards(tmp_path, TOPICS)
        shards.rows(ROW)(np.array(times), np.ones((len(times), SIZE)))
        shards.flush()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, "HELD", 0)
            (part,) = shards.recording().topics["rig/state"].parts()
        assert part.rows.even == ((0, 5) if times == [0, 5, 10, 15] else None)
        assert part.times.tolist() == times
        shards.remove()


def test_columns_on_the_disk_are_not_read_into_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "HELD", 0)
    shards = Shards(tmp_path, TOPICS)
    values = np.arange(9.0 * SIZE).reshape(9, SIZE)
    shards.rows(ROW)(np.arange(9), values)
    shards.flush()
    signals = Signals(shards.recording())
    names = [f"{topic}/{label}" for topic in list(PORTS)[:3] for label in signals.table(topic).columns]
    for k, name in enumerate(names):
        t, x = signals[name]
        assert is_long(t)
        assert is_long(x)
        assert t.tolist() == (np.arange(9) / 1e9).tolist()
        assert x.tolist() == (values[:, k] != 0.0 if name.startswith("rig/stop") else values[:, k]).tolist()
    # Another process gets the numbers, not the file.
    assert pickle.loads(pickle.dumps(signals.recording)).topics == signals.recording.topics


def stretches():
    """A topic of six messages in three blocks of numbers, and their content."""
    topic, values = Topic("rig/state", PORTS["rig/state"].msgtype), np.arange(12.0).reshape(6, 2)
    for first, last in pairwise((0, 1, 3, 6)):
        topic.add_columns(Columns(np.arange(first, last) * 10, values[first:last], LAYOUTS[0]))
    return topic, values


def test_numbers_stay_numbers_until_bytes_are_needed():
    topic, values = stretches()
    assert [len(part.times) for part in topic.parts()] == [1, 2, 3]
    whole = topic.columns()
    assert whole.times.tolist() == topic.ticks().tolist() == [0, 10, 20, 30, 40, 50]
    assert whole.values.tolist() == values.tolist()
    assert topic.columns() is whole
    assert [part.times.tolist() for part in topic.before(21).parts()] == [[0, 10, 20]]
    assert topic.before(0).parts() == ()
    assert topic.times == [0, 10, 20, 30, 40, 50]
    assert topic.columns() is whole  # reading the times does not convert the columns
    topic.add_columns(Columns(np.array([60]), np.array([[1.0, 2.0]]), LAYOUTS[0]))
    assert topic.columns().times.tolist() == [0, 10, 20, 30, 40, 50, 60] == topic.times
    assert len(topic.data) == 7
    assert topic.parts() == ()
    assert topic.columns() is None
    assert topic.ticks().tolist() == topic.times


def around(recording, last):
    """Record a row, three rows of native code, which leave room around them, and one or two rows more."""
    layouts = {list(PORTS).index("rig/state"): LAYOUTS[0]}
    row, rows = recording.row(layouts), recording.rows(layouts)
    row(0, (0.0, 0.5))
    table, _ = spacious([(3, 2), (5, 1)])
    table[:] = np.arange(6.0).reshape(3, 2) + 1.0
    rows(np.array([10, 20, 30]), table)
    for k, values in enumerate(last):
        row(40 + 10 * k, values)
    return table


@pytest.mark.parametrize("counts", [(4, 3), (HUGE // 2, HUGE, 5)])
def test_large_tables_of_answers_share_memory_that_begins_with_a_huge_page(counts):
    tables = spacious([(count, k + 1) for k, count in enumerate(counts)])
    for k, table in enumerate(tables):
        table[:] = k
        assert table.shape == (counts[k], k + 1)
        # the free rows
        assert table.base is not None
        table.base[0] = table.base[-1] = -1.0
    assert all((table == k).all() for k, table in enumerate(tables))
    assert tables[1].ctypes.data - tables[0].ctypes.data == 8 * (counts[0] + 2)
    assert len(counts) == 2 or (tables[0].ctypes.data - 8) % (8 * HUGE) == 0


@pytest.mark.parametrize("last", [[], [(7.0, 7.5)], [(7.0, 7.5), (8.0, 8.5)]])
def test_ticks_around_native_ones_are_joined_without_a_copy_where_there_is_room(last):
    recording = Recording((name, port.msgtype) for name, port in PORTS.items())
    table = around(recording, last)
    signals = Signals(recording)
    for k, name in enumerate(("x", "y")):
        column = signals[f"rig/state/{name}/position"].x
        assert column.tolist() == [0.5 * k, *(1.0 + k + 2.0 * np.arange(3)), *(values[k] for values in last)]
        assert np.shares_memory(column, table) is (len(last) < 2)
    assert signals["rig/state/x/position"].t.tolist() == (np.arange(4 + len(last)) / 1e8).tolist()


def test_a_recording_that_continues_another_does_not_change_it():
    recording = Recording((name, port.msgtype) for name, port in PORTS.items())
    around(recording, [(7.0, 7.5)])
    name, other = "rig/state/x/position", recording.before(40)
    other.row({list(PORTS).index("rig/state"): LAYOUTS[0]})(40, (9.0, 9.5))
    column = Signals(recording)[name].x
    assert Signals(other)[name].x[-1] == 9.0
    assert column[-1] == 7.0


def test_blocks_that_are_excluded_are_left_out():
    for n in range(-1, 8):
        topic, _values = stretches()
        remaining = topic.since(n)
        sizes = [len(part.times) for part in remaining.parts()]
        assert sizes == [[1, 2, 3], [1, 2, 3], [2, 3], [1, 3], [3], [2], [1], [], []][n + 1]
        assert remaining.times == [0, 10, 20, 30, 40, 50][max(n, 0) :]


def test_numbers_of_two_layouts_or_changed_times_are_no_columns():
    topic, _ = stretches()
    other = joint_state("a", "rig/state", ["x", "z"], position="m").layout()
    topic.add_columns(Columns(np.array([60]), np.array([[1.0, 2.0]]), other))
    assert topic.columns() is None
    assert parse(topic.msgtype, topic.data[6]).names == ("x", "z")
    topic, _ = stretches()
    topic.times.append(70)
    assert topic.parts() == ()
    assert Topic("a", "b").parts() == ()


def test_topics_are_equal_if_they_have_the_same_messages_under_one_name():
    first, second = stretches()[0], stretches()[0]
    assert len(second.data) == 6
    assert first == second
    for change in (
        lambda t: t.times.append(1) or t.data.append(b""),
        lambda t: t.data.__setitem__(0, b""),
        lambda t: t.times.__setitem__(0, 1),
        lambda t: setattr(t, "name", "other"),
        lambda t: setattr(t, "msgtype", "other"),
    ):
        other = stretches()[0]
        assert len(other.data) == 6
        change(other)
        assert first != other
    assert first != "rig/state"


def shard(path, seed, turns=12):
    """Write a shard; return the file, where each of its records ends, and what is recorded up to there."""
    writer, plain = ShardWriter(path, TOPICS, ROW), Plain()
    head = {"topics": [*TOPICS, (EVENTS, EVENT)], "row": [[k, layout.form] for k, layout in ROW.items()]}
    ends = [(len(b"softrig shard 2\n" + json.dumps(head).encode() + b"\n"), plain.now())]
    for what, t, values, data in drawn(seed, turns):
        if what == "row":
            writer.add_row(t, values)
            plain.row(t, values)
        elif what == "rows":
            writer.add_rows(values, data)
            for k, own in zip(values.tolist(), data.tolist(), strict=True):
                plain.row(k, own)
                ends.append((ends[-1][0] + 10 + 8 * SIZE, plain.now()))
            continue
        elif what == "add":
            writer.add(3, t, data)
            plain.add(3, t, data)
        else:
            writer.note(t, data)
            plain.note(t, data)
        ends.append((ends[-1][0] + (10 + 8 * SIZE if what == "row" else 14 + len(data)), plain.now()))
    writer.close()
    assert path.stat().st_size == ends[-1][0]
    return ends


def signals(recording):
    return {name: list(zip(t.times, t.data, strict=True)) for name, t in recording.topics.items()}


@pytest.mark.parametrize("seed", [3])
def test_a_shard_cut_anywhere_gives_its_whole_records_and_the_number_of_remaining_bytes(seed, tmp_path):
    path = tmp_path / "node.shard"
    ends = shard(path, seed, 8)
    whole = path.read_bytes()
    for cut in [*range(0, ends[0][0], 17), *range(ends[0][0] - 1, len(whole) + 1)]:
        path.write_bytes(whole[:cut])
        recording = Recording(TOPICS)
        over = recording.read_shard(path)
        at, expected = max((e for e in ends if e[0] <= cut), key=lambda e: e[0], default=(0, ends[0][1]))
        assert (over, signals(recording)) == (cut - at, expected)


def test_rows_without_numbers_are_read_to_the_last(tmp_path):
    """A clock message is only its time: ten bytes a row."""
    path, clock = tmp_path / "clock.shard", Layout("rosgraph_msgs/msg/Clock")
    writer = ShardWriter(path, [("/clock", clock.msgtype), ("x", "std_msgs/msg/Float64")], {0: clock})
    writer.add_row(1, ())
    writer.add(1, 2, b"between")
    writer.add_row(3, ())
    writer.close()
    recording = Recording([("/clock", clock.msgtype), ("x", "std_msgs/msg/Float64")])
    assert recording.read_shard(path) == 0
    assert signals(recording) == {"/clock": [(t, clock.encode(t, ())) for t in (1, 3)], "x": [(2, b"between")]}


@pytest.mark.parametrize("limit", [97, 150, 1 << 22])
def test_a_growing_shard_is_read_as_it_is_written(limit, tmp_path, monkeypatch):
    monkeypatch.setattr(ShardTail, "LIMIT", limit)
    path, growing = tmp_path / "whole.shard", tmp_path / "growing.shard"
    ends = shard(path, 5, 20)
    whole, head = path.read_bytes(), ends[0][0]
    recording, tail = Recording(TOPICS), ShardTail(growing)
    assert not tail.read(recording)  # the file does not exist yet
    growing.write_bytes(whole[:head])
    monkeypatch.setattr(ShardTail, "LIMIT", max(limit, head + 1))  # the head of a shard is read as a whole
    assert not tail.read(recording)
    monkeypatch.setattr(ShardTail, "LIMIT", limit)
    for size in range(head, len(whole) + 1, 41):
        growing.write_bytes(whole[:size])
        for _ in range(100):
            more = tail.read(recording)
            if not more:
                break
        assert signals(recording) == max((e for e in ends if e[0] <= size), key=lambda e: e[0])[1]
    growing.write_bytes(whole)
    styles = 0
    while tail.read(recording):
        styles += 1
    assert signals(recording) == ends[-1][1]
    assert styles <= 1


def test_a_shard_reports_whether_there_may_be_more(tmp_path, monkeypatch):
    path = tmp_path / "node.shard"
    writer = ShardWriter(path, TOPICS[3:])
    for k in range(9):
        writer.add(0, k, b"12345678")  # 22 bytes for each message
    writer.close()
    recording, tail = Recording(TOPICS), ShardTail(path)
    assert not tail.read(recording)  # one read returned everything
    writer = ShardWriter(path, TOPICS[3:])
    for k in range(9):
        writer.add(0, k, b"12345678")
    writer.close()
    monkeypatch.setattr(ShardTail, "LIMIT", path.stat().st_size - 8 * 22)
    recording, tail, messages = Recording(TOPICS), ShardTail(path), []
    for _ in range(4):
        messages.append((tail.read(recording), len(recording.topics["/clock"].times)))
        monkeypatch.setattr(ShardTail, "LIMIT", 3 * 22)
    assert messages == [(True, 1), (True, 4), (True, 7), (False, 9)]


def test_a_shard_is_written_to_the_disk_as_soon_as_it_must_be(tmp_path):
    """The first message immediately, then whenever more than 4096 bytes are pending, at a change of parameters, and at
    a flush.
    """
    path = tmp_path / "node.shard"
    writer = ShardWriter(path, TOPICS, ROW)
    sizes = [path.stat().st_size]

    def grown():
        sizes.append(path.stat().st_size)
        return sizes[-1] - sizes[-2]

    assert sizes[0] > 0
    writer.add(3, 1, b"1")
    assert grown() == 15
    writer.add(3, 2, bytes(4096 - 14))
    assert grown() == 0  # the growth is exactly the limit
    writer.add(3, 3, b"")
    assert grown() == 4096 + 14
    writer.add_row(4, [0.0] * SIZE)
    assert grown() == 0
    writer.note(5, b"change")
    assert grown() == 10 + 8 * SIZE + 20
    n = 4096 // (10 + 8 * SIZE)
    writer.add_rows(np.arange(n), np.zeros((n, SIZE)))
    assert grown() == 0
    writer.add_row(6, [0.0] * SIZE)
    assert grown() == (n + 1) * (10 + 8 * SIZE)
    writer.add(3, 7, b"last")
    writer.flush()
    assert grown() == 18
    writer.close()


def test_topics_of_a_shard_are_below_the_namespace_of_its_node(tmp_path):
    path, empty, none = tmp_path / "a.shard", tmp_path / "b.shard", tmp_path / "c.shard"
    writer = ShardWriter(path, [("a/said", "std_msgs/msg/Float64"), ("a/b/more", "std_msgs/msg/Float64")])
    writer.add(1, 5, b"x")
    writer.note(6, b"y")
    writer.close()
    recording = Recording([("said", "std_msgs/msg/Float64"), ("b/more", "std_msgs/msg/Float64")])
    assert recording.read_shard(path, "a/") == 0
    assert signals(recording) == {"said": [], "b/more": [(5, b"x")], EVENTS: [(6, b"y")]}
    assert shard_topics(path) == {"a/said": "std_msgs/msg/Float64", "a/b/more": "std_msgs/msg/Float64"}
    empty.write_bytes(path.read_bytes()[:30])
    assert shard_topics(empty) == {}
    empty.write_bytes(b"softrig shard 1\n" + path.read_bytes()[16:])  # a shard of another version is ignored
    assert shard_topics(empty) == {}
    both = read_shards([empty, none, path])
    assert signals(both) == {"a/said": [], "a/b/more": [(5, b"x")], EVENTS: [(6, b"y")]}
    assert (relative("/clock"), relative("/a/b"), relative("a/b")) == ("/clock", "a/b", "a/b")


def test_a_name_of_a_signal_may_leave_out_its_only_field():
    known = ("a/state/x/position", "a/state/y/position", "a/state/y/velocity", "a/rows/0,1", "single")
    for name, whole in (
        ("a/state/x", "a/state/x/position"),
        ("a/state/y", "a/state/y"),  # two fields match, so the name stays
        ("a/state/x/position", "a/state/x/position"),
        ("a/rows", "a/rows/0,1"),
        ("a/state", "a/state"),
        ("single", "single"),
        ("", "single"),
    ):
        assert full_name(name, known) == whole
    assert [short_name(name, known) for name in known] == ["a/state/x", *known[1:3], "a/rows", ""]
    topics = ("a", "a/state", "a/state/x", "b")
    for name, topic in (
        ("a/state/x/position", "a/state/x"),
        ("a/state/y/position", "a/state"),
        ("a/statement", "a"),
        ("a", ""),
        ("c/a/x", ""),
    ):
        assert topic_of(name, topics) == topic


def test_signals_from_numbers_and_from_bytes_are_the_same():
    """By an independent reader of the bytes; a flag is 0 or 1, time and stamps count from the epoch."""
    recording, again = Recording(TOPICS), Recording(TOPICS)
    rows = recording.rows(ROW)
    values = np.arange(15.0).reshape(3, 5)
    values[:, -1] = (0.0, 1.0, 1.0)
    rows(np.array([10**9, 2 * 10**9]), values[:2])
    rows(np.array([4 * 10**9]), values[2:])
    for name, topic in recording.topics.items():
        again.topics[name].times.extend(topic.times)
        again.topics[name].data.extend(topic.data)
    recording = Recording(TOPICS)
    rows = recording.rows(ROW)
    rows(np.array([10**9, 2 * 10**9]), values[:2])
    rows(np.array([4 * 10**9]), values[2:])
    labels = {
        "rig/state": ["x/position", "y/position"],
        "rig/rows": ["0", "1"],
        "rig/stop": ["data"],
    }
    for reported in (Signals(recording, 10**9), Signals(again, 10**9)):
        for k, (topic, own) in enumerate(labels.items()):
            table = reported.table(topic)
            assert list(table.columns) == own
            assert table.t.tolist() == table.stamp.tolist() == [0.0, 1.0, 3.0]
            for j, label in enumerate(own):
                signal = reported[f"{topic}/{label}"]
                assert signal.t is table.t
                assert signal.x.tolist() == values[:, 2 * k + j].tolist()
                assert signal.x.flags.c_contiguous
        assert list(reported) == [f"{topic}/{label}" for topic, own in labels.items() for label in own]
        assert len(reported) == 5
        assert reported.table("/clock").t.size == 0
    assert recording.topics["rig/state"].columns() is not None  # reading signals does not encode bytes
    assert reported["rig/state/x"] is reported["rig/state/x"]


def test_none_of_many_channels_is_lost():
    """A flag for each number of a row: more than nine are counted right."""
    port, recording = (
        joint_state("a", "wide", [f"x{k}" for k in range(13)], position="m"),
        Recording([("wide", "sensor_msgs/msg/JointState")]),
    )
    recording.rows({0: port.layout()})(np.array([0, 10**9]), np.arange(26.0).reshape(2, 13))
    table = Signals(recording).table("wide")
    assert {k: x.tolist() for k, x in table.columns.items()} == {f"x{k}/position": [k, 13.0 + k] for k in range(13)}


def test_stamps_that_are_not_the_ticks_and_messages_of_several_forms_are_read_one_by_one():
    recording = Recording(TOPICS)
    state = recording.topics["rig/state"]
    for t, stamp, names in ((5, 3, "xy"), (6, 4, "xy")):
        state.times.append(t * 10**9)
        state.data.append(Layout(state.msgtype, "", names, {"position": 2}).encode(stamp * 10**9 + 7, (1.0, 2.0)))
    table = Signals(recording, 10**9).table("rig/state")
    assert (table.t.tolist(), table.stamp.tolist()) == ([4.0, 5.0], [2.000000007, 3.000000007])
    state.times.append(7 * 10**9)  # a joint state with another frame and more joints
    state.data.append(Layout(state.msgtype, "world", "xy", {"position": 2}).encode(10**10, (5.0, 6.0)))
    table = Signals(recording, 10**9).table("rig/state")
    assert table.stamp.tolist() == [2.000000007, 3.000000007, 9.0]
    assert [x.tolist() for x in table.columns.values()] == [[1.0, 1.0, 5.0], [2.0, 2.0, 6.0]]
    state.times.append(8 * 10**9)
    state.data.append(Layout(state.msgtype, "", "yx", {"position": 2}).encode(0, (5.0, 6.0)))
    table = Signals(recording, 10**9).table("rig/state")  # found by the name of the joint
    assert {k: x.tolist() for k, x in table.columns.items()} == {
        "x/position": [1.0, 1.0, 5.0, 6.0],
        "y/position": [2.0, 2.0, 6.0, 5.0],
    }
    rows = recording.topics["rig/rows"]
    for t, dims in ((1, (("row", 1),)), (2, (("row", 2),)), (3, (("row", 1),))):
        size = dims[0][1]
        rows.times.append(t * 10**9)
        rows.data.append(Layout(rows.msgtype, dims=dims, counts={"data": size}).encode(0, (float(t),) * size))
    table = Signals(recording, 10**9).table("rig/rows")
    assert {k: x.tolist()[:2] for k, x in table.columns.items()} == {
        "0": [1.0, 2.0],
        "1": [pytest.approx(np.nan, nan_ok=True), 2.0],
    }
    assert table.stamp.tolist() == [-1.0] * 3
    for name, text in (
        ("rig/none/x", "no topic for signal 'rig/none/x'; recorded are rig/state, rig/rows, rig/stop, /clock"),
        ("rig/rows/7", "no signal '7' on rig/rows; it has 0, 1"),
    ):
        with pytest.raises(KeyError) as error:
            Signals(recording)[name]
        assert error.value.args[0] == text
    with pytest.raises(KeyError, match="no topic 'x'; recorded are rig/state, rig/rows, rig/stop, /clock"):
        Signals(recording).table("x")
    assert struct.calcsize("<qHI") == 14  # size of the head of a record
