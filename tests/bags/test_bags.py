"""Bags: written, read back by independent libraries, compared, repaired."""

import csv
import errno
import heapq
import json
import os
import random
import resource
import shutil
import sqlite3
import struct
import sys
import tracemalloc
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

import numpy as np
import pyarrow.parquet
import pytest
from conftest import few
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer as McapLibraryWriter
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore
from ruamel.yaml import YAML
from softrig_bags.cli import main_bag
from softrig_bags.compare import Tolerance, compare
from softrig_bags.content.stamps import is_stamped
from softrig_bags.content.topics import BagTopic, qos
from softrig_bags.errors import BagError
from softrig_bags.export import export
from softrig_bags.files.bag import STORAGES, BagWriter
from softrig_bags.read import read_bag, signals
from softrig_bags.repair import repair
from softrig_bags.tables import OnDisk, Piece
from softrig_bags.write import write_bag
from softrig_core import Recording, RunError, Signals
from softrig_core.wire.cdr import Layout
from softrig_core.wire.long import is_long
from softrig_core.wire.recording import ShardWriter

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

STATE = "sensor_msgs/msg/JointState"
LIMIT = 1 << 24  # bytes of a chunk; the real limit is 2 GB
FORMATS = [("mcap", "none"), ("mcap", "zstd"), ("sqlite3", "none")]


def recording(ticks=50, period=1_000_000, gain=1.0) -> Recording:
    """Two topics and the clock; the second publishes only at every fourth tick."""
    clock = Layout("rosgraph_msgs/msg/Clock")
    state = Layout(STATE, "", ["a", "b"], {"position": 2, "velocity": 2})
    command = Layout(STATE, "", ["a"], {"effort": 1})
    result = Recording([("/clock", "rosgraph_msgs/msg/Clock"), ("plant/state", STATE), ("command", STATE)])
    for k in range(ticks):
        t = k * period
        result.add(0, t, clock.encode(t, ()))
        result.add(1, t, state.encode(t, (k * 0.1, -k * 0.1, k * 1.0, 1.0)))
        if k % 4 == 0:
            result.add(2, t, command.encode(t, (gain * k,)))
    return result


def expected(source: Recording) -> list[tuple[str, int, bytes]]:
    return [("/" + topic.name.lstrip("/"), t, data) for t, topic, data in source.messages()]


def size(directory: Path) -> int:
    return sum(p.stat().st_size for p in directory.iterdir())


