#!/usr/bin/env bash
# comtrade reads the mark of a missing sample in binary files and stops at the one of ASCII files.
#
# Versions: comtrade 0.2.0. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: IEEE C37.111-1999 marks a missing analog sample by an empty field in ASCII and by 8000 (hex) in binary files; a
# reader gives NaN for both.
# Behaviour: binary gives NaN; ASCII raises ValueError about a float of '', with neither file nor line, and the record cannot be
# read at all.
#
# Output seen:
seen=$(
    cat <<'SEEN'
BINARY [1.0, nan, 3.0]
ASCII ValueError: could not convert string to float: ''
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

import comtrade

CFG = '''station,device,1999
1,1A,0D
1,UA,A,,kV,0.01,0,0,-32767,32767,1,1,P
50
1
1000,3
01/01/2026,00:00:00.000000
01/01/2026,00:00:00.000000
%s
1
'''
DATA = {
    "BINARY": b"".join(struct.pack("<IIh", k + 1, 1000 * k, value) for k, value in enumerate((100, -32768, 300))),
    "ASCII": b"1,0,100\r\n2,1000,\r\n3,2000,300\r\n",
}
for form, data in DATA.items():
    with open("record.cfg", "w") as file:
        file.write(CFG % form)
    with open("record.dat", "wb") as file:
        file.write(data)
    record = comtrade.Comtrade()
    try:
        record.load("record.cfg", "record.dat")
        print(form, list(record.analog[0]))
    except ValueError as error:
        print(form, "ValueError:", error)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
