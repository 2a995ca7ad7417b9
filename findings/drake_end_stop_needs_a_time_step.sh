#!/usr/bin/env bash
# Drake keeps the end stops of a URDF only with a time step; its continuous plant turns through them without a warning.
#
# Versions: drake 1.51.1 (PyPI). Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: one URDF is one machine: position limits hold in MultibodyPlant(0.0) as in MultibodyPlant(0.001), as the effort limit does.
# Behaviour: the effort limit acts in both. The position limits act only with a time step. The velocity limit acts in neither. All is
# silent, although the continuous plant refuses other constraints, such as mimic, with an error.
# For a comparison of plants, take a step, or give neither tool a limit that the motion reaches.
#
# Output seen:
seen=$(
    cat <<'SEEN'
limit none reached | step 0.0 s | after 1 s of 5 N m: 25.0 rad, 50.0 rad/s
limit none reached | step 0.001 s | after 1 s of 5 N m: 25.0 rad, 50.0 rad/s
limit effort 1 N m | step 0.0 s | after 1 s of 5 N m: 5.0 rad, 10.0 rad/s
limit effort 1 N m | step 0.001 s | after 1 s of 5 N m: 5.0 rad, 10.0 rad/s
limit position 0.5 rad | step 0.0 s | after 1 s of 5 N m: 25.0 rad, 50.0 rad/s
limit position 0.5 rad | step 0.001 s | after 1 s of 5 N m: 0.5 rad, 0.0 rad/s
limit velocity 1 rad/s | step 0.0 s | after 1 s of 5 N m: 25.0 rad, 50.0 rad/s
limit velocity 1 rad/s | step 0.001 s | after 1 s of 5 N m: 25.0 rad, 50.0 rad/s
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check drake==1.51.1
now=$(
    venv/bin/python - <<'PROGRAM'
from pydrake.all import MultibodyPlant, Parser, Simulator

ROBOT = """<robot name="r"><link name="base"/><link name="arm"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>LIMIT</joint>
<transmission name="t"><type>transmission_interface/SimpleTransmission</type>
<joint name="j"><hardwareInterface>EffortJointInterface</hardwareInterface></joint><actuator name="m"/></transmission></robot>"""


def moved(step, lower, upper, effort, velocity):
    limit = f'<limit lower="{lower}" upper="{upper}" effort="{effort}" velocity="{velocity}"/>'
    plant = MultibodyPlant(step)
    Parser(plant).AddModelsFromString(ROBOT.replace("LIMIT", limit), "urdf")
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    simulator = Simulator(plant)
    context = simulator.get_mutable_context()
    plant.get_actuation_input_port().FixValue(context, [5.0])
    simulator.AdvanceTo(1.0)
    return plant.GetPositionsAndVelocities(context)


for name, limits in (
    ("none reached", (-100, 100, 1000, 1000)),
    ("effort 1 N m", (-100, 100, 1, 1000)),
    ("position 0.5 rad", (-0.5, 0.5, 1000, 1000)),
    ("velocity 1 rad/s", (-100, 100, 1000, 1)),
):
    for step in (0.0, 0.001):
        q, v = moved(step, *limits)
        print(f"limit {name} | step {step} s | after 1 s of 5 N m: {q:.1f} rad, {abs(v):.1f} rad/s")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