@pytest.fixture
def file_limit():
    """Return a function that makes the kernel refuse writes beyond a file size, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda n: resource.setrlimit(resource.RLIMIT_FSIZE, (n, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize(("storage", "compression"), FORMATS)
def test_rosbags_reads_what_was_written_in_order(tmp_path, storage, compression):
    source = recording()
    write_bag(tmp_path / "bag", source, storage=storage, compression=compression, custom_data={"seed": "1"})
    with Reader(tmp_path / "bag") as reader:
        results = [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]
        assert reader.storage.metadata.custom == {"seed": "1"}
        assert {c.topic: c.msgcount for c in reader.connections} == {"/clock": 50, "/plant/state": 50, "/command": 13}
    assert results == expected(source)


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_mcap_reader_agrees_with_index_statistics_and_checksums(tmp_path, compression):
    source = recording(ticks=6000)
    write_bag(tmp_path / "bag", source, compression=compression)
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert len(summary.chunk_indexes) > 1
        assert summary.statistics.message_count == 13500
        assert summary.statistics.message_end_time == 5_999_000_000
        results = [(c.topic, m.log_time, m.data) for _, c, m in reader.iter_messages(log_time_order=False)]
        later = [m.log_time for _, _, m in reader.iter_messages(topics=["/command"], starting_at=5_990_000_000)]
    assert results == expected(source)
    assert later == [5_992_000_000, 5_996_000_000]


@pytest.mark.parametrize(("storage", "compression"), FORMATS)
def test_equal_recordings_give_equal_bytes(tmp_path, storage, compression):
    for place in ("one", "two"):
        write_bag(tmp_path / place / "bag", recording(), storage=storage, compression=compression)
    names = sorted(p.name for p in (tmp_path / "one/bag").iterdir())
    assert len(names) == 2
    for name in names:
        assert (tmp_path / "one/bag" / name).read_bytes() == (tmp_path / "two/bag" / name).read_bytes()


# Keys that rosbag2's metadata parser of version 9 requires, and the type that it expects of each.
QOS_FIELDS = {
    "history": str,
    "depth": int,
    "reliability": str,
    "durability": str,
    "deadline": dict,
    "lifespan": dict,
    "liveliness": str,
    "liveliness_lease_duration": dict,
    "avoid_ros_namespace_conventions": bool,
}
POLICIES = {
    "history": {"keep_last", "keep_all", "system_default", "unknown"},
    "reliability": {"reliable", "best_effort", "system_default", "unknown"},
    "durability": {"volatile", "transient_local", "system_default", "unknown"},
    "liveliness": {"automatic", "manual_by_topic", "system_default", "unknown"},
}


@pytest.mark.parametrize("seed", range(20))
def test_messages_are_ordered_by_time_then_topic_and_within_a_topic_by_arrival(seed):
    """Some are late, as in a real-time run; some topics have no messages; one bag has none at all."""
    rng, topics = random.Random(seed), seed % 5
    result = Recording((f"t{k}", STATE) for k in range(topics))
    streams = []
    for rank in range(topics):
        times = sorted(rng.choices(range(30), k=rng.choice([0, 3, 40])))
        for k in rng.sample(range(len(times)), len(times) // 8):
            times[k] -= rng.randrange(5)
        for k, t in enumerate(times):
            result.add(rank, t, b"%d" % k)
        streams.append([(t, rank, b"%d" % k) for k, t in enumerate(times)])
    merged = heapq.merge(*streams, key=lambda message: message[:2])
    assert [(t, int(topic.name[1:]), data) for t, topic, data in result.messages()] == list(merged)


@pytest.mark.parametrize(("storage", "suffix"), [("mcap", "mcap"), ("sqlite3", "db3")])
def test_metadata_has_every_field_that_rosbag2_demands(tmp_path, storage, suffix):
    write_bag(tmp_path / "bag", recording(), storage=storage)
    top = YAML(typ="safe").load(tmp_path / "bag" / "metadata.yaml")
    assert list(top) == ["rosbag2_bagfile_information"]
    info = top["rosbag2_bagfile_information"]
    assert info["version"] == 9
    assert info["storage_identifier"] == storage
    assert info["duration"] == {"nanoseconds": 49_000_000}
    assert info["starting_time"] == {"nanoseconds_since_epoch": 0}
    assert info["message_count"] == 113
    assert info["compression_format"] == info["compression_mode"] == ""
    assert info["relative_file_paths"] == [f"bag_0.{suffix}"]
    assert info["files"] == [
        {
            "path": f"bag_0.{suffix}",
            "starting_time": {"nanoseconds_since_epoch": 0},
            "duration": {"nanoseconds": 49_000_000},
            "message_count": 113,
        }
    ]
    assert info["custom_data"] is None
    assert isinstance(info["ros_distro"], str)
    for entry in info["topics_with_message_count"]:
        topic = entry["topic_metadata"]
        assert isinstance(entry["message_count"], int)
        assert topic["serialization_format"] == "cdr"
        assert topic["type_description_hash"].startswith("RIHS01_")
        for profile in topic["offered_qos_profiles"]:
            assert {k: type(v) for k, v in profile.items()} == QOS_FIELDS
            for policy, allowed in POLICIES.items():
                assert profile[policy] in allowed
            assert set(profile["deadline"]) == {"sec", "nsec"}


def test_mcap_carries_what_rosbag2s_plugin_reads(tmp_path):
    write_bag(tmp_path / "bag", recording())
    with (tmp_path / "bag" / "bag_0.mcap").open("rb") as file:
        reader = make_reader(file)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        for channel in summary.channels.values():
            assert channel.message_encoding == "cdr"
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
            profiles = YAML(typ="safe").load(channel.metadata["offered_qos_profiles"])
            assert profiles[0]["reliability"] == "reliable"
        assert {s.encoding for s in summary.schemas.values()} == {"ros2msg"}
        metadata = [YAML(typ="safe").load(m.metadata["serialized_metadata"]) for m in reader.iter_metadata()]
    assert [m["message_count"] for m in metadata] == [0, 113]
    assert metadata[-1]["version"] == 9


@pytest.mark.parametrize(
    "msgtype", [STATE, "trajectory_msgs/msg/JointTrajectory", "diagnostic_msgs/msg/DiagnosticArray"]
)
def test_type_hash_is_that_of_the_installed_messages(msgtype):
    package, _, name = msgtype.split("/")
    for prefix in os.environ["AMENT_PREFIX_PATH"].split(":"):
        path = Path(prefix) / "share" / package / "msg" / f"{name}.json"
        if path.is_file():
            hashes = {h["type_name"]: h["hash_string"] for h in json.loads(path.read_text())["type_hashes"]}
            break
    assert BagTopic.known("/x", msgtype).digest == hashes[msgtype]


def test_installed_type_outside_the_library_is_found_in_the_ament_prefix(tmp_path, monkeypatch):
    folder = tmp_path / "share/strange_msgs/msg"
    folder.mkdir(parents=True)
    (folder / "Pair.msg").write_text(
        "strange_msgs/One[2] pair\nstd_msgs/Header header\nstrange_msgs/Two[] more\nstring[<=3] names\nstring<=5 name\n"
    )
    (folder / "One.msg").write_text("float64[<=3] x\n")
    (folder / "Two.msg").write_text("strange_msgs/One[<=2] x\nstrange_msgs/Four y\n")
    (folder / "Four.msg").write_text("string text\n")
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    topic = BagTopic.known("/pair", "strange_msgs/msg/Pair")
    assert all(f"MSG: strange_msgs/{name}" in topic.definition for name in ("One", "Two", "Four"))
    assert topic.digest.startswith("RIHS01_")
    assert BagTopic.known("/none", "absent_msgs/msg/None").definition == ""


def test_offered_qos_is_kept(tmp_path):
    profile = qos(depth=1)
    writer = BagWriter(tmp_path / "bag")
    writer.write(writer.add_topic(BagTopic.known("/command", STATE, [profile])), 0, b"")
    writer.close()
    with Reader(tmp_path / "bag") as reader:
        assert [c.ext.offered_qos_profiles for c in reader.connections] == [[profile]]


def test_bad_arguments_are_refused_and_nothing_is_overwritten(tmp_path):
    write_bag(tmp_path / "bag", recording())
    before = size(tmp_path / "bag")
    with pytest.raises(BagError, match="exists already"):
        write_bag(tmp_path / "bag", recording())
    assert size(tmp_path / "bag") == before
    with pytest.raises(BagError, match="mcap or sqlite3"):
        write_bag(tmp_path / "a", recording(), storage="sqlite")
    with pytest.raises(BagError, match="none or zstd"):
        write_bag(tmp_path / "b", recording(), compression="gzip")
    with pytest.raises(BagError, match="mcap only"):
        write_bag(tmp_path / "c", recording(), storage="sqlite3", compression="zstd")
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_full_disk_leaves_no_bag_behind(tmp_path, file_limit, storage):
    source = recording(ticks=20_000)
    file_limit(1_000_000)
    with pytest.raises(RunError, match=r"bag .* not written"):
        write_bag(tmp_path / "bag", source, storage=storage)
    assert list(tmp_path.iterdir()) == []


# Reading --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("storage", "compression"), FORMATS)
def test_reading_returns_what_was_written(tmp_path, storage, compression):
    source = recording(ticks=4000)
    write_bag(tmp_path / "bag", source, storage=storage, compression=compression)
    result = read_bag(tmp_path / "bag")
    assert result.topics == source.topics
    bare = next(p for p in (tmp_path / "bag").iterdir() if p.suffix in (".mcap", ".db3"))
    assert read_bag(bare).topics == source.topics


HUMBLE_SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, serialization_format TEXT NOT NULL,
    offered_qos_profiles TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema VALUES (3, 'humble');
"""
HUMBLE_QOS = (
    "- history: 3\n  depth: 0\n  reliability: 1\n  durability: 2\n  deadline:\n    sec: 9223372036\n"
    "    nsec: 854775807\n  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: 1\n"
    "  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n  avoid_ros_namespace_conventions: false"
)


def humble_metadata(directory: Path, storage: str, source: Recording) -> None:
    """Metadata version 5 as `ros2 bag record` of Humble writes it."""
    messages = list(source.messages())
    topics = [
        {
            "topic_metadata": {
                "name": "/" + t.name.lstrip("/"),
                "type": t.msgtype,
                "serialization_format": "cdr",
                "offered_qos_profiles": HUMBLE_QOS,
            },
            "message_count": len(t.data),
        }
        for t in source.topics.values()
    ]
    times = {"starting_time": {"nanoseconds_since_epoch": 0}, "duration": {"nanoseconds": messages[-1][0]}}
    file = f"bag_0.{'db3' if storage == 'sqlite3' else storage}"
    info = {
        "version": 5,
        "storage_identifier": storage,
        **times,
        "message_count": len(messages),
        "topics_with_message_count": topics,
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file],
        "files": [{"path": file, **times, "message_count": len(messages)}],
    }
    with (directory / "metadata.yaml").open("w") as out:
        YAML().dump({"rosbag2_bagfile_information": info}, out)


