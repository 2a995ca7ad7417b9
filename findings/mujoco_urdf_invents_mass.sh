#!/usr/bin/env bash
# MuJoCo gives a URDF link without <inertial> the mass of its collision shape at the density of water.
#
# Versions: mujoco 4.0.0, pin 4.1.0. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a link without <inertial> has no mass (as pinocchio and KDL read it), or the file is refused.
# Behaviour: a collision box of 0.1 x 0.1 x 1 m becomes 10 kg (density 1000 kg/m^3) with the box's inertia, silently; a visual
# shape alone does not. pinocchio makes the same link massless. The same file is two robots.
# For a comparison of two simulators: give each link an inertial, zero ones included.
#
# Output seen:
seen=$(
    cat <<'SEEN'
MuJoCo 10.0 kg
pinocchio 0.0 kg
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check mujoco==4.0.0 pin==4.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
import mujoco
import pinocchio as pin

TEXT = (
    '<robot name="r"><link name="base"/><link name="arm"><collision><origin xyz="0 0 -0.5"/><geometry>'
    '<box size="0.1 0.1 1"/></geometry></collision></link><joint name="j" type="continuous"><parent link="base"/>'
    '<child link="arm"/><axis xyz="0 1 0"/></joint></robot>'
)
print("MuJoCo", round(float(mujoco.MjModel.from_xml_string(TEXT).body("arm").mass[0]), 9), "kg")
print("pinocchio", pin.buildModelFromXML(TEXT).inertias[1].mass, "kg")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
