"""Definitions and hashes of the message types of softrig's own topics, as Jazzy has them.

The library that knows all types of all distributions takes a tenth of a second to load, and a bag of a run needs a few.
A test compares these types with that library.
"""

from __future__ import annotations

from functools import cache

_HASHES = {
    "builtin_interfaces/msg/Duration": "RIHS01_e8d009f659816f758b75334ee1a9ca5b5c0b859843261f14c7f937349599d93b",
    "builtin_interfaces/msg/Time": "RIHS01_b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "diagnostic_msgs/msg/DiagnosticArray": "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "geometry_msgs/msg/PoseStamped": "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
    "geometry_msgs/msg/TransformStamped": "RIHS01_0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
    "geometry_msgs/msg/Vector3Stamped": "RIHS01_d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a",
    "geometry_msgs/msg/WrenchStamped": "RIHS01_8dc3deaf06b2ab281f9f9a742a8961c328ca7cec16e3fd6586d3a5c83fa78f77",
    "rcl_interfaces/msg/ParameterEvent": "RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
    "rosgraph_msgs/msg/Clock": "RIHS01_692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    "sensor_msgs/msg/JointState": "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "std_msgs/msg/Bool": "RIHS01_feb91e995ff9ebd09c0cb3d2aed18b11077585839fb5db80193b62d74528f6c9",
    "std_msgs/msg/Float64": "RIHS01_705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
    "std_msgs/msg/Float64MultiArray": "RIHS01_1025ddc6b9552d191f89ef1a8d2f60f3d373e28b283d8891ddcc974e8c55397f",
    "std_msgs/msg/Header": "RIHS01_f49fb3ae2cf070f793645ff749683ac6b06203e41c891e17701b1cb597ce6a01",
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "trajectory_msgs/msg/JointTrajectory": "RIHS01_179b33eba59d676f6d967ac71fe35e7ca2f64b2f3928f4a018cec115e213796e",
}
_FIELDS = {
    "builtin_interfaces/msg/Duration": """\
int32 sec
uint32 nanosec
""",
    "builtin_interfaces/msg/Time": """\
int32 sec
uint32 nanosec
""",
    "diagnostic_msgs/msg/DiagnosticArray": """\
std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
""",
    "diagnostic_msgs/msg/DiagnosticStatus": """\
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
""",
    "diagnostic_msgs/msg/KeyValue": """\
string key
string value
""",
    "geometry_msgs/msg/Point": """\
float64 x
float64 y
float64 z
""",
    "geometry_msgs/msg/Pose": """\
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
""",
    "geometry_msgs/msg/PoseStamped": """\
std_msgs/Header header
geometry_msgs/Pose pose
""",
    "geometry_msgs/msg/Quaternion": """\
float64 x
float64 y
float64 z
float64 w
""",
    "geometry_msgs/msg/Transform": """\
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
""",
    "geometry_msgs/msg/TransformStamped": """\
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
""",
    "geometry_msgs/msg/Vector3": """\
float64 x
float64 y
float64 z
""",
    "geometry_msgs/msg/Vector3Stamped": """\
std_msgs/Header header
geometry_msgs/Vector3 vector
""",
    "geometry_msgs/msg/Wrench": """\
geometry_msgs/Vector3 force
geometry_msgs/Vector3 torque
""",
    "geometry_msgs/msg/WrenchStamped": """\
std_msgs/Header header
geometry_msgs/Wrench wrench
""",
    "rcl_interfaces/msg/Parameter": """\
string name
rcl_interfaces/ParameterValue value
""",
    "rcl_interfaces/msg/ParameterEvent": """\
builtin_interfaces/Time stamp
string node
rcl_interfaces/Parameter[] new_parameters
rcl_interfaces/Parameter[] changed_parameters
rcl_interfaces/Parameter[] deleted_parameters
""",
    "rcl_interfaces/msg/ParameterValue": """\
uint8 type
bool bool_value
int64 integer_value
float64 double_value
string string_value
byte[] byte_array_value
bool[] bool_array_value
int64[] integer_array_value
float64[] double_array_value
string[] string_array_value
""",
    "rosgraph_msgs/msg/Clock": """\
builtin_interfaces/Time clock
""",
    "sensor_msgs/msg/JointState": """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
""",
    "std_msgs/msg/Bool": """\
bool data
""",
    "std_msgs/msg/Float64": """\
float64 data
""",
    "std_msgs/msg/Float64MultiArray": """\
std_msgs/MultiArrayLayout layout
float64[] data
""",
    "std_msgs/msg/Header": """\
builtin_interfaces/Time stamp
string frame_id
""",
    "std_msgs/msg/MultiArrayDimension": """\
string label
uint32 size
uint32 stride
""",
    "std_msgs/msg/MultiArrayLayout": """\
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
""",
    "std_msgs/msg/String": """\
string data
""",
    "trajectory_msgs/msg/JointTrajectory": """\
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint[] points
""",
    "trajectory_msgs/msg/JointTrajectoryPoint": """\
float64[] positions
float64[] velocities
float64[] accelerations
float64[] effort
builtin_interfaces/Duration time_from_start
""",
}
_BETWEEN = "=" * 80


@cache
def definition_of(msgtype: str) -> tuple[str, str] | None:
    """Return the definition of a type, with all types in it, and its hash; None for a type that is not in the list."""
    if msgtype not in _HASHES:
        return None
    names = list(dict.fromkeys(_within(msgtype)))
    sections = [_FIELDS[msgtype], *(f"MSG: {name.replace('/msg/', '/')}\n{_FIELDS[name]}" for name in names[1:])]
    return f"{_BETWEEN}\n".join(sections), _HASHES[msgtype]


def _within(msgtype: str) -> list[str]:
    """Return a type and those of its fields, each before its own."""
    result = [msgtype]
    for line in _FIELDS[msgtype].splitlines():
        name = line.split("[")[0].split(" ")[0].replace("/", "/msg/")
        if name in _FIELDS:
            result += _within(name)
    return result
