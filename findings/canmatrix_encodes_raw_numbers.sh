#!/usr/bin/env bash
# canmatrix's Frame.encode takes raw numbers and cuts them, where cantools takes values with their unit and rounds.
#
# Versions: canmatrix 1.3.3, cantools 45.1.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: both encode a value in the unit of the DBC: 2.3 V with a factor of 0.1 is the raw number 23.
# Behaviour: canmatrix writes a whole raw number: 2.3 becomes 2, that is 0.2 V on the bus, and -0.25 becomes -1 (floor); no
# warning. Its Signal.phys2raw scales and rounds, and encode does not call it. decode returns an object with raw and scaled
# value, so that what encode was given does not come back.
#
# Output seen:
seen=$(
    cat <<'SEEN'
value  cantools        canmatrix       phys2raw  decoded by canmatrix
  2.3   23 =   2.3 V     2 =   0.2 V        23  raw 2, scaled 0.2
 1.26   13 =   1.3 V     1 =   0.1 V        13  raw 1, scaled 0.1
-0.25   -2 =  -0.2 V    -1 =  -0.1 V        -2  raw -1, scaled -0.1
 23.0  230 =  23.0 V    23 =   2.3 V       230  raw 23, scaled 2.3
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check canmatrix==1.3.3 cantools==45.1.0 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
from pathlib import Path

import canmatrix.formats
import cantools

DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 1 M: 2 A
 SG_ u : 0|16@1- (0.1,0) [-3276.8|3276.7] "V" A
"""
Path("m.dbc").write_text(DBC)
one = cantools.database.load_file("m.dbc")
other = canmatrix.formats.loadp("m.dbc")[""].frame_by_name("M")
print("value  cantools        canmatrix       phys2raw  decoded by canmatrix")
for value in (2.3, 1.26, -0.25, 23.0):
    a, b = one.encode_message("M", {"u": value}), bytes(other.encode({"u": value}))
    raw = [int.from_bytes(data, "little", signed=True) for data in (a, b)]
    decoded = other.decode(b)["u"]
    print(f"{value:5} {raw[0]:4} = {one.decode_message('M', a)['u']:5.1f} V  {raw[1]:4} = {one.decode_message('M', b)['u']:5.1f} V ",
          f"{other.signals[0].phys2raw(value):8}  raw {decoded.raw_value}, scaled {decoded.phys_value}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
