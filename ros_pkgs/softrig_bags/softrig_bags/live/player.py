"""Play a bag: against the wall clock, or tick by tick with a node that answers."""

from __future__ import annotations

import gc
import math
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby, islice
from operator import itemgetter
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.node import NodeNameNonExistentError
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import HistoryPolicy, QoSProfile
from rclpy.subscription import Subscription
from softrig_core import SECOND, Recording, RunError
from softrig_core.wire import parameter_event
from softrig_core.wire.cdr import Layout
from softrig_core.wire.parameter_event import decode
from softrig_core.wire.recording import relative
from softrig_nodes.below.uses import RCLError
from softrig_nodes.ros.messages import message_class
from std_srvs.srv import Trigger

from ..content.stamps import is_stamped, stamp
from ..content.topics import BagTopic
from ..errors import BagError
from ..files.reader import LATEST, BagReader
from .ros import Session, publisher_profile

CLOCK = "/clock"
CHANGES = f"/{parameter_event.TOPIC}"
# Stands for "no tick follows"; it is later than any change of parameters that is still to be set.
OVER = 2**63 - 1, None
# The longest wall-clock time in s between two /clock messages, also where the bag has long gaps.
CLOCK_STEP = 0.025
WATCH_PERIOD = 0.25  # s


class Publishers:
    """The publishers of the topics that are played, and their subscribers.

    Parameters
    ----------
    remap : mapping of str to str
        Recorded name to name to publish.
    """

    def __init__(self, session: Session, bag: BagReader, topics: Sequence[BagTopic], remap: Mapping[str, str]) -> None:
        self._node = session.node
        self.names = {t.name: remap.get(t.name, t.name) for t in topics}
        self._publishers: dict[int, Any] = {}
        for i, topic in enumerate(bag.topics):
            if topic in topics:
                kind = _class(topic)
                name = self.names[topic.name]
                self._publishers[i] = self._node.create_publisher(kind, name, publisher_profile(topic))
        self.publish: dict[int, Callable[[bytes], None]] = {i: p.publish for i, p in self._publishers.items()}
        self.refused: Counter[str] = Counter()  # messages by topic

    def send(self, i: int, data: bytes) -> bool:
        """Publish a message of a topic; return whether the middleware accepted its bytes, which may be damaged."""
        try:
            self.publish[i](data)
        except RCLError:
            self.refused[self._publishers[i].topic_name] += 1
            return False
        return True

    def unheard(self, names: Sequence[str]) -> list[str]:
        """Return the published topics that have no subscriber."""
        received = {p.topic_name for p in self._publishers.values() if p.get_subscription_count()}
        return [n for n in names if n not in received]

    def finish(self) -> None:
        """Wait until every subscriber has the last messages."""
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=2))


def _class(topic: BagTopic) -> Any:
    try:
        return message_class(topic.msgtype)
    except (ImportError, AttributeError):
        raise BagError(
            f"{topic.name} is of type {topic.msgtype}, which is not installed here; leave it out with --exclude"
        ) from None


