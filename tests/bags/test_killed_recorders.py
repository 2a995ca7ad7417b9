"""Bags of recorders that are killed at a random moment, in each way in which rosbag2 writes.

The child writes as rosbag2 does (its schema, a transaction a batch, the pragmas and options of its presets) with the
libraries `sqlite3` and `mcap`. A bag is compared with what these libraries read from the remaining file.
"""

import io
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections import Counter
from contextlib import suppress

import pytest
from conftest import few
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from softrig_bags.cli import main_bag
from softrig_bags.errors import BagError
from softrig_bags.repair import repair
from softrig_core.wire.recording import ShardWriter

# rosbag2_storage_sqlite3: its default, `resilient`, and the journal modes that a configuration file can select.
SQLITE = {
    "default": ["journal_mode=MEMORY", "synchronous=OFF"],
    "resilient": ["journal_mode=WAL", "synchronous=NORMAL"],
    "wal_short": ["journal_mode=WAL", "wal_autocheckpoint=8"],
    "delete": ["journal_mode=DELETE", "synchronous=FULL"],
    "truncate": ["journal_mode=TRUNCATE", "synchronous=OFF", "cache_size=2"],
    "persist": ["journal_mode=PERSIST", "synchronous=OFF"],
    "exclusive": ["locking_mode=EXCLUSIVE", "journal_mode=WAL", "page_size=512"],
}
MCAP = {  # rosbag2_storage_mcap: its presets, and single options of the MCAP library
    "fastwrite": {"use_chunking": False},
    "zstd_fast": {"compression": "zstd", "enable_crcs": False, "chunk_size": 4096},
    "zstd_small": {"compression": "zstd", "chunk_size": 65536},
    "lz4": {"compression": "lz4", "chunk_size": 4096},
    "none": {"compression": "none", "chunk_size": 8192, "repeat_channels": False, "index": False},
}
CHILD = '''
import os, random, signal, sqlite3, sys, time
from contextlib import suppress
from mcap.writer import CompressionType, IndexType, Writer

SCHEMA = """
CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
    serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding TEXT NOT NULL,
    encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);
CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
    data BLOB NOT NULL);
CREATE INDEX timestamp_idx ON messages (timestamp ASC);
INSERT INTO schema(schema_version, ros_distro) VALUES (4, 'jazzy');
"""

def data(k):
    return b"\\0\\1\\0\\0" + k.to_bytes(8, "little") * (1 + k % 40)

def sqlite(folder, pragmas):
    db = sqlite3.connect(folder + "/bag_0.db3", isolation_level=None)
    for pragma in pragmas:
        db.execute("PRAGMA " + pragma)
    db.executescript("BEGIN;" + SCHEMA + "COMMIT;")
    db.execute("INSERT INTO topics VALUES (1, '/x', 'x_msgs/msg/X', 'cdr', '', '')")
    db.execute("INSERT INTO message_definitions VALUES (1, 'x_msgs/msg/X', 'ros2msg', 'float64 data', '')")
    os.write(ready, b"x")
    k = 0
    while True:
        db.execute("BEGIN")
        for _ in range(50):
            db.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", (k, data(k)))
            k += 1
        db.execute("COMMIT")

def mcap(folder, options):
    options = dict(options)
    options["compression"] = CompressionType[options.pop("compression", "none").upper()]
    if not options.pop("index", True):
        options["index_types"] = IndexType.NONE
    with open(folder + "/bag_0.mcap", "wb", buffering=3000) as out:
        writer = Writer(out, **options)
        writer.start("ros2", "x")
        schema = writer.register_schema("x_msgs/msg/X", "ros2msg", b"float64 data")
        channel = writer.register_channel("/x", "cdr", schema)
        os.write(ready, b"x")
        k = 0
        while True:
            writer.add_message(channel, k, data(k), k)
            k += 1

def size(folder):
    found = 0
    for file in os.scandir(folder):
        with suppress(FileNotFoundError):  # a journal that has just gone
            found += file.stat().st_size
    return found

begun, ready = os.pipe()
chance = random.Random(len(sys.argv))
for job in sys.argv[1:]:
    kind, given, folder = eval(job)
    os.mkdir(folder)
    if not (child := os.fork()):
        (sqlite if kind == "sqlite" else mcap)(folder, given)
    os.read(begun, 1)
    wanted = size(folder) + chance.randrange(40_000)
    while size(folder) < wanted:
        time.sleep(0.0005)
    time.sleep(chance.uniform(0.0, 0.003))
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
'''


