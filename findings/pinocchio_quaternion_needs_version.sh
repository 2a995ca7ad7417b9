#!/usr/bin/env bash
# pinocchio drops <origin quat_xyzw=...> of a URDF unless the robot says version="1.1".
#
# Versions: pin 4.1.0 (urdfdom 6.0 by cmeel). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a quaternion is used, or a file that may not have one is refused.
# Behaviour: without a version, or with 1.0, the attribute is ignored without a word: the joint frame is not turned at all.
# For a robot from a newer exporter: an arm that should hang stands up, and nothing says so.
#
# Output seen:
seen=$(
    cat <<'SEEN'
no version | the joint's z axis points to [0. 0. 1.]
version="1.0" | the joint's z axis points to [0. 0. 1.]
version="1.1" | the joint's z axis points to [ 0.  0. -1.]
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
import numpy as np
import pinocchio as pin

TEXT = (
    '<robot name="r"{}><link name="base"/><link name="arm"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="j" type="continuous"><parent link="base"/><child link="arm"/><origin quat_xyzw="1 0 0 0"/>'
    '<axis xyz="0 1 0"/></joint></robot>'
)
for version in ("", ' version="1.0"', ' version="1.1"'):
    turned = pin.buildModelFromXML(TEXT.format(version)).jointPlacements[1].rotation
    print(version.strip() or "no version", "| the joint's z axis points to", (turned @ np.array([0, 0, 1])).round(6) + 0.0)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
