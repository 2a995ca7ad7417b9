"""CDR codecs: against rosbags' own serializer, by property, and against malformed bytes."""

import math
import re
import struct
from functools import partial

import numpy as np
import pytest
from hypothesis import event, given, strategies as st
from rosbags.typesys import Stores, get_typestore
from softrig_core import Refused, array, command, joint_state, number, reference, scalars, vector3, wrench
from softrig_core.block.codec import Decoder
from softrig_core.wire.cdr import Layout, getter, parse
from softrig_core.wire.stream import CdrError
from softrig_core.wire.types import TYPES as MESSAGE_TYPES

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
FLOATS = st.floats(-1e7, 1e7)
PORTS = [
    joint_state("a", "t", ["x", "y"], position="m", velocity="m/s", effort="N"),
    joint_state("a", "t", ["x", "y", "zz"], velocity="m/s"),
    command("a", "t", ["armature"], "V"),
    scalars("a", "t", {"voltage": "V", "current": "A"}),
    reference("a", "t", ["x"], position="m", acceleration="m/s^2"),
    vector3("a", "t", "abc", "A"),
    wrench("a", "t", "foot"),
    number("a", "t", "V"),
]


def header(stamp, frame=""):
    time = TYPES["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
    return TYPES["std_msgs/msg/Header"](time, frame)


def joint_message(stamp, names, position=(), velocity=(), effort=(), frame=""):
    arrays = [np.array(v, dtype=np.float64) for v in (position, velocity, effort)]
    message = TYPES["sensor_msgs/msg/JointState"](header(stamp, frame), list(names), *arrays)
    return bytes(STORE.serialize_cdr(message, "sensor_msgs/msg/JointState"))


@pytest.mark.parametrize("port", PORTS, ids=lambda p: f"{p.msgtype}{p.fields}")
@given(data=st.data(), stamp=STAMPS)
def test_a_written_port_is_read_back_bit_for_bit(port, data, stamp):
    values = tuple(data.draw(FLOATS) for _ in range(port.size))
    result = Decoder(port)(port.layout().encode(stamp, values))
    assert struct.pack(f"{port.size}d", *result[1]) == struct.pack(f"{port.size}d", *values)
    assert result[0] == (-1 if port.msgtype == "std_msgs/msg/Float64" else stamp)


def test_a_message_has_the_frame_world_unless_its_port_names_another():
    text = joint_state("a", "t", ("x",), position="m").layout().encode(5, (1.0,))
    assert parse("sensor_msgs/msg/JointState", text).frame_id == "world"
    for foreign in (text, joint_message(5, ["x"], (1.0,)), joint_message(5, ["x"], (1.0,), frame="map")):
        assert Decoder(joint_state("b", "t", ("x",), position="m"))(foreign) == (5, (1.0,))
    placed = wrench("a", "t", "foot").layout().encode(5, (0.0,) * 6)
    assert parse("geometry_msgs/msg/WrenchStamped", placed).frame_id == "foot"
    assert number("a", "t", "V").frame == ""


def test_an_array_without_a_layout_is_accepted_from_outside_only():
    bare = Layout("std_msgs/msg/Float64MultiArray", counts={"data": 2}).encode(0, (1.0, 2.0))
    assert Decoder(array("a", "t", {"joint": 2}, "V", held=True))(bare) == (-1, (1.0, 2.0))
    with pytest.raises(Refused, match="data has 2 values, expected 3"):
        Decoder(array("a", "t", {"joint": 3}, "V", held=True))(bare)
    with pytest.raises(Refused, match="shape"):
        Decoder(array("a", "t", {"joint": 2}, "V"))(bare)


def test_channels_have_other_names_for_outside_nodes_all_or_none():
    decode = Decoder(command("a", "t", ("motor1", "motor2"), "V", also=("joint1", "joint2")))
    assert decode(joint_message(5, ["joint2", "joint1"], effort=(1.0, 2.0))) == (5, (2.0, 1.0))
    assert decode(joint_message(6, ["motor1", "motor2"], effort=(1.0, 2.0))) == (6, (1.0, 2.0))
    for names in (["joint1", "motor2"], ["joint1"], ["joint1", "joint1"]):
        with pytest.raises(Refused, match="names"):
            decode(joint_message(7, names, effort=(1.0,) * len(names)))
    with pytest.raises(ValueError, match="1 other names for 2 channels"):
        command("a", "t", ("motor1", "motor2"), "V", also=("joint1",))


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (joint_message(0, ["v"], effort=[1.0]), "names ['v'], expected ['u']"),
        (joint_message(0, ["u"], effort=[1.0, 2.0]), "effort has 2 values, expected 1 (u)"),
        (joint_message(0, ["u"]), "effort has 0 values, expected 1 (u)"),
        (joint_message(0, ["u"], effort=[math.nan]), "u/effort is nan"),
        (joint_message(0, ["u"], effort=[-math.inf]), "u/effort is -inf"),
        (joint_message(0, ["u"], effort=[1.0])[:-3], "end inside a field"),
        (b"", "end inside a field"),
        (b"\0\1\0\0" + b"\xff" * 60, "does not fit"),
    ],
)
def test_a_bad_message_is_refused_with_the_reason(data, reason):
    decode = Decoder(command("a", "t", ["u"], "V"))
    for _ in range(2):  # repeated, because a refused message must not change the cached layout
        with pytest.raises(Refused, match=re.escape(reason)):
            decode(data)


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_at_most_refused(data):
    for port in PORTS:
        decode = Decoder(port)
        try:
            _, values = decode(data)
        except Refused:
            continue
        assert len(values) == port.size
        assert all(math.isfinite(v) for v in values)


