"""Recovery of MCAP files, truncated anywhere or with any byte of a chunk changed, against an independent count."""

import struct
import sys
import zlib
from pathlib import Path

import pytest
from mcap.records import Message
from mcap.writer import CompressionType, Writer
from rosbags.interfaces import QosDurability
from softrig_bags.content.topics import BagTopic, qos
from softrig_bags.files.bag import BagWriter
from softrig_bags.files.compressed import LIMIT, decompressed, inflate
from softrig_bags.files.mcap_file import McapFile
from softrig_bags.files.mcap_recover import Recovery, whole_records
from softrig_bags.files.source import Damaged
from softrig_bags.info import describe
from softrig_bags.repair import FileReport, Repair
from softrig_bags.write import write_bag
from softrig_core import Recording
from softrig_core.wire.cdr import Layout

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd
from lz4.frame import compress as lz4

HEADER = "std_msgs/msg/Header"
MAGIC = b"\x89MCAP0\r\n"
CHUNK, MESSAGE, FOOTER = 6, 5, 2


def whole(folder, monkeypatch, compression="none", count=9):
    """A file of three chunks with three messages each, of topics with definitions."""
    monkeypatch.setattr(McapFile, "CHUNK_BYTES", 1 << 20)
    writer = BagWriter(folder, compression=compression)
    numbers = [writer.add_topic(BagTopic(name, "x_msgs/msg/X", "byte[4] x")) for name in ("/a", "/b")]
    for k in range(count):
        writer.write(numbers[k % 2], k, b"\0\1\0\0" + bytes([k] * (20 + k)))
        if k % 3 == 2:
            writer.flush()
    writer.close()
    return next(folder.glob("*.mcap"))


def records(content, at=0):
    """Records by their lengths: opcode, where each begins, where its content begins and ends."""
    while at + 9 <= len(content):
        code, length = struct.unpack_from("<BQ", content, at)
        yield code, at, at + 9, at + 9 + length
        at += 9 + length


def chunk_parts(content, begin):
    """The start and the length of a chunk's data."""
    (letters,) = struct.unpack_from("<I", content, begin + 28)
    (length,) = struct.unpack_from("<Q", content, begin + 32 + letters)
    return begin + 40 + letters, length


def test_all_whole_messages_of_a_truncated_file_remain(tmp_path, monkeypatch):
    content = whole(tmp_path / "bag", monkeypatch).read_bytes()
    ends, stretches = [], []  # where messages end; where records begin and end, and which are chunks
    for code, at, begin, end in records(content, 8):
        stretches.append((at, end, code == CHUNK))
        if code == CHUNK:
            data, length = chunk_parts(content, begin)
            inside = content[data : data + length]
            ends += [data + stop for kind, _, _, stop in records(inside) if kind == MESSAGE]
        if code == FOOTER:
            break
    assert len(ends) == 9
    file = tmp_path / "cut.mcap"
    for cut in [*range(8, len(content), 5), len(content)]:
        file.write_bytes(content[:cut])
        recovery = Recovery(file)
        results = [r.log_time for r in recovery if isinstance(r, Message)]
        assert results == [k for k, end in enumerate(ends) if end <= cut], cut
        broken = next(((at, chunk) for at, end, chunk in stretches if at <= cut < end), None)
        lost = []
        if broken and cut - broken[0] >= 9:  # the cut leaves the head of the record intact
            lost = ["the end of a chunk that was cut"] if broken[1] else [f"the last {cut - broken[0]} bytes"]
        assert recovery.lost == lost, cut


@pytest.mark.parametrize("compression", ["none", "zstd"])
def test_a_chunk_with_a_changed_byte_is_lost_and_no_other(tmp_path, monkeypatch, compression):
    content = whole(tmp_path / "bag", monkeypatch, compression).read_bytes()
    (_, _, begin, end) = [r for r in records(content, 8) if r[0] == CHUNK][1]
    data, length = chunk_parts(content, begin)
    file = tmp_path / "changed.mcap"
    for at in (*range(data, data + length, 11), begin + 24):  # the last place is the checksum of the chunk
        file.write_bytes(content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :])
        recovery = Recovery(file)
        assert [r.log_time for r in recovery if isinstance(r, Message)] == [0, 1, 2, 6, 7, 8], at
        assert recovery.lost == ["1 damaged chunks"]
        assert recovery.compression == compression
    assert end == data + length


