"""Arrays: their bytes, and the number in their layout that replaces the stamp which they lack."""

from itertools import count

import numpy as np
import pytest
from conftest import differences, few, in_process, make_scenario
from faultrig import MATRIX as SPREAD, STATE, Lag
from hypothesis import given, strategies as st
from outside import script
from rosbags.typesys import Stores, get_typestore
from simulated import SimulatedRig, World
from softrig_core import Block, Level, Recording, Refused, Rig, Signals, array, pose, rig_of
from softrig_core.block.codec import Decoder, selection
from softrig_core.wire.cdr import Layout, parse
from softrig_nodes import run_processes
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment
from softrig_nodes.processes.placement import Listener, Placement

MATRIX = array("m", "matrix", {"row": 2, "column": 3}, "kg m^2")
POSE = pose("p", "tool_pose", "base_link")
MULTI = "std_msgs/msg/Float64MultiArray"
MS = 1_000_000
store = get_typestore(Stores.ROS2_JAZZY)
types = store.types


def message(dims, values):
    """A message as written by a user of ROS without softrig."""
    dimension, layout = types["std_msgs/msg/MultiArrayDimension"], types["std_msgs/msg/MultiArrayLayout"]
    strides = np.cumprod([size for _, size in reversed(dims)])[::-1].tolist()
    dim = [dimension(label, size, stride) for (label, size), stride in zip(dims, strides, strict=True)]
    return bytes(store.serialize_cdr(types[MULTI](layout(dim, 0), np.array(values, dtype=float)), MULTI))


def test_array_bytes_are_those_of_the_ros_type():
    values = (1.0, -2.5, 3.0, 4.0, 5.0, 6.0)
    data = MATRIX.layout().encode(17, values)
    message = store.deserialize_cdr(data, MULTI)
    dim = message.layout.dim
    assert [(d.label, d.size, d.stride) for d in dim] == [("row; sequence 000000000017", 2, 6), ("column", 3, 3)]
    assert message.layout.data_offset == 0
    assert tuple(message.data) == values
    assert bytes(store.serialize_cdr(message, MULTI)) == data
    assert Decoder(MATRIX)(data) == (17, values)


def test_a_reader_that_ignores_the_number_sees_the_matrix():
    values = np.arange(6.0)
    result = store.deserialize_cdr(MATRIX.layout().encode(4, values.tolist()), MULTI)
    dim, offset = result.layout.dim, result.layout.data_offset
    expected = values.reshape(2, 3)
    np.testing.assert_array_equal(result.data.reshape([d.size for d in dim]), expected)
    np.testing.assert_array_equal(result.data.reshape(dim[0].size, dim[1].size), expected)
    for i in range(2):  # the formula in MultiArrayLayout.msg
        for j in range(3):
            assert result.data[offset + dim[1].stride * i + j] == expected[i, j]
    assert dim[0].stride == result.data.size


@given(st.integers(0, 10**12 - 1))
def test_every_number_has_as_many_bytes(number):
    layout = MATRIX.layout()
    data = layout.encode(number, (0.5,) * 6)
    assert len(data) == layout.length
    assert Decoder(MATRIX)(data) == layout.decode(data) == (number, (0.5,) * 6)
    assert parse(MULTI, data).number == parse(MULTI, data).mark == number


@pytest.mark.parametrize("number", [-1, 10**12])
def test_a_number_beyond_twelve_digits_is_not_a_number(number):
    with pytest.raises(ValueError, match=f"message number {number}"):
        MATRIX.layout().encode(number, (0.0,) * 6)


@pytest.mark.parametrize(
    ("label", "number"), [("row", -1), ("row; sequence 5", 5), ("row; sequence 000000000000005", 5)]
)
def test_others_may_omit_the_number_or_format_it_as_they_like(label, number):
    decode, values = Decoder(MATRIX), tuple(map(float, range(6)))
    data = message([(label, 2), ("column", 3)], values)
    assert [decode(data), decode(MATRIX.layout().encode(7, values)), decode(data)] == [
        (number, values),
        (7, values),
        (number, values),
    ]


