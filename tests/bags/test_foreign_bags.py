"""Bags as other tools leave them: metadata of every version, QoS and counts that are wrong, types of every kind."""

import sqlite3
import struct
from io import BytesIO
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from mcap.writer import CompressionType, Writer
from rclpy.serialization import serialize_message
from ruamel.yaml import YAML
from scipy.io import loadmat
from sensor_msgs.msg import JointState
from softrig_bags.align import align
from softrig_bags.cli import main_bag, main_compare
from softrig_bags.compare import Tolerance, compare
from softrig_bags.content.definitions import UnknownType, complete, types_of
from softrig_bags.content.layouts import LONGEST, LONGEST_OCTETS, Undecodable, template
from softrig_bags.content.topics import BagTopic, typestore
from softrig_bags.errors import BagError
from softrig_bags.export import ROWS
from softrig_bags.files.bag import BagWriter
from softrig_bags.files.metadata import profiles
from softrig_bags.files.reader import BagReader
from softrig_bags.live.player import span
from softrig_bags.read import read_bag, signals
from softrig_core.wire.cdr import Layout
from softrig_nodes.ros.messages import message_class
from std_msgs.msg import Byte, ByteMultiArray, Char, String

try:
    from compression import zstd
except ImportError:
    from backports import zstd

FLOAT, STATE = "std_msgs/msg/Float64", "sensor_msgs/msg/JointState"
START = 1_764_000_000_000_000_000
RELIABLE = "- history: keep_last\n  depth: 10\n  reliability: reliable\n  durability: volatile\n"
LATCHED = RELIABLE.replace("volatile", "transient_local")


def number(value):
    return struct.pack("<HHd", 0x100, 0, value)


def mcap(path, rows, *, definitions=(), qos=RELIABLE, profile="ros2", **options):
    """A file of (topic, type, time, bytes), with each type's definition (text, language) or without one."""
    out = BytesIO()
    writer = Writer(out, **{"compression": CompressionType.NONE} | options)
    writer.start(profile)
    known = {FLOAT: ("float64 data", "ros2msg"), **dict(definitions)}
    channels = {}
    for topic, msgtype, t, data in rows:
        if (topic, msgtype) not in channels:
            text, language = known.get(msgtype, ("", ""))
            schema = writer.register_schema(msgtype, language, text.encode())
            encoding = "json" if language == "jsonschema" else "cdr"
            channels[topic, msgtype] = writer.register_channel(
                topic, encoding, schema, {"offered_qos_profiles": qos} if qos else {}
            )
        writer.add_message(channels[topic, msgtype], t, data, t)
    writer.finish()
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(out.getvalue())
    return path


def metadata(bag, topics, files, *, version=9, count=None, start=START, duration=900_000_000, qos=RELIABLE, **more):
    """The metadata that rosbag2 writes beside the file: topics (name, type, count)."""
    profiles_ = YAML(typ="safe").load(qos) if version >= 9 and qos else qos
    times = {"starting_time": {"nanoseconds_since_epoch": start}, "duration": {"nanoseconds": duration}}
    about = {
        "version": version,
        "storage_identifier": "mcap" if files[0].endswith("mcap") else "sqlite3",
        "relative_file_paths": files if version > 1 else [f"{bag.name}/{name}" for name in files],
        **times,
        "message_count": sum(n for *_, n in topics) if count is None else count,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": msgtype,
                    "serialization_format": "cdr",
                    **({"offered_qos_profiles": profiles_} if version > 2 else {}),
                    **({"type_description_hash": ""} if version > 6 else {}),
                },
                "message_count": n,
            }
            for name, msgtype, n in topics
        ],
        **({"compression_format": "", "compression_mode": ""} if version > 2 else {}),
        **({"files": [{"path": f, **times, "message_count": 1} for f in files]} if version > 4 else {}),
        **({"custom_data": {"who": "1"}} if version > 5 else {}),
        **({"ros_distro": "iron"} if version > 7 else {}),
        **more,
    }
    with (bag / "metadata.yaml").open("w") as out:
        YAML().dump({"rosbag2_bagfile_information": about}, out)


def speeds(n=10, topic="/speed", step=100_000_000, start=START, first=0):
    return [(topic, FLOAT, start + k * step, number(first + k)) for k in range(n)]


def database(path, rows, schema):
    """An SQLite file with the schema of a version of rosbag2: 1 Dashing, 2 Foxy, 3 Humble, 4 Iron and Jazzy."""
    path.parent.mkdir(parents=True, exist_ok=True)
    db = sqlite3.connect(path)
    extra = ", offered_qos_profiles TEXT" if schema > 1 else ""
    extra += ", type_description_hash TEXT" if schema > 3 else ""
    db.execute(f"CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT{extra})")
    db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
    if schema > 2:
        db.execute("CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT)")
        db.execute("CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER, metadata TEXT)")
    if schema > 3:
        db.execute(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT, encoding TEXT, "
            "encoded_message_definition TEXT, type_description_hash TEXT)"
        )
        db.execute("INSERT INTO message_definitions VALUES (1, ?, 'ros2msg', 'float64 data', '')", (FLOAT,))
    db.execute(f"INSERT INTO topics VALUES (7, '/speed', ?, 'cdr'{', ?' if schema > 1 else ''}{', ?' * (schema > 3)})",
               (FLOAT, *([RELIABLE] if schema > 1 else []), *([""] if schema > 3 else [])))  # fmt: skip
    db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (7, ?, ?)", [(t, d) for _, _, t, d in rows])
    db.commit()
    db.close()


@pytest.mark.parametrize("storage", ["mcap", "db3"])
@pytest.mark.parametrize("version", range(1, 10))
def test_metadata_of_every_version_and_databases_of_every_distribution(tmp_path, version, storage):
    bag, name = tmp_path / "bag", f"bag_0.{storage}"
    if storage == "mcap":
        mcap(bag / name, speeds())
    else:
        database(bag / name, speeds(), schema={1: 1, 2: 1, 3: 2, 4: 2, 5: 3}.get(version, 4))
    numbers = "- history: 1\n  depth: 0\n  reliability: 1\n  durability: 1\n" if 2 < version < 9 else RELIABLE
    metadata(bag, [("/speed", FLOAT, 10)], [name], version=version, qos=numbers)
    with BagReader(bag) as result:
        assert (result.counts, result.is_whole) == ([10], True)
        assert result.custom_data == ({"who": "1"} if version > 5 else {})
    t, x = signals(bag)["speed/data"]
    np.testing.assert_allclose(t, np.arange(10) / 10)
    assert x.tolist() == list(range(10))


