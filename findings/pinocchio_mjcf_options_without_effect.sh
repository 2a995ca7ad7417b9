#!/usr/bin/env bash
# pinocchio reads an MJCF model without its gravity, its group of masses and its frames, and says nothing.
#
# Versions: pin 4.1.0 (pinocchio 4.1.0), mujoco 4.0.0, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: what decides masses and weight is read, or named as left out: other things that are not supported (shell inertia) raise.
# Behaviour: option gravity stays 9.81 m/s^2, inertiagrouprange counts geoms that only draw (twice the mass here), boundmass is left
# out, and a geom within frame has no mass at all.
#
# Output seen:
seen=$(
    cat <<'SEEN'
nothing: mass 1.0 and 1.0 kg, torque -1.4109 and -1.4109 Nm
gravity of the moon: mass 1.0 and 1.0 kg, torque -0.2330 and -1.4109 Nm
masses of group 0: mass 1.0 and 2.0 kg, torque -1.4109 and -2.8219 Nm
2 kg at least: mass 2.0 and 1.0 kg, torque -2.8219 and -1.4109 Nm
in a frame: mass 1.0 and 0.0 kg, torque -1.4109 and 0.0000 Nm
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

BALL = '<geom type="sphere" size="0.1" mass="1" pos="0 0 0.3"/>'
MODEL = '<mujoco>%s<worldbody><body name="link"><joint name="y" type="hinge" axis="0 1 0"/>%s</body></worldbody></mujoco>'
CASES = {
    "nothing": ("", BALL),
    "gravity of the moon": ('<option gravity="0 0 -1.62"/>', BALL),
    "masses of group 0": ('<compiler inertiagrouprange="0 0"/>', BALL + BALL.replace("<geom ", '<geom group="3" ')),
    "2 kg at least": ('<compiler boundmass="2"/>', BALL),
    "in a frame": ("", f"<frame>{BALL}</frame>"),
}
for name, parts in CASES.items():
    text = MODEL % parts
    with open("model.xml", "w") as file:
        file.write(text)
    mine, other = mujoco.MjModel.from_xml_string(text), pinocchio.buildModelFromMJCF("model.xml")
    state, data, angle = mujoco.MjData(mine), other.createData(), np.array([0.5])
    state.qpos[:] = angle
    mujoco.mj_forward(mine, state)
    torques = state.qfrc_bias[0], pinocchio.computeGeneralizedGravity(other, data, angle)[0]
    print(f"{name}: mass {mine.body_mass[1]} and {other.inertias[1].mass} kg, torque {torques[0]:.4f} and {torques[1]:.4f} Nm")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
