"""CDR codecs: against rosbags' own serializer, by property, and against malformed bytes."""

import math
import re
import struct

import numpy as np
import pytest
from hypothesis import event, given, strategies as st
from rosbags.typesys import Stores, get_typestore
from softrig_core import Refused, array, button, command, joint_state, number, reference, scalars, vector3, wrench
from softrig_core.block.codec import Decoder, selection
from softrig_core.wire.cdr import Layout, parse

STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
STAMPS = st.integers(0, 2**31 * 10**9 - 1)
FLOATS = st.floats(-1e7, 1e7)
NAMES = st.lists(st.text(min_size=1, max_size=12).filter(lambda s: "\0" not in s), min_size=1, max_size=5, unique=True)

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
def test_what_a_port_writes_it_reads_back_bit_for_bit(port, data, stamp):
    values = tuple(data.draw(FLOATS) for _ in range(port.size))
    found = Decoder(port)(port.layout().encode(stamp, values))
    assert struct.pack(f"{port.size}d", *found[1]) == struct.pack(f"{port.size}d", *values)
    assert found[0] == (-1 if port.msgtype == "std_msgs/msg/Float64" else stamp)


def test_a_message_is_of_the_world_where_its_port_names_no_other_frame():
    said = joint_state("a", "t", ("x",), position="m").layout().encode(5, (1.0,))
    assert parse("sensor_msgs/msg/JointState", said).frame_id == "world"
    for theirs in (said, joint_message(5, ["x"], (1.0,)), joint_message(5, ["x"], (1.0,), frame="map")):
        assert Decoder(joint_state("b", "t", ("x",), position="m"))(theirs) == (5, (1.0,))
    placed = wrench("a", "t", "foot").layout().encode(5, (0.0,) * 6)
    assert parse("geometry_msgs/msg/WrenchStamped", placed).frame_id == "foot"
    assert number("a", "t", "V").frame == ""


def test_an_array_without_a_layout_is_taken_from_people_only():
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


@given(stamp=STAMPS, names=NAMES, frame=st.text(max_size=9).filter(lambda s: "\0" not in s), data=st.data())
def test_joint_state_bytes_are_those_of_rosbags(stamp, names, frame, data):
    n = len(names)
    fields = {
        f: tuple(data.draw(FLOATS) for _ in range(n))
        for f in ("position", "velocity", "effort")
        if data.draw(st.booleans())
    }
    layout = Layout("sensor_msgs/msg/JointState", frame, names, dict.fromkeys(fields, n))
    flat = [x for values in fields.values() for x in values]
    expected = joint_message(stamp, names, frame=frame, **fields)
    assert layout.encode(stamp, flat) == expected
    message = parse("sensor_msgs/msg/JointState", expected)
    assert (message.stamp, message.frame_id, message.names) == (stamp, frame, tuple(names))
    assert [x for values in message.fields.values() for x in values] == flat