@pytest.mark.parametrize("label", ["row; sequence ", "row; sequence -5", "row; sequence 0x5", "row sequence 5"])
def test_a_label_without_a_number_is_another_label(label):
    decode = Decoder(MATRIX)
    decode(MATRIX.layout().encode(7, (0.0,) * 6))
    with pytest.raises(Refused, match=r"expected {'row': 2, 'column': 3}"):
        decode(message([(label, 2), ("column", 3)], (0.0,) * 6))
    spoilt = bytearray(MATRIX.layout().encode(7, (0.0,) * 6))
    spoilt[spoilt.index(b"000000000007")] = ord("x")
    with pytest.raises(Refused, match=r"expected {'row': 2, 'column': 3}"):
        decode(bytes(spoilt))


def test_an_array_port_has_a_dimension():
    with pytest.raises(ValueError, match="at least one dimension"):
        array("m", "matrix", {}, "m")


def test_pose_bytes_are_those_of_the_ros_type():
    values = (0.1, 0.2, 0.3, 0.0, 0.6, 0.0, 0.8)
    data = POSE.layout().encode(1_500_000_000, values)
    message = store.deserialize_cdr(data, "geometry_msgs/msg/PoseStamped")
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("base_link", 500_000_000)
    p, o = message.pose.position, message.pose.orientation
    assert (p.x, p.y, p.z, o.x, o.y, o.z, o.w) == values
    assert bytes(store.serialize_cdr(message, "geometry_msgs/msg/PoseStamped")) == data
    assert Decoder(POSE)(data) == (1_500_000_000, values)


def test_signals_of_an_array_are_named_by_index():
    recording = Recording([("matrix", MATRIX.msgtype), ("tool_pose", POSE.msgtype)])
    for k in range(3):
        recording.add(0, k * 10**9, MATRIX.layout().encode(k, [k + 0.1 * i for i in range(6)]))
        recording.add(1, k * 10**9, POSE.layout().encode(k * 10**9, (k, 0, 0, 0, 0, 0, 1)))
    signals = Signals(recording)
    assert MATRIX.labels == ("0,0", "0,1", "0,2", "1,0", "1,1", "1,2")
    np.testing.assert_allclose(signals["matrix/1,2"].x, [0.5, 1.5, 2.5])
    np.testing.assert_allclose(signals["tool_pose/position/x"].x, [0, 1, 2])
    np.testing.assert_allclose(signals["tool_pose/orientation/w"].x, 1.0)


@pytest.mark.parametrize("dims", [{"row": 3, "column": 2}, {"row": 2, "col": 3}, {"row": 6}])
def test_other_shape_is_refused(dims):
    other = array("m", "matrix", dims, "kg m^2")
    with pytest.raises(Refused, match=r"expected {'row': 2, 'column': 3}"):
        Decoder(MATRIX)(other.layout().encode(0, [0.0] * 6))
    with pytest.raises(Refused, match=r"expected {'row': 2, 'column': 3}"):
        selection(other, MATRIX)


def test_shape_that_does_not_fit_the_data_is_refused():
    data = bytearray(MATRIX.layout().encode(0, [0.0] * 6))
    data[data.index(b"000\0") + 5] = 5  # damage the size of the first dimension
    with pytest.raises(Refused, match=r"6 values for the shape {'row': 5, 'column': 3}"):
        Decoder(MATRIX)(bytes(data))
    for n in range(len(data)):
        with pytest.raises(ValueError, match="std_msgs"):
            parse(MATRIX.msgtype, bytes(data[:n]))


# In lockstep arrays have no stamp, so they pair by their order.

ARRAYS = {"plant": "plant", "spread": "spread", "peaks": "peaks", "weigh": "weigh"}


