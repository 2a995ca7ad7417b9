#!/usr/bin/env bash
# numba's x ** 3 differs from CPython's in the last bit for a quarter of all numbers, and from its own x ** n with n a variable.
#
# Versions: numba 0.68.1. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: compiled code without fastmath gives the bits of Python for + - * / and **.
# Behaviour: CPython calls pow of the C library; numba multiplies repeatedly for an integer exponent. x ** 2 and x ** -1 agree,
# x ** 3 differs in 521 of 2000 numbers drawn from (-3, 3), x ** 10 in 1591, each time by rounding alone.
# For bits that must be the same with and without the compiler: write x * x * x, or pow with a float.
#
# Output seen:
seen=$(
    cat <<'SEEN'
x ** -3: 684 of 2000 differ
x ** -1: 1 of 2000 differ
x ** 2: 2 of 2000 differ
x ** 3: 521 of 2000 differ
x ** 4: 1017 of 2000 differ
x ** 10: 1591 of 2000 differ
x * x * x: 0 differ
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check numba==0.68.1
now=$(
    venv/bin/python - <<'PROGRAM'
import numba
import numpy as np

drawn = np.random.default_rng(1).uniform(-3, 3, 2000)
for n in (-3, -1, 2, 3, 4, 10):
    power = numba.njit(lambda x, n=n: x**n)
    print(f"x ** {n}: {sum(power(x) != float(x) ** n for x in drawn)} of 2000 differ")
cube = numba.njit(lambda x: x * x * x)
print("x * x * x:", sum(cube(x) != float(x) * float(x) * float(x) for x in drawn), "differ")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
