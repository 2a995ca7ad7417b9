#!/usr/bin/env bash
# cantools reads DBC signals that are marked m0 and m1 in a message without a multiplexer as signals that are always there.
#
# Versions: cantools 45.1.0. Date: 2026-11-28, CPython 3.11, Debian 12.
# Usual guess: the file is refused, as `m0` says "only while the multiplexer is 0" and no signal of the message is marked `M`.
# Behaviour: load_string accepts it without a warning: the message is not multiplexed, every frame decodes to all signals, and the
# file that cantools writes has lost the marks. If somebody deletes the one letter M of a DBC, a receiver takes whatever
# lies at a place for both signals. (If the two share bits, loading fails, with the word "overlapping".)
#
# Output seen:
seen=$(
    cat <<'SEEN'
mode marked M - multiplexed: True, mode 1 decodes to {'mode': 1, 'current': 3}
mode without mark - multiplexed: False, mode 1 decodes to {'mode': 1, 'voltage': 2, 'current': 3}
written again: ['SG_ current : 24|16', 'SG_ voltage : 8|16', 'SG_ mode : 0|8']
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check cantools==45.1.0
now=$(
    venv/bin/python - <<'PROGRAM'
import cantools

TEXT = '''VERSION ""
NS_ :
BS_:
BU_: drive
BO_ 100 measured: 8 drive
 SG_ mode {}: 0|8@1+ (1,0) [0|0] "" drive
 SG_ voltage m0 : 8|16@1- (1,0) [0|0] "V" drive
 SG_ current m1 : 24|16@1- (1,0) [0|0] "A" drive
'''
for mark in ("M ", ""):
    database = cantools.database.load_string(TEXT.format(mark), "dbc")
    message = database.get_message_by_name("measured")
    print("mode", "marked M" if mark else "without mark", "- multiplexed:", message.is_multiplexed(), end=", ")
    print("mode 1 decodes to", message.decode(bytes((1, 2, 0, 3, 0, 0, 0, 0))))
written = [line.split("@")[0].strip() for line in database.as_dbc_string().splitlines() if line.startswith(" SG_")]
print("written again:", written)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
