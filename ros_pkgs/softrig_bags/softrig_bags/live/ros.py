"""ROS parts shared by recorder and player: one node, an executor that ends on a signal, QoS profiles."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping, Sequence
from types import FrameType
from typing import Any, ClassVar

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.event_handler import EventHandler, QoSSubscriptionEventType as Event
from rclpy.exceptions import InvalidTopicNameException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.validate_full_topic_name import validate_full_topic_name
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from softrig_core import SECOND
from softrig_core.block.params import Declaration
from softrig_nodes.below import uses
from softrig_nodes.ros.arguments import non_ros_arguments, plain_errors
from softrig_nodes.ros.messages import range_descriptor
from softrig_nodes.ros.profile import joining, watch_ports
from softrig_nodes.ros.ros import ServingNode

from ..content.topics import BagTopic
from ..errors import BagError

_OF_ROS = ("use_sim_time", "start_type_description_service")
# In s. Python handles a signal between two calls only, so this is the longest wait before one is noticed.
SLICE = 0.1
# The depth of `rmw_qos_profile_default`, to which rosbag2 adapts the offers of latched publishers.
_ADAPTED = 10
_QUEUE = 1000


class Session:
    """A tool's node, spun in slices; SIGINT and SIGTERM only set `stopped`, so that the tool shuts down cleanly.

    Parameters
    ----------
    name : str
        Node name.
    argv : sequence of str
        Command line with the ROS arguments.
    parameters : sequence of (Declaration, value)
        The tool's options, as read-only parameters.

    Raises
    ------
    BagError
        The ROS arguments are invalid, or they set a parameter.

    Attributes
    ----------
    opened : Session or None
        The session of this process; the two end together (`softrig_nodes.below.leave`).
    """

    opened: ClassVar[Session | None] = None

    def __init__(self, name: str, argv: Sequence[str], parameters: Sequence[tuple[Declaration, Any]] = ()) -> None:
        self.stopped = False
        self._stop: Future[None] = Future()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._signalled)
        try:
            non_ros_arguments([name, *argv])
            with joining(), plain_errors():
                rclpy.init(args=list(argv), signal_handler_options=SignalHandlerOptions.NO)
                # Their parameters may be set to their present values, as `ros2 param load` of their own dump does.
                self.node = ServingNode(name, enable_rosout=False, automatically_declare_parameters_from_overrides=True)
        # An argument is invalid, or the profile of the middleware could not be read.
        except ValueError as error:
            # An invalid node name is refused only after rclpy has started.
            rclpy.try_shutdown()
            raise BagError(str(error)) from None
        Session.opened = self
        options = {declaration.name: value for declaration, value in parameters}
        for name, parameter in self.node.get_parameters_by_prefix("").items():
            # A file of `ros2 param dump` has the options too; the same value is no attempt to change one.
            if name in options and parameter.value == options[name]:
                self.node.undeclare_parameter(name)
            elif name not in _OF_ROS and not name.startswith("qos_overrides."):
                raise BagError(
                    f"parameter {name} cannot be set to {parameter.value} by ROS arguments; the options that can be "
                    "set are those of --help"
                )
        for declaration, value in parameters:
            self.node.declare_parameter(declaration.name, value, range_descriptor(declaration))
        watch_ports(self.node)
        self.node.serve_by(self.node.timer)
        self._executor: Any = uses.executor()
        self._executor.add_node(self.node)

    def _signalled(self, number: int, frame: FrameType | None) -> None:
        self.stop()

    def stop(self) -> None:
        """End the current and every further `spin`."""
        self.stopped = True
        if not self._stop.done():
            self._stop.set_result(None)

    def spin(self, seconds: float) -> None:
        """Handle events for a while; return early when stopped. An exception of a callback is raised here."""
        while seconds >= 0 and not self.stopped:
            # Python handles a signal only between two calls, hence the slices.
            self._executor.spin_until_future_complete(self._stop, min(seconds, SLICE))
            seconds -= SLICE

    def settle(self) -> None:
        """Process the messages that had arrived when `spin` was stopped."""
        # Where messages cannot be taken directly, each turn of the executor takes one.
        for _ in range(1 if uses.works("take_message") else _QUEUE):
            self._executor.spin_until_future_complete(Future(), 0.0)


class EventPoll:
    """Status events of subscriptions (messages lost, incompatible publishers), read when `poll` is called.

    The EventsExecutor takes one status for each notification. For the second of two notifications it queries the DDS
    reader while it holds the lock that the reader's own thread waits for. Under heavy loss this is a deadlock
    (rmw_fastrtps 8.4). A wait set reports which status is new, and taking a new status does not query the reader.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._group = MutuallyExclusiveCallbackGroup()
        self._handlers: dict[Subscription, list[EventHandler]] = {}

    def add(self, subscription: Subscription, callbacks: Mapping[Event, Callable[[Any], None]]) -> None:
        """Watch a subscription."""
        self._handlers[subscription] = [
            EventHandler(
                callback_group=self._group, callback=callback, event_type=kind, parent_impl=subscription.handle
            )
            for kind, callback in callbacks.items()
        ]
        if not uses.works("wait_set"):
            for handler in self._handlers[subscription]:
                self._node.add_waitable(handler)

    def remove(self, subscription: Subscription) -> None:
        """Forget a subscription."""
        for handler in self._handlers.pop(subscription):
            if not uses.works("wait_set"):
                self._node.remove_waitable(handler)
            handler.destroy()

    def poll(self) -> None:
        """Call back for every status that changed since the last call."""
        handlers = [h for group in self._handlers.values() for h in group]
        if handlers and uses.works("wait_set"):
            for callback, status in uses.news(self._node, handlers):
                callback(status)


