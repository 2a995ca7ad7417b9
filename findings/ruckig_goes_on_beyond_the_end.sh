#!/usr/bin/env bash
# Ruckig's trajectory goes on beyond its duration, with its last acceleration and without its limits.
#
# Versions: ruckig 0.19.4. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: after the duration at_time gives the target, or raises.
# Behaviour: at_time(t) extrapolates from the target with the target's velocity and acceleration as constants: the position
# leaves the target, and with a target acceleration the velocity passes max_velocity (10 where 1 is allowed) and grows without
# end. A controller that asks with a clock that runs on a little gets a moving reference. Only a target at rest stays.
#
# Output seen:
seen=$(
    cat <<'SEEN'
target velocity 0.0, acceleration 0.0, duration 1.700 s
   0.0 s after the end: position   1.000, velocity  0.000 (at most 1), acceleration 0.000
   1.0 s after the end: position   1.000, velocity  0.000 (at most 1), acceleration 0.000
  10.0 s after the end: position   1.000, velocity  0.000 (at most 1), acceleration 0.000
target velocity 0.5, acceleration 0.0, duration 1.462 s
   0.0 s after the end: position   1.000, velocity  0.500 (at most 1), acceleration 0.000
   1.0 s after the end: position   1.500, velocity  0.500 (at most 1), acceleration 0.000
  10.0 s after the end: position   6.000, velocity  0.500 (at most 1), acceleration 0.000
target velocity 0.0, acceleration 1.0, duration 1.834 s
   0.0 s after the end: position   1.000, velocity  0.000 (at most 1), acceleration 1.000
   1.0 s after the end: position   1.500, velocity  1.000 (at most 1), acceleration 1.000
  10.0 s after the end: position  51.000, velocity 10.000 (at most 1), acceleration 1.000
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ruckig==0.19.4
now=$(
    venv/bin/python - <<'PROGRAM'
from ruckig import InputParameter, Ruckig, Trajectory

for velocity, acceleration in ((0.0, 0.0), (0.5, 0.0), (0.0, 1.0)):
    given = InputParameter(1)
    given.current_position, given.current_velocity, given.current_acceleration = [0.0], [0.0], [0.0]
    given.target_position, given.target_velocity, given.target_acceleration = [1.0], [velocity], [acceleration]
    given.max_velocity, given.max_acceleration, given.max_jerk = [1.0], [2.0], [10.0]
    trajectory = Trajectory(1)
    Ruckig(1).calculate(given, trajectory)
    print(f"target velocity {velocity}, acceleration {acceleration}, duration {trajectory.duration:.3f} s")
    for later in (0.0, 1.0, 10.0):
        (p,), (v,), (a,) = trajectory.at_time(trajectory.duration + later)
        print(f"  {later:4.1f} s after the end: position {p:7.3f}, velocity {v:6.3f} (at most 1), acceleration {a:.3f}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