def humble_sqlite3(directory: Path, source: Recording) -> None:
    directory.mkdir()
    database = sqlite3.connect(directory / "bag_0.db3")
    database.executescript(HUMBLE_SCHEMA)
    numbers = {}
    for i, t in enumerate(source.topics.values(), 1):
        numbers[t.name] = i
        row = (i, "/" + t.name.lstrip("/"), t.msgtype, "cdr", HUMBLE_QOS)
        database.execute("INSERT INTO topics VALUES (?, ?, ?, ?, ?)", row)
    rows = [(numbers[topic.name], t, data) for t, topic, data in source.messages()]
    database.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    database.commit()
    database.close()
    humble_metadata(directory, "sqlite3", source)


def humble_mcap(directory: Path, source: Recording, **options) -> None:
    directory.mkdir()
    store = get_typestore(Stores.ROS2_HUMBLE)
    with (directory / "bag_0.mcap").open("wb") as file:
        writer = McapLibraryWriter(file, **{"compression": CompressionType.LZ4, "chunk_size": 4096} | options)
        writer.start("ros2", "libmcap 0.8.0")
        numbers = {}
        for t in source.topics.values():
            text = store.generate_msgdef(t.msgtype, ros_version=2)[0]
            schema = writer.register_schema(t.msgtype, "ros2msg", text.encode())
            details = {"offered_qos_profiles": HUMBLE_QOS}
            numbers[t.name] = writer.register_channel("/" + t.name.lstrip("/"), "cdr", schema, details)
        for t, topic, data in source.messages():
            writer.add_message(numbers[topic.name], t, data, t)
        writer.finish()
    humble_metadata(directory, "mcap", source)