class Meddler(World):
    """A graph that delivers changed messages of one topic: `change` returns the replacement of message k."""

    def __init__(self, topic, change, **options):
        super().__init__(**options)
        self.topic, self.change, self.seen = f"/{topic}", change, 0

    def send(self, writer, data):
        if writer.topic != self.topic:
            super().send(writer, data)
            return
        for changed in self.change(self.seen, data):
            super().send(writer, changed)
        self.seen += 1


def bare(k, data):
    """The message without its number."""
    parsed = parse(MULTI, data)
    values = parsed.fields["data"]
    return [Layout(MULTI, dims=parsed.dims, counts={"data": len(values)}).encode(0, values)]


def twice(k, data):
    return [data, data] if k == 5 else [data]


def lost(k, data):
    return [] if k == 5 else [data]


def skipping(k, data):
    return [renumbered(data, k + (k > 4))]


def renumbered(data, number):
    parsed = parse(MULTI, data)
    return parsed.layout(MULTI).encode(number, parsed.fields["data"])


@pytest.fixture
def loop():
    return rig_of(make_scenario(ARRAYS, 0.3))


def numbers(recording, topic):
    return [parse(MULTI, data).number for data in recording.topics[topic].data]


@pytest.mark.parametrize("groups", [(), [["plant", "weigh"]]])
def test_arrays_are_numbered_in_the_order_of_their_topic(loop, groups):
    run = SimulatedRig(loop, World(), "lockstep", groups=groups)
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(loop), run.recording) == []
    assert numbers(run.recording, "lag/matrix") == list(range(30))
    assert numbers(run.recording, "lag/peaks") == list(range(10))
    assert run.recording.topics["lag/peaks"].times == [(3 * k + 1) * 10 * MS for k in range(10)]


def test_arrays_have_the_same_numbers_in_real_time(loop):
    expected = in_process(loop)
    run = SimulatedRig(loop, World(), "realtime")
    assert set(run.run().values()) == {"done"}
    for topic in ("lag/matrix", "lag/peaks"):
        result = numbers(run.recording, topic)
        assert result == list(range(len(result)))
        assert len(result) >= len(expected.topics[topic].data) - 1
    assert "lost_arrays" not in run.adapters["weigh"].drive.statistics()


@pytest.mark.parametrize("topic", ["lag/matrix", "lag/peaks"])
def test_arrays_without_a_number_pair_by_order(loop, topic):
    run = SimulatedRig(loop, Meddler(topic, bare), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(loop), run.recording) == []
    assert not any(i.refused for i in run.adapters["weigh"].inputs)


@pytest.mark.parametrize(("topic", "sender"), [("lag/matrix", "spread"), ("lag/peaks", "peaks")])
def test_a_repeated_array_is_rejected_and_the_run_continues_with_the_same_numbers(loop, topic, sender):
    run = SimulatedRig(loop, Meddler(topic, twice), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(loop), run.recording) == []
    refused = {i.port.topic: (i.refused, i.last_refusal) for i in run.adapters["weigh"].inputs if i.refused}
    assert refused == {topic: (1, f"number 5 from {sender}, expected 6 (already there)")}
    text = f"refused on {topic}: number 5 from {sender}, expected 6 (already there)"
    assert (Level.ERROR, text) in run.nodes["weigh"].logs


@pytest.mark.parametrize(("topic", "sender"), [("lag/matrix", "spread"), ("lag/peaks", "peaks")])
def test_a_skipped_number_ends_the_run_immediately_and_is_named(loop, topic, sender):
    run = SimulatedRig(loop, Meddler(topic, skipping), "lockstep")
    assert set(run.run().values()) == {"failed"}
    assert str(run.adapters["weigh"].error) == f"{topic}: number 6 from {sender}, expected 5 (1 lost)"