def test_other_types_are_those_of_rosbags():
    vector, pair = TYPES["geometry_msgs/msg/Vector3"], TYPES["geometry_msgs/msg/Wrench"]
    cases = {
        "geometry_msgs/msg/Vector3Stamped": (
            vector3("a", "t", "dq", "A"),
            (1.0, 2.0, 3.0),
            lambda: (header(5, "dq"), vector(1.0, 2.0, 3.0)),
        ),
        "geometry_msgs/msg/WrenchStamped": (
            wrench("a", "t", "foot"),
            (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
            lambda: (header(5, "foot"), pair(vector(1.0, 2.0, 3.0), vector(4.0, 5.0, 6.0))),
        ),
        "std_msgs/msg/Float64": (number("a", "t", "V"), (2.5,), lambda: (2.5,)),
        "std_msgs/msg/Bool": (button("a", "t"), (1.0,), lambda: (True,)),
    }
    for name, (port, values, arguments) in cases.items():
        assert port.layout().encode(5, values) == bytes(STORE.serialize_cdr(TYPES[name](*arguments()), name)), name


def test_trajectory_point_bytes_are_those_of_rosbags():
    point = TYPES["trajectory_msgs/msg/JointTrajectoryPoint"](
        np.array([1.0, 2.0]),
        np.array([]),
        np.array([3.0, 4.0]),
        np.array([]),
        TYPES["builtin_interfaces/msg/Duration"](0, 0),
    )
    message = TYPES["trajectory_msgs/msg/JointTrajectory"](header(7_000_000_001, "world"), ["x", "y"], [point])
    expected = bytes(STORE.serialize_cdr(message, "trajectory_msgs/msg/JointTrajectory"))
    port = reference("a", "t", ["x", "y"], position="m", acceleration="m/s^2")
    assert port.layout().encode(7_000_000_001, (1.0, 2.0, 3.0, 4.0)) == expected


def test_another_order_of_names_and_more_fields_are_understood():
    decode = Decoder(joint_state("a", "t", ["x", "y"], velocity="m/s"))
    for stamp in (1, 2):  # the second time through the layout that the first one taught
        data = joint_message(stamp, ["y", "x"], position=(9.0, 9.0), velocity=(2.0, 1.0))
        assert decode(data) == (stamp, (1.0, 2.0))


def test_big_endian_is_understood():
    words = struct.pack(">BBBB", 0, 0, 0, 0) + struct.pack(">iII", 1, 5, 1) + b"\0\0\0\0"
    words += struct.pack(">II", 1, 2) + b"u\0" + b"\0\0" + struct.pack(">II", 0, 0) + struct.pack(">I", 1)
    words += b"\0" * (-(len(words) - 4) % 8) + struct.pack(">d", 4.5)
    assert Decoder(command("a", "t", ["u"], "V"))(words) == (10**9 + 5, (4.5,))


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
    for _ in range(2):  # the second time too: nothing may be learnt from it
        with pytest.raises(Refused, match=re.escape(reason)):
            decode(data)


@given(st.binary(max_size=200))
def test_no_bytes_do_more_than_be_refused(data):
    for port in PORTS:
        decode = Decoder(port)
        try:
            _, values = decode(data)
        except Refused:
            continue
        assert len(values) == port.size
        assert all(math.isfinite(v) for v in values)


@given(st.sampled_from(PORTS), st.lists(st.binary(min_size=8, max_size=8), min_size=40, max_size=40))
def test_any_numbers_are_refused_or_what_they_are(port, numbers):
    """Whole messages, so that most of them come to be read."""
    values = struct.unpack(f"<{port.size}d", b"".join(numbers)[: 8 * port.size])
    try:
        _, found = Decoder(port)(port.layout().encode(5, values))
    except Refused:
        assert not all(abs(v) < 1e5 for v in values)
    else:
        assert tuple(found) == values


@given(st.data())
def test_a_damaged_message_is_refused_or_finite(data):
    port = PORTS[0]
    whole = bytearray(port.layout().encode(123, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)))
    numbers = st.integers(len(whole) - 32, len(whole) - 1)  # what is refused there is refused for its value
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


def test_a_value_beyond_what_its_unit_can_mean_is_refused():
    port = joint_state("a", "t", ["x", "y"], position="rad", velocity="rad/s")
    decode, encode = Decoder(port), port.layout().encode
    large = (1e9, -1e9, 1e7, 1e7)  # each at its limit, together beyond the smallest
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


def test_a_wrong_frame_is_refused():
    abc, dq = vector3("a", "t", "abc", "A"), vector3("a", "t", "dq", "A")
    decode = Decoder(dq)
    for _ in range(2):
        with pytest.raises(Refused, match="frame_id 'abc', expected 'dq'"):
            decode(abc.layout().encode(0, (1.0, 2.0, 3.0)))
    with pytest.raises(Refused, match="frame_id"):
        selection(abc, dq)


def test_encoding_another_number_of_values_is_an_error():
    with pytest.raises(ValueError, match="2 values, expected 1"):
        command("a", "t", ["u"], "V").layout().encode(0, (1.0, 2.0))
