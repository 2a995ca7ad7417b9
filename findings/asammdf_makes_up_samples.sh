#!/usr/bin/env bash
# asammdf's to_dataframe fills other channels' instants with interpolated values, and values before the first sample.
#
# Versions: asammdf 8.8.28. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: a table of groups with different rasters has empty cells (NaN) where a channel has no sample.
# Behaviour: channels of floats are interpolated linearly, integers held, and before a channel's first sample its first value is
# repeated backwards, after its last one it is held, without a mark: of the 21 cells below 11 were never measured. Exports
# with a single time base do the same. A boolean comes back as 0 and 1.
# For a comparison of recordings: differences and crossings between samples are the tool's, not the drive's.
#
# Output seen:
seen=$(
    cat <<'SEEN'
table:
            voltage  count  enabled
timestamps                         
0.0             0.0      1        1
0.2             2.0      1        1
0.5             5.0      2        1
0.7             7.0      2        0
1.0            10.0      3        0
1.5            15.0      4        0
2.0            20.0      5        0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check asammdf==8.8.28
now=$(
    venv/bin/python - <<'PROGRAM'
import numpy as np
from asammdf import MDF, Signal

with MDF() as mdf:
    mdf.append(Signal(np.array([0.0, 10.0, 20.0]), np.array([0.0, 1.0, 2.0]), name="voltage"))
    mdf.append(Signal(np.array([1, 2, 3, 4, 5], dtype=np.int16), np.array([0.0, 0.5, 1.0, 1.5, 2.0]), name="count"))
    mdf.append(Signal(np.array([True, False]), np.array([0.2, 0.7]), name="enabled"))
    mdf.save("x.mf4", overwrite=True)
with MDF("x.mf4") as mdf:
    print("table:", mdf.to_dataframe().to_string(), sep="\n")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
