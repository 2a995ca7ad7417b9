#!/usr/bin/env bash
# A URDF joint without <axis> turns about x in pinocchio and ikpy, as URDF says, and about z in kinpy.
#
# Versions: kinpy 0.6.1, ikpy 4.2.1, pin 4.1.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: the element is optional and defaults to (1, 0, 0), so three readers of one file agree.
# Behaviour: kinpy fills in (0, 0, 1), for revolute, continuous and prismatic joints alike; nothing is reported. With the axis
# written out all three agree. Write <axis> always, or compare a frame of two libraries before the file is used.
#
# Output seen:
seen=$(
    cat <<'SEEN'
no axis
  pinocchio: position [0.2 0.  0. ], x axis of the tip [1. 0. 0.]
  ikpy: position [0.2 0.  0. ], x axis of the tip [1. 0. 0.]
  kinpy: position [0.  0.  0.2], x axis of the tip [0.878 0.479 0.   ]
<axis xyz="1 0 0"/>
  pinocchio: position [0.2 0.  0. ], x axis of the tip [1. 0. 0.]
  ikpy: position [0.2 0.  0. ], x axis of the tip [1. 0. 0.]
  kinpy: position [0.2 0.  0. ], x axis of the tip [1. 0. 0.]
<axis xyz="0 0 1"/>
  pinocchio: position [0.  0.  0.2], x axis of the tip [0.878 0.479 0.   ]
  ikpy: position [0.  0.  0.2], x axis of the tip [0.878 0.479 0.   ]
  kinpy: position [0.  0.  0.2], x axis of the tip [0.878 0.479 0.   ]
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check kinpy==0.6.1 ikpy==4.2.1 pin==4.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
import pathlib
import warnings

import ikpy.chain
import kinpy
import numpy as np
import pinocchio

warnings.simplefilter("ignore")
ROBOT = """<robot name="arm"><link name="base"/><link name="slide"/><link name="tip"/>
<joint name="turn" type="revolute"><parent link="base"/><child link="slide"/>{axis}
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
<joint name="move" type="prismatic"><parent link="slide"/><child link="tip"/>{axis}
<limit lower="-3" upper="3" effort="1" velocity="1"/></joint></robot>"""
for axis in ("", '<axis xyz="1 0 0"/>', '<axis xyz="0 0 1"/>'):
    text = ROBOT.format(axis=axis)
    pathlib.Path("arm.urdf").write_text(text)
    model = pinocchio.buildModelFromXML(text)
    data = model.createData()
    pinocchio.framesForwardKinematics(model, data, np.array([0.5, 0.2]))
    found = {"pinocchio": data.oMf[model.getFrameId("tip")].homogeneous}
    found["ikpy"] = ikpy.chain.Chain.from_urdf_file("arm.urdf", base_elements=["base"]).forward_kinematics([0, 0.5, 0.2])
    found["kinpy"] = kinpy.build_chain_from_urdf(text).forward_kinematics({"turn": 0.5, "move": 0.2})["tip"].matrix()
    print(axis or "no axis")
    for name, frame in found.items():
        print(f"  {name}: position {np.round(frame[:3, 3], 3) + 0.0}, x axis of the tip {np.round(frame[:3, 0], 3) + 0.0}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
