#!/usr/bin/env bash
# pinocchio numbers the joints of a URDF by their names, not in the order of the file.
#
# Versions: pin 4.1.0 (urdfdom 6.0 by cmeel). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: q[0] is the first joint of the file.
# Behaviour: joints that leave the same link are visited in the alphabetical order of their names: renaming a joint exchanges q[0]
# and q[1] of the same mechanism; the links' names and the file's order do not matter. No order is wrong, but whoever fills q
# by the order of the file exchanges two arms silently.
#
# Output seen:
seen=$(
    cat <<'SEEN'
file: shoulder (link a), hip (link b) -> hip shoulder
file: shoulder (link b), hip (link a) -> hip shoulder
file: arm (link a), hip (link b) -> arm hip
file: arm (link b), hip (link a) -> arm hip
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pin==4.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
import pinocchio as pin

LINK = '<link name="{}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
JOINT = (
    '<joint name="{}" type="revolute"><parent link="base"/><child link="{}"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
)
for first, second in (("shoulder", "hip"), ("arm", "hip")):
    for links in ("ab", "ba"):
        text = '<robot name="r"><link name="base"/>' + LINK.format("a") + LINK.format("b")
        text += JOINT.format(first, links[0]) + JOINT.format(second, links[1]) + "</robot>"
        print(f"file: {first} (link {links[0]}), {second} (link {links[1]}) ->", *list(pin.buildModelFromXML(text).names)[1:])
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
