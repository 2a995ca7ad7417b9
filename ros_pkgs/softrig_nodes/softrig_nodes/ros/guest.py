"""A third-party node with its own timer: it gets its inputs, its clock is advanced, and its answer is awaited.

It is started in the namespace of the rig's node, with /clock remapped into that namespace. So it subscribes and
publishes there and not on the topics of the rig. After each input of a tick it gets two requests, one after the other,
and its clock moves only when its executor has answered both. Messages from one process to another arrive in order. An
executor checks its subscriptions and then its services, so it may answer the first request although it has missed an
input that arrived between the two checks, before the request. When the second request is sent, the input has arrived,
and of all that is ready an executor serves subscriptions first. So its callbacks of the tick have run by then, at any
load. (An acknowledgement by DDS would prove less, and comes with a heartbeat, up to seconds later.)
"""

from __future__ import annotations

import atexit
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import Any

import rclpy
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from softrig_core.block.codec import Decoder
from softrig_core.block.port import CLOCK, Port, Refused
from softrig_core.board.clocked import WAITS, ClockEntry
from softrig_core.errors import RunError
from softrig_core.guard import print_for

from ..below.uses import pending_messages, works
from ..processes.shared_memory import domain_id
from .messages import message_class
from .profile import RANGE, joining, watch_ports

QOS = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
CLOCKED = "a subscription of its clock"
LOOK = 0.05  # s between two looks at the graph
# s after which a time is published again. rclpy and rclcpp subscribe to /clock with best effort, so it may be lost;
# receiving the same time twice makes no timer fire twice.
AGAIN = 0.5
REPORT_AFTER = 1.0  # s without a change after which a message names what is missing


