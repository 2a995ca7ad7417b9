#!/usr/bin/env bash
# numba's np.median of data with a NaN is a plain number, another one for each place of the NaN.
#
# Versions: numba 0.68.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: NaN, as numpy says, and as numba's own np.max, np.percentile and np.std say.
# Behaviour: the selection compares with NaN, which is always false, so what counts as the middle depends on where the NaN
# is. A median filter over samples of a sensor that dropped out once passes a number as if nothing had been lost, and sorting
# the same samples otherwise gives another one. np.percentile(x, 50) of numba is NaN. Check with np.isnan first.
#
# Output seen:
seen=$(
    cat <<'SEEN'
NaN at 0: numba 30.0, numpy nan, numba's 50 % nan
NaN at 1: numba 30.0, numpy nan, numba's 50 % nan
NaN at 2: numba nan, numpy nan, numba's 50 % nan
NaN at 3: numba nan, numpy nan, numba's 50 % nan
NaN at 4: numba 30.0, numpy nan, numba's 50 % nan
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

median = numba.njit(lambda x: np.median(x))
middle = numba.njit(lambda x: np.percentile(x, 50.0))
samples = [1.0, 2.0, 30.0, 40.0]
for place in range(5):
    x = np.array([*samples[:place], np.nan, *samples[place:]])
    print(f"NaN at {place}: numba {median(x)}, numpy {np.median(x)}, numba's 50 % {middle(x)}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
