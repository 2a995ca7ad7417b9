"""Nodes for the tests of recorder and player, as separate processes: plain rclpy, nothing of the suite's adapter.

python bag_nodes.py echo GAIN SECONDS LAST   command = GAIN * position, after SECONDS of work, up to message LAST
python bag_nodes.py publish COUNT            COUNT messages at once when a line comes on stdin, and waits
"""

import sys
import time

import rclpy
from rclpy.duration import Duration
from rclpy.node import Node
from sensor_msgs.msg import JointState


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
    while not publisher.get_subscription_count():
        time.sleep(0.01)
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


if __name__ == "__main__":
    rclpy.init()
    try:
        if sys.argv[1] == "echo":
            echo(float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4]))
        else:
            publish(int(sys.argv[2]))
    except KeyboardInterrupt:
        pass
