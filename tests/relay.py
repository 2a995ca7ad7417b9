"""A plain rclpy node, without softrig, that takes the place of any node of a rig.

    python relay.py FILE

FILE is JSON: ``name``, ``plant`` (whether it begins), ``outputs`` (topic, type, readers, whether stamped, times in ns,
bytes in hex) and ``reads`` (topic, type); the first topic that it reads calls for its answers: ``ticks`` are the times
of the caller, ``by_order`` says that its messages have no stamp of their tick. To a call at t it says all that is due
before the caller's next tick; a plant says what is due up to that tick, and begins when its readers are there. In real
time (``realtime``) t = 0 is at the stamp of the first call, and what it says is stamped accordingly.
"""

import importlib
import json
import sys
from bisect import bisect_right
from pathlib import Path

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile


class Relay(Node):
    def __init__(self, about):
        super().__init__(about["name"])
        self.plant, self.ticks, self.by_order = about["plant"], about["ticks"], about["by_order"]
        self.epoch = None if about["realtime"] else 0
        self.calls, self.called = 0, False
        self.outputs = [(o, self.create_publisher(message(o["type"]), o["topic"], 10)) for o in about["outputs"]]
        self.published = [0] * len(self.outputs)
        for k, port in enumerate(about["reads"]):
            receive = self.call if k == 0 else lambda data: None
            self.create_subscription(message(port["type"]), port["topic"], receive, QoSProfile(depth=10), raw=True)
        if self.plant:
            self.timer = self.create_timer(0.05, self.begin)

    def begin(self):
        if not self.called and all(p.get_subscription_count() >= o["readers"] for o, p in self.outputs):
            self.timer.cancel()
            self.say(0)

    def call(self, data):
        self.called = True
        if self.epoch is None:
            self.epoch = stamp(data)
        k = self.calls if self.by_order else bisect_right(self.ticks, stamp(data) - self.epoch) - 1
        self.calls += 1
        following = self.ticks[k + 1] if k + 1 < len(self.ticks) else 1 << 62
        self.say(following if self.plant else following - 1)

    def say(self, until):
        for k, (about, publisher) in enumerate(self.outputs):
            while self.published[k] < len(about["times"]) and about["times"][self.published[k]] <= until:
                data = bytes.fromhex(about["data"][self.published[k]])
                publisher.publish(stamped(data, stamp(data) + self.epoch) if about["stamped"] else data)
                self.published[k] += 1


def stamp(data):
    return int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")


def stamped(data, t):
    seconds, nanoseconds = divmod(t, 1_000_000_000)
    return data[:4] + seconds.to_bytes(4, "little") + nanoseconds.to_bytes(4, "little") + data[12:]


def message(kind):
    package, _, name = kind.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


rclpy.init()
rclpy.spin(Relay(json.loads(Path(sys.argv[1]).read_text())))