@pytest.mark.parametrize("mode", ["file", "frames", "message", "message alone"])
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_compressed_content_is_read_whichever_place_declares_it(tmp_path, mode, storage):
    """Whole files, also of several frames, and single messages, with metadata or without."""
    rows, bag, name = speeds(), tmp_path / "bag", f"bag_0.{storage}"
    if mode.startswith("message"):
        rows = [(*row[:3], zstd.compress(row[3]) if k % 2 else zstd.compress(row[3][:5]) + zstd.compress(row[3][5:]))
                for k, row in enumerate(rows)]  # fmt: skip
    (database(bag / name, rows, 4) if storage == "db3" else mcap(bag / name, rows))
    if mode in ("file", "frames"):
        content = (bag / name).read_bytes()
        half = len(content) // 2
        parts = [content] if mode == "file" else [content[:half], content[half:], b""]
        (bag / f"{name}.zstd").write_bytes(b"".join(map(zstd.compress, parts)))
        (bag / name).unlink()
        name += ".zstd"
    metadata(bag, [("/speed", FLOAT, 10)], [name], compression_format="zstd", compression_mode="FILE")
    path = bag / name if mode == "message alone" else bag
    assert signals(path)["speed/data"].x.tolist() == list(range(10))
    assert signals(bag / name)["speed/data"].x.tolist() == list(range(10))


@pytest.mark.parametrize("qos", [LATCHED, "", "- depth: 5\n", "no list", "- {history: 9, depth: many}", "[[]]", "- {"])
def test_the_qos_in_the_metadata_is_not_part_of_a_topic_name(tmp_path, capsys, qos):
    bag = tmp_path / "bag"
    mcap(bag / "bag_0.mcap", [*speeds(), *speeds(topic="/other")])
    metadata(bag, [("/speed", FLOAT, 10), ("/other", FLOAT, 10)], ["bag_0.mcap"], qos=qos, version=5)
    other = tmp_path / "other"
    mcap(other / "bag_0.mcap", [*speeds(first=1), *speeds(topic="/other")])
    metadata(other, [("/speed", FLOAT, 10), ("/other", FLOAT, 10)], ["bag_0.mcap"], qos=LATCHED)
    assert main_bag(["export", str(bag), "--out", str(tmp_path / "e")]) == 0
    assert len((tmp_path / "e/speed.csv").read_text().splitlines()) == 11
    assert main_compare([str(bag), str(bag)]) == 0
    assert "speed: 10 messages, equal" in capsys.readouterr().out
    assert main_compare([str(bag), str(other)]) == 1
    with BagReader(bag) as reader:
        assert span(reader, 0.0, None).start == START
        assert len(list(reader.messages())) == 20


def test_partial_profiles_are_completed_with_a_publishers_defaults():
    (result,) = profiles("- reliability: best_effort\n  deadline: {sec: 1, nsec: 5}\n  depth: '3'\n")
    assert (result.reliability.name, result.durability.name, result.depth) == ("BEST_EFFORT", "VOLATILE", 3)
    assert (result.deadline.sec, result.deadline.nsec) == (1, 5)
    assert [p.history.name for p in profiles("- history: 3\n- history: keep_all\n- history: odd\n")] == [
        "UNKNOWN", "KEEP_ALL", "UNKNOWN"
    ]  # fmt: skip


CLAIMS = [
    ({"count": 9}, "10 messages in the files, metadata.yaml claims 9"),
    ({"count": 0}, "10 messages in the files, metadata.yaml claims 0"),
    ({"topics": 12}, "/speed: 10 messages in the files, metadata.yaml claims 12"),
    ({"topics": 0}, "/speed: 10 messages in the files, metadata.yaml claims 0"),
]


@pytest.mark.parametrize(("claim", "reported"), CLAIMS, ids=str)
@pytest.mark.parametrize("verb", ["info", "export", "compare", "signals"])
def test_the_messages_read_are_compared_with_the_metadata_in_every_verb(tmp_path, capsys, claim, reported, verb):
    bag = tmp_path / "bag"
    mcap(bag / "bag_0.mcap", speeds())
    metadata(bag, [("/speed", FLOAT, claim.get("topics", 10))], ["bag_0.mcap"], count=claim.get("count"))
    if verb == "signals":
        t, x = signals(bag)["speed/data"]
        assert (t[-1], len(x)) == (0.9, 10)
    else:
        calls = {
            "info": lambda: main_bag(["info", str(bag)]),
            "export": lambda: main_bag(["export", str(bag), "--out", str(tmp_path / "out")]),
            "compare": lambda: main_compare([str(bag), str(bag)]),
        }
        assert calls[verb]() == 1
    assert reported in capsys.readouterr().err


def test_topics_missing_from_the_metadata_and_extra_or_missing_files_are_reported(tmp_path, capsys):
    bag = tmp_path / "bag"
    mcap(bag / "a_0.mcap", [*speeds(), *speeds(3, "/other")])
    mcap(bag / "b_0.mcap", speeds(start=START + 2_000_000_000, first=10))
    metadata(bag, [("/speed", FLOAT, 20)], ["a_0.mcap", "b_0.mcap"], count=23)
    assert main_bag(["info", str(bag)]) == 1
    assert "/other: 3 messages in the files, metadata.yaml does not name the topic" in capsys.readouterr().err
    assert signals(bag)["speed/data"].x.tolist() == list(range(20))
    metadata(bag, [("/speed", FLOAT, 10), ("/other", FLOAT, 3)], ["a_0.mcap"])
    assert main_bag(["info", str(bag)]) == 1
    assert "b_0.mcap is in the folder, but not in metadata.yaml: it was not read" in capsys.readouterr().err
    metadata(bag, [("/speed", FLOAT, 10), ("/other", FLOAT, 3)], ["a_0.mcap", "c_0.mcap"])
    assert main_bag(["info", str(bag)]) == 2
    assert "c_0.mcap is in metadata.yaml, but not in the folder" in capsys.readouterr().err


@pytest.mark.parametrize(("start", "duration"), [(START, 900_000_000), (0, 0), (-5, "soon")])
@pytest.mark.parametrize("storage", ["mcap", "db3"])
def test_times_and_order_come_from_the_files(tmp_path, storage, start, duration):
    """Files that overlap in time, one of them out of order within, and metadata with the times of the last alone."""
    bag, rows = tmp_path / "bag", []
    for k in range(3):
        own = speeds(start=START + k * 500_000_000, first=10 * k)
        own = [own[i] for i in (0, 2, 1, 3, 9, 8, 4, 5, 6, 7)]
        rows += own
        if storage == "mcap":
            mcap(bag / f"bag_{k}.mcap", own, use_chunking=k != 1)
        else:
            database(bag / f"bag_{k}.db3", own, 4)
    files = [f"bag_{k}.{storage}" for k in range(3)]
    metadata(bag, [("/speed", FLOAT, 30)], files, start=start, duration=duration)
    rows.sort(key=lambda row: row[2])
    with BagReader(bag) as result:
        assert [(t, data) for _, t, data in result.messages()] == [(t, data) for _, _, t, data in rows]
        assert (result.start, result.end) == (START, rows[-1][2])
        part = span(result, 0.0, None)
        assert sum(part.start <= t <= part.end for _, t, _ in result.messages(start=part.start)) == 30
    assert signals(bag)["speed/data"].t[0] == 0.0


