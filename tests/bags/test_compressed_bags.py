"""Bags that rosbag2 has compressed by file or by message, and what can be repaired of them after a crash."""

import os
import random
import sqlite3

import lz4.frame
import pytest
from conftest import few
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.enums import CompressionFormat, CompressionMode
from rosbags.typesys import Stores, get_typestore
from softrig_bags.cli import main_bag
from softrig_bags.errors import BagError
from softrig_bags.files.compressed import inflate
from softrig_bags.files.reader import BagReader
from softrig_bags.read import read_bag
from softrig_bags.repair import repair
from softrig_core import Recording
from softrig_core.wire.cdr import Layout

STATE = "sensor_msgs/msg/JointState"
PLUGINS = {".mcap": StoragePlugin.MCAP, ".db3": StoragePlugin.SQLITE3}


def recording(ticks=30_000):
    layout = Layout(STATE, "", ["a", "b"], {"position": 2})
    result = Recording([("state", STATE)])
    for k in range(ticks):
        t = k * 1_000_000
        result.add(0, t, layout.encode(t, (0.1 * k, 1e-3 * k * k)))
    return result


def write(directory, source, mode, suffix):
    """What rosbag2 writes with --compression-mode file or message, by the rosbags library."""
    store = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(directory, version=9, storage_plugin=PLUGINS[suffix])
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        topic = writer.add_connection("/state", STATE, typestore=store)
        for t, _, data in source.messages():
            writer.write(topic, t, data)
    return next(p for p in directory.iterdir() if p.name != "metadata.yaml")


@pytest.mark.parametrize("share", few([0.2, 0.6, 0.99], 2))
def test_a_truncated_compressed_file_gives_the_messages_before_the_cut(tmp_path, share):
    source = recording()
    file = write(tmp_path / "bag", source, CompressionMode.FILE, ".mcap")
    assert file.name.endswith(".mcap.zstd")
    os.truncate(file, int(file.stat().st_size * share))
    (tmp_path / "bag" / "metadata.yaml").unlink()
    with pytest.raises(BagError, match="bag repair"), BagReader(tmp_path / "bag"):
        pass
    done = repair(tmp_path / "bag")
    assert "the compressed file ends there" in done.files[0].lost[-1]
    result = read_bag(tmp_path / "bag").topics["state"].data
    assert result == source.topics["state"].data[: len(result)]
    assert share * 0.5 < len(result) / 30_000 <= 1.0


@pytest.mark.parametrize("suffix", PLUGINS)
@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_bag_that_lacks_only_its_metadata_is_restored_completely(tmp_path, suffix, mode):
    source = recording(2000)
    write(tmp_path / "bag", source, mode, suffix)
    assert repair(tmp_path / "bag").bag is None  # an undamaged bag needs no repair
    (tmp_path / "bag" / "metadata.yaml").unlink()
    done = repair(tmp_path / "bag")
    assert done.files[0].lost == []
    assert read_bag(tmp_path / "bag").topics == source.topics


def test_an_uncompressed_file_beside_a_truncated_compressed_one_is_read(tmp_path):
    """rosbag2 was killed while it compressed the file."""
    source = recording(2000)
    file = write(tmp_path / "bag", source, CompressionMode.FILE, ".mcap")
    whole = write(tmp_path / "other", source, CompressionMode.NONE, ".mcap")
    whole.rename(file.with_suffix(""))
    os.truncate(file, 100)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    repair(tmp_path / "bag")
    assert read_bag(tmp_path / "bag").topics == source.topics


def test_a_damaged_message_loses_only_itself(tmp_path):
    source = recording(50)
    file = write(tmp_path / "bag", source, CompressionMode.MESSAGE, ".db3")
    database = sqlite3.connect(file)
    ((data,),) = database.execute("SELECT data FROM messages WHERE id = 7")
    database.execute("UPDATE messages SET data = ? WHERE id = 7", (data[:-3],))
    database.commit()
    database.close()
    done = repair(tmp_path / "bag", tmp_path / "new")
    assert done.files[0].lost == ["a message of /state at 6000000 ns"]
    data = source.topics["state"].data
    assert read_bag(tmp_path / "new").topics["state"].data == data[:6] + data[7:]


@pytest.mark.parametrize("suffix", PLUGINS)
def test_damage_beyond_repair_is_reported_in_one_line(tmp_path, capsys, suffix):
    file = write(tmp_path / "bag", recording(5000), CompressionMode.FILE, suffix)
    os.truncate(file, 40)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    before = sorted(tmp_path.rglob("*"))
    assert main_bag(["repair", str(tmp_path / "bag")]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "no complete message" in printed
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("size", range(65512, 65526))
def test_a_chunk_that_ends_at_the_limit_of_a_piece_is_complete(size):
    """It is decompressed in pieces of 65,536 bytes: the end of the stream may come after the last byte of content."""
    content = random.Random(1).randbytes(size)
    data = lz4.frame.compress(content)
    assert inflate(data, "lz4", size) == (content, True)
    assert inflate(data, "lz4", size - 1) == (content[:-1], False)