@pytest.mark.parametrize(("topic", "sender"), [("lag/matrix", "spread"), ("lag/peaks", "peaks")])
def test_a_lost_array_is_waited_for_by_name(loop, topic, sender):
    run = SimulatedRig(loop, Meddler(topic, lost), "lockstep")
    assert set(run.run().values()) == {"failed"}
    assert f"{topic} from {sender}" in str(run.adapters["weigh"].error)
    assert len(run.recording.topics["lag/command"].data) == (5 if sender == "spread" else 16)


def test_a_lost_array_of_a_fast_sender_is_named_by_the_next_one():
    """No awaited node needs it to continue, as with a fast sender and a slow subscriber."""
    nodes = {
        "plant": "plant",
        "spread": "spread",
        "gain": "gain",
        "source": "source",
        "watch": {"executable": "weigh", "remap": {"lag/command": "watch/command"}, "parameters": {"period": 0.1}},
        "peaks": "peaks",
    }
    run = SimulatedRig(rig_of(make_scenario(nodes, 0.5)), Meddler("lag/matrix", lost), "lockstep")
    assert set(run.run().values()) == {"failed"}
    assert str(run.adapters["watch"].error) == "lag/matrix: number 6 from spread, expected 5 (1 lost)"


def test_a_bad_array_is_answered_and_a_better_one_arrives_too_late(loop):
    """A controller answers with what it holds; a message with the same number is not one of the next tick."""
    bad = SPREAD.layout().encode(5, (float("nan"), 0.0))
    run = SimulatedRig(loop, Meddler("lag/matrix", lambda k, data: [bad, data] if k == 5 else [data]), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert [i.refused for i in run.adapters["weigh"].inputs] == [2, 0]
    command = Signals(run.recording)["lag/command/u/effort"].x
    x = Signals(run.recording)["lag/state/x/position"].x
    peaks = Signals(run.recording)["lag/peaks/1"].x
    assert command[5] == command[4]
    assert command[6] == 1.0 - 0.5 * (2.0 * x[6]) - 0.1 * peaks[1]


PUSH = array("push", "lag/push", {"axis": 1}, "N")


class Pushed(Lag):
    """The plant, with an array as its command."""

    INPUTS = (PUSH,)

    def advance(self, x, t, push):
        return super().advance(x, t, push, None, None)


class Push(Block):
    INPUTS = (STATE,)
    OUTPUTS = (PUSH,)

    def update(self, x, t, state):
        return x, {"push": (1.0 - state[0],)}


def test_a_plant_accepts_the_better_array_after_a_bad_one():
    pair = Rig.from_blocks({"plant": Pushed(), "law": Push()}, 0.2)
    bad = PUSH.layout().encode(5, (float("nan"),))
    run = SimulatedRig(pair, Meddler("lag/push", lambda k, data: [bad, data] if k == 5 else [data]), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(pair), run.recording) == []
    assert [i.refused for i in run.adapters["plant"].inputs] == [1]


# In real time the newest array counts.


def test_in_real_time_a_repeated_array_is_rejected_and_a_lost_one_counted(loop):
    change = {5: lambda data: [data, data], 8: lambda data: [], 9: lambda data: []}
    run = SimulatedRig(loop, Meddler("lag/matrix", lambda k, data: change.get(k, lambda d: [d])(data)), "realtime")
    assert set(run.run().values()) == {"done"}
    weigh = run.adapters["weigh"]
    assert [i.refused for i in weigh.inputs] == [1, 0]
    assert weigh.inputs[0].last_refusal == "number 5 from spread, expected 6 (already there)"
    assert [i.lost for i in weigh.inputs] == [2, 0]
    assert weigh.drive.statistics()["lost_arrays"] == 2
    assert weigh.step.reports["lost lag/matrix"][:2] == (Level.WARN, "2 messages of spread are lost")


def test_in_real_time_arrays_without_a_number_are_accepted(loop):
    run = SimulatedRig(loop, Meddler("lag/matrix", bare), "realtime")
    assert set(run.run().values()) == {"done"}
    assert [(i.refused, i.lost) for i in run.adapters["weigh"].inputs] == [(0, 0)] * 2
    assert len(run.recording.topics["lag/command"].data) >= 29


@pytest.mark.parametrize(("first", "matched"), [(0, False), (3, True)])
def test_in_real_time_a_returning_sender_counts_from_its_first_number(loop, first, matched):
    """A bag in a loop begins with number 0; the first ones of a new publisher may have been missed."""
    again = count(first)
    world = Meddler("lag/matrix", lambda k, data: [renumbered(data, next(again))] if k >= 12 else [data])
    run = SimulatedRig(loop, world, "realtime")
    reader = next(r for r in world.readers if r.topic == "/lag/matrix")
    if matched:
        world.at(run.epoch + 115 * MS, lambda: (reader.matched(0), reader.matched(1)))
    assert set(run.run().values()) == {"done"}
    assert [(i.refused, i.lost) for i in run.adapters["weigh"].inputs] == [(0, 0)] * 2


# A plain rclpy node.

OUTSIDE = """
import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

rclpy.init()
node = Node("others")
publisher = node.create_publisher(Float64MultiArray, "lag/matrix", 10)
said = []

def state(received):
    k, x = len(said), received.position[0]
    matrix = Float64MultiArray(data=[x, 2.0 * x])
    matrix.layout.dim = [MultiArrayDimension(label=LABEL, size=1, stride=2),
                         MultiArrayDimension(label="column", size=2, stride=2)]
    said.append(matrix)
    publisher.publish(matrix)
    if k == 20 and TWICE:
        publisher.publish(matrix)

node.create_subscription(JointState, "lag/state", state, 10)
rclpy.spin(node)
"""
NUMBER = 'f"row; sequence {k}"'


def with_outside_sender(label, twice, directory):
    """Run the rig with a plain rclpy node in place of the one that publishes the matrix."""
    nodes = ARRAYS | {"spread": {"executable": "spread", "external": True}}
    wired = rig_of(make_scenario(nodes, 0.3, timeout=60.0))
    code, outside = OUTSIDE.replace("LABEL", label).replace("TWICE", str(twice)), []
    with free_domain() as domain:

        def announce(text):
            if not outside:
                outside.append(script(code, environment(domain, directory)))

        try:
            return run_processes(wired, 0, directory, Placement(domain=domain, wait=60.0), Listener(announce=announce))
        finally:
            for process in outside:
                process.kill()
                process.wait()


@pytest.mark.processes
@pytest.mark.parametrize("label", few([NUMBER, '"row"'], 1))
def test_an_outside_sender_may_number_its_arrays_or_not(loop, label, tmp_path):
    outcome = with_outside_sender(label, False, tmp_path)
    assert outcome.error == ""
    assert not any(s["refused"] for s in outcome.status.values())
    # Only the bytes of the external topic differ.
    assert set(differences(in_process(loop), outcome.recording)) == {"lag/matrix"}


@pytest.mark.long
@pytest.mark.processes
def test_an_outside_sender_that_repeats_one_is_named(loop, tmp_path):
    outcome = with_outside_sender(NUMBER, True, tmp_path)
    assert outcome.error == ""
    refused = outcome.status["weigh"]["refused"]
    assert refused == {"lag/matrix": [1, "number 20 from spread, expected 21 (already there)"]}
    assert set(differences(in_process(loop), outcome.recording)) == {"lag/matrix"}


@pytest.mark.long
@pytest.mark.processes
def test_an_outside_sender_that_skips_one_ends_the_run_by_name(tmp_path):
    outcome = with_outside_sender('f"row; sequence {k + (k > 20)}"', False, tmp_path)
    assert "lag/matrix: number 22 from spread, expected 21 (1 lost)" in outcome.error
    assert len(outcome.recording.topics["lag/command"].data) == 21
