#!/usr/bin/env bash
# pinocchio reads capital letters of an MJCF file's eulerseq as small ones: fixed axes become moving ones.
#
# Versions: pin 4.1.0 (pinocchio 4.1.0), mujoco 4.0.0, scipy 1.17.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: eulerseq="XYZ" (rotations about the axes of the parent, as roll, pitch, yaw of URDF) gives the orientation that
# MuJoCo has.
# Behaviour: the letters' case is ignored, all sequences turn about the moved axes. A body of euler="10 40 70" is 47 degrees
# off. Small letters agree.
#
# Output seen:
seen=$(
    cat <<'SEEN'
xyz: MuJoCo 0.0 degrees from scipy, pinocchio 0.0
XYZ: MuJoCo 0.0 degrees from scipy, pinocchio 46.9
zyx: MuJoCo 0.0 degrees from scipy, pinocchio 0.0
ZYX: MuJoCo 0.0 degrees from scipy, pinocchio 46.9
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pin==4.1.0 mujoco==4.0.0 scipy==1.17.1 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import mujoco
import numpy as np
import pinocchio
from scipy.spatial.transform import Rotation

MODEL = '''<mujoco><compiler eulerseq="%s"/><worldbody><body name="link" euler="10 40 70"><joint name="z" type="hinge" axis="0 0 1"/>
<geom type="box" size="0.1 0.2 0.3" mass="2"/></body></worldbody></mujoco>'''
for sequence in ("xyz", "XYZ", "zyx", "ZYX"):
    text = MODEL % sequence
    with open("body.xml", "w") as file:
        file.write(text)
    w, x, y, z = mujoco.MjModel.from_xml_string(text).body_quat[1]
    mine = Rotation.from_quat([x, y, z, w])
    # scipy's capital letters are moving axes, MuJoCo's are fixed ones
    expected = Rotation.from_euler(sequence.swapcase(), [10, 40, 70], degrees=True)
    other = Rotation.from_matrix(pinocchio.buildModelFromMJCF("body.xml").jointPlacements[1].rotation)
    apart = [round(np.degrees((expected.inv() * one).magnitude()), 2) for one in (mine, other)]
    print(f"{sequence}: MuJoCo {apart[0] + 0.0} degrees from scipy, pinocchio {apart[1] + 0.0}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