@pytest.mark.parametrize(("first", "last"), [(START, 0), (0, 0), (START, START - 1), (START - 9, START - 5)])
def test_wrong_times_of_a_chunk_lose_no_message(tmp_path, first, last):
    """Fields that a writer has left at zero or miscounted, and a player that starts reading at a later time."""
    file = mcap(tmp_path / "x.mcap", speeds())
    content = bytearray(file.read_bytes())
    # The chunk begins here; its index follows later.
    at = content.index(struct.pack("<QQ", START, START + 900_000_000))
    content[at : at + 16] = struct.pack("<QQ", first, last)
    file.write_bytes(content)
    with BagReader(file) as bag:
        assert sum(1 for _ in bag.messages(start=span(bag, 0.0, None).start)) == 10
    with BagReader(file) as bag, pytest.raises(BagError, match=r"start offset 5 s: the bag is only 0\.9 s long"):
        span(bag, 5.0, None)


def test_a_database_with_a_time_before_zero_is_refused(tmp_path, capsys):
    file = tmp_path / "a.db3"
    database(file, [("/speed", FLOAT, -5, number(1.0)), *speeds(3)], 4)
    assert main_bag(["info", str(file)]) == 2
    assert f"messages are at -5 to {START + 2 * 10**8}, expected whole numbers of ns from 0" in capsys.readouterr().err
    assert main_bag(["repair", str(file), "--out", str(tmp_path / "out")]) == 1
    assert "3 messages kept, lost: 1 damaged rows" in capsys.readouterr().out


def test_a_database_with_nulls_for_unknown_values_is_read_and_repaired(tmp_path):
    file = tmp_path / "a.db3"
    database(file, speeds(3), 4)
    db = sqlite3.connect(file)
    db.execute("UPDATE topics SET type_description_hash=NULL, offered_qos_profiles=NULL, serialization_format=NULL")
    db.execute("UPDATE message_definitions SET encoded_message_definition=NULL, encoding=NULL")
    db.commit()
    db.close()
    assert signals(file)["speed/data"].x.tolist() == [0.0, 1.0, 2.0]
    assert main_bag(["repair", str(file), "--out", str(tmp_path / "out")]) == 0
    assert signals(tmp_path / "out")["speed/data"].x.tolist() == [0.0, 1.0, 2.0]


UNREADABLE = [
    ("unknown", "", "no definition of a/msg/X"),
    ("unknown", "x", "its definition is in unknown"),
    ("ros2msg", "float64[ x", "cannot be read"),
    ("ros2idl", "module a { struct X { double x; ", "the text ends"),
    ("ros2idl", "module a { module msg { union X switch (long) { case 1: long y; }; }; };", "'union', expected"),
    ("ros2msg", "b/Unknown y", "no definition of b/msg/Unknown, which is in a/msg/X"),
    ("jsonschema", '{"type": "object"}', "its messages are in json"),
    ("protobuf", "x", "its definition is in protobuf"),
    ("", "", "no definition of a/msg/X"),
]


