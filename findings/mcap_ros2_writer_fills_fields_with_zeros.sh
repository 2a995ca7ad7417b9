#!/usr/bin/env bash
# The writer of mcap-ros2-support writes zeros for fields that a message lacks and leaves out fields the type does not have.
#
# Versions: mcap-ros2-support 0.6.0, mcap 1.6.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a message that does not fit its definition is refused, as rclpy and rosbags refuse it.
# Behaviour: a missing field is written as 0, an empty text or an empty array; a field with another name is left out; neither
# is reported. A bag written from dicts or objects of a newer version of a message has zeros in it that nobody measured.
#
# Output seen:
seen=$(
    cat <<'SEEN'
stamp 12 s 0 ns, frame ''
name [], position [1.0], velocity [], effort []
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check mcap-ros2-support==0.6.0 mcap==1.6.0
now=$(
    venv/bin/python - <<'PROGRAM'
import io

from mcap_ros2.reader import read_ros2_messages
from mcap_ros2.writer import Writer

DEFINITION = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
===
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
===
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
file = io.BytesIO()
writer = Writer(file)
schema = writer.register_msgdef("sensor_msgs/msg/JointState", DEFINITION)
stamp = {"sec": 12, "nanoseconds": 500_000_000}  # nanosec in ROS 2
writer.write_message("/j", schema, {"header": {"stamp": stamp}, "names": ["a"], "position": [1.0], "torque": [2.0]}, 1)
writer.finish()
file.seek(0)
for read in read_ros2_messages(file):
    m = read.ros_msg
    print(f"stamp {m.header.stamp.sec} s {m.header.stamp.nanosec} ns, frame {m.header.frame_id!r}")
    print(f"name {m.name}, position {m.position}, velocity {m.velocity}, effort {m.effort}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