def killed(place, times):
    """Folders that killed recorders have left, `times` of each preset."""
    jobs = [
        (kind, options, str(place / f"{kind}_{name}_{k}"))
        for kind, presets in (("sqlite", SQLITE), ("mcap", MCAP))
        for name, options in presets.items()
        for k in range(times)
    ]
    command = [sys.executable, "-c", CHILD, *map(repr, jobs)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60 + 10 * times)
    assert not done.returncode, done.stderr
    return place


@pytest.fixture(scope="module")
def five(tmp_path_factory):
    return killed(tmp_path_factory.mktemp("killed"), 5)


def rows_by_sqlite(folder, scratch):
    """The rows that SQLite itself reads from a copy of all files, up to the first error."""
    shutil.copytree(folder, scratch)
    result = []
    database = sqlite3.connect(scratch / "bag_0.db3")
    with suppress(sqlite3.Error):
        for row in database.execute("SELECT timestamp, data FROM messages ORDER BY id"):
            result.append(row)
    database.close()
    return result


def messages_by_mcap(content):
    """The messages that the library reads as a stream, up to the first error."""
    result = []
    with suppress(McapError, struct.error):
        for record in StreamReader(io.BytesIO(content)).records:
            if isinstance(record, Message):
                result.append((record.log_time, record.data))
    return result


def check_all_saved(folders, kind):
    """Check that everything the library finds is saved, in order, and that the reported number of messages is right."""
    most = 0
    for folder in folders:
        out = folder.with_name(f"repaired_{folder.name}")
        if kind == "sqlite":
            wanted = rows_by_sqlite(folder, folder.with_name(f"copy_{folder.name}"))
        else:
            wanted = messages_by_mcap((folder / "bag_0.mcap").read_bytes())
        try:
            repaired = repair(folder, out)
        except BagError:
            if wanted:
                raise
            continue
        if kind == "sqlite":
            with sqlite3.connect(next(out.glob("*.db3"))) as database:
                saved = database.execute("SELECT timestamp, data FROM messages ORDER BY id").fetchall()
        else:
            with next(out.glob("*.mcap")).open("rb") as file:
                messages = make_reader(file).iter_messages(log_time_order=False)
                saved = [(message.log_time, message.data) for _, _, message in messages]
        assert saved[: len(wanted)] == wanted
        # Messages saved from a cut chunk or behind a damaged page keep the order of time, too.
        times = [t for t, _ in saved]
        assert times == sorted(set(times))
        assert repaired.files[0].kept == len(saved)
        most = max(most, len(wanted))
    assert most  # the recorders had written messages


KINDS = [*(("sqlite", preset) for preset in SQLITE), *(("mcap", preset) for preset in MCAP)]


@pytest.mark.parametrize(("kind", "preset"), few(KINDS, 3))
def test_everything_that_the_library_finds_after_a_killed_recorder_is_saved(five, kind, preset):
    check_all_saved(sorted(five.glob(f"{kind}_{preset}_?")), kind)


@pytest.mark.long
def test_fifty_killed_recorders_of_each_preset(tmp_path):
    killed(tmp_path, 50)
    for kind, preset in KINDS:
        folders = [tmp_path / f"{kind}_{preset}_{k}" for k in range(50)]
        check_all_saved(folders, kind)