@pytest.mark.parametrize(("language", "text", "reported"), UNREADABLE)
def test_a_topic_that_cannot_be_decoded_is_named_and_all_others_are_read(tmp_path, capsys, language, text, reported):
    file = mcap(
        tmp_path / "x.mcap",
        [*speeds(), ("/x", "a/msg/X", START, b"\0\1\0\0\2")],
        definitions=[("a/msg/X", (text, language))] if language else (),
    )
    assert main_bag(["info", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "cannot be decoded: " in printed
    assert reported in printed
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 0
    printed = capsys.readouterr().err
    assert "/x (a/msg/X) cannot be decoded: " in printed
    assert reported in printed
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["speed.csv"]
    assert main_compare([str(file), str(file)]) == 0
    assert "x: 1 messages, equal" in capsys.readouterr().out


NESTED_IDL = (
    "module my { module msg { struct Inner { double value; }; }; };",
    '#include "my/msg/Inner.idl"\nmodule my {\n  module msg {\n    typedef double pair__2[2];\n'
    "    module Outer_Constants { const int8 A = 1; };\n"
    '    @verbatim (language="comment", text=\n      "it\'s (an) outer one" "\\n")\n'
    '    struct Outer {\n      @unit (value="m")\n      my::msg::Inner inner;\n      my::msg::pair__2 pair;\n'
    "      sequence<boolean, 3> flags; // some\n      string<4> name;\n    };\n  };\n};",
)
OUTER = struct.pack("<HH3dI3B", 0x100, 0, 2.5, 1.0, 2.0, 3, 1, 0, 1) + struct.pack("<BI3s", 0, 3, b"ab\0")
LINE = "=" * 80


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_definitions_in_idl_are_read_as_rosbag2_documents_them(tmp_path, first, end):
    """Every definition begins with a line with its name, which the first may leave out."""
    head = f"{LINE}\nIDL: my/msg/Outer\n" if first else ""
    text = f"{head}{NESTED_IDL[1]}\n{LINE}\nIDL: my/msg/Inner\n{NESTED_IDL[0]}"
    file = mcap(
        tmp_path / "x.mcap",
        [("/x", "my/msg/Outer", START, OUTER), *speeds()],
        definitions=[("my/msg/Outer", (text.replace("\n", end), "ros2idl"))],
    )
    result = signals(file)
    assert {name: result[name].x.tolist() for name in result if name.startswith("x/")} == {
        "x/inner/value": [2.5], "x/pair/0": [1.0], "x/pair/1": [2.0],
        "x/flags/0": [1.0], "x/flags/1": [0.0], "x/flags/2": [1.0],
    }  # fmt: skip
    assert result["speed/data"].x.tolist() == list(range(10))


def test_all_installed_definitions_are_the_same_in_both_languages():
    """The code that rosidl generated from the .msg files of this distribution, by two grammars and two parsers."""
    import os

    count = 0
    for prefix in os.environ["AMENT_PREFIX_PATH"].split(":"):
        for file in sorted(Path(prefix).glob("share/*/msg/*.msg")):
            if not (idl := file.with_suffix(".idl")).exists():
                continue
            name = f"{file.parts[-3]}/msg/{file.stem}"
            one = types_of(name, file.read_text(), "ros2msg")[name][1]
            two = types_of(name, idl.read_text(), "ros2idl")[name][1]
            if not one:  # IDL has no empty structure, so it gets one dummy member
                assert [field for field, _ in two] == ["structure_needs_at_least_one_member"]
                continue
            plain = str(one).replace("'char'", "'uint8'")
            assert str(two) == plain, name
            count += 1
    assert count > 100


@pytest.mark.parametrize(
    "text", ["\ufefffloat64 value\r\nint32 n\r\n", "float64 value  # m\n\nint8 A=1\nint32 n 5\nstring B = a#b\n"]
)
def test_definitions_with_a_byte_order_mark_line_ends_constants_and_defaults(tmp_path, text):
    data = struct.pack("<HHdi", 0x100, 0, 1.5, 2)
    file = mcap(tmp_path / "x.mcap", [("/x", "a/msg/X", START, data)], definitions=[("a/msg/X", (text, "ros2msg"))])
    result = signals(file)
    assert {name: result[name].x.tolist() for name in result} == {"x/value": [1.5], "x/n": [2.0]}


def decoded(definition, data, language="ros2msg"):
    """Columns of one message of a type by its definition."""
    types = complete("a/msg/X", types_of("a/msg/X", definition, language))
    made = template("a/msg/X", types, data)
    rows = np.frombuffer(data, np.uint8)[None]
    texts = {leaf.path: made.texts(rows, leaf)[0] for leaf in made.leaves if leaf.text}
    return {label: float(x[0]) for label, x in made.columns(rows).items()}, texts


@pytest.mark.parametrize("value", [0, 1, 100, 127, 128, 200, 255])
def test_bytes_and_characters_are_decoded_as_in_rclpy(value):
    for kind, message in ((Byte, Byte(data=bytes([value]))), (Char, Char(data=value))):
        data = serialize_message(message)
        name = f"std_msgs/msg/{kind.__name__}"
        made = template(name, complete(name, {}), data)
        expected = message.data[0] if isinstance(message.data, bytes) else message.data
        assert made.columns(np.frombuffer(data, np.uint8)[None])["data"][0] == expected == value
    data = serialize_message(ByteMultiArray(data=[bytes([value]), b"\7"]))
    name = "std_msgs/msg/ByteMultiArray"
    made = template(name, complete(name, {}), data)
    columns = made.columns(np.frombuffer(data, np.uint8)[None])
    assert [columns[f"data/{i}"][0] for i in range(2)] == [value, 7]


VALUES = {
    "bool": (True, False), "int8": (-128, 127), "uint8": (0, 255), "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1), "int32": (-(2**31), 2**31 - 1), "uint32": (0, 2**32 - 1), "int64": (-(2**62), 2**40),
    "uint64": (0, 2**63), "float32": (0.5, -1.25), "float64": (1e-300, -0.1),
}  # fmt: skip


def test_every_primitive_type_alone_and_in_sequences_is_decoded_as_in_rclpy():
    """By two messages that contain all of them: rcl_interfaces/ParameterValue and one of sensor_msgs."""
    kinds = {
        "std_msgs/msg/Bool": "bool", **{f"std_msgs/msg/Int{k}": f"int{k}" for k in (8, 16, 32, 64)},
        **{f"std_msgs/msg/UInt{k}": f"uint{k}" for k in (8, 16, 32, 64)},
        **{f"std_msgs/msg/Float{k}": f"float{k}" for k in (32, 64)},
    }  # fmt: skip
    for name, kind in kinds.items():
        for value in VALUES[kind]:
            data = serialize_message(message_class(name)(data=value))
            made = template(name, complete(name, {}), data)
            assert made.columns(np.frombuffer(data, np.uint8)[None]) == {"data": [float(value)]}
    name = "rcl_interfaces/msg/ParameterValue"
    value = message_class(name)(
        type=5, bool_value=True, integer_value=-(2**40), double_value=0.1, string_value="é",
        byte_array_value=[b"\xc8", b"\1"], bool_array_value=[True, False, True], integer_array_value=[1, -2],
        double_array_value=[0.25], string_array_value=["a", "", "bc"],
    )  # fmt: skip
    data = serialize_message(value)
    made = template(name, complete(name, {}), data)
    rows = np.frombuffer(data, np.uint8)[None]
    assert {k: float(x[0]) for k, x in made.columns(rows).items()} == {
        "type": 5, "bool_value": 1, "integer_value": -(2**40), "double_value": 0.1,
        "byte_array_value/0": 200, "byte_array_value/1": 1,
        "bool_array_value/0": 1, "bool_array_value/1": 0, "bool_array_value/2": 1,
        "integer_array_value/0": 1, "integer_array_value/1": -2, "double_array_value/0": 0.25,
    }  # fmt: skip
    texts = {leaf.path: made.texts(rows, leaf)[0] for leaf in made.leaves if leaf.text}
    assert texts == {
        "string_value": "é", "string_array_value/0": "a", "string_array_value/1": "", "string_array_value/2": "bc"
    }  # fmt: skip


def cdr(order, *items):
    """A message by the rules of XCDR1: (code of struct, value) one after the other, each aligned to its size."""
    out = bytearray()
    for code, value in items:
        size = struct.calcsize(code)
        out += bytes(-len(out) % size)
        out += struct.pack(order + code, value)
    return (b"\0\1\0\0" if order == "<" else b"\0\0\0\0") + bytes(out)


@pytest.mark.parametrize("order", ["<", ">"])
def test_both_byte_orders_and_all_alignments(tmp_path, order):
    data = cdr(
        order, ("b", -3), ("d", 0.1), ("B", 1), ("h", -300), ("B", 200), ("q", -(2**40)), ("?", True), ("f", 0.5)
    )
    result, _ = decoded("int8 a\nfloat64 b\nbool c\nint16 d\nbyte e\nint64 f\nbool g\nfloat32 h", data)
    assert result == {"a": -3, "b": 0.1, "c": 1, "d": -300, "e": 200, "f": -(2.0**40), "g": 1, "h": 0.5}
    stamped = cdr(order, ("i", 7), ("I", 5), ("I", 1), ("B", 0), ("I", 0), ("I", 1), ("d", 2.5), ("I", 0), ("I", 0))
    file = mcap(tmp_path / "x.mcap", [("/j", STATE, 9 * 10**9, stamped)])
    table = signals(file).table("j")
    assert (table.stamp.tolist(), {k: x.tolist() for k, x in table.columns.items()}) == (
        [7.000000005],
        {"position/0": [2.5]},
    )


@pytest.mark.parametrize("width", ["H", "I"])
def test_wide_texts_of_two_and_four_bytes_a_character_are_read(width):
    """As Fast CDR wrote them since version 2 and before."""
    letters = "aé中"
    items = [("I", 3), *((width, ord(c)) for c in letters)]
    result, texts = decoded("wstring text\nfloat64 x", cdr("<", *items, ("d", 1.5)))
    assert (result, texts) == ({"x": 1.5}, {"text": letters})


@pytest.mark.parametrize(
    ("definition", "data", "reported"),
    [
        ("float64 x", b"\0\1\0\0" + bytes(7), "ends within x"),
        ("float64 x", b"\0\1\0\0" + bytes(12), "4 bytes longer"),
        ("float64 x", b"\0\7\0\0" + bytes(8), "begin with 00070000"),
        ("float64 x", b'{"x": 1}', "not CDR"),
        ("float64 x", b"", "begin with nothing"),
        ("float64[] x", b"\0\1\0\0" + b"\xff" * 4, "claims 4294967295 elements"),
        ("string x", b"\0\1\0\0" + b"\x09\0\0\0abc", "ends within x"),
    ],
)
def test_bytes_are_checked_before_they_are_decoded(definition, data, reported):
    with pytest.raises(Undecodable, match=reported):
        decoded(definition, data)


def test_damaged_single_messages_are_counted_and_the_others_returned(tmp_path, capsys):
    rows = speeds()
    rows[3] = (*rows[3][:3], b"\0\1\0\0\1")
    rows[7] = (*rows[7][:3], b"")
    file = mcap(tmp_path / "x.mcap", rows)
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 1
    printed = capsys.readouterr().err
    assert (
        f"/speed: 2 of 10 messages cannot be decoded, the first at {START + 300_000_000} ns: it ends within" in printed
    )
    assert [line.split(",")[2] for line in (tmp_path / "out/speed.csv").read_text().splitlines()[1:]] == list(
        "01245689"
    )


def test_names_that_collide_with_python_or_the_table_and_fields_called_header_are_read(tmp_path):
    definition = f"float64 time\nfloat64 from\nb/Own header\nint8 class\n{LINE}\nMSG: b/Own\nfloat64 stamp\nuint8 seq"
    data = cdr("<", ("d", 1.5), ("d", 2.5), ("d", 3.5), ("B", 4), ("b", -5))
    file = mcap(
        tmp_path / "x.mcap", [("/x", "a/msg/X", START, data)], definitions=[("a/msg/X", (definition, "ros2msg"))]
    )
    result = signals(file)
    assert {name: result[name].x[0] for name in result} == {
        "x/time": 1.5, "x/from": 2.5, "x/header/stamp": 3.5, "x/header/seq": 4, "x/class": -5
    }  # fmt: skip
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 0
    head, row = (tmp_path / "out/x.csv").read_text().splitlines()
    assert head == '"time","stamp","field/time","from","header/stamp","header/seq","class"'
    assert row == "0,0,1.5,2.5,3.5,4,-5"


@pytest.mark.parametrize("definition", ["", "int8 A=1", "std_msgs/Empty a\nfloat64 x"])
def test_an_empty_message_has_one_byte(definition):
    data = b"\0\1\0\0\0" if "Empty" not in definition else cdr("<", ("B", 0), ("d", 2.5))
    result, _ = decoded(definition or "# nothing", data)
    assert result == ({"x": 2.5} if "Empty" in definition else {})


def test_arrays_that_are_too_long_for_columns_are_named(tmp_path, capsys):
    assert (LONGEST, LONGEST_OCTETS) == (4096, 64)
    lengths = {"float32": LONGEST + 1, "uint8": LONGEST_OCTETS + 1}
    for kind, n in lengths.items():
        width = {"float32": 4, "uint8": 1}[kind]
        data = b"\0\1\0\0" + struct.pack("<dI", 1.5, n) + bytes(width * n)
        file = mcap(
            tmp_path / f"{kind}.mcap",
            [("/x", "a/msg/X", START, data)],
            definitions=[("a/msg/X", (f"float64 y\n{kind}[] many", "ros2msg"))],
        )
        assert list(signals(file)) == ["x/y"]
        assert f"/x: too long for columns: many of {n} elements" in capsys.readouterr().err
        changed = bytearray(data)
        changed[-width] = 1
        other = mcap(
            tmp_path / f"{kind}2.mcap",
            [("/x", "a/msg/X", START, bytes(changed))],
            definitions=[("a/msg/X", (f"float64 y\n{kind}[] many", "ros2msg"))],
        )
        result = compare(file, other)
        assert (result.first.field, result.topics[0].differing) == (f"many/{n - 1}", 1)


def test_types_are_those_of_the_distribution_that_wrote_the_bag(tmp_path):
    """A Range of Humble has no variance; the bag has no definitions."""
    data = cdr("<", ("i", 1), ("I", 0), ("I", 1), ("B", 0), ("B", 1), ("f", 0.5), ("f", 0.25), ("f", 9.0), ("f", 2.5))
    bag = tmp_path / "bag"
    database(bag / "bag_0.db3", [("", "", START, data)], 3)
    with sqlite3.connect(bag / "bag_0.db3") as db:
        db.execute("UPDATE topics SET name = '/range', type = 'sensor_msgs/msg/Range'")
    metadata(bag, [("/range", "sensor_msgs/msg/Range", 1)], ["bag_0.db3"], version=5, qos="")
    result = signals(bag)
    assert {name: result[name].x[0] for name in result} == {
        "range/radiation_type": 1, "range/field_of_view": 0.5, "range/min_range": 0.25, "range/max_range": 9.0,
        "range/range": 2.5,
    }  # fmt: skip


def joints(names, positions, stamp, velocities=()):
    message = JointState(name=names, position=positions, velocity=list(velocities))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
    return serialize_message(message)


def two_publishers(path, *, swapped=False, gain=1.0):
    """An arm and a gripper on one topic, equal stamps, in either order."""
    rows = []
    for k in range(10):
        t = START + k * 100_000_000
        both = [joints(["arm_1", "arm_2"], [1.0 + k, 2.0 + k], t), joints(["gripper"], [gain * (100.0 + k)], t)]
        for i, data in enumerate(both[::-1] if swapped else both):
            rows.append(("/joint_states", STATE, t + 1000 * i, data))
    return mcap(path, rows)


def test_columns_of_two_publishers_are_named_by_their_joints(tmp_path):
    result = signals(two_publishers(tmp_path / "x.mcap"))
    nan = np.nan
    expected = {
        "arm_1": np.ravel([(1.0 + k, nan) for k in range(10)]), "arm_2": np.ravel([(2.0 + k, nan) for k in range(10)]),
        "gripper": np.ravel([(nan, 100.0 + k) for k in range(10)]),
    }  # fmt: skip
    assert list(result) == [f"joint_states/{name}/position" for name in expected]
    for name, x in expected.items():
        np.testing.assert_array_equal(result[f"joint_states/{name}/position"].x, x)
    swapped = two_publishers(tmp_path / "y.mcap", swapped=True)
    assert compare(tmp_path / "x.mcap", swapped).equal
    off = compare(tmp_path / "x.mcap", two_publishers(tmp_path / "z.mcap", swapped=True, gain=1.01))
    assert (off.topics[0].differing, off.first.field) == (10, "gripper/position")
    for limit, agrees in ((1.1, True), (1.0, False)):
        assert align(result, signals(tmp_path / "z.mcap"), default=Tolerance(limit)).equal is agrees


@pytest.mark.parametrize(("stamp", "word"), [(0, "zero"), (START, "equal")])
def test_meaningless_stamps_are_recognised_and_the_bag_time_is_used(tmp_path, capsys, stamp, word):
    """In a comparison message by message, and in one signal by signal, where the bags have different clocks."""
    files = []
    for name, gain, start in (("a", 1.0, START), ("b", 5.0, START), ("later", 5.0, START + 10**9 + 5)):
        rows = [("/j", STATE, start + k * 10**8, joints(["j"], [gain * k], stamp)) for k in range(50)]
        files.append(mcap(tmp_path / f"{name}.mcap", rows))
    a, b, later = map(str, files)
    assert main_compare([a, a]) == 0
    assert f"j: header stamps are all {word} in A: paired by bag time" in capsys.readouterr().out
    assert main_compare([a, b]) == 1
    assert "50 messages, 49 differ" in capsys.readouterr().out
    for arguments in ([a, later], [a, b, "--align"]):
        assert main_compare(arguments) == 1
        printed = capsys.readouterr().out
        assert "bag time is used" in printed
        assert "j/j/position: max 196" in printed
        assert "49 of 50 samples beyond the tolerance" in printed


def test_stamps_of_two_clocks_are_no_time_axis(tmp_path):
    files = []
    for name, gain in (("a", 1.0), ("b", 3.0)):
        rows = []
        for k in range(40):
            # Every other message is stamped by a clock that is seven seconds late.
            stamp = START + k * 10**8 - (k % 2) * 7 * 10**9
            rows.append(("/j", STATE, START + k * 10**8, joints(["j"], [gain * k], stamp)))
        files.append(mcap(tmp_path / f"{name}.mcap", rows))
    result = align(*map(signals, files))
    assert result.notes == ["j: header stamps go back 20 times in A, as those of several clocks do: bag time is used"]
    assert result.deviations[0].largest == pytest.approx(2.0 * 39)


def test_topics_that_cannot_be_compared_over_time_do_not_count_as_agreement(tmp_path, capsys):
    """A topic that cannot be decoded, one without a common time, a name in neither bag, equal bag times."""
    both, late = speeds(), speeds(topic="/late", start=START + 10**10)
    event = ("/event", "odd_msgs/msg/Odd", START, b"\0\1\0\0")
    files = {
        "a": [*both, *speeds(topic="/late")],
        "b": [*both, *late],
        "odd": [*both, event],
        "once": speeds(3, step=0),
        "other": [row[:3] + (number(9.0 if k else 0.0),) for k, row in enumerate(speeds(3, step=0))],
        "four": speeds(4, step=0),
        "long": speeds(100),
    }
    path = {name: str(mcap(tmp_path / f"{name}.mcap", rows)) for name, rows in files.items()}
    for a, b, reported in (
        ("a", "b", "not compared: late/data: A and B have no time in common"),
        ("odd", "odd", "not compared: event cannot be decoded; leave it out with --ignore"),
        ("once", "other", "2 of 3 samples beyond the tolerance"),
        ("long", "a", "not compared: speed/data: 9 of 9.9 s, which only one of the bags has"),
    ):
        assert main_compare(["--align", path[a], path[b]]) == 1
        assert reported in capsys.readouterr().out
    assert main_compare(["--align", path["odd"], path["odd"], "--ignore", "event"]) == 0
    assert "all signals that both have agree" in capsys.readouterr().out
    assert main_compare(["--align", path["a"], path["a"], "--topics", "speed", "gone"]) == 2
    assert "no topic gone to compare; there are speed, late" in capsys.readouterr().err
    assert main_compare(["--align", path["once"], path["four"]]) == 2
    assert "speed/data: all its messages have one time" in capsys.readouterr().err


def test_a_topic_without_a_name_is_exported_as_a_table_of_text(tmp_path):
    file = mcap(tmp_path / "a.mcap", speeds(2, topic="/"))
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 0
    assert (tmp_path / "out/topic.csv").read_text().splitlines()[1] == "0,0,0"


@pytest.mark.parametrize("form", ["csv", "parquet", "mat"])
def test_64_bit_integers_are_exported_exactly(tmp_path, form):
    """2^53 + 1 is the first integer that no float represents; nanoseconds since 1970 are beyond it."""
    rows = [
        ("/x", "a/msg/X", START + k, struct.pack("<HHqQd", 0x100, 0, 2**53 + k, 2**64 - 1 - k, k)) for k in range(3)
    ]
    types = [("a/msg/X", ("int64 a\nuint64 b\nfloat64 c", "ros2msg"))]
    file = mcap(tmp_path / "a.mcap", rows, definitions=types)
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out"), "--format", form]) == 0
    table = tmp_path / f"out/x.{form}"
    if form == "csv":
        results = [[int(field) for field in line.split(",")[2:4]] for line in table.read_text().splitlines()[1:]]
    elif form == "parquet":
        columns = pyarrow.parquet.read_table(table)
        results = [list(row) for row in zip(columns["a"].to_pylist(), columns["b"].to_pylist(), strict=True)]
    else:
        columns = loadmat(table)
        results = [[int(a), int(b)] for a, b in zip(columns["a"].ravel(), columns["b"].ravel(), strict=True)]
        assert columns["c"].dtype == float
    assert results == [[2**53 + k, 2**64 - 1 - k] for k in range(3)]


def test_fields_of_any_name_become_variables_of_matlab(tmp_path):
    """One with the name of our own list of names, a keyword, and two that differ only in characters that MATLAB does
    not allow.
    """
    fields = ("names", "end", "time", "a_b", "a__b")
    types = [("a/msg/X", ("\n".join(f"float64 {field}" for field in fields), "ros2msg"))]
    rows = [("/x", "a/msg/X", START + k, struct.pack("<HH5d", 0x100, 0, *(k + n for n in range(5)))) for k in range(2)]
    file = mcap(tmp_path / "a.mcap", rows, definitions=types)
    assert main_bag(["export", str(file), "--out", str(tmp_path), "--format", "mat"]) == 0
    columns = loadmat(tmp_path / "x.mat")
    assert [str(name[0]) for name in columns["names"].ravel()][2:] == ["names", "end", "field/time", "a_b", "a__b"]
    made = [name for name in columns if not name.startswith("__")]
    assert made == ["names", "time", "stamp", "names_2", "xend", "field_time", "a_b", "a_b_2"]
    assert [columns[name].ravel().tolist() for name in made[3:]] == [[n, n + 1] for n in range(5)]


@pytest.mark.parametrize("form", ["csv", "parquet"])
def test_integers_that_some_messages_lack_stay_integers(tmp_path, form):
    """Elements of an array that grows: a column that is added later, and one that is empty from then on."""

    def row(k, *values):
        return "/x", "a/msg/X", START + k, struct.pack(f"<HHIi{len(values)}q", 0x100, 0, len(values), 0, *values)

    rows = [row(k, 2**53 + 1) for k in range(ROWS)] + [row(ROWS, 2**53 + 3, 2**53 + 5), row(ROWS + 1)]
    file = mcap(tmp_path / "a.mcap", rows, definitions=[("a/msg/X", ("int64[] a", "ros2msg"))])
    assert main_bag(["export", str(file), "--out", str(tmp_path), "--format", form]) == 0
    if form == "csv":
        lines = [line.split(",")[2:] for line in (tmp_path / "x.csv").read_text().splitlines()]
        assert [lines[1], *lines[-2:]] == [["9007199254740993", ""], ["9007199254740995", "9007199254740997"], ["", ""]]
    else:
        columns = pyarrow.parquet.read_table(tmp_path / "x.parquet")
        assert [columns[f"a/{k}"].to_pylist()[-2:] for k in (0, 1)] == [[2**53 + 3, None], [2**53 + 5, None]]


def test_files_have_names_that_every_system_accepts_and_renamed_topics_are_reported(tmp_path, capsys):
    topics = ["/Speed", "/speed", "/a/b", "/a.b", "/../up", "/nul\0", "/" + "long" * 80, "/c\nd", '/a<b>:"|?*\\c']
    file = mcap(tmp_path / "a.mcap", [row for k, t in enumerate(topics) for row in speeds(k + 1, topic=t)])
    assert main_bag(["export", str(file), "--out", str(tmp_path / "out")]) == 0
    made = sorted(path.name for path in (tmp_path / "out").iterdir())
    long = "long" * 50 + ".csv"
    assert made == sorted(
        [
            "Speed.csv",
            "speed_2.csv",
            "a.b.csv",
            "a.b_2.csv",
            "_..up.csv",
            "nul_.csv",
            long,
            "c_d.csv",
            "a_b_______c.csv",
        ]
    )
    assert sorted(len((tmp_path / "out" / name).read_text().splitlines()) for name in made) == list(range(2, 11))
    printed = capsys.readouterr().err
    assert "topic speed is in the file speed_2" in printed
    assert "topic a/b " not in printed
    assert main_bag(["info", str(file)]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 2 + len(topics)


@pytest.mark.parametrize(("head", "what"), [(b"#ROSBAG V2.0\n", "a bag of ROS 1"), (b"ULog\1", "a log of PX4"),
    (b"PK\3\4", "a ZIP archive"), (b"\x1f\x8b", "by gzip"), (b"", "has 0 bytes")])  # fmt: skip
def test_a_file_often_mistaken_for_a_bag_is_refused_by_its_kind(tmp_path, head, what):
    (tmp_path / "x.bag").write_bytes(head + bytes(100) if head else b"")
    with pytest.raises(BagError, match=what), BagReader(tmp_path / "x.bag"):
        pass


@pytest.mark.parametrize(
    "text", ["", "[]", "rosbag2_bagfile_information: 5", "a: 1", "rosbag2_bagfile_information: {files: [1]}"]
)
def test_a_file_that_is_not_metadata_is_refused_in_one_line(tmp_path, text):
    mcap(tmp_path / "bag/a.mcap", speeds())
    (tmp_path / "bag/metadata.yaml").write_text(text)
    with (
        pytest.raises(BagError, match=r"metadata\.yaml is not that of a bag: (it has no|expected)") as error,
        BagReader(tmp_path / "bag"),
    ):
        pass
    assert "Error" not in str(error.value)


def test_a_comparison_without_common_topics_is_refused(tmp_path, capsys):
    empty = tmp_path / "empty"
    writer = BagWriter(empty)
    writer.add_topic(BagTopic.known("/speed", FLOAT))
    writer.close()
    assert main_compare([str(empty), str(empty)]) == 2
    assert "nothing to compare" in capsys.readouterr().err
    full = mcap(tmp_path / "x.mcap", speeds())
    assert main_compare([str(empty), str(full)]) == 1
    assert main_compare([str(full), str(full), "--topics", "speed", "--ignore", "s*"]) == 2


def test_integers_that_a_float_cannot_distinguish_differ(tmp_path):
    files = [
        mcap(
            tmp_path / f"{k}.mcap",
            [("/x", "a/msg/X", START, struct.pack("<HHq", 0x100, 0, 2**60 + k))],
            definitions=[("a/msg/X", ("int64 count", "ros2msg"))],
        )
        for k in range(2)
    ]
    result = compare(*files)
    assert (result.first.a, result.first.b) == (2**60, 2**60 + 1)
    assert compare(*files, default=Tolerance(1.0)).equal


def test_texts_that_are_not_utf_8_do_not_stop_reading(tmp_path):
    data = serialize_message(String(data="ab"))
    odd = data.replace(b"ab", b"\xff\xfe")
    files = [
        mcap(tmp_path / f"{k}.mcap", [*speeds(), ("/note", "std_msgs/msg/String", START, d)])
        for k, d in enumerate((data, odd))
    ]
    assert signals(files[1])["speed/data"].x.tolist() == list(range(10))
    result = compare(*files)
    assert (result.first.field, result.first.a, result.first.b) == ("data", "ab", "\\xff\\xfe")


def test_late_partners_are_found_and_long_waits_are_kept_in_a_file(tmp_path, monkeypatch):
    """Half of a topic's messages come at the end in one of the bags; more are pending than memory may hold."""
    monkeypatch.setattr("softrig_bags.pairing.ROWS", 50)
    monkeypatch.setattr("softrig_bags.pairing.SPILL", 2_000)
    monkeypatch.setattr("softrig_bags.files.reader.BATCH", 1_000)
    rows = [("/j", STATE, START + k * 10**6, joints(["j"], [float(k)], k * 10**6 + 1)) for k in range(600)]
    one = mcap(tmp_path / "a.mcap", rows, chunk_size=2_000)
    late = [(a, b, t + (10**10 if k % 2 else 0), d) for k, (a, b, t, d) in enumerate(rows)]
    late[301] = (*late[301][:3], joints(["j"], [7.0], 301 * 10**6 + 1))
    del late[500]
    two = mcap(tmp_path / "b.mcap", late, chunk_size=2_000)
    result = compare(one, two)
    (topic,) = result.topics
    assert (topic.missing, topic.extra, topic.differing, result.paired) == (1, 0, 1, 599)
    assert str(result.first) == "t = 0.301000001 s, j j/position: 301.0 against 7.0"
    assert compare(one, tmp_path / "a.mcap", bitwise=True).equal


def test_each_file_of_the_folder_is_read_once(tmp_path):
    """A moved bag whose metadata has absolute paths, one of them twice, and does not name its storage."""
    bag, old = tmp_path / "bag", tmp_path / "old"
    mcap(bag / "bag_0.mcap", speeds())
    mcap(old / "bag_0.mcap", speeds(3))
    metadata(bag, [("/speed", FLOAT, 10)], [str(old / "bag_0.mcap")] * 2, storage_identifier="")
    with BagReader(bag) as result:
        assert (result.counts, result.is_whole, result.files) == ([10], True, [bag / "bag_0.mcap"])


def test_a_channel_without_a_schema_is_named(tmp_path, capsys):
    out = BytesIO()
    writer = Writer(out)
    writer.start()
    writer.add_message(writer.register_channel("/raw", "", 0), START, b"any bytes", 0)
    speed = writer.register_channel("/speed", "cdr", writer.register_schema(FLOAT, "ros2msg", b"float64 data"))
    writer.add_message(speed, START, number(2.5), 0)
    writer.finish()
    (tmp_path / "x.mcap").write_bytes(out.getvalue())
    assert signals(tmp_path / "x.mcap")["speed/data"].x.tolist() == [2.5]
    assert "/raw () cannot be decoded: its channel has no schema" in capsys.readouterr().err


def test_unknown_types_are_named():
    with pytest.raises(UnknownType, match="no definition of a/msg/None, in the bag or here"):
        complete("a/msg/None", {})
    assert typestore().fielddefs["std_msgs/msg/Float64"]


def test_rows_of_a_topic_without_a_name_are_counted(tmp_path, capsys):
    bag = tmp_path / "bag"
    database(bag / "bag_0.db3", speeds(), 4)
    with sqlite3.connect(bag / "bag_0.db3") as db:
        db.execute("UPDATE messages SET topic_id = 9 WHERE id > 8")
    metadata(bag, [("/speed", FLOAT, 10)], ["bag_0.db3"])
    assert main_bag(["info", str(bag)]) == 1
    printed = capsys.readouterr().err
    assert "/speed: 8 messages in the files, metadata.yaml claims 10" in printed
    assert "topic 9 without a name: 2 messages in the files, metadata.yaml does not name the topic" in printed


@pytest.mark.parametrize("suffix", ["-wal", "-journal"])
def test_files_beside_a_database_are_read_and_not_changed(tmp_path, suffix):
    path = tmp_path / "bag_0.db3"
    database(path, speeds(4), 4)
    db = sqlite3.connect(path)
    if suffix == "-wal":
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA wal_autocheckpoint = 0")
        db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (7, ?, ?)",
                       [(t, d) for _, _, t, d in speeds(6, start=START + 10**9)])  # fmt: skip
        db.commit()
    else:
        db.execute("PRAGMA cache_size = 1")
        db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (7, ?, ?)",
                       [(START + k, bytes(900)) for k in range(400)])  # fmt: skip
    killed = tmp_path / "killed"
    killed.mkdir()
    for file in tmp_path.glob("bag_0.db3*"):  # copy the files while the recorder writes
        (killed / file.name).write_bytes(file.read_bytes())
    db.close()
    before = {p.name: p.read_bytes() for p in killed.iterdir() if not p.name.endswith("-shm")}
    assert len(before) == 2
    count = 10 if suffix == "-wal" else 4
    assert len(read_bag(killed / "bag_0.db3").topics["speed"].data) == count
    assert {p.name: p.read_bytes() for p in killed.iterdir() if not p.name.endswith("-shm")} == before


def test_a_layout_of_the_suite_and_its_columns_agree(tmp_path):
    """Arrays by their dimensions, trajectories by their joints, as a recording in memory names them."""
    layouts = {
        "array": Layout(
            "std_msgs/msg/Float64MultiArray", counts={"data": 6}, dims=(("row", 2), ("column", 3)), numbered=True
        ),
        "goal": Layout("trajectory_msgs/msg/JointTrajectory", "", ["a", "b"], {"position": 2, "velocity": 2}),
        "pose": Layout("geometry_msgs/msg/PoseStamped", "map"),
        "wrench": Layout("geometry_msgs/msg/WrenchStamped"),
        "vector": Layout("geometry_msgs/msg/Vector3Stamped"),
        "flag": Layout("std_msgs/msg/Bool"),
    }  # fmt: skip
    from softrig_bags.write import write_bag
    from softrig_core import Recording, Signals

    recording = Recording([(name, layout.msgtype) for name, layout in layouts.items()])
    for k in range(5):
        for i, layout in enumerate(layouts.values()):
            recording.add(
                i, k, layout.encode(k, tuple(float(k + j > 2) + j * (layout.size > 1) for j in range(layout.size)))
            )
    write_bag(tmp_path / "bag", recording)
    result, known = signals(tmp_path / "bag"), Signals(recording)
    assert list(result) == list(known)
    for name in known:
        np.testing.assert_array_equal(result[name].x, known[name].x)
    assert compare(known, result, bitwise=True).equal


def test_a_missing_file_and_one_that_is_not_a_bag_are_reported(tmp_path):
    (tmp_path / "x.mcap").write_bytes(b"nothing of the kind")
    with pytest.raises(BagError, match="neither an MCAP file nor one of SQLite"):
        read_bag(tmp_path / "x.mcap")
    with pytest.raises(BagError, match="does not exist"):
        read_bag(tmp_path / "none.mcap")
