#!/usr/bin/env bash
# numba's round(x, n) is another number than CPython's for one in 24 decimals of three digits.
#
# Versions: numba 0.68.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a compiled function rounds as the interpreter does, to the nearest double of n decimals.
# Behaviour: CPython rounds the exact value of the double; numba multiplies by 10**n, rounds, and divides, as np.round does, so
# 2.675 (which lies below) becomes 2.68 where CPython says 2.67. With NUMBA_DISABLE_JIT=1, the usual way to debug, the same
# source then takes other branches: a quantiser, a look-up by a rounded key. round(x) without digits agrees.
#
# Output seen:
seen=$(
    cat <<'SEEN'
round(2.675, 2): CPython 2.67 numba 2.68 numpy 2.68
round(0.15, 1): CPython 0.1 numba 0.2
of 9999 decimals with three digits differ 412
of 9999 halves without digits differ 0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check numba==0.68.1 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import numba
import numpy as np

rounded = numba.njit(lambda x, n: round(x, n))
whole = numba.njit(lambda x: round(x))
print("round(2.675, 2): CPython", round(2.675, 2), "numba", rounded(2.675, 2), "numpy", np.round(2.675, 2))
print("round(0.15, 1): CPython", round(0.15, 1), "numba", rounded(0.15, 1))
values = [k / 1000 for k in range(1, 10_000)]
print("of 9999 decimals with three digits differ", sum(rounded(v, 2) != round(v, 2) for v in values))
print("of 9999 halves without digits differ", sum(whole(k + 0.5) != round(k + 0.5) for k in range(9_999)))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
