#!/usr/bin/env bash
# rosbags: a bag is one nanosecond longer than its metadata says, and the time of the last message as a limit leaves it out.
#
# Versions: rosbags 0.11.9. Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: Reader.duration is the number that metadata.yaml and ros2 bag info have, and messages(stop=...) includes it.
# Behaviour: end_time is the last time + 1 and duration 201 where the metadata has 200, in sqlite3, MCAP and ROS 1 bags: the
# intervals are half open. messages(stop=last) omits all messages of this time; messages(stop=reader.end_time) has
# them. A cut by times taken from messages loses the last sample.
#
# Output seen:
seen=$(
    cat <<'SEEN'
SQLITE3 ['nanoseconds: 200'] duration 201 end 301 up to 300: [100, 200]
MCAP ['nanoseconds: 200'] duration 201 end 301 up to 300: [100, 200]
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check rosbags==0.11.9
now=$(
    venv/bin/python - <<'PROGRAM'
from pathlib import Path

from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
Float64 = store.types["std_msgs/msg/Float64"]
for plugin in StoragePlugin:
    folder = Path(plugin.name)
    with Writer(folder, version=9, storage_plugin=plugin) as writer:
        speed = writer.add_connection("/speed", Float64.__msgtype__, typestore=store)
        for time in (100, 200, 300):
            writer.write(speed, time, store.serialize_cdr(Float64(1.0), Float64.__msgtype__))
    written = [line.strip() for line in (folder / "metadata.yaml").read_text().splitlines() if "nanoseconds:" in line][:1]
    with Reader(folder) as reader:
        to_last = [time for _, time, _ in reader.messages(stop=300)]
        print(plugin.name, written, "duration", reader.duration, "end", reader.end_time, "up to 300:", to_last)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
