import numpy as np
import pytest
from conftest import differences, in_process
from faultrig import COMMAND, STATE, Lag
from rosbags.typesys import Stores, get_typestore
from simulated import SimulatedRig, World
from softrig_core.model.block import Block
from softrig_core.model.port import Refused, array, pose
from softrig_core.rig.rig import Rig
from softrig_core.wire.cdr import parse
from softrig_core.wire.codec import Decoder, selection
from softrig_core.wire.recording import Recording
from softrig_core.wire.signals import Signals

MATRIX = array("m", "matrix", {"row": 2, "column": 3}, "kg m^2")
POSE = pose("p", "tool_pose", "base_link")
store = get_typestore(Stores.ROS2_JAZZY)


def test_array_bytes_are_those_of_the_ros_type():
    values = (1.0, -2.5, 3.0, 4.0, 5.0, 6.0)
    data = MATRIX.layout().encode(0, values)
    message = store.deserialize_cdr(data, "std_msgs/msg/Float64MultiArray")
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [("row", 2, 6), ("column", 3, 3)]
    assert message.layout.data_offset == 0
    assert tuple(message.data) == values
    assert bytes(store.serialize_cdr(message, "std_msgs/msg/Float64MultiArray")) == data
    assert Decoder(MATRIX)(data) == (0, values)


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
        recording.add(0, k * 10**9, MATRIX.layout().encode(0, [k + 0.1 * i for i in range(6)]))
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
    data[data.index(b"row\0") + 4] = 5  # the size of the first dimension
    with pytest.raises(Refused, match=r"6 values for the shape {'row': 5, 'column': 3}"):
        Decoder(MATRIX)(bytes(data))
    for n in range(len(data)):
        with pytest.raises(ValueError, match="std_msgs"):
            parse(MATRIX.msgtype, bytes(data[:n]))


# in lockstep: they have no stamp and pair by order

SPREAD = array("matrix", "lag/matrix", {"row": 1, "column": 2}, "m")


class Spread(Block):
    """The state as an array."""

    INPUTS = (STATE,)
    OUTPUTS = (SPREAD,)

    def update(self, t, state):
        return {"matrix": (state[0], 2.0 * state[0])}


class Weigh(Block):
    """A command from the array."""

    INPUTS = (SPREAD,)
    OUTPUTS = (COMMAND,)

    def update(self, t, matrix):
        return {"command": (1.0 - 0.5 * matrix[1],)}


class Lossy(World):
    """A graph that loses the sixth array."""

    seen = 0

    def send(self, writer, data):
        self.seen += writer.topic == "/lag/matrix"
        if writer.topic != "/lag/matrix" or self.seen != 6:
            super().send(writer, data)


@pytest.fixture
def loop():
    return Rig.from_blocks({"plant": Lag(), "spread": Spread(), "weigh": Weigh()}, 0.2)


def test_arrays_pair_by_order(loop):
    run = SimulatedRig(loop, World(), "lockstep")
    assert set(run.run().values()) == {"done"}
    assert differences(in_process(loop), run.recording) == []


def test_a_lost_array_is_waited_for_by_name(loop):
    """The arrays behind it do not take its place: the run ends, and says where it stands."""
    run = SimulatedRig(loop, Lossy(), "lockstep")
    states = run.run()
    assert set(states.values()) == {"failed"}
    assert "lag/matrix from spread" in str(run.adapters["weigh"].error)
    assert len(run.recording.topics["lag/command"].data) == 5
