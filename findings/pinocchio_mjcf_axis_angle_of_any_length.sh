#!/usr/bin/env bash
# pinocchio takes the axis of an MJCF axisangle as a unit vector: another length gives a matrix that is no rotation.
#
# Versions: pin 4.1.0 (pinocchio 4.1.0), mujoco 4.0.0, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: axisangle="1 1 0 40" turns by 40 degrees about the diagonal, as in MuJoCo, which normalises the axis; or the file is
# refused.
# Behaviour: the placement of the joint has the determinant 1.74 instead of 1, a tip at 1 m is at 1.72 m, and nothing is said. The axis
# of a joint of any length ("0 3 4") is normalised.
#
# Output seen:
seen=$(
    cat <<'SEEN'
axisangle 0 0 1 40: tip at 1.0 m in MuJoCo, 1.0 m in pinocchio; determinant 1.0
axisangle 1 1 0 40: tip at 1.0 m in MuJoCo, 1.7175 m in pinocchio; determinant 1.7438
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pin==4.1.0 mujoco==4.0.0 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import mujoco
import numpy as np
import pinocchio

MODEL = '''<mujoco><worldbody><body name="link" axisangle="%s"><joint name="z" type="hinge" axis="0 3 4"/>
<geom type="sphere" size="0.1" mass="1"/><body name="tip" pos="0.6 0 0.8"><joint name="y" type="hinge" axis="0 1 0"/>
<geom type="box" size="0.1 0.2 0.3" mass="2"/></body>
</body></worldbody></mujoco>'''
for angle in ("0 0 1 40", "1 1 0 40"):
    text = MODEL % angle
    with open("arm.xml", "w") as file:
        file.write(text)
    mine, other = mujoco.MjModel.from_xml_string(text), pinocchio.buildModelFromMJCF("arm.xml")
    state, data = mujoco.MjData(mine), other.createData()
    mujoco.mj_forward(mine, state)
    pinocchio.forwardKinematics(other, data, np.zeros(2))
    there = [round(float(np.linalg.norm(place)), 4) for place in (state.xpos[2], data.oMi[2].translation)]
    turn = round(float(np.linalg.det(other.jointPlacements[1].rotation)), 4)
    print(f"axisangle {angle}: tip at {there[0]} m in MuJoCo, {there[1]} m in pinocchio; determinant {turn}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
