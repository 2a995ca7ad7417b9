#!/usr/bin/env bash
# Two rclpy nodes of one name in a process: destroying the second makes the publishers of the first anonymous.
#
# Versions: ros-jazzy-rclpy 7.1.6, ros-jazzy-rmw-fastrtps-cpp 8.4.3 (wheels of PyPI). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: destroy_node() of the second removes that one; the first stays as it was.
# Behaviour: the graph keeps one entry for the name and drops the endpoints with it: from then on
# get_publishers_info_by_topic() gives _NODE_NAME_UNKNOWN_ for the first node's publisher, though the node lives and publishes.
# For a test that starts a node twice in one process: give each another name or namespace.
#
# Output seen:
seen=$(
    cat <<'SEEN'
one node: /twin
two nodes: /twin
second destroyed: _NODE_NAMESPACE_UNKNOWN__NODE_NAME_UNKNOWN_ nodes ['twin']
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-sensor-msgs==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    ROS_DOMAIN_ID=83 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST venv/bin/python - 2>/dev/null <<'PROGRAM'
import time

import rclpy
from rclpy.node import Node
from std_msgs.msg import Header

rclpy.init()
first = Node("twin")
first.create_publisher(Header, "/x", 1)


def publisher():
    (info,) = first.get_publishers_info_by_topic("/x")
    return info.node_namespace + info.node_name


def until(condition):
    end = time.monotonic() + 10.0
    while not condition() and time.monotonic() < end:
        time.sleep(0.01)


until(lambda: publisher() == "/twin")
print("one node:", publisher())
second = Node("twin")
until(lambda: first.get_node_names().count("twin") == 2)
print("two nodes:", publisher())
second.destroy_node()
until(lambda: first.get_node_names().count("twin") == 1)
print("second destroyed:", publisher(), "nodes", first.get_node_names())
rclpy.shutdown()
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
