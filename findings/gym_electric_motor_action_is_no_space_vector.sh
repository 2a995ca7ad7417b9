#!/usr/bin/env bash
# gym-electric-motor: action k of a finite B6 bridge is the binary number of the legs with phase a first, no space vector.
#
# Versions: gym-electric-motor 3.0.3, gymnasium and numpy as pip chooses. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: action 1 is the first active vector (100, phase a high) and 1 to 6 go round the hexagon, as tables of direct torque
# and predictive control number them.
# Behaviour: action 1 raises phase c, action 4 phase a; 1, 2, 3 lie at 240, 120 and 180 degrees. A switching table that is
# fed unchanged turns the field in another order, and a drive still moves.
#
# Output seen:
seen=$(
    cat <<'SEEN'
0 [-0.5, -0.5, -0.5] zero
1 [-0.5, -0.5, 0.5] 240 degrees
2 [-0.5, 0.5, -0.5] 120 degrees
3 [-0.5, 0.5, 0.5] 180 degrees
4 [0.5, -0.5, -0.5] 0 degrees
5 [0.5, -0.5, 0.5] 300 degrees
6 [0.5, 0.5, -0.5] 60 degrees
7 [0.5, 0.5, 0.5] zero
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check gym-electric-motor==3.0.3
now=$(
    venv/bin/python - <<'PROGRAM'
import warnings

warnings.simplefilter("ignore")
import cmath
import math

import gym_electric_motor as gem

converter = gem.make("Finite-CC-PMSM-v0").unwrapped.physical_system.converter
for action in range(8):
    converter.reset()
    converter.set_action(action, 0.0)
    legs = [float(one) for one in converter.convert([0.0, 0.0, 0.0], 1e-5)]
    vector = sum(leg * cmath.exp(2j * math.pi * k / 3) for k, leg in enumerate(legs))
    angle = f"{round(math.degrees(cmath.phase(vector))) % 360} degrees" if abs(vector) > 1e-9 else "zero"
    print(action, legs, angle)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
