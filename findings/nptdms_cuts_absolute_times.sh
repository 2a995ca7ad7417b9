#!/usr/bin/env bash
# npTDMS cuts the absolute times of a channel to whole units: of 2,000 samples at 10 kHz one comes a microsecond early.
#
# Versions: npTDMS 1.13.0, numpy 2.4.6. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: time_track(absolute_time=True, accuracy="us") of an increment of 0.1 ms gives stamps exactly 100 us apart.
# Behaviour: the relative time in seconds is multiplied by 1e6 and cut, not rounded. Where the product falls below the whole
# number by one unit of the last place, the stamp is 1 us early: steps of 99 and 101 us. With "ns" it is 1 ns; the times in
# seconds are right. A join of two files on equal stamps drops such samples. Round the relative times instead.
#
# Output seen:
seen=$(
    cat <<'SEEN'
us: steps {99: 1, 100: 1997, 101: 1}, other steps behind samples [1290, 1291]
ns: steps {99999: 1, 100000: 1997, 100001: 1}, other steps behind samples [1290, 1291]
relative times within 1e-15 s of k / 10000: True
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check npTDMS==1.13.0 numpy==2.4.6
now=$(
    venv/bin/python - <<'PROGRAM'
import numpy as np
from nptdms import ChannelObject, TdmsFile, TdmsWriter

about = {"wf_increment": 1e-4, "wf_start_offset": 0.0, "wf_start_time": np.datetime64("2026-01-01T00:00:00")}
with TdmsWriter("run.tdms") as file:
    file.write_segment([ChannelObject("drive", "current", np.zeros(2000), properties=about)])
channel = TdmsFile.read("run.tdms")["drive"]["current"]
for accuracy in ("us", "ns"):
    stamps = channel.time_track(absolute_time=True, accuracy=accuracy)
    steps, counts = np.unique(np.diff(stamps).astype(int), return_counts=True)
    late = np.flatnonzero(np.diff(stamps).astype(int) != steps[1])
    print(f"{accuracy}: steps {dict(zip(steps.tolist(), counts.tolist()))}, other steps behind samples {late.tolist()}")
print("relative times within 1e-15 s of k / 10000:", bool(np.all(np.abs(channel.time_track() - np.arange(2000) / 10000) < 1e-15)))
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
