#!/usr/bin/env bash
# rclpy.time.Time(seconds=1.001) is 1000999999 ns: the product is cut, not rounded.
#
# Versions: ros-jazzy-rclpy 7.1.6 (wheels of PyPI). Date: 2026-11-28, CPython 3.11, Debian 12, x86-64.
# Usual guess: the nearest nanosecond, as a decimal number of milliseconds is a whole number of nanoseconds.
# Behaviour: Time and Duration take int(seconds * 1e9). Where the double lies below its decimal number the stamp is one
# nanosecond early: 271 of the first 10,000 whole milliseconds, among them every odd one from 1.001 s on for a while.
# Messages that one node stamps from a number of seconds and another from a number of ticks then differ in their stamps, and
# a filter for exactly equal times drops them. Use Time(nanoseconds=round(seconds * 1e9)).
#
# Output seen:
seen=$(
    cat <<'SEEN'
1.001 s is 1000999999 ns, -1000999999 ns as a negative duration
271 of the first 10000 milliseconds are another number of ns; the first: 1001 1003 1005 1007
by {-1} ns
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-jazzy-rclpy==7.1.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3
now=$(
    venv/bin/python - 2>/dev/null <<'PROGRAM'
from rclpy.duration import Duration
from rclpy.time import Time

print("1.001 s is", Time(seconds=1.001).nanoseconds, "ns,", Duration(seconds=-1.001).nanoseconds, "ns as a negative duration")
early = [k for k in range(1, 10_001) if Time(seconds=k / 1000).nanoseconds != k * 1_000_000]
print(len(early), "of the first 10000 milliseconds are another number of ns; the first:", *early[:4])
print("by", {Time(seconds=k / 1000).nanoseconds - k * 1_000_000 for k in early}, "ns")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
