#!/usr/bin/env bash
# A parameter that an rclpy node refused to set is described with the refused value's type.
#
# Versions: ros-jazzy-rclpy 7.1.6 (wheels of PyPI). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a set that an on-set callback refuses changes nothing.
# Behaviour: with dynamic_typing the descriptor's type is overwritten before the callbacks are asked: the parameter keeps its
# value 1.0 (a double), while describe_parameter says string. A tool that builds its form from the description offers the wrong kind.
#
# Output seen:
seen=$(
    cat <<'SEEN'
described as 3 with the value 1.0
set to a text: refused
described as 4 with the value 1.0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    ROS_DOMAIN_ID=84 ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST venv/bin/python - 2>/dev/null <<'PROGRAM'
import rclpy
from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

rclpy.init()
node = Node("n")
node.declare_parameter("k", 1.0, ParameterDescriptor(dynamic_typing=True))
node.add_on_set_parameters_callback(lambda parameters: SetParametersResult(successful=False, reason="no"))


def show():
    print("described as", node.describe_parameter("k").type, "with the value", node.get_parameter("k").value)


show()
(result,) = node.set_parameters([Parameter("k", value="text")])
print("set to a text:", "accepted" if result.successful else "refused")
show()
rclpy.shutdown()
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
