#!/usr/bin/env bash
# numba's np.sum and np.mean of a long float32 array are wrong by 5 %, numpy's by 1e-7.
#
# Versions: numba 0.68.1, numpy 2.4.6. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a compiled function gives what numpy gives, but for the last bits.
# Behaviour: numpy adds pairwise; numba adds one number after the other in float32, so a sum stops growing once it is 2**24
# times as large as what is added, and loses digits long before. It returns the result as a Python float, that is with the type
# of a double. A mean current over 20 million samples of a float32 record is 0.105 A where each sample is 0.1 A, and the
# standard deviation of a constant is 0.005 A. Convert with astype(float64) first.
#
# Output seen:
seen=$(
    cat <<'SEEN'
float32: numba sum 2097152.00, mean 0.104858, deviation 4.9e-03; numpy sum 2000000.25, mean 0.100000
float64: numba sum 2000000.03, mean 0.100000, deviation 0.0e+00; numpy sum 2000000.03, mean 0.100000
type of the compiled sum of float32: float
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


@numba.njit
def compiled(x):
    return np.sum(x), np.mean(x), np.std(x)


x = np.full(20_000_000, 0.1, np.float32)
for name, y in (("float32", x), ("float64", x.astype(np.float64))):
    sums = compiled(y)
    print(f"{name}: numba sum {sums[0]:.2f}, mean {sums[1]:.6f}, deviation {sums[2]:.1e}", end="; ")
    print(f"numpy sum {y.sum():.2f}, mean {y.mean():.6f}")
print("type of the compiled sum of float32:", type(compiled(x)[0]).__name__)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
