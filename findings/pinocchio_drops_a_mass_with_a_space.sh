#!/usr/bin/env bash
# A space behind the number of <mass value="2.0 "/> makes pinocchio build the robot without that link's mass.
#
# Versions: pin 4.1.0 (urdfdom of its wheels). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: 2 kg as XML readers trim numbers, or an exception.
# Behaviour: urdfdom writes "mass [2.0 ] is not a float" to stderr and leaves out the whole <inertial> of the link;
# buildModelFromXML succeeds, with another total mass, and every torque computed from it is wrong.
# For robots whose description is written by a script or by xacro: check computeTotalMass against what you expect.
#
# Output seen:
seen=$(
    cat <<'SEEN'
value "2.0": total mass 3.0 kg
value "2.0 ": total mass 1.0 kg
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check pin==4.1.0
now=$(
    venv/bin/python - 2>/dev/null <<'PROGRAM'
import pinocchio as pin

LINK = '<link name="{}"><inertial><mass value="{}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
JOINT = '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/><axis xyz="0 0 1"/></joint>'
for value in ("2.0", "2.0 "):
    links = '<link name="base"/>' + LINK.format("one", "1.0") + LINK.format("two", value)
    text = f'<robot name="r">{links}{JOINT.format("a", "base", "one")}{JOINT.format("b", "one", "two")}</robot>'
    print(f'value "{value}": total mass', pin.computeTotalMass(pin.buildModelFromXML(text)), "kg")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