def test_without_a_checksum_the_messages_before_the_damage_remain(tmp_path, monkeypatch):
    content = whole(tmp_path / "bag", monkeypatch).read_bytes()
    (_, _, begin, _) = [r for r in records(content, 8) if r[0] == CHUNK][1]
    data, length = chunk_parts(content, begin)
    ends = [stop for kind, _, _, stop in records(content[data : data + length]) if kind == MESSAGE]
    at = data + ends[0] + 1  # damage the length of the second message
    changed = content[: begin + 24] + bytes(4) + content[begin + 28 : at] + b"\xff" + content[at + 1 :]
    (tmp_path / "changed.mcap").write_bytes(changed)
    recovery = Recovery(tmp_path / "changed.mcap")
    assert [r.log_time for r in recovery if isinstance(r, Message)] == [0, 1, 2, 3, 6, 7, 8]
    assert recovery.lost == ["1 damaged chunks"]
    assert whole_records(content[data : data + length])[1] == length
    assert whole_records(content[data : data + ends[1] + 5])[1] == ends[1]


TEXT = bytes(range(256)) * 600


@pytest.mark.parametrize(
    ("data", "compression", "limit", "result"),
    [
        (TEXT, "", len(TEXT), (TEXT, True)),
        (TEXT, "", len(TEXT) - 1, (TEXT[:-1], False)),
        (zstd.compress(TEXT), "zstd", len(TEXT), (TEXT, True)),
        (zstd.compress(TEXT), "zstd", len(TEXT) - 1, (TEXT[:-1], False)),
        (lz4(TEXT), "lz4", len(TEXT), (TEXT, True)),
        (lz4(TEXT), "lz4", len(TEXT) - 1, (TEXT[:-1], False)),
        (zstd.compress(TEXT)[:-1], "zstd", LIMIT, (None, False)),
        (lz4(TEXT)[:-9], "lz4", LIMIT, (None, False)),
        (b"nothing", "zstd", LIMIT, (b"", False)),
        (b"nothing", "lz4", LIMIT, (b"", False)),
        (TEXT, "brotli", LIMIT, (b"", False)),
    ],
)
def test_everything_that_can_be_decompressed_is_recovered(data, compression, limit, result):
    content, complete = inflate(data, compression, limit)
    assert complete == result[1]
    assert TEXT.startswith(content) if result[0] is None else content == result[0]


