#!/usr/bin/env bash
# Of python-can's log formats, ASC loses the date and CSV and SQLite lose who sent and on which channel, by the library's own reader.
#
# Versions: python-can 4.6.1. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: can.Logger and can.LogReader of one library bring back what was logged: time, channel, direction.
# Behaviour (three messages, the second one sent, channel 0, stamps around 1764326400.123456 s):
#  ASC   stamps come back from zero although the file's head has the date (the reader drops it unless relative_timestamp=False)
#  CSV   the sent message comes back as received, the channel as None; SQLite (.db) the same
#  TRC   the channel comes back as 1; log (candump): as the text can0
#  ASC, TRC, log keep microseconds; BLF, CSV, SQLite about 0.1 us
# For a CAN recording beside a bag: only BLF keeps all of them.
#
# Output seen:
seen=$(
    cat <<'SEEN'
blf   date kept, offsets in us [0, 124, 247] received [True, False, True] channel 0
asc   date lost, offsets in us [0, 124, 247] received [True, False, True] channel 0
trc   date kept, offsets in us [0, 124, 247] received [True, False, True] channel 1
csv   date kept, offsets in us [0, 124, 247] received [True, True, True] channel None
db    date kept, offsets in us [0, 124, 247] received [True, True, True] channel None
log   date kept, offsets in us [0, 124, 247] received [True, False, True] channel 'can0'
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check python-can==4.6.1
now=$(
    venv/bin/python - <<'PROGRAM'
import can

START = 1764326400.123456
for ending in ("blf", "asc", "trc", "csv", "db", "log"):
    writer = can.Logger("x." + ending)
    for i in range(3):
        writer(can.Message(timestamp=START + i * 0.0001234, arbitration_id=5 + i, is_extended_id=False, data=[i], channel=0, is_rx=i != 1))
    writer.stop()
    read = list(can.LogReader("x." + ending))
    base = START if read[0].timestamp > 1 else 0.0
    print(f"{ending:5} date {'kept' if base else 'lost'}, offsets in us", [round((m.timestamp - base) * 1e6) for m in read],
          "received", [m.is_rx for m in read], "channel", repr(read[0].channel))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
