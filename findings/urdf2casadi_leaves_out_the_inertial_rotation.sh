#!/usr/bin/env bash
# urdf2casadi reads a link's inertia without the rotation of its inertial frame.
#
# Versions: urdf2casadi 1.0.0, casadi 3.8.2, urdf_parser_py 0.0.4, pin 4.1.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: the inertia matrix follows <origin rpy> of <inertial>, since the position of the same element is followed.
# Behaviour: xyz is used and rpy is not: a link that is long in y, written with a turn of 90 degrees as CAD exports write it,
# has the inertia of its long axis in the place of the short one. Gravity torques are right, so a comparison at rest does not
# show it; the same link written without rpy agrees with pinocchio.
#
# Output seen:
seen=$(
    cat <<'SEEN'
without rpy: inertia 0.6800, pinocchio 0.6800 (2 * 0.3^2 + 0.5 = 0.68); gravity torque -5.4214, pinocchio -5.4214
turned by 90 degrees: inertia 0.1900, pinocchio 0.6800 (2 * 0.3^2 + 0.5 = 0.68); gravity torque -5.4214, pinocchio -5.4214
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check urdf2casadi==1.0.0 casadi==3.8.2 urdf_parser_py==0.0.4 numpy==2.4.6 pin==4.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
from pathlib import Path

import numpy as np
import pinocchio
import urdf2casadi.urdfparser

URDF = """<robot name="arm"><link name="base"/>
 <link name="rod"><inertial><origin xyz="0.3 0 0" rpy="0 0 RPY"/><mass value="2"/>
  <inertia ixx="IXX" ixy="0" ixz="0" iyy="IYY" iyz="0" izz="0.5"/></inertial></link>
 <joint name="j" type="revolute"><parent link="base"/><child link="rod"/><origin xyz="0 0 0.1"/><axis xyz="0 1 0"/>
  <limit lower="-3" upper="3" effort="50" velocity="5"/></joint>
</robot>"""
q = np.array([0.4])
for text, rpy, ixx, iyy in (("without rpy", "0", "0.01", "0.5"), ("turned by 90 degrees", "1.5707963267948966", "0.5", "0.01")):
    file = Path("arm.urdf")
    file.write_text(URDF.replace("RPY", rpy).replace("IXX", ixx).replace("IYY", iyy))
    arm = urdf2casadi.urdfparser.URDFparser()
    arm.from_file(str(file))
    model = pinocchio.buildModelFromUrdf(str(file))
    data = model.createData()
    inertia = float(arm.get_inertia_matrix_crba("base", "rod")(q))
    torque = float(arm.get_gravity_rnea("base", "rod", [0, 0, -9.81])(q))
    print(f"{text}: inertia {inertia:.4f}, pinocchio {pinocchio.crba(model, data, q)[0, 0]:.4f} (2 * 0.3^2 + 0.5 = 0.68);",
          f"gravity torque {torque:.4f}, pinocchio {pinocchio.computeGeneralizedGravity(model, data, q)[0]:.4f}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
