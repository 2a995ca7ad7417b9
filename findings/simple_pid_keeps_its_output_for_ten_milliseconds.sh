#!/usr/bin/env bash
# simple-pid computes nothing while the dt it is given is below its sample_time of 10 ms: a loop at 1 kHz keeps its first output.
#
# Versions: simple-pid 2.0.1. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a call with dt computes an output; sample_time is a limit for loops that run by the wall clock.
# Behaviour: dt is compared with sample_time (0.01 s by default) and is not added up from call to call, so with dt = 1 ms every
# call after the first returns the first output, without a warning, however far the measured value goes. With sample_time=None
# or dt it follows.
# For a comparison of controllers: a simulated loop faster than 100 Hz runs open, and its figures are those of a constant.
#
# Output seen:
seen=$(
    cat <<'SEEN'
as it is: [2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
{'sample_time': None} [2.0, 1.0, 0.0, -1.0, -2.0, -3.0, -4.0, -5.0]
{'sample_time': 0.001} [2.0, 1.0, 0.0, -1.0, -2.0, -3.0, -4.0, -5.0]
1,000 calls of 1 ms: {0.0}
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check simple-pid==2.0.1
now=$(
    venv/bin/python - <<'PROGRAM'
from simple_pid import PID

measured = [0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5]
for options in ({}, {"sample_time": None}, {"sample_time": 0.001}):
    pid = PID(2.0, 0.0, 0.0, setpoint=1.0, **options)
    print(options or "as it is:", [pid(y, dt=0.001) for y in measured])
pid = PID(2.0, 0.0, 0.0, setpoint=1.0)
print("1,000 calls of 1 ms:", {pid(1.0 + 0.01 * k, dt=0.001) for k in range(1000)})
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