# Journals and other files beside the database -------------------------------------------------------------------------


def database(folder, journal, count=10):
    """A database with its journal as it is while the recorder works; the open connection keeps it in this state."""
    folder.mkdir()
    recorder = sqlite3.connect(folder / "bag_0.db3", isolation_level=None)
    recorder.execute(f"PRAGMA journal_mode={journal}")
    recorder.executescript(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,"
        " serialization_format TEXT NOT NULL);"
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,"
        " data BLOB NOT NULL);INSERT INTO topics VALUES (1, '/x', 'std_msgs/msg/Empty', 'cdr');"
    )
    rows = [(k, bytes([0, 1, 0, 0, 0])) for k in range(count)]
    recorder.execute("BEGIN")
    recorder.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, ?, ?)", rows)
    recorder.execute("COMMIT")
    return recorder


def kept(reported):
    return [(f.name, f.kept, f.lost, f.left_out) for f in reported.files]


@pytest.mark.parametrize("what", ["bag", "bag/bag_0.db3", "bag/bag_0.db3-wal", "bag/bag_0.db3-shm", ""])
def test_rows_that_are_only_in_the_journal_are_saved(tmp_path, what):
    (tmp_path / "run").mkdir()
    recorder = database(tmp_path / "run/bag", "WAL", 999)
    before = {p.name: p.read_bytes() for p in (tmp_path / "run/bag").iterdir()}
    assert len(before["bag_0.db3"]) < 9000  # all messages are still in the journal
    repaired = repair(tmp_path / "run" / what, tmp_path / "new")
    assert kept(repaired) == [("bag_0.db3 with bag_0.db3-wal", 999, [], [])]
    assert {p.name: p.read_bytes() for p in (tmp_path / "run/bag").iterdir()} == before
    recorder.close()


def test_a_bag_with_a_journal_beside_it_is_incomplete(tmp_path):
    """metadata.yaml agrees with the file, but a recorder has continued to write into the journal."""
    recorder = database(tmp_path / "bag", "WAL", 5)
    repaired = repair(tmp_path / "bag", tmp_path / "five")
    shutil.copy(repaired.bag / "metadata.yaml", tmp_path / "bag")
    text = (tmp_path / "bag/metadata.yaml").read_text().replace("five_0.db3", "bag_0.db3")
    (tmp_path / "bag/metadata.yaml").write_text(text)
    recorder.execute("PRAGMA wal_checkpoint")
    recorder.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 9, x'0001000000')")
    assert [f.kept for f in repair(tmp_path / "bag").files] == [6]
    assert [f.kept for f in repair(tmp_path / "bag", tmp_path / "again").files] == [6]
    recorder.close()


def test_a_database_that_changes_during_the_copy_is_read_under_its_locks(tmp_path, monkeypatch):
    recorder = database(tmp_path / "bag", "WAL", 500)
    copied = shutil.copyfile

    def changed(source, target):
        recorder.execute("INSERT INTO messages(topic_id, timestamp, data) VALUES (1, 9, x'0001000000')")
        return copied(source, target)

    monkeypatch.setattr("softrig_bags.files.sqlite_recover.shutil.copyfile", changed)
    repaired = repair(tmp_path / "bag", tmp_path / "new")
    assert repaired.files[0].kept == recorder.execute("SELECT count(*) FROM messages").fetchone()[0] > 500
    recorder.close()