def test_long_content_is_decompressed_piece_by_piece_up_to_the_damage():
    noise = b"".join(zlib.crc32(struct.pack("<I", k)).to_bytes(4, "little") for k in range(200_000))
    packed = bytearray(zstd.compress(noise))
    packed[len(packed) * 3 // 4] ^= 0xFF
    packed[len(packed) * 3 // 4 + 1] ^= 0xFF
    content, complete = inflate(bytes(packed), "zstd")
    assert not complete or content != noise
    assert len(content) >= len(noise) // 4
    assert noise.startswith(content[: len(noise) // 4])
    assert inflate(zstd.compress(noise), "zstd") == (noise, True)


def stream(content):
    """A frame that does not state its length."""
    packer = zstd.ZstdCompressor()
    return packer.compress(content[:9]) + packer.compress(content[9:]) + packer.flush()


@pytest.mark.parametrize(
    ("claimed", "compression", "data", "reported"),
    [
        (len(TEXT), "zstd", zstd.compress(TEXT), ""),
        (len(TEXT) - 1, "zstd", zstd.compress(TEXT), "claims"),
        (len(TEXT) + 1, "zstd", zstd.compress(TEXT), "that it claims"),
        (len(TEXT), "zstd", stream(TEXT), ""),
        (len(TEXT) - 1, "zstd", stream(TEXT), "that it claims"),
        (2 * len(TEXT), "zstd", 2 * zstd.compress(TEXT), ""),  # two frames in one chunk
        (2 * len(TEXT), "zstd", 2 * stream(TEXT), ""),
        (len(TEXT), "lz4", lz4(TEXT), ""),
        (len(TEXT) - 1, "lz4", lz4(TEXT), "that it claims"),
        (4, "", b"1234", ""),
        (3, "", b"1234", "that it claims"),
        (LIMIT + 1, "", b"1", "expected the actual size and at most"),
        (4, "zstd", b"1234", "claims"),
        (4, "bz2", b"1234", "compressed by 'bz2'"),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 30 else f"{type(value).__name__}",
)
def test_a_chunk_has_the_content_that_it_states_or_is_damaged(claimed, compression, data, reported):
    if not reported:
        assert decompressed(data, compression, claimed) == (data if claimed == 4 else (TEXT * 2)[:claimed])
        return
    with pytest.raises(Damaged, match=reported):
        decompressed(data, compression, claimed)


def test_a_file_of_another_writer_is_recovered_with_its_summary(tmp_path):
    """Messages outside of chunks, and records of unknown types."""
    with (tmp_path / "x.mcap").open("wb") as out:
        writer = Writer(out, compression=CompressionType.LZ4, use_chunking=False)
        writer.start()
        schema = writer.register_schema("s", "ros2msg", b"")
        channel = writer.register_channel("/a", "cdr", schema)
        for k in range(3):
            writer.add_message(channel, k, bytes([k]), k)
        writer.finish()
    recovery = Recovery(tmp_path / "x.mcap")
    assert [r.log_time for r in recovery if isinstance(r, Message)] == [0, 1, 2]
    assert (recovery.lost, recovery.compression) == ([], "none")


def test_reports_of_a_repair_are_as_expected():
    files = [FileReport("a.mcap", 3, ["x", "y"]), FileReport("b.mcap", 4, indexed=True), FileReport("c.mcap", 5)]
    assert str(Repair(Path("new"), files, Path("old"))) == (
        "a.mcap: 3 messages kept, lost: x, y\n"
        "b.mcap: 4 messages kept\n"
        "c.mcap: 5 messages kept, no index; what was not yet flushed when the recorder died is lost\n"
        "12 messages in new\n"
        "the damaged files are in old"
    )
    assert str(Repair(None, files[1:2])) == "b.mcap: 4 messages kept\nnothing to repair"


def test_the_content_of_a_bag_is_reported(tmp_path):
    recording = Recording([("a", HEADER), ("longer/name", HEADER)])
    for k in range(3):
        recording.add(0, k * 500_000_000, Layout(HEADER).encode(k, ()))
    write_bag(tmp_path / "bag", recording, custom_data={"seed": "7"}, latched=["a"])
    size = (tmp_path / "bag/bag_0.mcap").stat().st_size
    assert describe(tmp_path / "bag").splitlines() == [
        f"{tmp_path / 'bag'}: bag_0.mcap, {size / 1e6:.3g} MB",
        "3 messages in 1 s from 0 s",
        "  /a                   3  std_msgs/msg/Header  (reliable transient_local)",
        "  /longer/name         0  std_msgs/msg/Header  (reliable volatile)",
        "  seed: 7",
    ]
    for begin, reported in ((10**18, "2001-09-09 01:46:40.000+00:00"), (10**18 - 10**9, "999999999 s")):
        writer = BagWriter(tmp_path / str(begin))
        best_effort = BagTopic("/a", HEADER, "int8 x", offered=(qos(), qos(QosDurability.TRANSIENT_LOCAL)))
        number = writer.add_topic(best_effort)
        writer.add_topic(BagTopic("/b", HEADER, "int8 x"))
        writer.write(number, begin, b"")
        writer.close()
        lines = describe(tmp_path / str(begin)).splitlines()
        assert lines[1] == f"1 messages in 0 s from {reported}"
        assert lines[2].endswith("(reliable transient_local; reliable volatile)")
        assert lines[3].endswith("(QoS unknown)")
