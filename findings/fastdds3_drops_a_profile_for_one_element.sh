#!/usr/bin/env bash
# Fast DDS 3 (Kilted) drops a whole profile file for one element that Fast DDS 2 (Jazzy) spells otherwise; the node runs on.
#
# Versions: ros-kilted-rclpy 9.1.2, ros-kilted-rmw-fastrtps-cpp 9.3.3 (wheels of PyPI). Date: 2026-11-29, CPython 3.11, Debian 12, x86-64.
# Usual guess: heartbeatPeriod, now heartbeat_period, is reported and ignored, and the rest of the file holds; or the node refuses.
# Behaviour: lines of XMLPARSER errors, then all defaults: here the transports that the profile had switched off are used again,
# and leases, ports and buffers that a rig relies on would be the defaults, too. The status stays 0. A profile for both
# distributions needs two files.
#
# Output seen:
seen=$(
    cat <<'SEEN'
heartbeatPeriod: status 0, 4 lines of errors; shared memory of the transport that the profile switches off: True
heartbeat_period: status 0, 0 lines of errors; shared memory of the transport that the profile switches off: False
SEEN
)
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --no-compile --disable-pip-version-check ros-kilted-rclpy==9.1.2 ros-kilted-rmw-fastrtps-cpp==9.3.3 ros-std-msgs==5.5.1
now=$(
    ROS_DOMAIN_ID=84 ROS_AUTOMATIC_DISCOVERY_RANGE=SYSTEM_DEFAULT venv/bin/python - <<'PROGRAM'
import os
import pathlib
import subprocess
import sys

PROFILE = """<?xml version="1.0" encoding="UTF-8"?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <transport_descriptors>
    <transport_descriptor><transport_id>only_udp</transport_id><type>UDPv4</type><interfaceWhiteList><address>127.0.0.1</address></interfaceWhiteList></transport_descriptor>
  </transport_descriptors>
  <participant profile_name="node" is_default_profile="true">
    <rtps>
      <name>named by the profile</name>
      <userTransports><transport_id>only_udp</transport_id></userTransports>
      <useBuiltinTransports>false</useBuiltinTransports>
    </rtps>
  </participant>
  <data_writer profile_name="writer" is_default_profile="true">
    <times><{period}><sec>0</sec><nanosec>50000000</nanosec></{period}></times>
  </data_writer>
</profiles>
"""
PROGRAM = """
import rclpy

rclpy.init()
node = rclpy.create_node("node")
node.create_publisher(__import__("std_msgs.msg", fromlist=["Header"]).Header, "/x", 1)
maps = open("/proc/self/maps").read()
print("shared memory of the transport that the profile switches off:", "/dev/shm/fast" in maps)
rclpy.shutdown()
"""
for period in ("heartbeatPeriod", "heartbeat_period"):
    pathlib.Path("profile.xml").write_text(PROFILE.replace("{period}", period))
    here = {**os.environ, "FASTDDS_DEFAULT_PROFILES_FILE": "profile.xml"}
    ran = subprocess.run([sys.executable, "-c", PROGRAM], env=here, capture_output=True, text=True)
    errors = [line for line in ran.stderr.splitlines() if "XMLPARSER" in line]
    print(f"{period}: status {ran.returncode}, {len(errors)} lines of errors; {ran.stdout.strip()}")
PROGRAM
)
diff <(echo "$seen") <(echo "$now") || { echo "the behaviour has changed" >&2; exit 1; }
echo "$now"
