#!/usr/bin/env bash
# A ROS 2 process under Fast DDS cannot have a subscription and a publisher of different types on one topic, two processes can.
#
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (wheels of PyPI). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: endpoints of different types on one topic never match, whether they are in one process or in two.
# Behaviour: in one context (one DDS participant) the second one is refused: create_publisher raises an error that the topic exists
# with an incompatible type. In two contexts of the same process both are created and never match, as across processes.
# For a recorder of a topic that comes back with another type: the second type needs a participant of its own.
#
# Output seen:
seen=$(
    cat <<'SEEN'
one context | RCLError with 'incompatible type': True
two contexts | created, matched subscriptions: 0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-std-msgs==5.3.6 ros-sensor-msgs==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    venv/bin/python - <<'PROGRAM'
import os

os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
os.environ.setdefault("ROS_DOMAIN_ID", "88")
import rclpy
from sensor_msgs.msg import JointState
from std_msgs.msg import Header

for name, apart in (("one context", False), ("two contexts", True)):
    contexts = [rclpy.Context(), rclpy.Context()]
    for context in contexts:
        rclpy.init(context=context)
    one = rclpy.create_node("one", context=contexts[0], enable_rosout=False)
    two = rclpy.create_node("two", context=contexts[apart], enable_rosout=False)
    one.create_subscription(JointState, "/x", lambda message: None, 10)
    try:
        publisher = two.create_publisher(Header, "/x", 10)
        print(name, "| created, matched subscriptions:", publisher.get_subscription_count())
    except Exception as error:
        print(name, "|", type(error).__name__, "with 'incompatible type':", "incompatible type" in str(error))
    for node in (one, two):
        node.destroy_node()
    for context in contexts:
        rclpy.shutdown(context=context)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
