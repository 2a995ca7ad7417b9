#!/usr/bin/env bash
# rosbags' get_types_from_idl refuses the .idl files that ROS 2 itself installs.
#
# Versions: rosbags 0.11.9, ros-sensor-msgs 5.3.6 (share/sensor_msgs/msg/JointState.idl). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the text of an installed .idl file, which rosbag2 also stores in a bag as "ros2idl", can be registered.
# Behaviour: TypesysError "Could not parse", because the grammar knows no #include; without these lines the file is read.
# For a reader of bags with definitions in IDL: remove the lines that begin with #include before parsing.
#
# Output seen:
seen=$(
    cat <<'SEEN'
as installed: TypesysError
without #include: ['sensor_msgs/msg/JointState']
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check rosbags==0.11.9
venv/bin/pip install --quiet --no-compile --no-deps --disable-pip-version-check ros-sensor-msgs==5.3.6
now=$(
    venv/bin/python - <<'PROGRAM'
from pathlib import Path

from rosbags.typesys import get_types_from_idl

text = Path("venv/share/sensor_msgs/msg/JointState.idl").read_text()
plain = "\n".join(line for line in text.splitlines() if not line.startswith("#include"))
for name, idl in (("as installed", text), ("without #include", plain)):
    try:
        print(f"{name}:", list(get_types_from_idl(idl)))
    except Exception as error:
        print(f"{name}:", type(error).__name__)
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
