"""ROS 2 behind the seam `Middleware`: one rclpy node."""

from __future__ import annotations

import time
from ast import literal_eval
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.logging import LoggingSeverity
from rclpy.node import Node, NodeNameNonExistentError
from rclpy.parameter import Parameter, get_parameter_value
from rclpy.qos import (
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
    qos_check_compatible,
    qos_profile_services_default,
)
from rclpy.qos_overriding_options import QoSOverridingOptions, QoSPolicyKind
from rclpy.topic_endpoint_info import TopicEndpointInfo
from softrig_core.block.block import Level
from softrig_core.errors import RunError, closest
from softrig_core.wire.cdr import Layout
from yaml import YAMLError

from ..below.arrival import Arrival, library
from ..below.uses import (
    RCLError,
    descriptors,
    endpoints,
    keep_overrides,
    leave_to_executor,
    leave_to_us,
    log,
    options as made_with,
    overrides,
    parameters,
    sending,
    services,
    works,
)
from ..processes.dead_locks import DeadLocks
from ..processes.shared_memory import Ears, domain_id
from ..seam.middleware import Matched, Middleware, Numbered, Peer, Place, Reader, Receive, Send
from ..seam.monitor import Monitor
from .garbage import Garbage
from .messages import message_class
from .processor import Processor
from .requests import BUSY, IDLE, MOST, Credit, Periodic, Requests

# Depth 10: in lockstep at most two messages of a topic are ever under way; outside readers get some slack.
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)

# A Fast DDS writer with a full history asks all readers for an acknowledgement at each message, and they answer;
# otherwise it asks every 50 ms, in which a lockstep loop sends some hundred messages: a seventh of the processor time
# of a tick.
WRITTEN = QoSProfile(depth=200, reliability=ReliabilityPolicy.RELIABLE)

OF_QOS = "qos_overrides."  # prefix of the names of QoS parameters
POLICIES = (
    QoSPolicyKind.HISTORY,
    QoSPolicyKind.DEPTH,
    QoSPolicyKind.RELIABILITY,
    QoSPolicyKind.DURABILITY,
    QoSPolicyKind.LIFESPAN,
    QoSPolicyKind.DEADLINE,
)

LOOK = 20_000_000  # ns: between two checks of the number of writers
SEARCH = 250_000_000  # ns: between two looks for garbage that a tick may have left
PATIENCE = 2.0  # s: for a tick under way in another thread at the end
# s: time for subscribers to receive the last messages, which are lost when their writer is removed. On a busy host this
# may take seconds.
LAST = 10.0

# A number without a point, as 1e-05, is text for YAML 1.1; a list with one of them is one text.
NUMBERS = (Parameter.Type.INTEGER, Parameter.Type.STRING)
LISTS = (Parameter.Type.INTEGER_ARRAY, Parameter.Type.STRING_ARRAY, Parameter.Type.STRING)
TYPES = {kind.value for kind in Parameter.Type}
LONG = 100  # characters of a name or a value in a message
EMPTY = (Parameter.Type.BOOL_ARRAY, Parameter.Type.BYTE_ARRAY)  # types that a list without elements may have
ARRAYS = (Parameter.Type.INTEGER_ARRAY, Parameter.Type.DOUBLE_ARRAY, Parameter.Type.STRING_ARRAY)

KINDS = {
    Parameter.Type.BOOL: "true or false",
    Parameter.Type.INTEGER: "a whole number",
    Parameter.Type.DOUBLE: "a number",
    Parameter.Type.STRING: "text",
    Parameter.Type.BOOL_ARRAY: "a list of true and false",
    Parameter.Type.INTEGER_ARRAY: "a list of whole numbers",
    Parameter.Type.DOUBLE_ARRAY: "a list of numbers",
    Parameter.Type.STRING_ARRAY: "a list of texts",
}

# Called with a request, an empty response, and optionally the seconds without time for it.
Answer = Callable[..., Any]
SEVERITY = {Level.OK: LoggingSeverity.INFO, Level.WARN: LoggingSeverity.WARN, Level.ERROR: LoggingSeverity.ERROR}