def test_files_of_both_storages_in_one_folder_are_saved(tmp_path):
    recorder = database(tmp_path / "bag", "DELETE", 7)
    recorder.close()
    with (tmp_path / "bag/a_0.mcap").open("wb") as out:
        writer = Writer(out)
        writer.start("ros2", "x")
        schema = writer.register_schema("std_msgs/msg/Empty", "ros2msg", b"")
        channels = [writer.register_channel(f"/{n}", n, schema) for n in ("cdr", "json")]
        for k in range(6):
            writer.add_message(channels[k % 2], k, b"\0\1\0\0\0", k)
        writer.add_attachment(0, 0, "notes.txt", "text/plain", b"x")
        writer.add_metadata("site", {"a": "b"})
        writer.finish()
    (tmp_path / "bag/metadata.yaml").write_text(
        "rosbag2_bagfile_information: {relative_file_paths: [a_0.mcap, bag_0.db3, bag_1.db3]}"
    )
    repaired = repair(tmp_path / "bag", tmp_path / "new")
    assert kept(repaired) == [
        ("a_0.mcap", 6, [], ["1 attachment notes.txt", "1 metadata site"]),
        ("bag_0.db3", 7, [], []),
        ("bag_1.db3", 0, ["all of it: metadata.yaml lists this file, but it does not exist"], []),
    ]
    assert (
        str(repaired).splitlines()[0] == "a_0.mcap: 6 messages kept, left out: 1 attachment notes.txt, 1 metadata site"
    )
    assert not repaired.complete
    with next(repaired.bag.glob("*_0.mcap")).open("rb") as file:  # compare the encoded messages
        counts = Counter((c.topic, c.message_encoding, s.name) for s, c, _ in make_reader(file).iter_messages())
    assert counts == {("/cdr", "cdr", "std_msgs/msg/Empty"): 3, ("/json", "json", "std_msgs/msg/Empty"): 3}


def test_wrong_metadata_is_reported_and_written_again(tmp_path, capsys):
    database(tmp_path / "bag", "DELETE", 7).close()
    repair(tmp_path / "bag")
    text = (tmp_path / "bag/metadata.yaml").read_text()
    assert main_bag(["repair", str(tmp_path / "bag")]) == 0  # the repaired bag needs no repair
    assert capsys.readouterr().out == "nothing to repair\n"
    (tmp_path / "bag/metadata.yaml").write_text(text.replace("message_count: 7", "message_count: 9"))
    shutil.rmtree(tmp_path / "bag.damaged")
    assert main_bag(["repair", str(tmp_path / "bag")]) == 1
    printed = capsys.readouterr()
    assert "/x: 7 messages, metadata.yaml claimed 9\n7 messages in" in printed.out
    assert printed.err == ""
    assert (tmp_path / "bag/metadata.yaml").read_text() == text


def test_the_longer_recording_of_a_dead_node_and_its_replacement_is_saved(tmp_path):
    (tmp_path / "run/log").mkdir(parents=True)
    for file, count in (("a.shard", 2), ("a.shard.died", 9), ("b.shard", 5), ("b.shard.died", 3), ("c.shard.died", 1)):
        shard = ShardWriter(tmp_path / "run/log" / file, [(file[0], "std_msgs/msg/Empty")])
        for t in range(count):
            shard.add(0, t, b"\0\1\0\0\0")
        shard.close()
    repaired = repair(tmp_path / "run")
    assert repaired.bag == tmp_path / "run/bag"
    assert [(f.name, f.kept) for f in repaired.files] == [("a.shard.died", 9), ("b.shard", 5), ("c.shard.died", 1)]


def test_shards_beside_the_files_of_a_bag_are_reported(tmp_path):
    database(tmp_path / "bag", "DELETE").close()
    ShardWriter(tmp_path / "bag/a.shard", [("a", "std_msgs/msg/Empty")]).close()
    with pytest.raises(BagError, match=r"shards of a run \(a.shard\) and files of a bag \(bag_0.db3\): expected"):
        repair(tmp_path / "bag", tmp_path / "new")


def test_a_bag_that_was_being_written_when_the_run_was_killed_is_saved(tmp_path):
    database(tmp_path / ".bag.77.part", "DELETE", 4).close()
    repaired = repair(tmp_path)
    assert (repaired.bag, repaired.files[0].kept) == (tmp_path / "bag", 4)
