#!/usr/bin/env bash
# canmatrix writes a floating-point signal of a DBC into a SYM file as a signed integer.
#
# Versions: canmatrix 1.3.3, lxml 6.1.3. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: a DBC that is converted decodes the same bytes to the same values, or the conversion says what it cannot.
# Behaviour: SIG_VALTYPE_ is known while the DBC is read and lost in PEAK's SYM (whose word for it is "float"): -2.5 rad/s is
# read as -1071644672. No warning. Converted to KCD the value stays, and the free range of the signal becomes 0 to
# 4294967295 when canmatrix reads it back.
#
# Output seen:
seen=$(
    cat <<'SEEN'
dbc: {'speed': -2.5, 'current': 3.21}, float True, range 0 to 0
kcd: {'speed': -2.5, 'current': 3.21}, float True, range 0 to 4294967295
sym: {'speed': -1071644672.0, 'current': 3.21}, float False, range 0 to 0
['Var=speed signed 0,32 /u:rad/s /min:0 /max:0 /d:0']
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check canmatrix==1.3.3 lxml==6.1.3
now=$(
    venv/bin/python - <<'PROGRAM'
import struct

import canmatrix.formats

DBC = '''VERSION ""
NS_ :
BS_:
BU_: drive
BO_ 256 shaft: 6 drive
 SG_ speed : 0|32@1- (1,0) [0|0] "rad/s" Vector__XXX
 SG_ current : 32|16@1- (0.01,0) [-100|100] "A" Vector__XXX
SIG_VALTYPE_ 256 speed : 1;
'''
with open("drive.dbc", "w") as file:
    file.write(DBC)
matrix = canmatrix.formats.loadp_flat("drive.dbc")
for form in ("dbc", "kcd", "sym"):
    canmatrix.formats.dumpp({"": matrix}, f"again.{form}")
    frame = canmatrix.formats.loadp_flat(f"again.{form}").frame_by_name("shaft")
    values = {name: float(one.phys_value) for name, one in frame.decode(struct.pack("<fh", -2.5, 321)).items()}
    speed = frame.signal_by_name("speed")
    print(f"{form}: {values}, float {speed.is_float}, range {speed.min} to {speed.max}")
print([line.strip() for line in open("again.sym") if "Var=speed" in line])
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
