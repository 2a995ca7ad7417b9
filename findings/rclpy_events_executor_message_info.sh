#!/usr/bin/env bash
# A subscription callback that takes message info works with rclpy's usual executor and raises SystemError with EventsExecutor.
#
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (wheels of PyPI). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the executor does not decide which callbacks are allowed: def callback(message, info) gets the sequence numbers.
# Behaviour: SingleThreadedExecutor passes the dict; rclpy.experimental's EventsExecutor raises SystemError at the first message.
# For a recorder that counts lost messages by publication_sequence_number: not with the fast executor.
#
# Output seen:
seen=$(
    cat <<'SEEN'
SingleThreadedExecutor passes a dict
EventsExecutor raises SystemError: null argument to internal routine
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
os.environ.setdefault("ROS_DOMAIN_ID", "87")
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.task import Future
from std_msgs.msg import Header

for kind in (SingleThreadedExecutor, EventsExecutor):
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("n", context=context, enable_rosout=False)
    executor, done = kind(context=context), Future()
    executor.add_node(node)
    node.create_subscription(Header, "/x", lambda message, info: done.set_result(type(info).__name__), 10)
    publisher = node.create_publisher(Header, "/x", 10)
    publisher.publish(Header())
    try:
        executor.spin_until_future_complete(done, 20.0)
        print(kind.__name__, "passes a", done.result())
    except SystemError as error:
        print(kind.__name__, "raises", type(error).__name__ + ":", str(error).split("(")[0].strip())
    node.destroy_node()
    rclpy.shutdown(context=context)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