class ServingNode(Node):  # type: ignore[misc]
    """A node whose services survive any request: rclpy's own end the node at a parameter of an unknown type.

    Parameters that are set in one request are set together if all are valid; otherwise each is set by itself (`ros2
    param load` of a whole file). An integer is accepted for a real number. A read-only parameter may be set to the
    value that it has. The ticks of the nodes have priority: all services share one part of the time (see `serve_by`). A
    set that has waited too long for it is refused, and the answer states when to try again.

    Attributes
    ----------
    remark : str
        Remark on an accepted set; rclpy reports only the reason of a refusal.
    overdrawn : callable
        Gets the reason why a set was refused for lack of time.
    dropped : callable
        Called for each answer that is dropped because its client has left.
    monitor : Monitor
        Monitor of all calls of the node: no service is answered during a tick.
    paused : callable
        Returns whether the rig is paused here.
    credit : Credit
        Time that services and other calls from outside may use.
    """

    remark = ""
    paused: Callable[[], bool] = staticmethod(lambda: False)
    overdrawn: Callable[[str], object] = staticmethod(lambda text: None)
    dropped: Callable[[], object] = staticmethod(lambda: None)
    credit = Credit()  # shared by all nodes of a process
    _requests: Requests | None = None

    def __init__(self, *names: Any, **options: Any) -> None:
        self._answering: dict[Any, Answer] = {}
        self.monitor = Monitor(self._wake)
        super().__init__(*names, **options | made_with())
        keep_overrides(self)

    def _wake(self) -> None:
        if (executor := self.executor) is not None:
            executor.create_task(self.monitor.serve)

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], **options: Any) -> Any:
        """Offer a service; a call that fails is refused with the reason."""
        answering = self._refusing(srv_type, srv_name, callback)

        def answer(request: Any, response: Any) -> Any:  # called by an executor
            with self.monitor:
                return answering(request, response)

        options["qos_profile"] = copy(options.get("qos_profile", qos_profile_services_default))
        # In a flood the middleware keeps the newest requests and drops the others (see `requests`).
        options["qos_profile"].depth = MOST
        service = super().create_service(srv_type, srv_name, answer, **options)
        self._answering[service] = answering
        if self._requests is not None:
            self._requests.add(service, answering)
        return service

    def _refusing(self, srv_type: Any, name: str, callback: Callable[[Any, Any], Any]) -> Answer:
        """Return a callback that answers a request, or refuses it if that fails."""

        def answering(request: Any, response: Any, wait: float = 0.0) -> Any:
            try:
                if srv_type is SetParameters:
                    response.results = self._set(request.parameters, wait)
                elif srv_type is SetParametersAtomically:
                    response.result = self._set_together(request.parameters, wait)
                else:
                    return callback(request, response)
            except Exception as error:
                self.get_logger().error(f"{name}: {type(error).__name__}: {error}", once=True)
                refusal = SetParametersResult(successful=False, reason=str(error))
                if srv_type is SetParameters:
                    response.results = [refusal] * len(request.parameters)
                elif srv_type is SetParametersAtomically:
                    response.result = refusal
            return response

        return answering

    def timer(self, ns: int, callback: Callable[[], None]) -> RosTimer:
        """Call back every `ns`, by a clock that cannot be set."""
        return RosTimer(self.create_timer(ns / 1e9, callback, clock=Clock(clock_type=ClockType.STEADY_TIME)))

    def wanting(self) -> float:
        """Return how long an external request has to wait for time to serve it, s; zero if there is time."""
        return 0.0 if self.paused() else self.credit.wanting()

    def serve_by(self, timer: Callable[[int, Callable[[], None]], Periodic]) -> None:
        """Answer requests when a timer fires, so that a flood of them delays neither other timers nor ticks.

        Parameters
        ----------
        timer : callable
            Gets a period in ns and what to call; its calls are in the node's monitor.
        """
        if not works("requests"):
            return
        requests = self._requests = Requests(self, self.credit, lambda: self.paused(), lambda: self.dropped())
        # rclpy has created the service of type descriptions by itself, so it has no callback in `_answering`.
        for service in services(self):
            answering = self._answering.get(service)
            requests.add(service, answering or self._refusing(service.srv_type, service.srv_name, service.callback))

        def serve() -> None:
            periodic.period = BUSY if requests.serve() else IDLE

        periodic = timer(IDLE, serve)

    def _set(self, messages: Sequence[Any], wait: float = 0.0) -> list[SetParametersResult]:
        together = self._set_together(messages, wait)
        if together.successful or len(messages) < 2:
            return [together] * len(messages)
        return [self._set_together([message], wait) for message in messages]

    def _set_together(self, messages: Sequence[Any], wait: float) -> SetParametersResult:
        if wait:
            text = f"more is set than fits between the ticks, expected a pause of {wait:.1f} s"
            self.overdrawn(text)
            return SetParametersResult(successful=False, reason=text)
        known, described = parameters(self), descriptors(self)
        strange = next((m.name for m in messages if m.name not in described), None)
        # rclpy's own refusal would not name the parameter.
        if strange is not None:
            message = strange[:LONG]
            reason = f"{message!r} is not a parameter of {self.get_name()}{closest(message, described)}"
            return SetParametersResult(successful=False, reason=reason)
        untyped = next((m for m in messages if m.value.type not in TYPES), None)
        if untyped is not None:
            reason = f"parameter {untyped.name}: type {untyped.value.type}, expected 0 to {max(TYPES)} (rcl_interfaces)"
            return SetParametersResult(successful=False, reason=reason)
        wanted = [self._meant(m) for m in messages]
        now = {p.name: known[p.name] for p in wanted if p.name in known}
        new = [p for p in wanted if p.name not in now or now[p.name].type_ != p.type_ or plain(now[p.name]) != plain(p)]
        if reason := next(filter(None, map(self._misfit, new)), ""):
            return SetParametersResult(successful=False, reason=reason)
        self.remark = ""
        types = {p.name: described[p.name].type for p in new}
        result = self.set_parameters_atomically(new) if new else SetParametersResult(successful=True)
        # By then rclpy has changed the described type to that of the refused value.
        if not result.successful:
            for name, kind in types.items():
                described[name].type = kind
        result.reason = result.reason or self.remark
        return result

    def _misfit(self, wanted: Parameter) -> str:
        """Describe why a value cannot replace the present one: rclpy accepts any type, and an empty value for a
        removal.
        """
        if wanted.name == "use_sim_time":
            # rclpy makes and destroys a subscription of /clock, which takes Python's lock and those of Fast DDS in the
            # other order than a message that arrives (see `arrival`): the node would hang for ever.
            return "parameter use_sim_time is fixed from the start on: the ticks of this node have a time of their own"
        known = parameters(self)
        kind = known[wanted.name].type_ if wanted.name in known else Parameter.Type.NOT_SET
        if kind in (Parameter.Type.NOT_SET, wanted.type_):
            return ""
        if wanted.type_ == Parameter.Type.NOT_SET:
            return f"parameter {wanted.name} has no value, expected one"
        return f"parameter {wanted.name} = {repr(plain(wanted))[:LONG]}: expected {KINDS.get(kind, kind.name)}"

    def _meant(self, message: Any) -> Parameter:
        """Return the intended value: where floats are expected, numbers of any type become floats."""
        parameter = Parameter.from_parameter_msg(message)
        known = parameters(self).get(parameter.name)
        # rclpy does not store a parameter that was declared without a value.
        if known is None:
            known = Parameter(parameter.name, Parameter.Type.NOT_SET)
        # `ros2 param load` of a dump sends the present values in this form, which must not count as changes of type.
        elif message.value == guessed(plain(known)):
            return known
        real = known.type_ == Parameter.Type.DOUBLE or (
            known.type_ == Parameter.Type.NOT_SET and descriptors(self)[parameter.name].floating_point_range
        )
        with suppress(ValueError, TypeError, SyntaxError):
            if real and parameter.type_ in NUMBERS:
                return Parameter(parameter.name, Parameter.Type.DOUBLE, float(parameter.value))
            if known.type_ == Parameter.Type.INTEGER and parameter.type_ == Parameter.Type.DOUBLE:
                return Parameter(parameter.name, Parameter.Type.INTEGER, as_integer(parameter.value))
            if known.type_ == Parameter.Type.DOUBLE_ARRAY and parameter.type_ in LISTS:
                values = literal_eval(parameter.value) if isinstance(parameter.value, str) else parameter.value
                return Parameter(parameter.name, Parameter.Type.DOUBLE_ARRAY, [*map(float, values)])
            if known.type_ in ARRAYS and parameter.type_ in EMPTY and not parameter.value:
                return Parameter(parameter.name, known.type_, [])
        return parameter


