#!/usr/bin/env bash
# CasADi's fmin and fmax of 0.0 and -0.0 differ between its virtual machine and the C that it generates.
#
# Versions: casadi 3.8.2, gcc 12.2 -O2 -ffp-contract=off. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a Function and the C generated from it give the same bits for + - * / fmin fmax.
# Behaviour: of two zeros the virtual machine returns the first argument, the generated C the second one, for fmin and
# fmax alike. Both are allowed by C's fmin, but 1/x, atan2 and copysign then part by sign: the last column is 1/fmin.
# For a repeatable run: whether a compiler was found can decide a sign.
#
# Output seen:
seen=$(
    cat <<'SEEN'
machine   0.0  -0.0  0.0 0.0 inf
C         0.0  -0.0  -0.0 -0.0 -inf
machine  -0.0   0.0  -0.0 -0.0 -inf
C        -0.0   0.0  0.0 0.0 inf
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check casadi==3.8.2
now=$(
    venv/bin/python - <<'PROGRAM'
import subprocess

import casadi as ca

x, y = ca.SX.sym("x"), ca.SX.sym("y")
f = ca.Function("f", [x, y], [ca.fmin(x, y), ca.fmax(x, y), 1 / ca.fmin(x, y)])
f.generate("f.c")
subprocess.run(["gcc", "-O2", "-ffp-contract=off", "-shared", "-fPIC", "f.c", "-o", "f.so", "-lm"], check=True)
g = ca.external("f", "./f.so")
for a, b in ((0.0, -0.0), (-0.0, 0.0)):
    for name, h in (("machine", f), ("C", g)):
        print(f"{name:8}{a:5} {b:5} ", *(float(v) for v in h(a, b)))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
