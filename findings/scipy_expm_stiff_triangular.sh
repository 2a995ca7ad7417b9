#!/usr/bin/env bash
# scipy.linalg.expm of a stable lower triangular matrix with widely spread rates is right to six digits only.
#
# Versions: scipy 1.17.1, numpy 2.4.6, mpmath 1.4.1 (60 digits as reference). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the error is some 1e-15 of the largest entry, as for other small matrices; triangular ones are the easy case.
# Behaviour: for order 20, rates from 1e-12 to 1e2 1/s and couplings of order one, the largest error is 3e-6 of the largest
# entry; transposed it is the same. Twenty-five terms of the Taylor series with ten squarings are right to 3e-14 for that matrix.
# For a sampled plant (a chain of slow and fast stages): hold the result against more digits, or against another method.
#
# Output seen:
seen=$(
    cat <<'SEEN'
lower triangular: error above 1e-7 of the largest entry: True
Taylor series with ten squarings: error below 1e-12: True
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check scipy==1.17.1 numpy==2.4.6 mpmath==1.4.1
now=$(
    venv/bin/python - <<'PROGRAM'
import mpmath
import numpy as np
from scipy.linalg import expm

mpmath.mp.dps = 60
draw = np.random.default_rng(0)
for n in (5,) * 5 + (10,) * 5 + (20,):  # the eleventh draw of this stream
    matrix = np.diag(-(10 ** draw.uniform(-12, 2, n))) + np.tril(draw.normal(size=(n, n)), -1)
right = np.array(mpmath.expm(mpmath.matrix(matrix.tolist())).tolist(), dtype=float)


def error(result):
    return abs(result - right).max() / abs(right).max()


print("lower triangular: error above 1e-7 of the largest entry:", error(expm(matrix)) > 1e-7)
scaled, series, term = matrix / 2**10, np.eye(20), np.eye(20)
for k in range(1, 25):
    term = term @ scaled / k
    series = series + term
for _ in range(10):
    series = series @ series
print("Taylor series with ten squarings: error below 1e-12:", error(series) < 1e-12)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
