#!/usr/bin/env bash
# After mj_step MuJoCo's sensor data and body poses belong to the state before the step, qpos and time to the one after.
#
# Versions: mujoco 4.0.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: after mj_step everything in mjData belongs to one instant: a jointpos sensor equals qpos, the clock sensor
# equals time.
# Behaviour: sensors, poses and contacts are computed from the state that the step starts from and are not computed again after
# the integration. A loop that reads sensordata after each step and logs it with data.time has a delay of one step more than
# the same loop with qpos; the first reading is 0. mj_forward after the step brings all to one instant.
# For a law on real topics: what a sensor node publishes after a step is stamped one step too late.
#
# Output seen:
seen=$(
    cat <<'SEEN'
mj_step   : time 0.01 qpos -0.001 qvel -0.1 height 0.000 | sensors: clock 0.00 position 0.000 velocity 0.0
mj_step   : time 0.02 qpos -0.003 qvel -0.2 height -0.001 | sensors: clock 0.01 position -0.001 velocity -0.1
mj_step   : time 0.03 qpos -0.006 qvel -0.3 height -0.003 | sensors: clock 0.02 position -0.003 velocity -0.2
mj_forward: time 0.03 qpos -0.006 qvel -0.3 height -0.006 | sensors: clock 0.03 position -0.006 velocity -0.3
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check mujoco==4.0.0 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import mujoco

MODEL = """<mujoco>
  <option gravity="0 0 -10" timestep="0.01"/>
  <worldbody><body name="b"><joint name="j" type="slide" axis="0 0 1"/><geom size="0.1" mass="1"/></body></worldbody>
  <sensor><jointpos joint="j"/><jointvel joint="j"/><clock/></sensor>
</mujoco>"""
model = mujoco.MjModel.from_xml_string(MODEL)
data = mujoco.MjData(model)


def line(when):
    position, velocity, clock = data.sensordata
    print(f"{when}: time {data.time:.2f} qpos {data.qpos[0]:.3f} qvel {data.qvel[0]:.1f} height {data.xpos[1, 2]:.3f}",
          f"| sensors: clock {clock:.2f} position {position:.3f} velocity {velocity:.1f}")


for _ in range(3):
    mujoco.mj_step(model, data)
    line("mj_step   ")
mujoco.mj_forward(model, data)
line("mj_forward")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