def jazzy_message_compressed(directory: Path, source: Recording) -> None:
    """A bag by the rosbags library, sqlite3 with each message compressed."""
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(directory, version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        names = {
            t.name: writer.add_connection("/" + t.name.lstrip("/"), t.msgtype, typestore=store)
            for t in source.topics.values()
        }
        for t, topic, data in source.messages():
            writer.write(names[topic.name], t, data)


@pytest.mark.parametrize("make", [humble_sqlite3, humble_mcap, jazzy_message_compressed])
def test_bags_of_other_recorders_are_read(tmp_path, make):
    source = recording()
    make(tmp_path / "bag", source)
    assert read_bag(tmp_path / "bag").topics == source.topics
    t, x = signals(tmp_path / "bag")["plant/state/b/position"]
    np.testing.assert_array_equal(x, -0.1 * np.arange(50))
    np.testing.assert_array_equal(t, np.arange(50) / 1000)


def foreign_bag(directory: Path, start: int = 0) -> None:
    """An Imu with a header, an array of varying length, text, and an unknown type."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = store.types
    time, header = types["builtin_interfaces/msg/Time"], types["std_msgs/msg/Header"]
    vector, turn = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    result = Recording(
        [
            ("imu", "sensor_msgs/msg/Imu"),
            ("note", "std_msgs/msg/String"),
            ("list", "std_msgs/msg/Float64MultiArray"),
            ("odd", "odd_msgs/msg/Odd"),
        ]
    )
    for k in range(3):
        stamp = start + k * 500_000_000
        imu = types["sensor_msgs/msg/Imu"](
            header(time(stamp // 10**9, stamp % 10**9), "imu"), turn(0.0, 0.0, 0.0, 1.0), np.arange(9.0),
            vector(0.0, 0.0, k * 0.25), np.zeros(9), vector(0.0, 0.0, 9.81), np.zeros(9))  # fmt: skip
        layout = types["std_msgs/msg/MultiArrayLayout"]([], 0)
        numbers = types["std_msgs/msg/Float64MultiArray"](layout, np.arange(k + 1.0))
        messages = [imu, types["std_msgs/msg/String"]("x"), numbers]
        for i, (topic, message) in enumerate(zip(result.topics.values(), messages, strict=False)):
            result.add(i, stamp, bytes(store.serialize_cdr(message, topic.msgtype)))
        result.add(3, stamp, b"\x00\x01\x00\x00\x07")
    write_bag(directory, result)


def test_signals_of_foreign_types(tmp_path):
    foreign_bag(tmp_path / "bag")
    result = signals(tmp_path / "bag")
    _, x = result["imu/angular_velocity/z"]
    np.testing.assert_array_equal(x, [0, 0.25, 0.5])
    np.testing.assert_array_equal(result.table("imu").stamp, [0, 0.5, 1])
    np.testing.assert_array_equal(result["list/data/1"].x, [np.nan, 1, 1])
    assert result["imu/orientation_covariance/8"].x[0] == 8
    assert not [name for name in result if name.startswith(("note/", "odd/"))]
    assert read_bag(tmp_path / "bag").topics["odd"].data == [b"\x00\x01\x00\x00\x07"] * 3
    with pytest.raises(BagError, match="no definition of odd_msgs/msg/Odd"):
        result.table("odd")


@pytest.mark.parametrize("style", [1, 2, 7])
def test_columns_on_the_disk_have_the_numbers_of_those_in_memory(style, tmp_path, monkeypatch):
    """Also where messages lack a column, in blocks of few messages, and read a few at a time."""
    foreign_bag(tmp_path / "bag")
    write_bag(tmp_path / "own", recording())
    for name in ("softrig_core.wire.long.STRETCH", "softrig_bags.tables.STRETCH"):
        monkeypatch.setattr(name, style)
    monkeypatch.setattr("softrig_bags.files.mcap_file.McapFile.CHUNK_BYTES", 300)
    write_bag(tmp_path / "chunks", recording())
    for bag in ("bag", "own", "chunks"):
        usual, result = signals(tmp_path / bag), signals(tmp_path / bag, on_disk=True)
        assert list(result) == list(usual)
        assert result.end == usual.end
        for topic in usual.decodable:
            a, b = usual.table(topic), result.table(topic)
            assert any(map(is_long, (b.t, b.stamp))) is (len(a.t) > style)
            for x, y in zip((a.t, a.stamp, *a.columns.values()), (b.t, b.stamp, *b.columns.values()), strict=True):
                np.testing.assert_array_equal(np.asarray(y), x)
                np.testing.assert_array_equal(np.asarray(y[1:3]), x[1:3])


def test_threads_can_read_columns_on_the_disk_at_the_same_time(monkeypatch):
    """A page draws in one thread while another computes figures: a read must not use the file's common position."""
    monkeypatch.setattr("softrig_bags.tables.STRETCH", 2)
    with TemporaryFile() as file:
        table = OnDisk(file)
        table.add(Piece(np.arange(9), np.arange(9), {"x": np.arange(9.0)}, {}))
        file.flush()
        x = table.whole().columns["x"]
        before = file.tell()
        np.testing.assert_array_equal(np.asarray(x[3:6]), [3.0, 4.0, 5.0])
        assert file.tell() == before


def test_numbers_of_messages_are_known_before_the_messages_are_read(tmp_path, monkeypatch):
    foreign_bag(tmp_path / "bag")
    with monkeypatch.context() as patch:
        patch.setattr("softrig_bags.read.read_bag", None)
        topics = signals(tmp_path / "bag").recording.topics
        known = {name: (topic.number, topic.newest()) for name, topic in topics.items()}
    assert known == {name: (len(topic.times), topic.times[-1]) for name, topic in topics.items()}
    assert set(known.values()) == {(3, 1_000_000_000)}


def test_wall_clock_bags_start_at_zero_seconds(tmp_path):
    foreign_bag(tmp_path / "bag", start=1_700_000_000_250_000_000)
    result = signals(tmp_path / "bag")
    np.testing.assert_array_equal(result["imu/angular_velocity/z"].t, [0, 0.5, 1])
    np.testing.assert_array_equal(result.table("imu").stamp, [0, 0.5, 1])


def test_export_as_tables(tmp_path):
    write_bag(tmp_path / "bag", recording(ticks=9))
    written = export(tmp_path / "bag", tmp_path / "out", "csv")
    assert sorted(p.name for p in written) == ["clock.csv", "command.csv", "plant.state.csv"]
    with (tmp_path / "out/plant.state.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(r["a/position"]) for r in rows] == [k * 0.1 for k in range(9)]
    export(tmp_path / "bag", tmp_path / "out", "parquet")
    table = pyarrow.parquet.read_table(tmp_path / "out/command.parquet")
    assert table.column_names == ["time", "stamp", "a/effort"]
    assert table["a/effort"].to_pylist() == [0.0, 4.0, 8.0]
    with pytest.raises(BagError, match="csv, parquet, mat"):
        export(tmp_path / "bag", tmp_path / "out", "xlsx")


def test_a_file_that_is_not_a_bag_is_named(tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        read_bag(tmp_path / "none")
    with pytest.raises(BagError, match="not a bag"):
        read_bag(tmp_path)
    write_bag(tmp_path / "bag", recording(ticks=9000))
    file = tmp_path / "bag/bag_0.mcap"
    content = bytearray(file.read_bytes())
    content[2000] ^= 1
    file.write_bytes(content)
    with pytest.raises(BagError, match="damaged: Chunk checksum mismatch"):
        read_bag(tmp_path / "bag")
    (tmp_path / "bag/metadata.yaml").unlink()
    with pytest.raises(BagError, match="softrig bag repair"):
        read_bag(tmp_path / "bag")


@pytest.mark.parametrize("make", [humble_sqlite3, humble_mcap])
def test_damage_that_shows_on_opening_is_reported(tmp_path, make):
    make(tmp_path / "bag", recording())
    file = next(p for p in (tmp_path / "bag").iterdir() if p.suffix in (".mcap", ".db3"))
    file.write_bytes(file.read_bytes().replace(b"/plant/state", b"/plant\xffstate"))
    for path in (tmp_path / "bag", file):
        with pytest.raises(BagError, match=r"damaged: .*softrig bag repair"):
            read_bag(path)


# Comparing ------------------------------------------------------------------------------------------------------------


def compared(a: Recording, b: Recording, **options):
    return compare(Signals(a), Signals(b), **options)


def test_equal_recordings_agree(tmp_path):
    write_bag(tmp_path / "bag", recording(), storage="sqlite3")
    result = compare(Signals(recording()), signals(tmp_path / "bag"), bitwise=True)
    assert result.equal
    assert result.first is None
    assert {t.topic: t.count_b for t in result.topics} == {"/clock": 50, "plant/state": 50, "command": 13}


def test_the_first_difference_is_named():
    result = compared(recording(), recording(gain=1.01))
    assert not result.equal
    assert (result.first.stamp, result.first.topic, result.first.field) == (4_000_000, "command", "a/effort")
    assert (result.first.a, result.first.b) == (4.0, 4.04)
    assert str(result.first) == "t = 0.004 s, command a/effort: 4.0 against 4.04"
    command = result.topics[2]
    assert command.differing == 12  # 12 of 13 messages differ: the first command is zero in both bags
    assert command.largest == {"a/effort": pytest.approx(0.48)}
    assert [t.equal for t in result.topics] == [True, True, False]


def test_no_deviation_is_reported_for_fields_that_agree():
    layout, pair = Layout(STATE, "", ["a"], {"position": 1, "velocity": 1}), []
    for velocity in (1.0, 1.5):
        pair.append(Recording([("state", STATE)]))
        pair[-1].add(0, 0, layout.encode(0, (2.0, velocity)))
    assert compared(*pair).topics[0].largest == {"a/velocity": 0.5}


@pytest.mark.parametrize(
    ("options", "equal"),
    [
        ({"default": Tolerance(relative=0.0101)}, True),
        ({"default": Tolerance(relative=0.0099)}, False),
        ({"default": Tolerance(absolute=0.481)}, True),
        ({"default": Tolerance(absolute=0.479)}, False),
        ({"tolerances": {"*/position": Tolerance(9.0), "command/*/effort": Tolerance(0.481)}}, True),
        ({"tolerances": {"command/*": Tolerance(), "*": Tolerance(9.0)}}, False),
        ({"default": Tolerance(absolute=0.481), "bitwise": True}, False),
        ({"ignore": ["comm*"]}, True),
    ],
)
def test_tolerances(options, equal):
    assert compared(recording(), recording(gain=1.01), **options).equal is equal


def test_missing_and_extra_messages_are_counted():
    less = recording()
    for values in (less.topics["plant/state"].times, less.topics["plant/state"].data):
        del values[10:12]
    result = compared(recording(), less)
    state = result.topics[1]
    assert (state.missing, state.extra, state.differing) == (2, 0, 0)
    assert str(result.first) == "t = 0.01 s, plant/state message: present against missing"
    assert compared(less, recording()).topics[1].extra == 2
    longer = compared(recording(), recording(ticks=54))
    assert [t.extra for t in longer.topics] == [4, 4, 1]
    del less.topics["command"]
    assert compared(recording(), less).topics[2].missing == 13


def test_equal_stamps_are_paired_in_order():
    """A delayed link repeats the acquisition time of its newest sample."""
    layout = Layout(STATE, "", ["a"], {"position": 1})
    one, two = Recording([("late", STATE)]), Recording([("late", STATE)])
    for k, stamp in enumerate([0, 0, 0, 5, 5]):
        one.add(0, k, layout.encode(stamp, (1.0 * k,)))
        two.add(0, k, layout.encode(stamp, (1.0 * k if k != 2 else 7.0,)))
    result = compared(one, two)
    assert result.topics[0].differing == 1
    assert (result.first.a, result.first.b) == (2.0, 7.0)


def test_names_frames_types_and_nan():
    def single(msgtype=STATE, frame="", name="a", value=1.0):
        result = Recording([("x", msgtype)])
        fields = {"effort": 1} if msgtype == STATE else {}
        result.add(0, 0, Layout(msgtype, frame, [name], fields).encode(0, (value,) if fields else (value,) * 3))
        return result

    assert compared(single(), single(frame="map")).first.field == "frame_id"
    assert compared(single(), single(name="b")).first.field == "a/effort"
    assert compared(single(), single("geometry_msgs/msg/Vector3Stamped")).first.field == "type"
    assert compared(single(value=np.nan), single(value=np.nan)).equal
    loose = compared(single(), single(value=np.nan), default=Tolerance(9.0, 9.0))
    assert not loose.equal
    assert json.loads(loose.to_json())["first"]["b"] == "nan"


def test_a_bitwise_comparison_finds_differences_that_numbers_do_not_show():
    other = recording()
    other.topics["command"].times[1] += 1
    assert compared(recording(), other).equal
    result = compared(recording(), other, bitwise=True)
    assert str(result.first) == "t = 0.004 s, command bag time: 4000000 against 4000001"


def test_foreign_types_are_compared_by_field(tmp_path):
    foreign_bag(tmp_path / "a")
    foreign_bag(tmp_path / "b")
    assert compare(tmp_path / "a", tmp_path / "b").equal
    changed = read_bag(tmp_path / "b")
    for topic, at in (("imu", -1), ("note", 8), ("odd", 4)):
        data = bytearray(changed.topics[topic].data[1])
        data[at] ^= 1
        changed.topics[topic].data[1] = bytes(data)
    write_bag(tmp_path / "c", changed)
    result = compare(tmp_path / "a", signals(tmp_path / "c"))
    results = {t.topic: t.first and t.first.field for t in result.topics}
    assert results == {"imu": "linear_acceleration_covariance/8", "note": "data", "list": None, "odd": "bytes"}
    assert json.loads(result.to_json())["topics"][0]["differing"] == 1


def test_types_defined_only_in_the_bag_are_paired_by_stamp(tmp_path):
    layout = Layout("geometry_msgs/msg/Vector3Stamped")
    definition = BagTopic.known("/x", layout.msgtype).definition
    for name, delay in (("a", 0), ("b", 3)):
        writer = BagWriter(tmp_path / name)
        number = writer.add_topic(BagTopic("/x", "strange_msgs/msg/Vector", definition))
        for k in range(5):
            writer.write(number, k + delay, layout.encode(k, (k, 0, 0)))
        writer.close()
    assert compare(signals(tmp_path / "a"), signals(tmp_path / "b")).equal
    # the repaired bag needs the definition: no installed package has this type
    again = repair(tmp_path / "a", tmp_path / "repaired")
    assert compare(signals(tmp_path / "a"), signals(again.bag)).equal
    assert list(signals(again.bag).decodable) == list(signals(tmp_path / "a").decodable) == ["x"]


def test_constants_may_stand_before_the_header():
    assert is_stamped(BagTopic.known("/battery", "sensor_msgs/msg/BatteryState"))
    assert not is_stamped(BagTopic("/x", "x_msgs/msg/X", "int8 A=1\nint8 B = 2\nstring<=5 text\nstd_msgs/Header h"))


def test_the_duration_of_a_trajectory_is_compared():
    layout = Layout("trajectory_msgs/msg/JointTrajectory", "", ["a"], {"position": 1})
    one, two = Recording([("goal", layout.msgtype)]), Recording([("goal", layout.msgtype)])
    data = layout.encode(0, (1.0,))
    one.add(0, 0, data)
    two.add(0, 0, data[:-8] + b"\5\0\0\0" + data[-4:])
    first = compared(one, two).first
    assert (first.field, first.a, first.b) == ("time_from_start", 0.0, 5.0)
    assert compared(one, two, tolerances={"*/time_from_start": Tolerance(5.0)}).equal


# Repairing ------------------------------------------------------------------------------------------------------------


def cut(directory: Path, share: float) -> None:
    """Truncate the storage file and delete the metadata, as a crash of recorder and machine may."""
    (directory / "metadata.yaml").unlink()
    file = next(directory.iterdir())
    os.truncate(file, int(file.stat().st_size * share))


def test_a_truncated_database_with_pages_that_refer_to_missing_ones_is_refused(tmp_path):
    """A crash of the recorder does not truncate a database: its journal undoes what was not committed."""
    write_bag(tmp_path / "bag", recording(ticks=20_000), storage="sqlite3")
    cut(tmp_path / "bag", 0.6)
    with pytest.raises(BagError, match=r"no complete message in it; `sqlite3 FILE .recover` may find rows"):
        repair(tmp_path / "bag")
    assert not (tmp_path / "bag.damaged").exists()


@pytest.mark.parametrize("compression", few(["zstd", "none"], 1))
def test_a_cut_bag_is_repaired(tmp_path, compression):
    source = recording(ticks=20_000)
    write_bag(tmp_path / "bag", source, compression=compression, custom_data={"seed": "7"})
    cut(tmp_path / "bag", 0.6)
    done = repair(tmp_path / "bag")
    whole, result = expected(source), expected(read_bag(tmp_path / "bag"))
    assert 0.4 * len(whole) < len(result) < 0.7 * len(whole)
    assert result == whole[: len(result)]
    assert done.files[0].kept == len(result)
    assert done.files[0].lost
    assert (tmp_path / "bag.damaged").is_dir()
    with Reader(tmp_path / "bag") as reader:
        assert reader.storage.metadata.custom == {"seed": "7"}
        assert all(c.msgdef.data and c.digest and c.ext.offered_qos_profiles for c in reader.connections)
    again = repair(tmp_path / "bag")
    assert again.bag is None
    assert str(again) == "nothing to repair"


def test_a_damaged_chunk_loses_only_its_own_messages(tmp_path):
    source = recording(ticks=20_000)
    write_bag(tmp_path / "bag", source)
    file = tmp_path / "bag/bag_0.mcap"
    content = bytearray(file.read_bytes())
    content[900_000] ^= 1
    file.write_bytes(content)
    done = repair(tmp_path / "bag", tmp_path / "new")
    assert done.files[0].lost == ["1 damaged chunks"]
    whole, results = expected(source), set(expected(read_bag(tmp_path / "new")))
    lost = [i for i, message in enumerate(whole) if message not in results]
    assert lost == list(range(lost[0], lost[-1] + 1))
    assert 0 < len(lost) < 8000


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Truncate a file, zero a sector, or write noise over a part."""
    at = chance.randrange(len(content))
    match chance.randrange(3):
        case 0:
            return content[:at]
        case 1:
            at -= at % 512
            return content[:at] + bytes(512) + content[at + 512 :]
    return content[:at] + chance.randbytes(64) + content[at + 64 :]


@pytest.mark.parametrize(("seeds", "least"), [(8, 3), pytest.param(20, 8, marks=pytest.mark.long)])
@pytest.mark.parametrize("make", [humble_sqlite3, humble_mcap])
def test_any_damage_gives_a_readable_bag_or_a_one_line_refusal(tmp_path, make, seeds, least):
    """The MCAP file has no checksums, so that the parser itself must notice the damage."""
    options = {} if make is humble_sqlite3 else {"compression": CompressionType.NONE, "enable_crcs": False}
    make(tmp_path / "whole", recording(ticks=500), **options)
    file = next(p for p in (tmp_path / "whole").iterdir() if p.suffix in (".mcap", ".db3"))
    repaired = 0
    for seed in range(seeds):
        bag = tmp_path / f"bag{seed}"
        shutil.copytree(tmp_path / "whole", bag)
        (bag / file.name).write_bytes(damaged(file.read_bytes(), random.Random(seed)))
        try:
            done = repair(bag)
        except BagError:  # the file contains no complete message
            continue
        kept = sum(f.kept for f in done.files)
        repaired += kept > 0
        assert done.bag is None or len(expected(read_bag(bag))) == kept
    assert repaired >= least


def test_a_damaged_page_of_a_database_loses_its_rows_and_few_more(tmp_path):
    source = recording(ticks=3000)
    write_bag(tmp_path / "bag", source, storage="sqlite3")
    file = tmp_path / "bag/bag_0.db3"
    content = file.read_bytes()
    at = len(content) // 2 // 4096 * 4096
    file.write_bytes(content[:at] + bytes(4096) + content[at + 4096 :])
    done = repair(tmp_path / "bag")
    whole, result = expected(source), expected(read_bag(tmp_path / "bag"))
    assert done.files[0].lost
    assert set(result) < set(whole)
    assert len(result) > 0.95 * len(whole)
    assert result[-1] == whole[-1]


def test_a_database_that_ends_within_a_page_is_repaired(tmp_path):
    source = recording(ticks=3000)
    write_bag(tmp_path / "bag", source, storage="sqlite3")
    file = tmp_path / "bag/bag_0.db3"
    content = file.read_bytes()
    file.write_bytes(content[: len(content) * 6 // 10 // 4096 * 4096 + 100])
    assert repair(tmp_path / "bag").files[0].lost
    whole, result = expected(source), expected(read_bag(tmp_path / "bag"))
    assert set(result) < set(whole)
    assert len(result) > 0.5 * len(whole)


def test_a_single_database_is_repaired_if_only_the_folder_of_the_new_bag_is_writable(tmp_path, monkeypatch):
    places = []

    def scratch(dir, prefix):
        places.append(dir)
        return TemporaryDirectory(dir=dir, prefix=prefix)

    monkeypatch.setattr("softrig_bags.repair.TemporaryDirectory", scratch)
    write_bag(tmp_path / "media/bag", recording(), storage="sqlite3")
    repair(tmp_path / "media/bag/bag_0.db3", tmp_path / "home/new")
    assert places == [tmp_path / "home"]
    assert expected(read_bag(tmp_path / "home/new")) == expected(recording())


def split(bag, storage, limit, count, size):
    """Files of a bag with `count` messages of `size` bytes, split at `limit`."""
    writer = BagWriter(bag, storage=storage, split_bytes=limit)
    number = writer.add_topic(BagTopic.known("/x", STATE))
    for k in range(count):
        writer.write(number, k, bytes(size))
    writer.close()
    return sorted(bag.glob("bag_*"))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_split_by_size(tmp_path, storage):
    files = split(tmp_path / "bag", storage, 700_000, 2000, 1000)
    sizes = [p.stat().st_size for p in files]
    assert len(sizes) >= 3
    assert all(650_000 < n < 800_000 for n in sizes[:-1])
    assert read_bag(tmp_path / "bag").topics["x"].times == list(range(2000))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_split_size_below_the_head_of_a_file_does_not_make_one_file_per_message(tmp_path, storage):
    files = split(tmp_path / "bag", storage, 2_000, 400, 100)
    assert 20 <= len(files) <= 45  # the data are 40,000 bytes; each message adds an overhead
    assert read_bag(tmp_path / "bag").topics["x"].times == list(range(400))


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_split_bags_are_read_and_repaired(tmp_path, storage):
    source = recording(ticks=1_200)
    writer = BagWriter(tmp_path / "bag", storage=storage, split_ns=500_000_000)
    numbers = {
        t.name: writer.add_topic(BagTopic.known("/" + t.name.lstrip("/"), t.msgtype)) for t in source.topics.values()
    }
    for t, topic, data in source.messages():
        writer.write(numbers[topic.name], t, data)
    writer.close()
    assert read_bag(tmp_path / "bag").topics == source.topics
    info = YAML(typ="safe").load(tmp_path / "bag/metadata.yaml")["rosbag2_bagfile_information"]
    assert [f["starting_time"]["nanoseconds_since_epoch"] for f in info["files"]] == [0, 5 * 10**8, 10 * 10**8]
    assert info["duration"] == {"nanoseconds": 1_199_000_000}
    (tmp_path / "bag/metadata.yaml").unlink()
    repair(tmp_path / "bag")
    assert read_bag(tmp_path / "bag").topics == source.topics
    assert len(list((tmp_path / "bag").iterdir())) == 4


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize(("begin", "split"), [(0, 0), (7_000, 0), (1_700_000_000 * 10**9, 30), (5, 1)])
def test_the_metadata_lists_the_content_of_each_file(tmp_path, storage, begin, split):
    """At any start time; a file is full after its duration, the tenth is listed after the ninth; also after a
    repair.
    """
    times = [begin + t for t in (0, 4, 9, 10, 11, 12, 13, 29, 30, 31, 60, 75)]
    writer = BagWriter(tmp_path / "bag", storage=storage, split_ns=split)
    number = writer.add_topic(BagTopic.known("/x", "std_msgs/msg/Float64"))
    silent = writer.add_topic(BagTopic.known("/silent", "std_msgs/msg/Float64"))
    for t in times:
        writer.write(number, t, b"\x00\x01\x00\x00" + struct.pack("<d", float(t - begin)))
    writer.close()
    assert (writer.count, silent) == (len(times), 2)
    files = []
    for t in times:
        if not files or (split and t - files[-1][0] >= split):
            files.append([])
        files[-1].append(t)

    def check():
        info = YAML(typ="safe").load(tmp_path / "bag/metadata.yaml")["rosbag2_bagfile_information"]
        assert (info["starting_time"], info["duration"], info["message_count"]) == (
            {"nanoseconds_since_epoch": begin},
            {"nanoseconds": 75},
            len(times),
        )
        messages = [
            (f["starting_time"]["nanoseconds_since_epoch"], f["duration"]["nanoseconds"], f["message_count"])
            for f in info["files"]
        ]
        assert messages == [(f[0], f[-1] - f[0], len(f)) for f in files]
        assert [t["message_count"] for t in info["topics_with_message_count"]] == [len(times), 0]
        with Reader(tmp_path / "bag") as reader:
            assert (reader.start_time, reader.duration, reader.message_count) == (begin, 76, len(times))
            assert [t for _, t, _ in reader.messages()] == times

    check()
    (tmp_path / "bag/metadata.yaml").unlink()
    repair(tmp_path / "bag")
    check()


def test_bags_of_other_recorders_are_repaired(tmp_path):
    for make in (humble_sqlite3, humble_mcap):
        directory = tmp_path / make.__name__
        make(directory, recording())
        cut(directory, 1.0)
        repair(directory)
        assert read_bag(directory).topics == recording().topics


def test_shards_of_a_killed_run_become_a_bag(tmp_path):
    source = recording()
    (tmp_path / "log").mkdir()
    for name, wanted in (("plant", ["plant/state", "/clock"]), ("controller", ["command"])):
        shard = ShardWriter(tmp_path / f"log/{name}.shard", [(t, source.topics[t].msgtype) for t in wanted])
        for i, topic in enumerate(wanted):
            for t, data in zip(source.topics[topic].times, source.topics[topic].data, strict=True):
                shard.add(i, t, data)
        shard.close()
    os.truncate(tmp_path / "log/controller.shard", (tmp_path / "log/controller.shard").stat().st_size - 5)
    done = repair(tmp_path / "log")
    assert done.bag == tmp_path / "bag"
    assert [(f.kept, bool(f.lost)) for f in done.files] == [(12, True), (100, False)]
    assert not any("index" in str(f) for f in done.files)  # a shard has no index and is written to the disk immediately
    result = read_bag(tmp_path / "bag")
    assert result.topics["plant/state"] == source.topics["plant/state"]
    assert result.topics["command"].data == source.topics["command"].data[:-1]


def test_repair_refuses_files_that_it_cannot_save(tmp_path):
    with pytest.raises(BagError, match=r"no \.mcap"):
        repair(tmp_path)
    write_bag(tmp_path / "bag", recording())
    cut(tmp_path / "bag", 0.01)
    with pytest.raises(BagError, match="no complete message"):
        repair(tmp_path / "bag")
    (tmp_path / "bag.damaged").mkdir()
    with pytest.raises(BagError, match="exists already"):
        repair(tmp_path / "bag")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "bag.damaged"]


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_bag_is_closed_properly_on_a_full_disk(tmp_path, file_limit, storage):
    """As a recorder does: everything before the disk was full stays, in a valid bag."""
    writer = BagWriter(tmp_path / "bag", storage=storage)
    number = writer.add_topic(BagTopic.known("/x", STATE))
    layout, written = Layout(STATE, "", ["a"], {"position": 1}), 0
    file_limit(1_400_000)

    def fill() -> None:
        nonlocal written
        while True:
            writer.write(number, written, layout.encode(written, (0.5,)))
            written += 1

    with pytest.raises(OSError, match=r"large|full|disk I/O"):
        fill()
    file_limit(1_500_000)
    lost = writer.salvage()
    result = read_bag(tmp_path / "bag").topics["x"]
    assert result.times == list(range(written + 1 - lost))
    assert 0 < lost < 10_000


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
@pytest.mark.parametrize("moment", ["close", "open"])
def test_a_disk_full_at_a_split_leaves_the_files_before(tmp_path, monkeypatch, file_limit, storage, moment):
    kind = STORAGES[storage]

    class NoSecond(kind):
        def __init__(self, path, *rest):
            super().__init__(path, *rest)
            if moment == "open" and "_1." in path.name:
                raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("softrig_bags.files.bag.STORAGES", {storage: NoSecond})
    writer = BagWriter(tmp_path / "bag", storage=storage, split_ns=100)
    number = writer.add_topic(BagTopic.known("/x", STATE))
    for k in range(100):
        writer.write(number, k, bytes(1000))
    writer.flush()
    if moment == "close":
        file_limit(1)
    with pytest.raises(OSError, match=r"large|full|disk I/O"):
        writer.write(number, 100, bytes(1000))
    file_limit(1 << 30)
    assert writer.salvage() == 1
    assert read_bag(tmp_path / "bag").topics["x"].times == list(range(100))
    assert sorted(p.name for p in (tmp_path / "bag").iterdir()) == [f"bag_0{kind.SUFFIX}", "metadata.yaml"]
    if storage == "mcap":
        with (tmp_path / "bag/bag_0.mcap").open("rb") as file:
            assert len(list(make_reader(file).iter_metadata())) == 2


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_reports_its_size_and_its_content(tmp_path, storage):
    """Of pending messages: their bytes and the overhead of each; of written ones: the bytes of the file."""
    kind = STORAGES[storage]
    file = kind(tmp_path / f"x{kind.SUFFIX}", "none", "")
    file.add_topic(1, BagTopic.known("/x", STATE))
    file.flush()
    for round_ in range(3):
        before, beside = file.size, 31 if storage == "mcap" else 24
        for k in range(4):
            file.write(1, 10 * round_ + k, bytes(100))
            assert file.size == before + (k + 1) * (100 + beside)
        assert file.counts == {1: 4 * round_}
        file.flush()
        assert file.size == file.path.stat().st_size
        assert (file.counts, file.first, file.last) == ({1: 4 * round_ + 4}, 0, 10 * round_ + 3)
    file.write(1, 99, bytes(100))
    assert file.discard() == 1
    assert file.size == file.path.stat().st_size
    file.close("")


@pytest.mark.parametrize(("storage", "each"), [("mcap", 131), ("sqlite3", 124)])
def test_a_file_is_full_exactly_at_its_limit(tmp_path, storage, each):
    for more in (0, 1):
        writer = BagWriter(tmp_path / str(more), storage=storage, split_bytes=3 * each + more)
        number = writer.add_topic(BagTopic.known("/x", STATE))
        for k in range(8):
            writer.write(number, k, bytes(100))
        writer.close()
        assert [sum(f.counts.values()) for f in writer._files] == [[3, 3, 2], [4, 4]][more]


def test_metadata_may_be_exactly_as_long_as_the_limit(tmp_path, monkeypatch):
    write_bag(tmp_path / "bag", recording())
    size = (tmp_path / "bag/metadata.yaml").stat().st_size
    monkeypatch.setattr("softrig_bags.files.metadata.LIMIT", size)
    assert read_bag(tmp_path / "bag").topics
    monkeypatch.setattr("softrig_bags.files.metadata.LIMIT", size - 1)
    with pytest.raises(BagError, match=f"metadata.yaml is longer than {size - 1} bytes"):
        read_bag(tmp_path / "bag")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_file_that_cannot_be_created_is_reported_with_the_reason(tmp_path, monkeypatch, storage):
    """There is then no file to remove."""

    def full(*_):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr("softrig_bags.files.bag.STORAGES", {storage: full})
    full.SUFFIX = STORAGES[storage].SUFFIX
    with pytest.raises(OSError, match="full"):
        BagWriter(tmp_path / "bag", storage=storage, reserve=10)
    assert list(tmp_path.iterdir()) == []


def chunk(content: bytes, compression: str, claimed: int, data: bytes) -> bytes:
    """An MCAP chunk record, with any stated size."""
    body = struct.pack("<QQQI", 0, 0, claimed, zlib.crc32(content)) + struct.pack("<I", len(compression))
    body += compression.encode() + struct.pack("<Q", len(data)) + data
    return b"\x06" + struct.pack("<Q", len(body)) + body


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_whole_messages_inside_a_truncated_chunk_are_recovered(tmp_path, compression):
    """The second half of the only chunk is cut off; the first half is saved, as an exact prefix."""
    source, chance = (
        Recording([("a", STATE)]),
        random.Random(1),
    )  # random values do not compress, so the chunk has several zstd blocks
    layout = Layout(STATE, "", ["a", "b"], {"position": 2})
    for k in range(4000):
        source.add(0, k, layout.encode(k, (chance.random(), chance.random())))
    write_bag(tmp_path / "bag", source, compression=compression)
    cut(tmp_path / "bag", 0.5)
    done = repair(tmp_path / "bag")
    whole, result = expected(source), expected(read_bag(tmp_path / "bag"))
    assert 0.2 * len(whole) < len(result) < 0.9 * len(whole)
    assert result == whole[: len(result)]
    assert done.files[0].lost == ["the end of a chunk that was cut"]


def test_a_chunk_that_would_fill_the_memory_is_left_out(tmp_path, monkeypatch):
    for module in ("files.mcap_recover", "files.compressed"):
        monkeypatch.setattr(f"softrig_bags.{module}.LIMIT", LIMIT)
    write_bag(tmp_path / "bag", recording())
    file = tmp_path / "bag/bag_0.mcap"
    content = file.read_bytes()
    bomb = zstd.compress(bytes(LIMIT + 1))
    head = content[:8] + chunk(b"", "zstd", 10, bomb) + chunk(b"", "zstd", 1 << 40, b"x")
    file.write_bytes(head + content[8:])
    assert len(bomb) < 100_000
    tracemalloc.start()
    with pytest.raises(BagError, match="claims 10 uncompressed"):
        read_bag(tmp_path / "bag")
    done = repair(tmp_path / "bag", tmp_path / "new")
    assert tracemalloc.get_traced_memory()[1] < 3 * LIMIT
    tracemalloc.stop()
    assert done.files[0].lost == ["2 damaged chunks"]
    assert expected(read_bag(tmp_path / "new")) == expected(recording())


def test_a_damaged_bag_leaves_one_line_and_no_log(tmp_path, monkeypatch, capsys):
    (tmp_path / "logs").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "logs"))
    write_bag(tmp_path / "bag", recording())
    file = tmp_path / "bag/bag_0.mcap"
    file.write_bytes(file.read_bytes().replace(b"plant/state", b"\xff" * 11))
    assert main_bag(["info", str(tmp_path / "bag")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert list((tmp_path / "logs").iterdir()) == []


def test_a_definition_that_cannot_be_read_is_named(tmp_path):
    write_bag(tmp_path / "bag", recording(), storage="sqlite3")
    database = sqlite3.connect(tmp_path / "bag/bag_0.db3")
    database.execute("UPDATE message_definitions SET encoded_message_definition = 'float64[ x'")
    database.commit()
    database.close()
    result = signals(tmp_path / "bag")
    assert result.decodable == []
    assert (
        "the definition of sensor_msgs/msg/JointState cannot be read: 'float64[ x'" in result.left_out["command"].reason
    )
    with pytest.raises(BagError, match=r"the definition of .* cannot be read"):
        result.table("command")
    with pytest.raises(BagError, match="none of its topics can be decoded"):
        export(tmp_path / "bag", tmp_path / "out", "csv")


@pytest.mark.parametrize(
    "change",
    [
        lambda about: about["topics_with_message_count"][0]["topic_metadata"].update(name={"a": 1}),
        lambda about: about["topics_with_message_count"][0].update(message_count=[]),
        lambda about: about.update(message_count=1 << 70),
        lambda about: about.update(custom_data="text"),
    ],
)
def test_metadata_of_other_kinds_is_reported_in_one_line(change, tmp_path, capsys):
    write_bag(tmp_path / "bag", recording())
    file, yaml = tmp_path / "bag" / "metadata.yaml", YAML(typ="safe")
    about = yaml.load(file.read_text())
    change(about["rosbag2_bagfile_information"])
    with file.open("w") as out:
        yaml.dump(about, out)
    assert main_bag(["info", str(tmp_path / "bag")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


@pytest.mark.parametrize("column", ["data = 'text'", "timestamp = 'late'"])
def test_rows_of_other_kinds_are_reported_in_one_line(column, tmp_path, capsys):
    write_bag(tmp_path / "bag", recording(), storage="sqlite3")
    with sqlite3.connect(next((tmp_path / "bag").glob("*.db3"))) as database:
        database.execute(f"UPDATE messages SET {column} WHERE id = 2")
    assert main_bag(["export", str(tmp_path / "bag"), "--out", str(tmp_path / "x.csv")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
