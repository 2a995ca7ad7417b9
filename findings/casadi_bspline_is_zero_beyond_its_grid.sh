#!/usr/bin/env bash
# casadi.interpolant: beyond the grid 'linear' extrapolates and 'bspline' is 0, without a word.
#
# Versions: casadi 3.8.2, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: both kinds do the same beyond the grid: they hold the last value, or extrapolate, or raise.
# Behaviour: 'linear' goes on with the slope of the last interval. 'bspline' and its derivative drop to 0 right behind the last
# point, below the first one, too. A flux map of a motor whose current exceeds the table by 1 per mille has no flux and no
# inductance there: the model's current jumps, and an optimiser sees a cliff. Clip the argument, or widen the table.
#
# Output seen:
seen=$(
    cat <<'SEEN'
linear   i =  -0.015 A: flux -0.00150 Vs, inductance  0.10000 H
linear   i =  14.985 A: flux  0.89970 Vs, inductance  0.02000 H
linear   i =  15.015 A: flux  0.90030 Vs, inductance  0.02000 H
linear   i =  20.000 A: flux  1.00000 Vs, inductance  0.02000 H
bspline  i =  -0.015 A: flux  0.00000 Vs, inductance  0.00000 H
bspline  i =  14.985 A: flux  0.90000 Vs, inductance  0.00012 H
bspline  i =  15.015 A: flux  0.00000 Vs, inductance  0.00000 H
bspline  i =  20.000 A: flux  0.00000 Vs, inductance  0.00000 H
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check casadi==3.8.2 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import casadi as ca

grid, flux = [0.0, 5.0, 10.0, 15.0], [0.0, 0.5, 0.8, 0.9]
x = ca.MX.sym("x")
for kind in ("linear", "bspline"):
    table = ca.interpolant("flux", kind, [grid], flux)
    both = ca.Function("both", [x], [table(x), ca.jacobian(table(x), x)])
    for current in (-0.015, 14.985, 15.015, 20.0):
        value, slope = map(float, both(current))
        print(f"{kind:8} i = {current:7.3f} A: flux {value + 0.0:8.5f} Vs, inductance {slope + 0.0:8.5f} H")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
