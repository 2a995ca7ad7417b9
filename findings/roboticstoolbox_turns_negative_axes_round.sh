#!/usr/bin/env bash
# The Robotics Toolbox moves a URDF joint with a negative axis the right way, and computes its torques for the positive one.
#
# Versions: roboticstoolbox-python 1.5.0, spatialmath-python 1.1.18, pin 4.1.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: gravity torque, inertia matrix and rne of a URDF arm belong to the same joint angles as its forward kinematics.
# Behaviour: fkine follows the axis 0 -1 0; gravload, inertia and rne have the sign of 0 1 0 for that joint, so the torque is
# not the slope of the toolbox's potential energy in the joint's angle, and gravity compensation pushes the wrong way.
# pinocchio agrees with the slope. With a positive axis all three agree. No warning.
#
# Output seen:
seen=$(
    cat <<'SEEN'
second axis 0 1 0
  slope of the toolbox's energy   -8.8528  -1.3553
  gravload of the toolbox         -8.8528  -1.3553
  rne of the toolbox at rest      -8.8528  -1.3553
  gravity torque of pinocchio     -8.8528  -1.3553
  inertia between the joints: toolbox 0.0984, pinocchio 0.0984
second axis 0 -1 0
  slope of the toolbox's energy   -8.2925   0.7951
  gravload of the toolbox         -8.2925  -0.7951
  rne of the toolbox at rest      -8.2925  -0.7951
  gravity torque of pinocchio     -8.2925   0.7951
  inertia between the joints: toolbox 0.0984, pinocchio -0.0984
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check roboticstoolbox-python==1.5.0 spatialmath-python==1.1.18 numpy==2.4.6 scipy==1.17.1 pin==4.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
import warnings
from pathlib import Path

import numpy as np
import pinocchio
from roboticstoolbox import Robot

warnings.simplefilter("ignore")
URDF = """<robot name="arm">
 <link name="base"/>
 <link name="one"><inertial><origin xyz="0.2 0 0"/><mass value="2"/>
  <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.05" iyz="0" izz="0.05"/></inertial></link>
 <link name="two"><inertial><origin xyz="0.15 0 0"/><mass value="1"/>
  <inertia ixx="0.01" ixy="0" ixz="0" iyy="0.03" iyz="0" izz="0.03"/></inertial></link>
 <joint name="a" type="revolute"><parent link="base"/><child link="one"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
 <joint name="b" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.4 0 0"/><axis xyz="0 SIGN 0"/>
  <limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
</robot>"""
q = np.array([0.3, -0.7])


def energy(robot, q):
    """The potential energy by the toolbox's own kinematics."""
    heights = ((robot.fkine(q, end=link.name).A @ [*link.r, 1.0])[2] * link.m for link in robot.links[1:])
    return 9.81 * sum(heights)


def show(values):
    return " ".join(f"{v:8.4f}" for v in values)


for sign in ("1", "-1"):
    file = Path(f"arm{sign}.urdf").absolute()
    file.write_text(URDF.replace("SIGN", sign))
    robot, model = Robot.URDF(str(file)), pinocchio.buildModelFromUrdf(str(file))
    slope = [(energy(robot, q + h) - energy(robot, q - h)) / 2e-6 for h in 1e-6 * np.eye(2)]
    data = model.createData()
    print(f"second axis 0 {sign} 0")
    print("  slope of the toolbox's energy ", show(slope))
    print("  gravload of the toolbox       ", show(robot.gravload(q)))
    print("  rne of the toolbox at rest    ", show(robot.rne(q, 0.0 * q, 0.0 * q)))
    print("  gravity torque of pinocchio   ", show(pinocchio.computeGeneralizedGravity(model, data, q)))
    print(f"  inertia between the joints: toolbox {robot.inertia(q)[0, 1]:.4f}, pinocchio {pinocchio.crba(model, data, q)[0, 1]:.4f}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