def plain(parameter: Parameter) -> Any:
    """Return a value in the form of the block's parameters: arrays of any kind as lists."""
    value = parameter.value
    return value if value is None or isinstance(value, bool | int | float | str) else list(value)


def as_integer(value: float) -> int:
    """Return a float as the integer that it equals; a ValueError if it is not one."""
    if not value.is_integer() or abs(value) >= 2.0**63:
        raise ValueError(value)
    return int(value)


def guessed(value: Any) -> Any:
    """Return how `ros2 param load` reads a value's text: no value as 'None', an empty list as one of bools."""
    with suppress(YAMLError, AssertionError):
        return get_parameter_value(str(value))
    return None


def _peer(endpoint: TopicEndpointInfo) -> Peer:
    return Peer(endpoint.node_name, endpoint.node_namespace, endpoint.topic_type)


Arguments = ParamSpec("Arguments")


def quiet_after_shutdown(callback: Callable[Arguments, None]) -> Callable[Arguments, None]:
    """End a callback silently if a signal has shut the context down; the executor would log its stack.

    Parameters
    ----------
    callback : callable
        Of a timer or a subscription; it may publish.
    """

    # rclpy inspects the signature of a callback.
    @wraps(callback)
    def call(*data: Arguments.args, **named: Arguments.kwargs) -> None:
        try:
            callback(*data, **named)
        except RCLError:
            if rclpy.ok():
                raise

    return call


