#!/usr/bin/env bash
# A ROS 2 parameter file means other values to a node than to PyYAML, with which tools write and check such files.
#
# Versions: ros-jazzy-rclpy 7.1.6 (wheels of PyPI), PyYAML 6.0.3. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: both read YAML 1.1, so a value is the same for the node and for a script that looks into the file.
# Behaviour, of the scalars tried: 1:30 is 90 for PyYAML and a text for rcl; 1e3 is a text for PyYAML and 1000.0 for rcl; 0b101 and 1_000
# are numbers for PyYAML and texts for rcl; y is a text for PyYAML and true for rcl; ~ and null are None and the TEXTS "~" and "null";
# !!float 5 is 5.0 and the integer 5; 9223372036854775808 is an integer and a double. Lists of an integer and a float are no parameter.
# For a rig: read a parameter file by rcl's own rules before a run, else a gain of 1e3 is a text in one of them.
#
# Output seen:
seen=$(
    cat <<'SEEN'
1:30                 PyYAML 90                     rcl '1:30' differ
1e3                  PyYAML '1e3'                  rcl 1000.0 differ
0b101                PyYAML 5                      rcl '0b101' differ
1_000                PyYAML 1000                   rcl '1_000' differ
y                    PyYAML 'y'                    rcl True differ
~                    PyYAML None                   rcl '~' differ
null                 PyYAML None                   rcl 'null' differ
!!float 5            PyYAML 5.0                    rcl 5 differ
9223372036854775808  PyYAML 9223372036854775808    rcl 9.223372036854776e+18 differ
0x10                 PyYAML 16                     rcl 16 same
0777                 PyYAML 511                    rcl 511 same
.inf                 PyYAML inf                    rcl inf same
yes                  PyYAML True                   rcl True same
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pyyaml==6.0.3 ros-jazzy-rclpy==7.1.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    venv/bin/python - <<'PROGRAM'
import rclpy
import yaml
from rclpy.node import Node

for word in ("1:30", "1e3", "0b101", "1_000", "y", "~", "null", "!!float 5", "9223372036854775808", "0x10", "0777", ".inf", "yes"):
    with open("p.yaml", "w") as file:
        file.write("/**:\n  ros__parameters:\n    k: " + word + "\n")
    with open("p.yaml") as file:
        one = yaml.safe_load(file)["/**"]["ros__parameters"]["k"]
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", "p.yaml"])
    node = Node("n", context=context, automatically_declare_parameters_from_overrides=True, enable_rosout=False, start_parameter_services=False)
    other = node.get_parameter("k").value
    node.destroy_node()
    rclpy.shutdown(context=context)
    print(f"{word:20} PyYAML {one!r:22} rcl {other!r}", "same" if (type(one), one) == (type(other), other) else "differ")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
