#!/usr/bin/env bash
# pinocchio reads the range of a slide joint of an MJCF file as degrees: a lift of 1 m has 17 mm.
#
# Versions: pin 4.1.0 (pinocchio 4.1.0), mujoco 4.0.0, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a range of a slide joint is a length in m, as in MuJoCo, whose unit of angles (compiler angle="degree", the
# default) is that of hinges alone.
# Behaviour: buildModelFromMJCF multiplies both ends by pi/180 unless the file says angle="radian". Masses, damping,
# armature and dry friction of the same joint are as in MuJoCo.
#
# Output seen:
seen=$(
    cat <<'SEEN'
default: MuJoCo up to 1.0 m, pinocchio up to 0.017453
   damping 3.0 3.0 armature 0.2 0.2
<compiler angle="radian"/> MuJoCo up to 1.0 m, pinocchio up to 1.0
   damping 3.0 3.0 armature 0.2 0.2
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
import pinocchio

MODEL = '''<mujoco>%s<worldbody><body name="lift"><joint name="z" type="slide" axis="0 0 1" range="0 1" limited="true"
damping="3" armature="0.2"/><geom type="box" size="0.1 0.1 0.1" mass="2"/></body></worldbody></mujoco>'''
for compiler in ("", '<compiler angle="radian"/>'):
    text = MODEL % compiler
    with open("lift.xml", "w") as file:
        file.write(text)
    mine, other = mujoco.MjModel.from_xml_string(text), pinocchio.buildModelFromMJCF("lift.xml")
    print(compiler or "default:", "MuJoCo up to", mine.jnt_range[0, 1], "m, pinocchio up to", round(other.upperPositionLimit[0], 6))
    print("   damping", mine.dof_damping[0], other.damping[0], "armature", mine.dof_armature[0], other.armature[0])
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
