#!/usr/bin/env bash
# rosbags reads std_msgs/Byte as signed, mcap-ros2-support reads std_msgs/Char as signed: each is right where the other is wrong.
#
# Versions: rosbags 0.11.9, mcap-ros2-support 0.6.0. Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: byte and char of ROS 2 messages are both octets from 0 to 255 (their IDL: octet and uint8), in any reader.
# Behaviour: of the octet 200 rosbags makes -56 for `byte` (200 for `char`), mcap-ros2-support -56 for `char` (200 for `byte`).
# rclpy gives b'\xc8' and 200. ByteMultiArray alike: an array of int8 in rosbags.
# For a comparison of two tools' exports of one bag: status bytes above 127 differ by 256.
#
# Output seen:
seen=$(
    cat <<'SEEN'
byte: rosbags -56, mcap-ros2-support 200
char: rosbags 200, mcap-ros2-support -56
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check rosbags==0.11.9 mcap-ros2-support==0.6.0
now=$(
    venv/bin/python - <<'PROGRAM'
from mcap_ros2._dynamic import generate_dynamic
from rosbags.typesys import Stores, get_typestore

store = get_typestore(Stores.ROS2_JAZZY)
octet = bytes([0, 1, 0, 0, 200])  # CDR, little endian, one octet
for name, word in (("Byte", "byte"), ("Char", "char")):
    type_name = f"std_msgs/msg/{name}"
    other = generate_dynamic(type_name, f"{word} data")[type_name](octet)
    print(f"{word}: rosbags {int(store.deserialize_cdr(octet, type_name).data)}, mcap-ros2-support {other.data}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
