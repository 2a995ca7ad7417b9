#!/usr/bin/env bash
# scipy.optimize.linprog and milp return an "optimal" point that violates a constraint twentyfold, when a coefficient is small.
#
# Versions: scipy 1.17.1 (HiGHS inside). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: status 0 means that A_ub x <= b_ub holds within a tolerance, in whatever units the model is written.
# Behaviour: HiGHS sets coefficients of the matrix below 1e-9 to zero (its option small_matrix_value). scipy passes neither the
# option nor the warning on: the result has status 0, success True, and slack 0, and the row's left side is 105 for 5.
# For converters and dispatch: farads, henries and per-unit costs in SI units are of that size; scale rows first.
#
# Output seen:
seen=$(
    cat <<'SEEN'
linprog | status 0 | x [1.e+12 5.e+00] | left side 105.0 of at most 5
milp | status 0 | x [1.e+12 5.e+00] | left side 105.0 of at most 5
linprog, scaled by 1e10 | status 0 | x [5.e+10 0.e+00] | left side 5.0 of at most 5
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check scipy==1.17.1
now=$(
    venv/bin/python - <<'PROGRAM'
import numpy as np
from scipy.optimize import Bounds, LinearConstraint, linprog, milp

row, limit, upper = np.array([[1e-10, 1.0]]), [5.0], [1e12, 10.0]
for name, result in (
    ("linprog", linprog([-1, -1], A_ub=row, b_ub=limit, bounds=[(0, u) for u in upper])),
    ("milp", milp([-1, -1], constraints=LinearConstraint(row, -np.inf, limit), bounds=Bounds([0, 0], upper))),
    ("linprog, scaled by 1e10", linprog([-1, -1], A_ub=row * 1e10, b_ub=[5e10], bounds=[(0, u) for u in upper])),
):
    print(name, "| status", result.status, "| x", result.x, "| left side", float(row[0] @ result.x), "of at most 5")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
