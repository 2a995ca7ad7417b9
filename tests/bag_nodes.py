"""Nodes for the tests of recorder and player, as separate processes: plain rclpy, nothing of the suite's adapter.

python bag_nodes.py echo GAIN SECONDS LAST   command = GAIN * position, after SECONDS of work, up to message LAST
python bag_nodes.py publish COUNT            COUNT messages at once when a line comes on stdin, and waits
"""

import sys
import time

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String


def echo(gain, work, last):
    node = Node("echo")
    publisher = node.create_publisher(JointState, "command", 10)
    count = 0

    def answer(message):
        nonlocal count
        count += 1
        end = time.perf_counter() + work
        while time.perf_counter() < end:
            pass
        if count <= last:
            reply = JointState(name=["a"], effort=[gain * message.position[0]])
            reply.header.stamp = message.header.stamp
            publisher.publish(reply)

    node.create_subscription(JointState, "plant/state", answer, 10)
    rclpy.spin(node)


def publish(count):
    node = Node("publisher")
    publisher = node.create_publisher(JointState, "burst", 10)
    wait_for_reader(publisher)
    print("matched", flush=True)
    sys.stdin.readline()
    message = JointState(name=["a"], position=[1.0])
    for k in range(count):
        message.header.stamp.nanosec = k
        publisher.publish(message)
    print("sent", flush=True)
    publisher.wait_for_all_acked(Duration(seconds=20))
    print("acknowledged", flush=True)
    sys.stdin.read()


def mixed():
    node = Node("mixed")
    latched = node.create_publisher(String, "text", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
    latched.publish(String(data="once"))
    unreliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    sensor = node.create_publisher(JointState, "sensor", unreliable)
    both = [node.create_publisher(JointState, "both", 10)]
    print("latched", flush=True)
    wait_for_reader(sensor, both[0])
    both[0].publish(JointState(name=["reliable"]))
    both[0].wait_for_all_acked(Duration(seconds=20))
    both.append(node.create_publisher(JointState, "both", unreliable))
    wait_for_reader(both[1])
    sensor.publish(JointState(name=["sensor"]))
    for publisher, name in zip(both, ("reliable again", "unreliable"), strict=True):
        publisher.publish(JointState(name=[name]))
    print("sent", flush=True)
    sys.stdin.read()


def wait_for_reader(*publishers):
    while not all(p.get_subscription_count() for p in publishers):
        time.sleep(0.01)


if __name__ == "__main__":
    rclpy.init()
    try:
        if sys.argv[1] == "echo":
            echo(float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
        elif sys.argv[1] == "mixed":
            mixed()
        else:
            publish(int(sys.argv[2]))
    except KeyboardInterrupt:
        pass
