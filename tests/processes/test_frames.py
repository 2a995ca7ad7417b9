"""/tf and /tf_static of a running robot, without tf2_msgs: what tf2 reads, computed from its published joint states."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import PATIENCE
from rosbags.typesys import Stores, get_typestore
from softrig_core.block.scene import Pose
from softrig_nodes.below.tf_message import ELEMENT, HASH, SOURCE, TF
from softrig_nodes.face.frames import encode
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.executables import environment, find_executable
from softrig_nodes.processes.fork_server import start_node
from softrig_robots.manipulator.plant import ManipulatorPlant

STORE = get_typestore(Stores.ROS2_JAZZY)
POSES = [
    Pose("world", "base_link", (0.0, 1.0, -2.0), (0.0, 0.0, 0.0, 1.0)),
    Pose("base_link", "a", (0.5, 0.25, 3.0), (0.5, -0.5, 0.5, 0.5)),
]

LISTEN = f"""
import sys
import time
import rclpy
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from softrig_nodes.ros.messages import message_class
from type_description_interfaces.srv import GetTypeDescription

rclpy.init()
node = Node("listener")
found = {{"tf": [], "static": [], "joints": []}}
kind = message_class("{TF}")
node.create_subscription(kind, "/tf", found["tf"].append, 100, raw=True)
late = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
node.create_subscription(kind, "/tf_static", found["static"].append, late, raw=True)
node.create_subscription(JointState, "joint_states", found["joints"].append, 1000, raw=True)
end = time.monotonic() + {PATIENCE}
while (len(found["tf"]) < 5 or not found["static"]) and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=1.0)
client = node.create_client(GetTypeDescription, "/plant/get_type_description")
client.wait_for_service()
request = GetTypeDescription.Request(type_name="{TF}", type_hash="RIHS01_{HASH}", include_type_sources=True)
answer = client.call_async(request)
rclpy.spin_until_future_complete(node, answer)
for name, messages in found.items():
    for message in messages:
        print(name, bytes(message).hex())
description = answer.result().type_description
print("described", *(d.type_name for d in [description.type_description, *description.referenced_type_descriptions]))
print("hash", node.get_publishers_info_by_topic("/tf")[0].topic_type_hash)
"""


def test_bytes_and_hash_are_those_of_the_message_type():
    kinds = STORE.types

    def made(name, **fields):
        return kinds[name](**fields)

    transforms = [
        made(
            "geometry_msgs/msg/TransformStamped",
            header=made(
                "std_msgs/msg/Header", stamp=made("builtin_interfaces/msg/Time", sec=3, nanosec=7), frame_id=p.parent
            ),
            child_frame_id=p.child,
            transform=made(
                "geometry_msgs/msg/Transform",
                translation=made("geometry_msgs/msg/Vector3", **dict(zip("xyz", p.position))),
                rotation=made("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", p.rotation))),
            ),
        )
        for p in POSES
    ]
    assert encode(3_000_000_007, POSES) == bytes(STORE.serialize_cdr(made(TF, transforms=transforms), TF))
    assert STORE.hash_rihs01(TF) == f"RIHS01_{HASH}"
    assert SOURCE.decode().split()[0].replace("/", "/msg/").removesuffix("[]") == ELEMENT.decode()


@pytest.mark.processes
def test_the_frames_of_a_robot_are_forward_kinematics_of_its_joint_states(tmp_path):
    with free_domain() as domain:
        variables = environment(domain, tmp_path)
        command = [str(find_executable("softrig_robots", "manipulator_plant")), "--ros-args", "-r", "__node:=plant"]
        plant = start_node("softrig_robots", "manipulator_plant", command, variables, 2)
        try:
            done = subprocess.run([sys.executable, "-c", LISTEN], env=variables, stdout=subprocess.PIPE, text=True,
                                  check=True, timeout=PATIENCE)  # fmt: skip
        finally:
            plant.kill()
            plant.wait()
    messages = {name: [] for name in ("tf", "static", "joints", "described", "hash")}
    for line in done.stdout.splitlines():
        name, *words = line.split()
        messages[name] += words
    still, *_ = (STORE.deserialize_cdr(bytes.fromhex(data), TF) for data in messages["static"])
    assert [(x.header.frame_id, x.child_frame_id) for x in still.transforms] == [
        ("world", "base_link"),
        ("link3", "tool"),
    ]
    joints = [STORE.deserialize_cdr(bytes.fromhex(data), "sensor_msgs/msg/JointState") for data in messages["joints"]]
    assert {j.header.frame_id for j in joints} == {"world"}
    at = {(j.header.stamp.sec, j.header.stamp.nanosec): j.position for j in joints}
    scene = ManipulatorPlant.scene(ManipulatorPlant.Params())
    compared = 0
    for message in (STORE.deserialize_cdr(bytes.fromhex(data), TF) for data in messages["tf"]):
        stamp = message.transforms[0].header.stamp
        if (stamp.sec, stamp.nanosec) not in at:  # the transform is older than the first joint state that was read
            continue
        compared += 1
        for x, pose in zip(message.transforms, scene.moving(at[stamp.sec, stamp.nanosec]), strict=True):
            assert (x.header.frame_id, x.child_frame_id) == (pose.parent, pose.child)
            p, q = x.transform.translation, x.transform.rotation
            assert np.array_equal([p.x, p.y, p.z, q.x, q.y, q.z, q.w], [*pose.position, *pose.rotation])
    assert compared
    assert messages["hash"] == [f"RIHS01_{HASH}"]
    assert messages["described"][0] == TF
    assert ELEMENT.decode() in messages["described"][1:]