@given(st.sampled_from(PORTS), st.lists(st.binary(min_size=8, max_size=8), min_size=40, max_size=40))
def test_arbitrary_numbers_are_refused_or_read_correctly(port, numbers):
    """Complete messages, so that most of them can be read."""
    values = struct.unpack(f"<{port.size}d", b"".join(numbers)[: 8 * port.size])
    try:
        _, result = Decoder(port)(port.layout().encode(5, values))
    except Refused:
        assert not all(abs(v) < 1e5 for v in values)
    else:
        assert tuple(result) == values


@given(st.data())
def test_a_damaged_message_is_refused_or_finite(data):
    port = PORTS[0]
    whole = bytearray(port.layout().encode(123, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)))
    numbers = st.integers(len(whole) - 32, len(whole) - 1)  # in these bytes only the value can be refused
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(numbers | st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    end = data.draw(st.just(len(whole)) | st.integers(0, len(whole)))
    try:
        _, values = Decoder(port)(bytes(whole[:end]))
    except Refused:
        event("refused")
        return
    event("taken")
    assert all(math.isfinite(v) for v in values)


def test_a_value_beyond_the_plausible_range_of_its_unit_is_refused():
    port = joint_state("a", "t", ["x", "y"], position="rad", velocity="rad/s")
    decode, encode = Decoder(port), port.layout().encode
    large = (1e9, -1e9, 1e7, 1e7)  # each value at its own limit, which exceeds the smallest limit
    assert decode(encode(0, large))[1] == large
    for at, value, text in (
        (1, 1.1e9, "y/position is 1.1e+09 rad, expected at most 1e+09"),
        (2, -1.7e308, "x/velocity is -1.7e+308 rad/s, expected at most 1e+07"),
    ):
        values = list(large)
        values[at] = value
        with pytest.raises(Refused, match=re.escape(text)):
            decode(encode(0, values))
    assert scalars("a", "t", {"voltage": "V", "cost": "$"}, limits=(500.0, 1e6)).limits == (500.0, 1e6)
    with pytest.raises(ValueError, match="1 limits for 2 values"):
        joint_state("a", "t", ["x", "y"], position="m", limits=(1.0,))


def test_encoding_another_number_of_values_is_an_error():
    with pytest.raises(ValueError, match="2 values, expected 1"):
        command("a", "t", ["u"], "V").layout().encode(0, (1.0, 2.0))


# ---- messages of all types, written by rosbags ----

ROS = {  # each creates the message of rosbags from stamp, frame, names, values and dimensions
    "builtin_interfaces/msg/Time": lambda s, f, n, v, d: TYPES["builtin_interfaces/msg/Time"](*divmod(s, 10**9)),
    "rosgraph_msgs/msg/Clock": lambda s, f, n, v, d: (TYPES["builtin_interfaces/msg/Time"](*divmod(s, 10**9)),),
    "std_msgs/msg/Header": lambda s, f, n, v, d: header(s, f),
    "std_msgs/msg/Float64": lambda s, f, n, v, d: v["data"],
    "std_msgs/msg/Bool": lambda s, f, n, v, d: (bool(v["data"][0]),),
    "sensor_msgs/msg/JointState": lambda s, f, n, v, d: (header(s, f), n, *map(np.array, v.values())),
    "trajectory_msgs/msg/JointTrajectory": lambda s, f, n, v, d: (
        header(s, f),
        n,
        [
            TYPES["trajectory_msgs/msg/JointTrajectoryPoint"](
                *map(np.array, v.values()), TYPES["builtin_interfaces/msg/Duration"](0, 0)
            )
        ],
    ),
    "geometry_msgs/msg/Vector3Stamped": lambda s, f, n, v, d: (
        header(s, f),
        TYPES["geometry_msgs/msg/Vector3"](*v["vector"]),
    ),
    "geometry_msgs/msg/WrenchStamped": lambda s, f, n, v, d: (
        header(s, f),
        TYPES["geometry_msgs/msg/Wrench"](*(TYPES["geometry_msgs/msg/Vector3"](*x) for x in v.values())),
    ),
    "geometry_msgs/msg/PoseStamped": lambda s, f, n, v, d: (
        header(s, f),
        TYPES["geometry_msgs/msg/Pose"](
            TYPES["geometry_msgs/msg/Point"](*v["position"]), TYPES["geometry_msgs/msg/Quaternion"](*v["orientation"])
        ),
    ),
    "std_msgs/msg/Float64MultiArray": lambda s, f, n, v, d: (
        TYPES["std_msgs/msg/MultiArrayLayout"](
            [
                TYPES["std_msgs/msg/MultiArrayDimension"](
                    f"{label}; sequence {s:012d}" if k == 0 and f else label,
                    size,
                    math.prod(size for _, size in d[k:]),
                )
                for k, (label, size) in enumerate(d)
            ],
            0,
        ),
        np.array(v["data"]),
    ),
}
COUNTS = {"Vector3Stamped": [3], "WrenchStamped": [3, 3], "PoseStamped": [3, 4], "Float64": [1], "Bool": [1]}
DIMS = {
    "std_msgs/msg/Float64MultiArray": [(), (("row", 2), ("column", 3)), (("é", 33),), (("a", 1), ("b", 2), ("c", 5))]
}


def drawn_messages():
    """Some messages of each type: names, frames and lengths of all kinds, the longest beyond the limit of a single
    name.
    """
    draw = np.random.default_rng(5)
    for msgtype, ros in ROS.items():
        schema = {i.name: i.kind for i in MESSAGE_TYPES[msgtype].schema if i.kind in ("sequence", "numbers", "flag")}
        for turn, n in enumerate((1, 2, 3, 5, 33, 40)):
            dims = DIMS[msgtype][turn % 4] if msgtype in DIMS else ()
            sizes = COUNTS.get(msgtype.rpartition("/")[2], [n if draw.random() < 0.7 else 0 for _ in schema])
            sizes = [math.prod(size for _, size in dims)] if dims else sizes
            size, kind = sum(sizes), "flag" if "flag" in schema.values() else "d"
            flat = draw.choice([0.0, 1.0], size) if kind == "flag" else draw.normal(size=size)
            parts = np.split(flat, np.cumsum(sizes)[:-1]) if sizes else []
            values = {name: part.tolist() for name, part in zip(schema, parts, strict=True)}
            frame, names = ("", "world", "b", "ü" * turn)[turn % 4], [f"joint{'x' * k}" for k in range(n)]
            framed, named = MESSAGE_TYPES[msgtype].schema[1:2] == (("frame", "", 0),), MESSAGE_TYPES[msgtype].named
            numbered = bool(dims) and turn < 4
            stamp = int(draw.integers(0, 10**12 if dims else 2**31 * 10**9))
            bytes_of = partial(STORE.serialize_cdr, typename=msgtype)
            made = ros(stamp, numbered if dims else frame, names, values, dims)
            made = TYPES[msgtype](*made) if isinstance(made, tuple | list) else made
            layout = Layout(msgtype, frame if framed else "", names if named else (),
                            {name: len(v) for name, v in values.items()}, dims, numbered)  # fmt: skip
            mark = stamp if numbered or MESSAGE_TYPES[msgtype].stamped else -1
            both = [bytes(bytes_of(made, little_endian=little)) for little in (True, False)]
            yield msgtype, layout, mark, values, both


DRAWN = list(drawn_messages())


def test_messages_of_every_type_are_those_of_rosbags_and_are_read_in_either_order_of_bytes():
    assert {msgtype for msgtype, *_ in DRAWN} == set(MESSAGE_TYPES)
    for msgtype, layout, mark, values, (little, big) in DRAWN:
        flat = tuple(x for part in values.values() for x in part)
        assert layout.encode(max(mark, 0), flat) == little, msgtype
        assert layout.decode(little) == (mark, flat)
        assert (layout.size, layout.length) == (len(flat), len(little))
        for data in (little, big):
            message = parse(msgtype, data)
            assert {k: list(v) for k, v in message.fields.items()} == values
            assert message.mark == mark
            assert message.layout(msgtype).form == layout.form
        for other in (little[:-1], little + b"\0", big):
            assert layout.decode(other) is None
        with pytest.raises(ValueError, match=f"{len(flat) + 1} values, expected {len(flat)}"):
            layout.encode(0, (*flat, 0.0))


def test_a_layout_is_known_by_each_of_its_bytes_but_stamp_number_values_and_padding():
    """Which are variable: whatever two messages of one layout, all of whose bits differ, have in common is fixed."""
    for msgtype, layout, _, values, (little, _) in DRAWN:
        flat = [x for part in values.values() for x in part]
        flagged = MESSAGE_TYPES[msgtype].schema[0].kind == "flag"
        ones, twos = ((0.0, 1.0) if flagged else struct.unpack("<2d", b"\x55" * 8 + b"\xaa" * 8) for _ in "ab")
        first = layout.encode(0 if layout.numbered else 0x11111111 * 10**9 + 0x11111111, [ones[0]] * len(flat))
        last = 111111111111 if layout.numbered else 0x22222222 * 10**9 + 0x22222222
        second = layout.encode(last, [twos[1]] * len(flat))
        free = {k for k, (a, b) in enumerate(zip(first, second, strict=True)) if a != b}
        block = np.frombuffer(little, np.uint8)[None]
        for k in range(0, len(little), 1 + len(little) // 99):
            other = bytearray(little)
            other[k] ^= 1
            used = layout.decode(bytes(other)) is not None
            same = layout.same_shape(np.frombuffer(bytes(other), np.uint8)[None])
            if k in free:
                assert used
                assert same
            elif little[k] or k < 2:
                assert not used, (msgtype, k)
                assert not same
            else:  # a zero may be padding; both functions must then agree
                assert used == same
        assert layout.same_shape(np.repeat(block, 3, 0))


def test_many_messages_decoded_together_equal_single_ones():
    draw = np.random.default_rng(6)
    for _, layout, _, _, _ in DRAWN:
        marks = draw.integers(0, 10**12 if layout.numbered else 2**31 * 10**9, 4)
        values = draw.normal(size=(4, layout.size))
        if any(code == "1?" for _, code in layout.slots):
            values = np.array([[0.0], [1.0], [-2.5], [1e-300]])
        block = layout.encode_block(marks, values)
        rows = [layout.encode(mark, row) for mark, row in zip(marks.tolist(), values.tolist(), strict=True)]
        assert [bytes(row) for row in block] == rows
        messages = [layout.decode(row)[1] for row in rows]
        assert [list(map(float, row)) for row in messages] == [
            [float(c[k]) for c in layout.columns(block)] for k in range(4)
        ]
        assert all(c.dtype == np.float64 and c.flags.c_contiguous for c in layout.columns(block))


def test_a_number_has_at_most_twelve_digits_and_leading_zeros_are_optional():
    layout = Layout("std_msgs/msg/Float64MultiArray", dims=(("row", 1),), counts={"data": 1}, numbered=True)
    assert parse(layout.msgtype, layout.encode(10**12 - 1, (1.0,))).number == 10**12 - 1
    for too_many in (-1, 10**12):
        with pytest.raises(ValueError, match=f"message number {too_many}, expected one of at most 12 digits"):
            layout.encode(too_many, (1.0,))
    for label, result in (
        ("row; sequence 7", ("row", 7)),
        ("row; sequence " + "9" * 18, ("row", 10**18 - 1)),
        ("row; sequence " + "9" * 19, ("row; sequence " + "9" * 19, None)),
        ("row; sequence ", ("row; sequence ", None)),
        ("row; sequence -1", ("row; sequence -1", None)),
        ("a\nb; sequence 1; sequence 2", ("a\nb; sequence 1", 2)),
    ):
        foreign = Layout(layout.msgtype, dims=((label, 1),), counts={"data": 1}).encode(0, (1.0,))
        message = parse(layout.msgtype, foreign)
        assert (message.dims[0][0], message.number) == result
    second = Layout(layout.msgtype, dims=(("a", 1), ("b; sequence 3", 1)), counts={"data": 1}).encode(0, (1.0,))
    assert parse(layout.msgtype, second).number is None  # only the first dimension may have a number


# A JointState with the frame "ab", the name "q" and an effort of 1 N, cut at each byte. Byte 4: stamp; 12 and 16:
# length and text of the frame; 20: number of names; 24 and 28: length and text of the name; 32 and 36: no position
# and no velocity; 40: number of efforts; 44: the effort, aligned to 8 bytes from byte 4 on.
CUT = [
    (range(4), 4, None),
    (range(4, 8), 4, None),
    (range(8, 12), 8, None),
    (range(12, 16), 12, None),
    (range(16, 19), None, "a string of 3 bytes at byte 16 does not fit in {n}"),
    (range(19, 24), 20, None),
    (range(24, 28), 24, None),
    (range(28, 30), None, "a string of 2 bytes at byte 28 does not fit in {n}"),
    (range(30, 36), 32, None),
    (range(36, 40), 36, None),
    (range(40, 44), 40, None),
    (range(44, 52), 44, None),
]


def test_a_message_that_is_cut_anywhere_names_the_truncated_part():
    whole = Layout("sensor_msgs/msg/JointState", "ab", ["q"], {"effort": 1}).encode(5, (1.0,))
    assert len(whole) == 52
    for ends, at, text in CUT:
        for n in ends:
            message = text.format(n=n) if text else f"{n} bytes end inside a field at byte {at}"
            with pytest.raises(CdrError) as error:
                parse("sensor_msgs/msg/JointState", whole[:n])
            assert str(error.value) == f"sensor_msgs/msg/JointState: {message}"
    assert parse("sensor_msgs/msg/JointState", whole + b"more").fields["effort"] == (1.0,)


@pytest.mark.parametrize(
    ("msgtype", "at", "count", "text"),
    [
        ("sensor_msgs/msg/JointState", 12, 0, "a string of 0 bytes at byte 16 does not fit in 52"),
        ("sensor_msgs/msg/JointState", 20, 11, "claims 11 names in 52 bytes"),  # each name needs at least 5 bytes
        ("sensor_msgs/msg/JointState", 40, 7, "claims 7 values of effort in 52 bytes"),
        ("sensor_msgs/msg/JointState", 40, 6, "52 bytes end inside a field at byte 44"),
        ("std_msgs/msg/Float64MultiArray", 4, 4, "claims 4 dimensions in 44 bytes"),
        ("std_msgs/msg/Float64MultiArray", 28, 6, "claims 6 values of data in 44 bytes"),
        ("std_msgs/msg/Float64MultiArray", 16, 2, "1 values for the shape {'a': 2}"),
        ("trajectory_msgs/msg/JointTrajectory", 32, 2, "2 points, expected exactly one"),
        ("trajectory_msgs/msg/JointTrajectory", 32, 0, "0 points, expected exactly one"),
    ],
)
def test_a_message_that_claims_more_than_it_has_is_refused(msgtype, at, count, text):
    if "Array" in msgtype:
        whole = Layout(msgtype, dims=(("a", 1),), counts={"data": 1}).encode(0, (1.0,))
    else:
        whole = Layout(msgtype, "ab", ["q"], {"effort": 1}).encode(5, (1.0,))
    other = whole[:at] + struct.pack("<I", count) + whole[at + 4 :]
    with pytest.raises(CdrError) as error:
        parse(msgtype, other)
    assert str(error.value) == f"{msgtype}: {text}"


def test_a_length_may_claim_at_most_the_bytes_of_the_message():
    whole = Layout("sensor_msgs/msg/JointState", "abcdef", ["q"], {"effort": 1}).encode(5, (1.0,))
    assert len(whole) == 60
    whole += bytes(4)
    for count, text in ((8, "64 bytes end inside a field at byte 52"), (9, "claims 9 values of effort in 64 bytes")):
        with pytest.raises(CdrError, match=text):
            parse("sensor_msgs/msg/JointState", whole[:44] + struct.pack("<I", count) + whole[48:])


def test_a_single_item_is_a_tuple_too():
    row = ("a", "b", "c", "d")
    assert [getter(p)(row) for p in ((), (2,), (0,), (3, 1), (1, 1, 2))] == [
        (),
        ("c",),
        ("a",),
        ("d", "b"),
        ("b", "b", "c"),
    ]
