"""A typical outside controller: a timer or a callback, stamps not copied. ``clocked_node.py KIND``."""

import sys

import rclpy
from rclpy.node import Node
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

KP, KI, PERIOD, LIMIT = 0.8, 0.2, 0.01, 12.0


class Pi(Node):
    """PI controller of the motor's speed; publishes twice, late, never or wrong numbers if its arguments say so."""

    def __init__(self, kind: str) -> None:
        super().__init__("pi")
        self.kind, self.speed, self.reference, self.integral, self.n = kind, 0.0, 0.0, 0.0, 0
        self.command = self.create_publisher(JointState, "motor/command", 10)
        self.create_subscription(JointTrajectory, "motor/reference", self.on_reference, 10)
        self.create_subscription(JointState, "motor/state", self.on_state, 10)
        if kind != "message":
            self.create_timer(PERIOD * (2.0 if kind == "slow" else 1.0), self.answer)

    def on_reference(self, message: JointTrajectory) -> None:
        self.reference = message.points[0].velocities[0]

    def on_state(self, message: JointState) -> None:
        self.speed = message.velocity[0]
        if self.kind == "message":
            self.answer()

    def answer(self) -> None:
        self.n += 1
        error = self.reference - self.speed
        u = KP * error + KI * self.integral
        if abs(u) <= LIMIT or u * error < 0.0:
            self.integral += PERIOD * error
        message = JointState()
        # Stamped with its own clock, not with the stamp of its input.
        message.header.stamp = self.get_clock().now().to_msg()
        message.name = ["armature"]
        message.effort = [min(max(u, -LIMIT), LIMIT)]
        if self.kind == "wrong" and self.n > 5:
            message.effort = [float("nan")]
        for _ in range(2 if self.kind == "twice" and self.n > 5 else 1):
            self.command.publish(message)


rclpy.init(args=sys.argv)
rclpy.spin(Pi(sys.argv[1]))
