#!/usr/bin/env bash
# pinocchio reads a URDF's damping and friction into its model, and its dynamics use neither.
#
# Versions: pin 4.1.0. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: <dynamics damping="5" friction="2"/> acts in aba(), since model.damping holds 5 after reading the file.
# Behaviour: aba() and rnea() ignore model.damping and the dry friction limits: the acceleration of a turning joint is the
# same with and without the tag. <mimic> is ignored, too, unless buildModelFromUrdf is asked for it (mimic=True).
# For a robot's rig: a damped arm swings undamped unless the caller adds -damping * v himself.
#
# Output seen:
seen=$(
    cat <<'SEEN'
no tag | damping [0.] | acceleration at 1 rad/s [0.5]
<dynamics damping="5" friction="2"/> | damping [5.] | acceleration at 1 rad/s [0.5]
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
    '<robot name="r"><link name="base"/><link name="arm"><inertial><origin xyz="0 0 -1"/><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    '<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>'
    '<limit lower="-1" upper="1" effort="1" velocity="1"/>{}</joint></robot>'
)
for tag in ("", '<dynamics damping="5" friction="2"/>'):
    model = pin.buildModelFromXML(TEXT.format(tag))
    data, one = model.createData(), np.ones(1)
    print(tag or "no tag", "| damping", model.damping, "| acceleration at 1 rad/s", pin.aba(model, data, 0 * one, one, one))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
