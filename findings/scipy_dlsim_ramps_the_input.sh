#!/usr/bin/env bash
# scipy.signal.dlsim with t ramps the input between its points: a digital system sees values that nobody commanded.
#
# Versions: scipy 1.17.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: the input of a sampled system is held until the next value, as a D/A converter does.
# Behaviour: where t is coarser than the system's period the input is interpolated linearly. A step of 1 V given at 0.2 s
# grain reaches a system of 0.1 s period as 0, 0.5, 1, so the answer to a step is that to a ramp, and its overshoot is
# smaller: 13.8 instead of 16.3 % below. Repeat the values (np.repeat) and leave t out.
#
# Output seen:
seen=$(
    cat <<'SEEN'
a delay of one period answers a step at 0.2 s: [0.  0.  0.5 1.  1. ]
overshoot with t: 13.8 %, values held: 16.3 %
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check scipy==1.17.1 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import numpy as np
from scipy.signal import cont2discrete, dlsim

delay = ([[0.0]], [[1.0]], [[1.0]], [[0.0]], 0.1)
_, y, _ = dlsim(delay, np.array([0.0, 1.0, 1.0]), t=np.array([0.0, 0.2, 0.4]))
print("a delay of one period answers a step at 0.2 s:", y.ravel())
wn, zeta = 4.0, 0.5  # overshoot exp(-pi zeta/sqrt(1 - zeta^2)) = 16.3 %
A, B = np.array([[0.0, 1.0], [-wn**2, -2 * zeta * wn]]), np.array([[0.0], [wn**2]])
system = cont2discrete((A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1))), 0.01)
coarse = np.arange(0.0, 6.01, 0.5)
step = (coarse >= 0.5) * 1.0
ramped = dlsim(system, step, t=coarse)[1]
held = dlsim(system, np.repeat(step, 50))[1]
print(f"overshoot with t: {100 * (ramped.max() - 1):.1f} %, values held: {100 * (held.max() - 1):.1f} %")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
