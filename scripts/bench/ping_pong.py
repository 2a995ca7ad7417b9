"""The two sides of a bare rclpy ping-pong, each in its own process: ``python -m bench.ping_pong``.

``bytes``: EventsExecutor and serialized bytes, about as fast as bare Fast DDS. ``arrival``: the same bytes, answered
in the thread that has received them, which is what is possible here. ``objects``: what people usually write, message
objects and rclpy.spin (SingleThreadedExecutor).
"""

from __future__ import annotations

import itertools
import json
import sys
import time
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from softrig_core.wire.cdr import Layout
from softrig_nodes.below.arrival import RMW, Arrival, library
from softrig_nodes.below.leave import leave

STATE = Layout("sensor_msgs/msg/JointState", "", ("shaft",), {"position": 1, "velocity": 1, "effort": 1})
SENSORS = Layout("sensor_msgs/msg/JointState", "", ("encoder_count", "current_a"), {"position": 2})
COMMAND = Layout("sensor_msgs/msg/JointState", "", ("armature",), {"effort": 1})
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)


def main() -> None:
    """Play one role: ``ping`` counts loops and prints them as JSON, ``pong`` answers until it is killed."""
    kind, role, loops = sys.argv[1], sys.argv[2], int(sys.argv[3])
    rclpy.init()
    node = Node(role, start_parameter_services=False, enable_rosout=False)
    done: Future[None] = Future()
    if kind == "objects":
        _objects(node, role, loops, done)
    else:
        _bytes(node, role, loops, done)
        _spin(node, done, where_it_arrives=kind == "arrival")
    leave([node], 0)


def _bytes(node: Node, role: str, loops: int, done: Future[None]) -> None:
    from sensor_msgs.msg import JointState

    if role == "pong":
        command = node.create_publisher(JointState, "bench/command", QOS)
        answer = COMMAND.encode(0, (0.0,))
        _on_both(node, lambda: command.publish(answer), raw=True)
    else:
        state = node.create_publisher(JointState, "bench/state", QOS)
        sensors = node.create_publisher(JointState, "bench/sensors", QOS)
        first, second = STATE.encode(0, (0.0,) * 3), SENSORS.encode(0, (0.0,) * 2)

        def send() -> None:
            state.publish(first)
            sensors.publish(second)

        _ping(node, send, loops, done, state, raw=True)


def _spin(node: Node, done: Future[None], *, where_it_arrives: bool) -> None:
    from rclpy.experimental.events_executor import EventsExecutor

    rcl: Any = library() if where_it_arrives else None
    if where_it_arrives and rcl is None:
        raise SystemExit(f"only with {RMW}")

    results = list(node.subscriptions) if where_it_arrives else []
    arrivals = [Arrival(rcl, s, s.callback, lambda count: None, lambda accept: accept()) for s in results]
    for arrival in arrivals:
        node._subscriptions.remove(arrival.subscription)
        arrival.begin()
    executor = EventsExecutor()
    executor.add_node(node)
    while not done.done():
        executor.spin_until_future_complete(done, 5.0)
    for arrival in arrivals:
        arrival.end()


def _objects(node: Node, role: str, loops: int, done: Future[None]) -> None:
    from sensor_msgs.msg import JointState

    now = node.get_clock().now
    if role == "pong":
        command = node.create_publisher(JointState, "bench/command", 10)

        def answer() -> None:
            message = JointState(name=["armature"], effort=[0.0])
            message.header.stamp = now().to_msg()
            command.publish(message)

        _on_both(node, answer, raw=False)
    else:
        state = node.create_publisher(JointState, "bench/state", 10)
        sensors = node.create_publisher(JointState, "bench/sensors", 10)

        def send() -> None:
            first = JointState(name=["shaft"], position=[0.0], velocity=[0.0], effort=[0.0])
            second = JointState(name=["encoder_count", "current_a"], position=[0.0, 0.0])
            first.header.stamp = second.header.stamp = now().to_msg()
            state.publish(first)
            sensors.publish(second)

        _ping(node, send, loops, done, state, raw=False)
    rclpy.spin_until_future_complete(node, done)


def _on_both(node: Node, answer: Any, *, raw: bool) -> None:
    """Call `answer` each time when state and sensors have both arrived."""
    from sensor_msgs.msg import JointState

    seen = [0, 0]

    def receive(which: int) -> None:
        seen[which] += 1
        if seen[0] == seen[1]:
            answer()

    node.create_subscription(JointState, "bench/state", lambda _: receive(0), QOS, raw=raw)
    node.create_subscription(JointState, "bench/sensors", lambda _: receive(1), QOS, raw=raw)


def _ping(node: Node, send: Any, loops: int, done: Future[None], publisher: Any, *, raw: bool) -> None:
    from sensor_msgs.msg import JointState

    stamps: list[int] = []

    def receive(_: Any) -> None:
        stamps.append(time.perf_counter_ns())
        if len(stamps) > loops:
            times = sorted(b - a for a, b in itertools.pairwise(stamps))
            result = {
                "loops_s": loops / (stamps[-1] - stamps[0]) * 1e9,
                "p50_us": times[loops // 2] / 1e3,
                "p99_us": times[loops * 99 // 100] / 1e3,
            }
            print(json.dumps(result), flush=True)
            done.set_result(None)
        else:
            send()

    subscription = node.create_subscription(JointState, "bench/command", receive, QOS, raw=raw)

    def start() -> None:
        if publisher.get_subscription_count() and subscription.get_publisher_count():
            timer.cancel()
            send()

    timer = node.create_timer(0.3, start)


if __name__ == "__main__":
    main()
