#!/usr/bin/env bash
# One URDF with <mimic>: MuJoCo couples the two fingers, pinocchio lets the second one swing freely.
#
# Versions: mujoco 4.0.0, pin 4.1.0, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: both read the tag, or say that they do not.
# Behaviour: MuJoCo makes an equality constraint with multiplier and offset. pinocchio's buildModelFromUrdf and
# buildModelFromXML have an argument mimic that is False unless given: without a word the model has one joint more, no torque
# of the motor reaches the second finger, and inertia at the motor is half. With mimic=True nv is 1 and the inertia is right.
#
# Output seen:
seen=$(
    cat <<'SEEN'
pinocchio: joints that move 2 accelerations for 1 N m at the drive [90.909  0.   ]
pinocchio, mimic=True: joints that move 1 inertia [[0.022]] before [0.011 0.011]
MuJoCo: joints 2 equality constraints 1 polynomial [ 0. -1.]
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pin==4.1.0 numpy==2.4.6 mujoco==4.0.0
now=$(
    venv/bin/python - <<'PROGRAM'
import mujoco
import numpy as np
import pinocchio as pin

FINGER = '''<link name="{0}"><inertial><origin xyz="0.1 0 0"/><mass value="1"/>
<inertia ixx="0.001" iyy="0.001" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>'''
JOINT = '''<joint name="{0}" type="revolute"><parent link="palm"/><child link="{1}"/><axis xyz="0 0 1"/>
<limit lower="-1" upper="1" effort="9" velocity="9"/>{2}</joint>'''
gripper = (
    '<robot name="gripper"><link name="palm"/>'
    + FINGER.format("left") + FINGER.format("right")
    + JOINT.format("drive", "left", "")
    + JOINT.format("follower", "right", '<mimic joint="drive" multiplier="-1"/>')
    + "</robot>"
)
free = pin.buildModelFromXML(gripper)
print("pinocchio: joints that move", free.nv, "accelerations for 1 N m at the drive",
      pin.aba(free, free.createData(), np.zeros(2), np.zeros(2), np.array([1.0, 0.0])).round(3))
coupled = pin.buildModelFromXML(gripper, mimic=True)
print("pinocchio, mimic=True: joints that move", coupled.nv, "inertia",
      pin.crba(coupled, coupled.createData(), np.zeros(1)).round(4), "before", pin.crba(free, free.createData(), np.zeros(2)).diagonal().round(4))
model = mujoco.MjModel.from_xml_string(gripper)
print("MuJoCo: joints", model.nv, "equality constraints", model.neq, "polynomial", model.eq_data[0][:2])
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