class Pauser:
    """The services ``~/pause``, ``~/resume`` and ``~/step``; a step is all messages of the next bag time."""

    def __init__(self, session: Session, paused: bool, on_change: Callable[[], None] = lambda: None) -> None:
        self.paused = paused
        self.steps = 0
        self._on_change = on_change
        for name in ("pause", "resume", "step"):
            session.node.create_service(Trigger, f"~/{name}", partial(self._serve, name))

    def _serve(self, name: str, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.paused = name != "resume"
        self.steps = self.steps + (name == "step") if self.paused else 0
        response.success = True
        self._on_change()
        return response


@dataclass
class Span:
    """The part of a bag that is played: bag times in ns, the end included."""

    start: int
    end: int


def span(bag: BagReader, offset: float, duration: float | None) -> Span:
    """Return the span that begins `offset` s after the first message and lasts `duration` s.

    Raises
    ------
    BagError
        The bag is empty, or the offset is after its end.
    """
    if bag.is_empty:
        raise BagError(f"{bag.path} is empty")
    start = bag.start + round(offset * SECOND)
    if start > bag.end:
        raise BagError(f"start offset {offset:g} s: the bag is only {(bag.end - bag.start) / SECOND:g} s long")
    return Span(start, LATEST if duration is None else start + round(duration * SECOND))


class Player:
    """Plays against the wall clock, at any rate; messages of equal times in their recorded order.

    Parameters
    ----------
    rate : float
        Bag seconds a wall-clock second.
    loop : bool
        Begin again at the end.
    clock : bool
        Publish bag time on /clock before the messages of each bag time, and in between.
    paused : bool
        Wait for ``~/resume`` or ``~/step``.
    """

    def __init__(
        self,
        session: Session,
        bag: BagReader,
        publishers: Publishers,
        interval: Span,
        *,
        rate: float,
        loop: bool,
        clock: bool,
        paused: bool,
    ) -> None:
        self._session, self._bag, self._publishers, self._part = session, bag, publishers, interval
        self._rate, self._loop = rate, loop
        self._pauser = Pauser(session, paused)
        self._clock: Callable[[bytes], None] | None = None
        if clock:
            profile = QoSProfile(depth=10)
            self._clock = session.node.create_publisher(
                message_class("rosgraph_msgs/msg/Clock"), CLOCK, profile
            ).publish
        self._layout = Layout("rosgraph_msgs/msg/Clock")
        self._wall, self._served, self._now = 0.0, 0.0, 0
        self.sent = 0

    def run(self, wait: bool = False) -> None:
        """Play until the end or until stopped.

        Parameters
        ----------
        wait : bool
            Do not start before every topic has a subscriber.
        """
        while wait and not self._session.stopped and self._publishers.unheard(list(self._publishers.names.values())):
            self._session.spin(0.02)
        gc.collect()
        # Objects that exist now live until the end; a collection that visits them would delay messages.
        gc.freeze()
        while not self._session.stopped:
            self._once()
            if not self._loop:
                break
        self._publishers.finish()

    def _once(self) -> None:
        self._wall, self._now = time.monotonic(), self._part.start
        publish, now = self._publishers.publish, -1
        for i, t, data in self._bag.messages(self._publishers.names, self._part.start):
            if t > self._part.end:
                break
            # A topic of two types has one publisher, so the messages of the other type are left out.
            if i not in publish:
                continue
            if t != now:
                self._wait(t)
                now = t
            if self._session.stopped:
                return
            self.sent += self._publishers.send(i, data)

    def _wait(self, t: int) -> None:
        """Return when bag time `t` is due."""
        session, pauser = self._session, self._pauser
        while not session.stopped:
            wall = time.monotonic()
            if not pauser.paused:
                self._now += round((wall - self._wall) * self._rate * SECOND)
            self._wall = wall
            # The player is late, but ~/pause and ~/resume must be answered all the same.
            if wall - self._served > CLOCK_STEP:
                self._served = wall
                session.spin(0)
            if pauser.paused and pauser.steps:
                pauser.steps -= 1
                self._now = t
                break
            if self._now >= t and not pauser.paused:
                break
            left = math.inf if pauser.paused else (t - self._now) / SECOND / self._rate
            session.spin(min(left, CLOCK_STEP))
            self._served = time.monotonic()
            if self._clock is not None and not pauser.paused and left > CLOCK_STEP:
                self._clock(self._layout.encode(self._now, ()))
        if self._clock is not None:
            self._clock(self._layout.encode(t, ()))


@dataclass
class Answers:
    """Messages that the node under test has published on one topic, and those expected of it.

    Parameters
    ----------
    name : str
        Recorded topic name.
    recorded : bool
        Whether the bag determines which ticks are answered; otherwise an answer is expected at every tick.
    """

    name: str
    msgtype: str
    recorded: bool
    stamped: bool
    ticks: list[int] = field(default_factory=list)
    stamps: list[int] = field(default_factory=list)
    data: list[bytes] = field(default_factory=list)

    def expect(self, tick: int, header: int) -> None:
        """Await one more answer, of a tick and with a header stamp; RunError: it has arrived with another stamp."""
        self.ticks.append(tick)
        self.stamps.append(header)
        self._check(len(self.ticks) - 1)

    def receive(self, data: bytes) -> None:
        """Return the next answer; RunError: an answer with another stamp is awaited."""
        self.data.append(data)
        self._check(len(self.data) - 1)

    @property
    def missing(self) -> bool:
        """Return whether an answer is awaited."""
        return len(self.data) < len(self.ticks)

    def _check(self, i: int) -> None:
        if not self.stamped or i >= min(len(self.data), len(self.ticks)):
            return
        result, wanted = stamp(self.data[i]), self.stamps[i]
        if result != wanted:
            raise RunError(f"{self.name}: answer stamped {result / SECOND:.9g} s, expected {wanted / SECOND:.9g} s")


def _changes(bag: BagReader) -> Iterator[tuple[int, str, dict[str, Any]]]:
    """Yield the changes of parameters in a bag: tick (ns), node, new values."""
    if any(topic.name == CHANGES for topic in bag.topics):
        for _, _, data in bag.messages([CHANGES], 0):
            t, node, values = decode(data)
            yield t, node.rpartition("/")[2], values


class LockstepPlayer:
    """Plays tick by tick: the next tick is sent when the node under test has answered the last one.

    The tick of a message is its bag time if that is simulated time (bags of a run, `recorder` with ``--use-sim-time``:
    some message has its stamp as bag time), else its header stamp; a message without header belongs to the tick before
    it. Answers are expected at the ticks at which the bag has answers, or at every tick if it has none. A node that may
    be silent on all topics publishes its ticks on ``<node>/tick``; the player waits for each of them. Parameter changes
    that the bag has on ``/parameter_events`` for a node with the name of the one under test are set before their tick.

    Parameters
    ----------
    publishers : Publishers
        Of the topics that are played, without those of the answers.
    answers : sequence of str
        Recorded names of the topics that the node under test publishes.
    remap : mapping of str to str
        Recorded name to the name on which the node publishes.
    timeout : float
        Wall-clock seconds without progress that end the replay.
    """

    def __init__(
        self,
        session: Session,
        bag: BagReader,
        publishers: Publishers,
        answers: Sequence[str],
        remap: Mapping[str, str],
        interval: Span,
        *,
        timeout: float = 10.0,
        paused: bool = False,
    ) -> None:
        self._session, self._bag, self._publishers, self._part = session, bag, publishers, interval
        self._names, self._remap = answers, remap
        self._timeout = timeout
        self._pauser = Pauser(session, paused, self._step)
        self._answers: dict[str, Answers] = {}
        self._subscriptions: list[Subscription] = []
        self._paces: set[str] = set()
        self._changes = deque(_changes(bag))
        self._tuned: dict[str, AsyncParameterClient] = {}
        self._setting = False
        self._groups = self._ticks()
        self._following: tuple[int, Sequence[tuple[int, bytes]] | None] = next(self._groups, OVER)
        self._ready = self._finished = False
        self._tick = interval.start
        self._progress = (-1, time.monotonic())
        self.sent = 0

    def run(self) -> Recording:
        """Wait for the node, play all ticks, and return its answers; their times are the ticks.

        Raises
        ------
        RunError
            The node did not start, did not answer in time, or answered another tick; or a signal was received.
        """
        session = self._session
        session.node.create_timer(WATCH_PERIOD, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME))
        while not session.stopped and not self._listening():
            session.spin(0.02)
        while not session.stopped and self._absent():
            session.spin(0.02)
        gc.collect()
        gc.freeze()
        self._ready = True
        self._step()
        while not session.stopped:
            session.spin(1.0)
        self._publishers.finish()
        if not self._finished:
            raise RunError(f"stopped at t = {self._tick / SECOND:.9g} s")
        answers = [a for a in self._answers.values() if a.name not in self._paces]
        result = Recording((relative(a.name), a.msgtype) for a in answers)
        for i, answer in enumerate(answers):
            for tick, data in zip(answer.ticks, answer.data, strict=False):
                result.add(i, tick, data)
        return result

    def _listening(self) -> bool:
        """Subscribe to the answers as soon as their types are known."""
        recorded = {t.name: t for t in self._bag.topics}
        types = dict(self._session.node.get_topic_names_and_types())
        for name in self._names:
            live = self._remap.get(name, name)
            if name in self._answers or (name not in recorded and live not in types):
                continue
            topic = recorded.get(name) or BagTopic.known(name, types[live][0])
            self._subscribe(topic, live, name in recorded)
        return all(name in self._answers for name in self._names)

    def _subscribe(self, topic: BagTopic, live: str, recorded: bool) -> None:
        answer = self._answers[topic.name] = Answers(topic.name, topic.msgtype, recorded, is_stamped(topic))

        def receive(data: bytes) -> None:
            answer.receive(data)
            self._step()

        # Every answer counts, so none may be replaced by a newer one in the queue.
        profile = QoSProfile(history=HistoryPolicy.KEEP_ALL)
        self._subscriptions.append(
            self._session.node.create_subscription(_class(topic), live, receive, profile, raw=True)
        )

    def _absent(self) -> list[str]:
        """Describe what is not matched yet: the publishers of answers, and the node's own subscriptions."""
        node, absent, wanted = self._session.node, [], set()
        played = set(self._publishers.names.values())
        for subscription in list(self._subscriptions):
            topic = subscription.topic_name
            publishers = node.get_publishers_info_by_topic(topic)
            # The answers of two nodes could not be told apart.
            if len(publishers) > 1:
                raise RunError(f"{len(publishers)} publishers on {topic}, expected exactly one")
            if not publishers or not subscription.get_publisher_count():
                absent.append(f"no node publishes {topic}")
                continue
            publisher = publishers[0]
            try:
                inputs = node.get_subscriber_names_and_types_by_node(publisher.node_name, publisher.node_namespace)
            # Discovery has found the publisher, but not yet the name of its node.
            except (NodeNameNonExistentError, RCLError):
                absent.append(f"the node behind {topic} is not known yet")
                continue
            wanted |= played.intersection(name for name, _ in inputs)
            absent += self._untuned(publisher.node_name, publisher.node_namespace)
            absent += self._paced(f"{publisher.node_namespace.rstrip('/')}/{publisher.node_name}")
        if not absent and not wanted:
            absent.append(f"the node subscribes none of {', '.join(sorted(played))}")
        return absent + [f"{name} is not matched" for name in self._publishers.unheard(sorted(wanted))]

    def _untuned(self, name: str, namespace: str) -> list[str]:
        """Create clients that set the parameters whose changes are in the bag; describe what is not matched yet."""
        if not any(node == name for _, node, _ in self._changes):
            return []
        full = f"{namespace.rstrip('/')}/{name}"
        client = self._tuned.setdefault(name, AsyncParameterClient(self._session.node, full))
        return [] if client.services_are_ready() else [f"the parameter services of {full} are not matched"]

    def _paced(self, name: str) -> list[str]:
        """Subscribe to the tick topic of a node if it has one; describe what is not matched yet."""
        tick = f"{name}/tick"
        if tick in self._paces or tick in self._answers or not self._session.node.count_publishers(tick):
            return []
        self._paces.add(tick)
        self._subscribe(BagTopic.known(tick, "std_msgs/msg/Header"), tick, False)
        return [f"{tick} is not matched"]

    def _step(self) -> None:
        """Send ticks until one is to be answered."""
        pauser = self._pauser
        while self._may_step():
            if self._changes and self._changes[0][0] <= self._following[0] and self._set():
                return
            if pauser.paused:
                if not pauser.steps:
                    return
                pauser.steps -= 1
            tick, messages = self._following
            if messages is None:
                self._finished = True
                self._session.stop()
                return
            self._following = next(self._groups, OVER)
            self._send(tick, messages)

    def _may_step(self) -> bool:
        waiting = self._setting or any(a.missing for a in self._answers.values())
        return self._ready and not self._finished and not waiting

    def _set(self) -> bool:
        """Set the changes of the bag before the next tick; return whether an answer must be waited for."""
        _, node, values = self._changes.popleft()
        client = self._tuned.get(node)
        # The change is of another node than the one under test.
        if client is None:
            return False
        self._setting = True
        asked = client.set_parameters_atomically([Parameter(name, value=v) for name, v in values.items()])
        asked.add_done_callback(lambda answer: self._was_set(node, values, answer.result()))
        return True

    def _was_set(self, node: str, values: Mapping[str, Any], answer: Any) -> None:
        if not answer.result.successful:
            raise RunError(
                f"{node} refuses {', '.join(values)} at t = {self._following[0] / SECOND:.9g} s: {answer.result.reason}"
            )
        self._setting = False
        self._step()

    def _send(self, tick: int, messages: Sequence[tuple[int, bytes]]) -> None:
        self._tick = tick
        publish, sent = self._publishers.publish, self.sent
        for i, data in messages:
            if i in publish:
                self.sent += self._publishers.send(i, data)
            else:
                answer = self._answers[self._bag.topics[i].name]
                answer.expect(tick, stamp(data) if answer.stamped else 0)
        if self.sent > sent:
            for answer in self._answers.values():
                if not answer.recorded:
                    answer.expect(tick, tick)

    def _ticks(self) -> Iterator[tuple[int, list[tuple[int, bytes]]]]:
        """Yield the messages of each tick, played and answers, in their recorded order."""
        interval, wanted = self._part, {*self._publishers.names, *self._names}
        stamped = [is_stamped(t) for t in self._bag.topics]
        messages: Iterator[tuple[int, int, bytes]]
        numbers = {i for i, topic in enumerate(self._bag.topics) if topic.name in self._names}
        # Of two types on a topic one is played.
        numbers |= self._publishers.publish.keys()
        published = self._bag.messages(wanted, interval.start)
        messages = ((t, i, d) for i, t, d in published if t <= interval.end and i in numbers)
        # The first messages show whether bag time is simulated time; one whose stamp is its bag time decides.
        head = list(islice(messages, 200))
        messages = chain(head, messages)
        if not any(stamped[i] and stamp(data) == t for t, i, data in head):
            tick = 0
            results: list[tuple[int, int, bytes]] = []
            for _, i, data in messages:
                tick = stamp(data) if stamped[i] else tick
                results.append((tick, i, data))
            # Header stamps need not ascend in a bag by arrival, and `groupby` needs the messages of a tick side by
            # side.
            messages = iter(sorted(results, key=itemgetter(0)))
        for tick, group in groupby(messages, key=itemgetter(0)):
            yield tick, [(i, data) for _, i, data in group]

    def _watch(self) -> None:
        """End a replay that makes no progress."""
        now, received = time.monotonic(), sum(len(a.data) for a in self._answers.values()) + self.sent
        if received != self._progress[0] or self._pauser.paused:
            self._progress = (received, now)
        elif now - self._progress[1] > self._timeout:
            if self._ready:
                lacking = ", ".join(a.name for a in self._answers.values() if a.missing)
                raise RunError(f"no answer to t = {self._tick / SECOND:.9g} s on {lacking} within {self._timeout:g} s")
            # The types of the answers must be known before their publishers can be looked for.
            absent = self._absent() if self._listening() else [f"no node publishes {', '.join(self._names)}"]
            raise RunError(f"no node to play to within {self._timeout:g} s: {'; '.join(absent)}")
