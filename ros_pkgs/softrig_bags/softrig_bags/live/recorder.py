"""Record topics into a bag: the bytes of the wire, and a count of the messages that were lost."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.event_handler import QoSSubscriptionEventType as Event, SubscriptionEventCallbacks
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo
from softrig_core import RunError
from softrig_nodes.below.uses import pending_messages
from softrig_nodes.ros.messages import message_class
from softrig_nodes.seam.awaited import RECORDER, left_out
from softrig_nodes.seam.tick import TICK

from ..content.stamps import is_stamped, stamp
from ..content.topics import BagTopic
from ..files.bag import BagWriter
from .holds import Holds, patience
from .join import Join, missed
from .ros import EventPoll, Session, offered, subscription_profile
from .selection import Selection

# In s. With the 0.5 MB of a chunk this is the most that a kill -9 can cost.
FLUSH_PERIOD = 0.5
DISCOVERY_PERIOD = 0.1  # s
# Bytes kept free on the disk, so that index and metadata can be written when it is full.
RESERVE = 1 << 20


class Recorder:
    """Subscribes to selected topics as they appear and writes every message.

    Parameters
    ----------
    stamped : bool
        Bag time is the header stamp (topics without header: the newest stamp seen) instead of the time of arrival.
    holds : Holds, optional
        Notices that this process was held.
    """

    def __init__(
        self,
        session: Session,
        writer: BagWriter,
        selection: Selection,
        stamped: bool = False,
        holds: Holds | None = None,
    ) -> None:
        self._session = session
        self._node = session.node
        self._writer = writer
        self._selection = selection
        self._stamped = stamped
        self._newest = 0
        self._subscriptions: dict[str, Subscription] = {}
        self._types: dict[str, str] = {}  # types of the subscriptions, by topic
        self._numbers: dict[tuple[str, str], int] = {}  # number of each topic and type
        self._refused: dict[tuple[str, str], str] = {}  # why a topic and type is not recorded
        self._left_out: set[str] = set()
        self._joins: dict[tuple[str, str], Join] = {}
        self._events = EventPoll(self._node)
        self._lost: dict[str, int] = {}
        self._lost_before: dict[str, int] = {}
        self.holds = holds or Holds(patience())
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._asks = self._node.create_publisher(message_class(TICK), RECORDER, 10)
        self._node.create_timer(DISCOVERY_PERIOD, self._discover, clock=steady)
        self._node.create_timer(FLUSH_PERIOD, self._flush, clock=steady)

    @property
    def lost(self) -> dict[str, int]:
        """Number of messages lost by topic."""
        topics = dict.fromkeys(name for name, _ in self._numbers)
        return {t: n for t in topics if (n := self._lost.get(t, 0) + self._lost_before.get(t, 0))}

    @property
    def missed(self) -> dict[str, int]:
        """Number of messages by topic that were published before this recorder joined, from stamps and numbers."""
        return missed((name, join) for (name, _), join in self._joins.items())

    @property
    def refused(self) -> list[str]:
        """Topics that were published and not recorded, with the reason."""
        return [f"{name} {reason}" for (name, _), reason in self._refused.items()]

    def losses(self) -> str:
        """Describe in a few words what is missing."""
        lost, missed = self.lost, self.missed
        counted = [f"LOST {sum(lost.values())}: {_listed(lost)}"] if lost else []
        if missed:
            counted.append(f"JOINED LATE, MISSED {sum(missed.values())}: {_listed(missed)}")
        uncounted = [f"NOT RECORDED: {'; '.join(self.refused)}"] if self._refused else []
        if self.holds.gaps:
            uncounted.append(f"HELD for {self.holds}: what was sent then may be missing")
        if uncounted and not counted:
            return f"none counted as lost, but {'; '.join(uncounted)}"
        return "; ".join([*counted, *uncounted]) or "none lost"

    def run(self) -> None:
        """Record until a signal is received, then store the messages that have arrived, and close the bag.

        Raises
        ------
        RunError
            The disk is full or broken; the bag is closed and holds everything written before.
        """
        self._discover()
        gc.collect()
        gc.freeze()
        try:
            while not self._session.stopped:
                self._session.spin(1.0)
            self._session.settle()
            self._drain()
            self._events.poll()
            self._note_losses()
            self._note_holds()
            if self.missed:
                self._writer.custom_data["missed"] = _listed(self.missed)
            if self._refused:
                self._writer.custom_data["not_recorded"] = "; ".join(self.refused)
            self._writer.close()
        except OSError as error:
            unwritten = self._writer.salvage()
            raise RunError(
                f"recording stopped: {error.strerror}; the last {unwritten} messages are lost, "
                f"{self._writer.directory} holds {self._writer.count}"
            ) from error

    def _discover(self) -> None:
        self._note_holds()
        for name, types in self._node.get_topic_names_and_types():
            if name not in self._selection:
                self._left_out.add(name)
            elif self._types.get(name) is None or len(types) > 1:
                self._follow(name)
        unread = self._left_out | {name for name, _ in self._refused if name not in self._types}
        self._asks.publish(left_out(self._node.get_fully_qualified_name(), sorted(unread)))

    def _follow(self, name: str) -> None:
        """Subscribe a topic with the type of its publishers, which may be another one than before.

        The middleware has one type for a topic in a process: of publishers of two types at a time one is recorded.
        """
        types = list(dict.fromkeys(p.topic_type for p in self._publishers(name)))
        usable = [t for t in types if self._is_usable(name, t)]
        if not usable:
            return
        if self._types.get(name) not in usable:
            if name in self._types:
                self._unsubscribe(name)
            self._subscribe(name, usable[0])
        for msgtype in usable:
            if msgtype != self._types[name]:
                self._refuse(name, msgtype, f"as {msgtype}: it is published as {self._types[name]} at the same time")

    def _is_usable(self, name: str, msgtype: str) -> bool:
        try:
            message_class(msgtype)
        except (ImportError, AttributeError):
            self._refuse(name, msgtype, f"as {msgtype}: this type is not installed here")
            return False
        return True

    def _refuse(self, name: str, msgtype: str, reason: str) -> None:
        if (name, msgtype) not in self._refused:
            self._refused[name, msgtype] = reason
            self._node.get_logger().error(f"{name} is not recorded {reason}")

    def _publishers(self, name: str) -> list[TopicEndpointInfo]:
        # The recorder publishes on topics of its own, which are not to be recorded.
        own_name = self._node.get_name()
        return [p for p in self._node.get_publishers_info_by_topic(name) if p.node_name != own_name]

    def _subscribe(self, name: str, msgtype: str) -> None:
        publishers = [p for p in self._publishers(name) if p.topic_type == msgtype]
        topic = BagTopic.known(name, msgtype, [offered(p.qos_profile) for p in publishers])
        if (name, msgtype) not in self._numbers:
            self._numbers[name, msgtype] = self._writer.add_topic(topic)
            self._node.get_logger().info(f"recording {name} [{msgtype}]")
        self._types[name] = msgtype

        def lost(event: Any) -> None:
            self._lost[name] = event.total_count

        subscription = self._subscriptions[name] = self._node.create_subscription(
            message_class(msgtype),
            name,
            self._receiver(topic),
            subscription_profile([p.qos_profile for p in publishers]),
            raw=True,
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
        )
        self._events.add(
            subscription,
            {
                Event.RCL_SUBSCRIPTION_MESSAGE_LOST: lost,
                Event.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS: lambda _: self._adapt(name, msgtype),
            },
        )

    def _adapt(self, name: str, msgtype: str) -> None:
        """Subscribe again, because a new publisher offers a weaker QoS than those before.

        Messages sent while the publishers match the new subscription (some ms) are lost and not counted.
        """
        self._unsubscribe(name)
        if any(p.topic_type == msgtype for p in self._publishers(name)):
            self._subscribe(name, msgtype)

    def _unsubscribe(self, name: str) -> None:
        subscription = self._subscriptions.pop(name)
        del self._types[name]
        self._events.remove(subscription)
        # Messages in its queue would be lost with the subscription.
        self._receive_pending(subscription)
        self._node.destroy_subscription(subscription)
        self._lost_before[name] = self._lost_before.get(name, 0) + self._lost.pop(name, 0)

    def _receiver(self, topic: BagTopic) -> Callable[[bytes], None]:
        write, number, now = self._writer.write, self._numbers[topic.name, topic.msgtype], time.time_ns
        join = self._joins.setdefault((topic.name, topic.msgtype), Join(topic))
        arrival, has_stamp = not self._stamped, is_stamped(topic)

        def receive(data: bytes) -> None:
            if arrival:
                t = now()
            elif has_stamp:
                # A bag cannot hold a negative time, but a message with a bad stamp must not end the recording.
                t = max(stamp(data), 0)
                self._newest = max(self._newest, t)
            else:  # a topic without a header: the newest stamp is the tick at which it was sent
                t = self._newest
            write(number, t, data)
            if join.open:
                join.inspect(data)

        return receive

    def _flush(self) -> None:
        self._writer.flush()
        self._events.poll()
        self._note_losses()

    def _note_losses(self) -> None:
        result = self.lost
        text = _listed(result)
        if text != self._writer.custom_data.get("lost", ""):
            self._writer.custom_data["lost"] = text
            self._node.get_logger().error(f"messages lost so far: {text}")

    def _note_holds(self) -> None:
        if self.holds.wake(self._count):
            self._writer.custom_data["held"] = str(self.holds)
            self._node.get_logger().error(
                f"this process was held for {self.holds}: publishers may have considered it dead; messages that "
                "they published then are neither recorded nor counted"
            )

    def _count(self) -> int:
        self._writer.flush()
        return self._writer.count

    def _drain(self) -> None:
        """Receive the messages that had arrived before the signal."""
        for subscription in self._subscriptions.values():
            self._receive_pending(subscription)

    def _receive_pending(self, subscription: Subscription) -> None:
        for data in pending_messages(subscription):
            subscription.callback(data)


def _listed(counts: dict[str, int]) -> str:
    return ", ".join(f"{topic}: {n}" for topic, n in counts.items())