def with_number(receive: Receive, numbered: Numbered) -> Callable[..., None]:
    """Return a callback of a subscription that passes the number of each message on before the message."""

    def receive_numbered(*value: Any) -> None:
        # The events executor passes both as one argument (rclpy 7.1), although it checks for a signature with two.
        data, info = value if len(value) == 2 else value[0]
        numbered(info["publication_sequence_number"])
        receive(data)

    receive_numbered.__signature__ = signature(lambda data, info: None)  # type: ignore[attr-defined]
    return receive_numbered


class RosTimer:
    """A timer of rclpy; see `Timer`."""

    def __init__(self, timer: Any) -> None:
        # The grid is the period that `again` was last called with. The period of rclpy's timer is another one for as
        # long as a late timer is drawn along to its grid.
        self._timer, self._grid = timer, 0

    @property
    def period(self) -> int:
        """The time to the call after the next one, ns."""
        return int(self._timer.timer_period_ns)

    @period.setter
    def period(self, ns: int) -> None:
        if ns != self._timer.timer_period_ns:
            self._timer.timer_period_ns = ns

    def again(self, ns: int, period: int = 0) -> None:
        """Fire after `ns` and then with a period."""
        # A reset makes rclpy's executor look at the timers once more (7.1 to 10: `UpdateTimers` of its timers manager),
        # each look that finds one due calls it, and each call looks once more by itself: a late one was called for ever
        # more often, and no message came through. One that has the period already is thus not reset but drawn along.
        timer = self._timer
        left = timer.time_until_next_call() if period and period == self._grid else None
        if left is not None:
            timer.timer_period_ns = period + (ns - left + period // 2) % period - period // 2
            return
        self._grid = period
        timer.timer_period_ns = max(1000, ns)
        timer.reset()
        if period:
            timer.timer_period_ns = period

    def cancel(self) -> None:
        """Never fire again, unless `again` is called."""
        self._timer.cancel()


class RosMiddleware(Middleware):
    """One rclpy node; see `Middleware` for the methods."""

    _ears, _locks = Ears(), DeadLocks()  # shared by all nodes of a process

    def __init__(self, node: ServingNode) -> None:
        self.node = node
        # A person who sets the QoS of a topic may want messages kept for late subscribers, so all of them are
        # published.
        self.mute = not any(name.startswith(OF_QOS) for name in overrides(node))
        self._overridable: list[str] = []  # topics with the kind of endpoint, as names of parameters begin
        self.monitor = node.monitor
        mode = overrides(node).get("run.mode")
        self._written = WRITTEN if mode is not None and mode.value == "lockstep" else QOS
        self._read: list[tuple[Any, Reader]] = []  # subscriptions
        self._arrivals: list[Arrival] = []
        self.name: str = node.get_name()
        self.full_name: str = node.get_fully_qualified_name()
        self._processor: Processor | None = None
        self._posted: list[Callable[[], object]] = []
        # Read once, so that the time of the node goes on evenly if the system's clock is set during the run.
        self._behind = time.time_ns() - time.monotonic_ns()
        node.serve_by(self.timer)

    @property
    def processor(self) -> int | None:  # type: ignore[override]
        """The processor on which the node works; None: any."""
        return None if self._processor is None else self._processor.number

    def resolve(self, topic: str) -> str:
        """Return the full name of a topic, remapping applied."""
        return str(self.node.resolve_topic_name(topic))

    def publisher(self, topic: str, msgtype: str, matched: Matched) -> Callable[[bytes], None]:
        """Offer a topic."""
        events = PublisherEventCallbacks(matched=self._counting(matched))
        with self._deaf():
            publisher = self.node.create_publisher(
                message_class(msgtype),
                topic,
                copy(self._written),
                event_callbacks=events,
                qos_overriding_options=self._overrides(topic, "publisher"),
            )
        return self._sending(publisher)

    def _sending(self, publisher: Any) -> Callable[[bytes], None]:
        return sending(publisher)

    def sender(self, topic: str, layout: Layout, matched: Matched) -> Send:
        """Offer a topic; its messages are serialized only while it has subscribers in another process."""
        if not self.mute:
            return super().sender(topic, layout, matched)
        readers = 0

        def count(number: int) -> None:
            nonlocal readers
            readers = number
            matched(number)

        publish, encode = self.publisher(topic, layout.msgtype, count), layout.encode

        def send(mark: int, values: tuple[float, ...]) -> None:
            if readers:
                publish(encode(mark, values))

        return send

    def subscribe(self, topic: str, msgtype: str, reader: Reader) -> None:
        """Subscribe to the bytes of a topic."""
        receive, numbered = reader.receive, reader.numbered
        events = SubscriptionEventCallbacks(matched=self._counting(reader.matched))
        accept = self._in_turn(receive if numbered is None else with_number(receive, numbered))
        with self._deaf():
            subscription = self.node.create_subscription(
                message_class(msgtype),
                topic,
                accept,
                copy(QOS),
                raw=True,
                event_callbacks=events,
                qos_overriding_options=self._overrides(topic, "subscription"),
            )
        self._read.append((subscription, reader))

    def _counting(self, matched: Matched) -> Callable[[Any], None]:
        """Return a callable that receives changes of the matched endpoints."""
        call = self._in_turn(matched)
        return lambda status: call(status.current_count)

    def _in_turn(self, callback: Callable[Arguments, None]) -> Callable[Arguments, None]:
        """Let a callback of the executor wait for the end of a tick in another thread."""

        @wraps(callback)
        def call(*data: Arguments.args, **named: Arguments.kwargs) -> None:
            with self.monitor:
                callback(*data, **named)

        return quiet_after_shutdown(call)

    # answers where messages arrive -------------------------------------------------------------------------------

    def be_prompt(self, place: Place) -> None:
        """Process messages of the present subscriptions in the thread that receives them."""
        rcl = library()
        if rcl is None:
            return
        # A message to the node itself arrives inside of `publish`, and no tick may run inside another one.
        topics = {p.topic_name for p in self.node.publishers}
        for subscription, reader in self._read:
            if subscription.topic_name in topics:
                continue
            # Otherwise the executor would also take messages and events of this subscription.
            leave_to_us(self.node, subscription)
            for handler in subscription.event_handlers:
                self.node.remove_waitable(handler)
            self._arrivals.append(Arrival(rcl, subscription, reader.receive, reader.matched, self.monitor.arrive))
        self.prompt = bool(self._arrivals)
        if self.prompt:
            self.timer(LOOK, self._check_arrivals)
            self.timer(SEARCH, Garbage(off=True).step)
            if place != "anywhere":
                self._processor = Processor(domain_id(), place == "beside", lambda: self.monitor.done)
                self.timer(SEARCH, self._processor.step)
        for arrival in self._arrivals:
            arrival.begin()

    def _check_arrivals(self) -> None:
        for arrival in self._arrivals:
            arrival.report_writers()

    @contextmanager
    def _deaf(self) -> Iterator[None]:
        """Ignore messages while the ``with`` block runs; see `arrival` for the reason."""
        for arrival in self._arrivals:
            arrival.end()
        try:
            yield
        finally:
            for arrival in self._arrivals:
                arrival.begin()

    def close(self) -> None:
        """Stop delivering messages; a RunError if a tick does not end."""
        if not self.monitor.close(PATIENCE):
            raise RunError(f"a tick has not come to its end within {PATIENCE:g} s")
        while self._arrivals:
            arrival = self._arrivals.pop()
            arrival.end()
            leave_to_executor(self.node, arrival.subscription)
            for handler in arrival.subscription.event_handlers:
                self.node.add_waitable(handler)
        self.monitor.serve()

    def _overrides(self, topic: str, kind: str) -> QoSOverridingOptions | None:
        """Let rclpy read overrides of a topic's QoS profile into the given profile, since a copy is made for each.

        Without overrides, the six parameters of each topic are not declared.
        """
        prefix = f"{OF_QOS}{self.resolve(topic)}.{kind}."
        self._overridable.append(prefix)
        overridden = any(name.startswith(prefix) for name in overrides(self.node))
        return QoSOverridingOptions(POLICIES) if overridden else None

    def report_ignored(self) -> None:
        """Log the QoS parameters that fit none of the topics offered and read so far; rclpy ignores them silently."""
        known = {f"{prefix}{policy.name.lower()}" for prefix in self._overridable for policy in POLICIES}
        for name in sorted(n for n in overrides(self.node) if n.startswith(OF_QOS) and n not in known):
            meant = closest(name, known) or f"; this node has {', '.join(sorted(self._overridable))}"
            self.log(Level.WARN, f"parameter {name} is ignored: it fits no topic and policy of this node{meant}")

    def post(self, call: Callable[[], object]) -> None:
        """Call a function after the current call has returned."""
        self._posted.append(call)
        # One task calls all that is posted before it runs.
        if len(self._posted) == 1:
            self.node.executor.create_task(self._in_turn(self._call_posted))

    def _call_posted(self) -> None:
        posted, self._posted = self._posted, []
        for call in posted:
            call()

    def timer(self, ns: int, callback: Callable[[], None]) -> RosTimer:
        """Call back every `ns`."""
        return self.node.timer(ns, self._in_turn(callback))

    def now(self) -> int:
        """Wall-clock time in ns."""
        return self._behind + time.monotonic_ns()

    def steady(self) -> float:
        """Monotonic time in s."""
        return time.monotonic()

    def publishers(self, topic: str) -> list[Peer]:
        """Writers of a topic, as the graph shows them."""
        return [_peer(i) for i in endpoints(self.node, topic, writers=True)]

    def subscribers(self, topic: str) -> list[Peer]:
        """Readers of a topic, as the graph shows them."""
        return [_peer(i) for i in endpoints(self.node, topic, writers=False)]

    def unfit(self, topic: str, msgtype: str) -> list[tuple[str, str]]:
        """Name the readers of a topic of ours that ask for more than it offers."""
        writers = endpoints(self.node, topic, writers=True)
        offered = [i.qos_profile for i in writers if _peer(i).full_name == self.full_name]
        result = []
        for reader in endpoints(self.node, topic, writers=False) if offered else ():
            fits, why = qos_check_compatible(offered[0], reader.qos_profile)
            if fits == QoSCompatibility.ERROR and reader.topic_type == msgtype:
                result.append((_peer(reader).name, str(why).replace("ERROR: ", "").strip("; ")))
        return result

    def subscriptions_of(self, peer: Peer) -> list[str]:
        """Topics that a node reads."""
        # Discovery knows a topic before the node that it belongs to.
        with suppress(NodeNameNonExistentError, RCLError):
            return [t for t, _ in self.node.get_subscriber_names_and_types_by_node(peer.name, peer.namespace)]
        return []

    def topics(self) -> dict[str, list[str]]:
        """Message types under which each topic exists."""
        return dict(self.node.get_topic_names_and_types())

    def deaf(self) -> str:
        """Report that a port in shared memory was taken away, and free the ports of killed processes."""
        self._locks.release(domain_id())
        lost = self._ears.lost()
        return (
            f"receives no messages any more: its port {lost} in shared memory was removed by another process"
            if lost
            else ""
        )

    def log(self, level: Level, text: str) -> None:
        """Log by the node's logger: terminal, log file and /rosout."""
        logger, severity = self.node.get_logger(), SEVERITY[level]
        if logger.is_enabled_for(severity):
            # rclpy would read source files to name the caller, which takes 13 to 30 ms at the first text and 0.25 ms at
            # each further one. A node often logs when it is already late.
            log(logger, severity, text)

    def drain(self) -> None:
        """Wait, for a bounded time, until all subscribers have the last messages; a subscriber may be paused."""
        until = time.monotonic() + LAST
        for publisher in self.node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, until - time.monotonic())))
