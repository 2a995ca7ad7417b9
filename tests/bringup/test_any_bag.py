"""Every verb that accepts a bag accepts any bag or refuses it in one line; this file holds the table of doc/bags.md.

Statuses: 0 done, 1 done with what could be read and the rest named, 2 refused in a line. Never 4, an error of softrig.
"""

import re
import shutil
import sqlite3
from pathlib import Path
from types import SimpleNamespace

import pytest
from bokeh.document import Document
from conftest import few
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from softrig_bags.content.topics import BagTopic
from softrig_bags.files.bag import BagWriter
from softrig_bringup.cli import main
from softrig_bringup.view import serve
from softrig_bringup.view.control import Control
from softrig_bringup.view.page import Page
from softrig_core.wire.cdr import Layout

FLOAT, STATE, WALL = "std_msgs/msg/Float64", "sensor_msgs/msg/JointState", 1_764_000_000 * 10**9
PAGE = Path(__file__).parents[2] / "ros_pkgs/softrig_bags/doc/bags.md"
SPEED = Layout(FLOAT)


def speeds(count):
    return [(WALL + k * 10**8, SPEED.encode(0, (float(k),))) for k in range(count)]


def of_rosbag2(folder, plugin=StoragePlugin.SQLITE3, mode=None):
    """A bag that the rosbags library writes."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    if mode is not None:
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/speed", FLOAT, typestore=get_typestore(Stores.ROS2_JAZZY))
        for t, data in speeds(10):
            writer.write(topic, t, data)
    return folder


def of_ours(folder, **options):
    """A bag of our writer with some flushed messages."""
    writer = BagWriter(folder, **options)
    number = writer.add_topic(BagTopic.known("/speed", FLOAT))
    for t, data in speeds(10):
        writer.write(number, t, data)
    writer.flush()
    return writer


def whole(folder, **options):
    of_ours(folder, **options).close()
    return folder


def of_mcap(file, msgtype="x_msgs/msg/X", encoding="cdr", definition=b""):
    """A single file with an unknown type."""
    file.parent.mkdir(parents=True)
    with file.open("wb") as out:
        writer = McapWriter(out)
        writer.start("", "x")
        channel = writer.register_channel("/x", encoding, writer.register_schema(msgtype, "ros2msg", definition))
        for t, data in speeds(3):
            writer.add_message(channel, t, data, t)
        writer.finish()
    return file


def cut(folder, share=0.6):
    file = next(p for p in folder.iterdir() if p.name != "metadata.yaml")
    file.write_bytes(file.read_bytes()[: int(file.stat().st_size * share)])
    return folder


def edited(folder, old, new):
    text = (folder / "metadata.yaml").read_text()
    assert old in text
    (folder / "metadata.yaml").write_text(text.replace(old, new))
    return folder


def without_metadata(folder):
    (folder / "metadata.yaml").unlink()
    return folder


def being_recorded(folder):
    """A bag during recording with rosbag2's preset `resilient`: committed rows are in the journal."""
    of_rosbag2(folder)
    (folder / "metadata.yaml").unlink()
    database = sqlite3.connect(next(folder.glob("*.db3")))
    database.execute("PRAGMA journal_mode=WAL")
    database.execute("INSERT INTO messages(topic_id, timestamp, data) SELECT topic_id, timestamp, data FROM messages")
    database.commit()
    OPEN.append(database)
    return folder


