#!/usr/bin/env bash
# canmatrix writes the multiplexer of each signal to JSON and does not read it back: a frame decodes to signals it does not hold.
#
# Versions: canmatrix 1.3.3. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: dump to JSON with jsonExportAll and load gives the same matrix; the file does hold "multiplex" for each signal.
# Behaviour: after loading, is_multiplexed is False. A frame in mode 0 (a voltage) is decoded to a voltage and to a current made of
# the same bytes, both finite and plausible. DBC to DBC keeps the multiplexer. Keep DBC as the source, or check
# frame.is_multiplexed after loading.
#
# Output seen:
seen=$(
    cat <<'SEEN'
multiplex in the file: 3
as loaded: multiplexed True, {'mode': 0.0, 'voltage': 400.0}
dbc: multiplexed True, {'mode': 0.0, 'voltage': 400.0}
json: multiplexed False, {'mode': 0.0, 'voltage': 400.0, 'current': 40.0}
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check canmatrix==1.3.3
now=$(
    venv/bin/python - <<'PROGRAM'
import io
import logging

import canmatrix.formats

logging.disable()
DBC = b"""VERSION ""
NS_ :
BS_:
BU_: DRIVE
BO_ 100 MEASURED: 8 DRIVE
 SG_ mode M : 0|8@1+ (1,0) [0|1] "" DRIVE
 SG_ voltage m0 : 8|16@1- (0.1,0) [-400|400] "V" DRIVE
 SG_ current m1 : 8|16@1- (0.01,0) [-40|40] "A" DRIVE
"""
matrix = canmatrix.formats.loads(DBC, import_type="dbc")[""]
frames = {"as loaded": matrix.frames[0]}
for kind, options in (("dbc", {}), ("json", {"jsonExportAll": True})):
    file = io.BytesIO()
    canmatrix.formats.dump(matrix, file, kind, **options)
    if kind == "json":
        print("multiplex in the file:", file.getvalue().count(b'"multiplex"'))
    (again,) = canmatrix.formats.loads(file.getvalue(), import_type=kind).values()
    frames[kind] = again.frames[0]
for name, frame in frames.items():
    values = {signal: float(value.phys_value) for signal, value in frame.decode(bytes([0, 0xA0, 0x0F, 0, 0, 0, 0, 0])).items()}
    print(f"{name}: multiplexed {frame.is_multiplexed}, {values}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