def offered(profile: QoSProfile) -> Qos:
    """Return a publisher's profile as a bag stores it."""

    def time(duration: Duration) -> QosTime:
        return QosTime(*divmod(duration.nanoseconds, SECOND))

    return Qos(
        QosHistory(profile.history.value),
        profile.depth,
        QosReliability(profile.reliability.value),
        QosDurability(profile.durability.value),
        time(profile.deadline),
        time(profile.lifespan),
        QosLiveliness(profile.liveliness.value),
        time(profile.liveliness_lease_duration),
        profile.avoid_ros_namespace_conventions,
    )


def subscription_profile(publishers: Sequence[QoSProfile]) -> QoSProfile:
    """Return the strongest profile that all publishers satisfy.

    History is keep all: with keep last, a message that arrives while the reader's queue is full replaces another
    without a trace; with keep all it is refused, the publisher repeats it, and a loss is reported.
    """
    reliable = all(p.reliability == ReliabilityPolicy.RELIABLE for p in publishers)
    latched = all(p.durability == DurabilityPolicy.TRANSIENT_LOCAL for p in publishers)
    return QoSProfile(
        history=HistoryPolicy.KEEP_ALL,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def is_topic_name(name: str) -> bool:
    """Return whether ROS has topics of a name, which may be relative."""
    try:
        validate_full_topic_name(name if name.startswith("/") else f"/{name}")
    except InvalidTopicNameException:
        return False
    return True


def publisher_profile(topic: BagTopic) -> QoSProfile:
    """Return the strongest profile that the recorded publishers offered: it suits all their subscribers.

    Several latched publishers become one. It keeps as many messages for a late subscriber as they kept together, and
    not fewer than the 10 of the offer to which rosbag2 adapts theirs (`Rosbag2QoS::adapt_offer_to_recorded_offers`).
    """
    unreliable = topic.offered and all(q.reliability == QosReliability.BEST_EFFORT for q in topic.offered)
    latched = [q for q in topic.offered if q.durability == QosDurability.TRANSIENT_LOCAL]
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(_ADAPTED, sum(map(_depth, latched))) if latched else _QUEUE,
        reliability=ReliabilityPolicy.BEST_EFFORT if unreliable else ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def _depth(latched: Qos) -> int:
    return latched.depth or 1 if latched.history == QosHistory.KEEP_LAST else _QUEUE
