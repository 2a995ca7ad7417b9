#!/usr/bin/env bash
# scipy.io.loadmat returns a MATLAB logical as uint8: `~` inverts its bits, and as an index it selects rows 0 and 1.
#
# Versions: scipy 1.17.1, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a bool array that savemat writes, or a logical from MATLAB or Simulink, comes back as a bool array.
# Behaviour: the file says logical (MATLAB reads it as such), loadmat drops that mark. `~on` is 254 and 255, which are all true,
# so a mask and its opposite select the same samples, or raise; `x[on]` picks x[1] and x[0] again and again in place of the
# samples where the drive was on, so the mean current below is wrong without an error. Convert with astype(bool).
#
# Output seen:
seen=$(
    cat <<'SEEN'
type uint8 inverse [255 254 254 255]
current where on: [0. 5. 5. 0.] mean 2.5
with astype(bool): [5. 7.] mean 6.0
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
import io

import numpy as np
from scipy.io import loadmat, savemat

file = io.BytesIO()
savemat(file, {"on": np.array([False, True, True, False]), "current": np.array([0.0, 5.0, 7.0, 0.5])})
read = loadmat(file, squeeze_me=True)
on, current = read["on"], read["current"]
print("type", on.dtype, "inverse", ~on)
print("current where on:", current[on], "mean", current[on].mean())
print("with astype(bool):", current[on.astype(bool)], "mean", current[on.astype(bool)].mean())
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
