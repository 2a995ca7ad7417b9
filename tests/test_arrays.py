import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from softrig_core.model.port import Refused, array, pose
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