class Guest:
    """A third-party node that is driven by a node of the rig.

    Parameters
    ----------
    name : str
        Name of the rig's node; the third-party node is in the namespace of this name.
    inputs, outputs : sequence of Port
        Ports that it reads and publishes.
    entry : ClockEntry
        Timeouts and order of its messages.

    Attributes
    ----------
    full_name : str
        Full name of the third-party node.
    """

    def __init__(self, name: str, inputs: Sequence[Port], outputs: Sequence[Port], entry: ClockEntry) -> None:
        self._name, self._inputs, self._outputs, self._seconds = name, inputs, outputs, entry.timeout
        self._context = Context()
        # Without this profile Fast DDS replaces a port whose reader has not run for 1 s. On a loaded host a process may
        # get no processor for longer, and the node would then receive nothing.
        with joining(silence=entry.timeout):
            rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
            self._node = Node(f"{name}_gate", namespace=name, context=self._context, start_parameter_services=False)
        watch_ports(self._node)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._publishers = {p.name: self._offer(p) for p in inputs}
        self._clock = self._offer(CLOCK)
        self._received: dict[str, list[bytes]] = {p.name: [] for p in outputs}
        self._decoders = {p.name: Decoder(p) for p in outputs}
        self._subscriptions = {
            p.name: self._node.create_subscription(
                message_class(p.msgtype), self._topic(p), self._received[p.name].append, QOS, raw=True
            )
            for p in outputs
        }
        self.full_name = f"/{name}/?"
        atexit.register(self.close)
        self._meet(entry.start_timeout)

    def close(self) -> None:
        """Remove the node from the graph."""
        if self._context.ok():
            self._executor.shutdown(0)
            self._node.destroy_node()
            rclpy.shutdown(context=self._context)

    def ask(self, t: int, inputs: Mapping[str, Any], answers: bool) -> Mapping[str, tuple[float, ...]]:
        """Publish the inputs of a tick, advance the clock to it, and wait for one message on each output.

        Parameters
        ----------
        t : int
            ns.
        answers : bool
            Whether it publishes at this tick.

        Raises
        ------
        RunError
            It has left, publishes nothing, publishes twice, or publishes something that cannot be read.
        """
        for port in self._inputs:
            value = inputs[port.name]
            if value is not None:
                self._publishers[port.name].publish(port.layout().encode(t, value))
                # One input after the other gives a fixed order, whichever of them the node answers.
                self._settle(t)
        now = CLOCK.layout().encode(t, ())
        self._clock.publish(now)
        if not answers:
            self._settle(t)
            self._check_silent(t)
            return {}
        self._wait(lambda: all(self._received.values()), t, again=lambda: self._clock.publish(now))
        self._settle(t)
        return {port.name: self._values_of(port, t) for port in self._outputs}

    def _values_of(self, port: Port, t: int) -> tuple[float, ...]:
        arrived = self._received[port.name]
        if len(arrived) != 1:
            raise RunError(
                f"{self.full_name} has published {len(arrived)} messages on {self._topic(port)} at t = {t / 1e9:.9g} s"
                ", expected exactly one a period; set the node's period and that of its timer alike"
            )
        try:
            return self._decoders[port.name](arrived.pop())[1]
        except Refused as error:
            raise RunError(
                f"{self.full_name} publishes on {self._topic(port)} at t = {t / 1e9:.9g} s: {error}"
            ) from None

    def _check_silent(self, t: int) -> None:
        for port in self._outputs:
            if self._received[port.name]:
                raise RunError(
                    f"{self.full_name} has published on {self._topic(port)} at t = {t / 1e9:.9g} s, before its first "
                    "message is due; a node that answers each message has first: 0.0"
                )

    # the graph ------------------------------------------------------------------------------------------------------

    def _topic(self, port: Port) -> str:
        return f"/{self._name}/{port.topic.lstrip('/')}"

    def _offer(self, port: Port) -> Any:
        return self._node.create_publisher(message_class(port.msgtype), self._topic(port), QOS)

    def _meet(self, limit: float) -> None:
        """Wait until the third-party node has all its endpoints, runs its executor, and uses /clock."""
        wanted: dict[str, Callable[[], int]] = {
            f"a subscription of {self._topic(p)}": self._publishers[p.name].get_subscription_count for p in self._inputs
        }
        for topic in map(self._topic, self._outputs):
            wanted[f"a publisher of {topic}"] = partial(self._node.count_publishers, topic)
        wanted[CLOCKED] = self._clock.get_subscription_count
        begin = since = time.monotonic()
        before: list[str] = []
        messages: list[str] = []
        while lacking := [kind for kind, count in wanted.items() if not count()]:
            self._executor.spin_once(LOOK)
            now = time.monotonic()
            if lacking != before:
                before, since = lacking, now
            if lacking != messages and now - since > REPORT_AFTER:
                messages = lacking
                print_for(self._name, f"{WAITS}: {self._lacks(lacking, wanted)}")
            if now - begin > limit:
                raise RunError(f"{self._lacks(lacking, wanted)}; waited for {limit:g} s")
        # The graph knows endpoints before the names of their nodes.
        self._wait(lambda: "UNKNOWN" not in self._named(), 0)
        self.full_name = self._named()
        self._parameters = self._node.create_client(GetParameters, f"{self.full_name}/get_parameters")
        self._wait(self._parameters.service_is_ready, 0)
        result = self._asked("use_sim_time", 0)
        if not (result.values and result.values[0].bool_value):
            raise RunError(f"{self.full_name} does not follow /clock; start it with -p use_sim_time:=true")

    def _lacks(self, lacking: Sequence[str], wanted: Collection[str]) -> str:
        """Describe what is missing and what to do: for a missing node, or one that lacks an input or output."""
        if len(lacking) < len(wanted):
            text = f"{self._named()} is there without {', '.join(lacking)}"
            if lacking == [CLOCKED]:
                return f"{text}; start it with -p use_sim_time:=true and -r /clock:=/{self._name}/clock"
            return f"{text}; remap its topic to this name, or remove the topic from `reads` or `publishes`"
        setting = "".join(f"{name}={os.environ[name]} " for name in (RANGE,) if name in os.environ)
        return (
            f"no node with {', '.join(lacking)}; start it as ROS_DOMAIN_ID={domain_id()} {setting}ros2 run PACKAGE "
            f"NODE --ros-args -r __ns:=/{self._name} -r /clock:=/{self._name}/clock -p use_sim_time:=true"
        )

    def _named(self) -> str:
        writers = self._node.get_publishers_info_by_topic(self._topic(self._outputs[0]))
        return f"{writers[0].node_namespace.rstrip('/')}/{writers[0].node_name}" if writers else "UNKNOWN"

    def _settle(self, t: int) -> None:
        """Wait until its executor has processed all messages that it received; collect what it has published by
        then.
        """
        # The first answer may come before the callback of a message that arrived earlier (see the module).
        for _ in range(2):
            self._asked("use_sim_time", t)
        for name, subscription in self._subscriptions.items():
            self._received[name] += pending_messages(subscription)
        # Where messages cannot be taken directly, each turn of the executor takes one.
        for _ in range(0 if works("take_message") else QOS.depth):
            self._executor.spin_once(0.0)

    def _asked(self, parameter: str, t: int) -> Any:
        future = self._parameters.call_async(GetParameters.Request(names=[parameter]))
        self._wait(future.done, t, "answers no call of its parameter service: its executor does not spin")
        return future.result()

    def _wait(
        self, done: Callable[[], bool], t: int, request: str = "", again: Callable[[], object] | None = None
    ) -> None:
        begin = time.monotonic()
        end, repeat = begin + self._seconds, begin + AGAIN
        while not done():
            self._executor.spin_once(LOOK)
            if again is not None and time.monotonic() > repeat:
                again()
                repeat += AGAIN
            unpublished = [p for p in self._outputs if not self._node.count_publishers(self._topic(p))]
            if unpublished and not done():
                raise RunError(f"{self.full_name} has gone at t = {t / 1e9:.9g} s")
            if time.monotonic() > end and not done():
                silent = [self._topic(p) for p in self._outputs if not self._received[p.name]]
                raise RunError(
                    f"{self.full_name} at t = {t / 1e9:.9g} s: "
                    + (
                        request
                        or f"no message on {', '.join(silent)} within {self._seconds:g} s of its clock, expected one "
                        "a period"
                    )
                )
