#!/usr/bin/env bash
# rclpy.serialize_message returns more bytes than the message has, and a strict reader refuses them.
#
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (wheels of PyPI), rosbags 0.11.9. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the bytes of serialize_message are the CDR of the message, at most three of them padding.
# Behaviour: for each empty double[] of the message the length counts its alignment, so JointState with one name and one position is
# eight bytes longer than what it holds. rclpy reads it; rosbags refuses it for its length ("CDR message size mismatch").
# For a bag written from Python: cut the bytes, or other readers call the bag damaged.
#
# Output seen:
seen=$(
    cat <<'SEEN'
1 velocities | rclpy 76 bytes | needed 76 | rosbags: read
0 velocities | rclpy 60 bytes | needed 52 | rosbags: SerdeError: CDR message size mismatch for 'sensor_msgs/msg/JointState'.
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check rosbags==0.11.9 ros-jazzy-rclpy==7.1.6 ros-sensor-msgs==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    venv/bin/python - <<'PROGRAM'
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import JointState

store = get_typestore(Stores.ROS2_JAZZY)
types = store.types
for message in (JointState(name=["a"], position=[1.0], velocity=[1.0], effort=[1.0]), JointState(name=["a"], position=[1.0])):
    data = serialize_message(message)
    assert deserialize_message(data, JointState) == message
    try:
        store.deserialize_cdr(data, "sensor_msgs/msg/JointState")
        answer = "read"
    except Exception as error:
        answer = type(error).__name__ + ": " + str(error)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    rows = (np.array(row) for row in (message.position, message.velocity, message.effort))
    same = types["sensor_msgs/msg/JointState"](header, list(message.name), *rows)
    needed = len(store.serialize_cdr(same, "sensor_msgs/msg/JointState"))
    print(len(message.velocity), "velocities | rclpy", len(data), "bytes | needed", needed, "| rosbags:", answer)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