OPEN = []
KINDS = {
    "the folder of a run": lambda run, place: run,
    "its bag": lambda run, place: run / "bag",
    "its bag, moved": lambda run, place: Path(shutil.copytree(run / "bag", place / "moved")),
    "its file": lambda run, place: Path(shutil.copy(next((run / "bag").glob("*.mcap")), place / "one.mcap")),
    "its bag, scenario unknown here": lambda run, place: edited(
        Path(shutil.copytree(run / "bag", place / "unknown")), "dc_motor_smc_b2", "no_such_scenario"
    ),
    "of `bag record`": lambda run, place: whole(place / "recorded"),
    "of rosbag2, sqlite3": lambda run, place: of_rosbag2(place / "foreign"),
    "of rosbag2, MCAP": lambda run, place: of_rosbag2(place / "foreign_mcap", StoragePlugin.MCAP),
    "split": lambda run, place: whole(place / "split", split_bytes=1),
    "compressed by file": lambda run, place: of_rosbag2(place / "packed", StoragePlugin.MCAP, CompressionMode.FILE),
    "compressed by message": lambda run, place: of_rosbag2(place / "small", mode=CompressionMode.MESSAGE),
    "cut": lambda run, place: cut(Path(shutil.copytree(run / "bag", place / "cut"))),
    "cut, without metadata": lambda run, place: without_metadata(cut(whole(place / "killed"), 0.9)),
    "live, MCAP": lambda run, place: OPEN.append(of_ours(place / "live")) or place / "live",
    "live, sqlite3 with a journal": lambda run, place: being_recorded(place / "journal"),
    "with other counts in its metadata": lambda run, place: edited(
        whole(place / "counts"), "message_count: 10", "message_count: 12"
    ),
    "of unknown types": lambda run, place: of_mcap(place / "unknown_type/x.mcap"),
    "of JSON": lambda run, place: of_mcap(place / "json/x.mcap", encoding="json"),
    "without messages": lambda run, place: BagWriter(place / "empty").close() or place / "empty",
    "no bag": lambda run, place: (place / "nothing").mkdir() or place / "nothing",
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("any") / "run"
    options = ["--mode", "inprocess", "--duration", "0.1", "--no-plots", "--out", str(folder)]
    assert main(["run", "dc_motor_smc_b2", *options]) == 0
    return folder


class Player:
    """A node and its executor that need no time."""

    stopped, opened = False, None

    def __init__(self, *_):
        self.node = self
        self.published = []

    def create_service(self, *_):
        pass

    def create_publisher(self, kind, topic, profile):
        return SimpleNamespace(
            publish=self.published.append,
            topic_name=topic,
            get_subscription_count=lambda: 1,
            wait_for_all_acked=lambda patience: True,
        )

    def spin(self, seconds):
        pass


def shown(source, how, address):
    """The page of `view`, as its server makes it."""
    control = Control(source.rig, lambda *words: None, lambda: 0.0, lambda: "")
    Page(Document(), source, control, lambda: ((), True), "me", "here", "light").update()


VERBS = {
    "bag info": lambda bag, out: ["bag", "info", bag],
    "bag export": lambda bag, out: ["bag", "export", bag, "--out", f"{out}/tables"],
    "bag compare": lambda bag, out: ["bag", "compare", bag, bag],
    "bag play": lambda bag, out: ["bag", "play", bag, "--rate", "1000000"],
    "bag repair": lambda bag, out: ["bag", "repair", bag, "--out", f"{out}/repaired"],
    "draw plot": lambda bag, out: ["draw", "plot", bag, "SIGNAL", "--format", "svg", "--out", f"{out}/plots"],
    "draw animate": lambda bag, out: ["draw", "animate", bag, "--out", f"{out}/film.svg"],
    "view": lambda bag, out: ["view", bag],
    "report": lambda bag, out: ["report", bag, "--out", f"{out}/report.html"],
    "run --like": lambda bag, out: [
        *("run", "--like", bag, "--mode", "inprocess", "--no-plots", "--out", f"{out}/again"),
    ],
    "pack": lambda bag, out: ["pack", bag, "--out", f"{out}/run.zip"],
}
WORDS = {0: "yes", 1: "partly", 2: "no"}


def table():
    """The table of the page: for each kind of bag the entry of each verb."""
    rows = [[c.strip() for c in line.strip("| \n").split("|")] for line in PAGE.read_text().splitlines() if "|" in line]
    head = next(row for row in rows if row[0] == "bag" and len(row) == len(VERBS) + 1)
    assert [re.sub("`", "", c) for c in head[1:]] == list(VERBS)
    return {row[0]: dict(zip(VERBS, row[1:], strict=True)) for row in rows if row[0] in KINDS}


@pytest.mark.parametrize("kind", few(KINDS, 5))
def test_every_verb_accepts_any_bag_or_refuses_it_in_one_line(run, tmp_path, capsys, monkeypatch, kind):
    monkeypatch.setattr("softrig_bags.live.ros.Session", Player)
    monkeypatch.setattr(serve, "serve", shown)
    monkeypatch.setattr("softrig_bags.cli._leaving", lambda tool: tool)
    bag = KINDS[kind](run, tmp_path)
    files = {p: p.read_bytes() for p in bag.rglob("*") if p.is_file() and not p.name.endswith("-shm")}
    signal = "motor/state/shaft/velocity" if kind.startswith(("the folder", "its", "of an")) else "speed/data"
    results = {}
    for verb, words in VERBS.items():
        out = tmp_path / "out" / verb.replace(" ", "_")
        out.mkdir(parents=True)
        status = main([signal if word == "SIGNAL" else str(word) for word in words(bag, out)])
        printed = capsys.readouterr()
        assert "error of softrig" not in printed.err + printed.out, (verb, printed.err)
        assert status in WORDS, (verb, status, printed.err)
        if status:
            assert all(line.startswith("softrig: ") for line in printed.err.splitlines()), (verb, printed.err)
        if status == 2:
            assert bag.name in printed.err or "nothing to compare" in printed.err, (verb, printed.err)
        results[verb] = WORDS[status]
    assert {p: p.read_bytes() for p in files} == files  # reading does not change the bag
    while OPEN:
        database = OPEN.pop()
        database.close() if isinstance(database, sqlite3.Connection) else database.abort()
    assert results == table()[kind]
