#!/usr/bin/env bash
# The Python package comtrade gives sample times in single precision: samples of a long record share one time.
#
# Versions: comtrade 0.2.0. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: Comtrade.time holds k / rate as a Python float, so differences of neighbours are the sampling interval.
# Behaviour: times are an array of 32-bit floats unless use_double_precision=True is given. In a record of 250 s at 20 kHz the
# interval of 50 us comes out as 45.8 or 61.0 us after 200 s, and at 100 kHz neighbours are equal.
# For a fault locator, where a microsecond is 150 m of line: ask for double precision.
#
# Output seen:
seen=$(
    cat <<'SEEN'
default: last intervals, us: 45.8 61.0
use_double_precision=True: last intervals, us: 50.0
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check comtrade==0.2.0
now=$(
    venv/bin/python - <<'PROGRAM'
import struct
from pathlib import Path

import comtrade

SAMPLES = 5_000_000
Path("r.cfg").write_text(
    "S,D,2013\n1,1A,0D\n1,UA,A,,V,0.01,0,0,-32767,32767,100,0.1,S\n50\n1\n"
    f"20000,{SAMPLES}\n01/01/2020,00:00:00.000000\n01/01/2020,00:00:00.000000\nBINARY\n1\n0,0\n0,0\n"
)
with Path("r.dat").open("wb") as data:
    for k in range(SAMPLES):
        data.write(struct.pack("<iih", k + 1, 0, 0))
for name, options in (("default", {}), ("use_double_precision=True", {"use_double_precision": True})):
    record = comtrade.Comtrade(**options)
    record.load("r.cfg", "r.dat")
    last = list(record.time)[-1000:]
    steps = sorted({f"{1e6 * (b - a):.1f}" for a, b in zip(last, last[1:])})
    print(f"{name}: last intervals, us:", *steps)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
