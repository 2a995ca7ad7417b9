"""Uses of rclpy below its public interface: the version in which each was seen, a test of it, and the public way.

Each use is tested once a process, before its first call. The public way is used if the test fails or if
`SOFTRIG_PUBLIC` names the use (several are separated by commas; `all` names every one). The public way gives the same
numbers; it takes longer or reports less.
"""

from __future__ import annotations

import ctypes
import importlib
import inspect
import os
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import cache
from typing import Any, NamedTuple

from rclpy.logging import LoggingSeverity
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.topic_endpoint_info import TopicEndpointInfo

VARIABLE = "SOFTRIG_PUBLIC"
SEEN = "rclpy 7.1 (Jazzy), 9.1 (Kilted)"
HEADER = struct.Struct("qq16sq")  # rmw_service_info_t: two times in ns, the client, the number of the request
OF_ROS = ("use_sim_time", "start_type_description_service")  # parameters that every node declares itself


class Use(NamedTuple):
    """One use of a private interface.

    Parameters
    ----------
    seen : str
        Versions with which it was observed to work.
    instead : str
        The public way, and what it costs.
    test : callable
        Raises an error or returns a false value if it does not work.
    """

    seen: str
    instead: str
    test: Callable[[], object]


def _c() -> Any:
    return importlib.import_module("rclpy.impl.implementation_singleton").rclpy_implementation


def _takes(function: Any, *names: str) -> bool:
    """Return whether a function has these parameters; for a C function, by the first line of its help."""
    try:
        known = set(inspect.signature(function).parameters)
    except ValueError:
        return all(f"{name}:" in (function.__doc__ or "") for name in names)
    return set(names) <= known


def _assigns(kind: type, *names: str) -> bool:
    return set(names) <= set(kind.__init__.__code__.co_names)  # type: ignore[misc]


def _service() -> bool:
    service = importlib.import_module("rclpy.service").Service
    return callable(service.send_response) and not hasattr(service, "__slots__")


USES = {
    "error": Use(SEEN, "RuntimeError, of which it is one", lambda: issubclass(_rcl_error(), RuntimeError)),
    "publish_raw": Use(SEEN, "Publisher.publish: 5 % of a lockstep loop", lambda: _takes(_c().Publisher.publish_raw)),
    "carrier": Use(
        SEEN,
        "messages of a container in real time are published by calls, up to eight together: 3 to 20 us of a tick each",
        lambda: importlib.import_module(".carrier", __package__).tested(),
    ),
    "ticking": Use(
        SEEN,
        "the ticks of a container in real time are run by Python: 30 to 90 us of each",
        lambda: importlib.import_module(".punctual", __package__).tested(),
    ),
    "log": Use(
        SEEN,
        "the logger's methods, which read source files to name the caller: 13 to 30 ms at the first text",
        lambda: callable(_c().rclpy_logging_rcutils_log),
    ),
    "endpoints": Use(
        SEEN,
        "Node.get_publishers_info_by_topic, which applies the node's remaps to a name that is one already",
        lambda: (
            callable(_c().rclpy_get_publishers_info_by_topic) and callable(_c().rclpy_get_subscriptions_info_by_topic)
        ),
    ),
    "overrides": Use(
        SEEN,
        "the node declares what it is given, which is undeclared again",
        lambda: _assigns(Node, "_parameter_overrides"),
    ),
    "parameters": Use(
        SEEN,
        "Node.get_parameter and describe_parameter; empty lists have the type of bytes",
        lambda: _assigns(Node, "_parameters", "_descriptors"),
    ),
    "subscriptions": Use(
        SEEN,
        "the executor takes all messages: a third of a lockstep loop's rate",
        lambda: _assigns(Node, "_subscriptions"),
    ),
    "requests": Use(
        SEEN,
        "the executor takes all requests: a flood delays timers, an answer to a client that has gone takes 0.1 s",
        lambda: _assigns(Node, "_services") and callable(_c().Service.service_take_request) and _service(),
    ),
    "client": Use(
        SEEN,
        "an answer is sent while any client is there: one to a client that has gone may take 0.1 s of a tick's time",
        lambda: callable(_c().rmw_service_info_t) and callable(_c().rclpy_get_subscriptions_info_by_topic),
    ),
    "events_executor": Use(
        SEEN,
        "SingleThreadedExecutor: six times the processor time of a message",
        lambda: callable(importlib.import_module("rclpy.experimental.events_executor").EventsExecutor),
    ),
    "wait_set": Use(
        SEEN,
        "events by the executor, which may stop for ever under heavy loss",
        lambda: all(callable(getattr(_c().WaitSet, n)) for n in ("clear_entities", "wait")),
    ),
    "take_message": Use(
        SEEN,
        "the executor's turns: of a queue at the end it takes one message a turn",
        lambda: callable(_c().Subscription.take_message),
    ),
}


def _rcl_error() -> type[Exception]:
    return importlib.import_module("rclpy._rclpy_pybind11").RCLError  # type: ignore[no-any-return]


@cache
def works(name: str) -> bool:
    """Return whether a use of `USES` works as before and the public way is not requested."""
    asked = os.environ.get(VARIABLE, "").split(",")
    if name in asked or "all" in asked:
        return False
    try:
        return bool(USES[name].test())
    except (ImportError, AttributeError, TypeError):
        return False


RCLError: type[Exception] = _rcl_error() if works("error") else RuntimeError


def sending(publisher: Any) -> Callable[[bytes], None]:
    """Return a function that publishes the bytes of a message."""
    return publisher.handle.publish_raw if works("publish_raw") else publisher.publish  # type: ignore[no-any-return]


def log(logger: Any, severity: LoggingSeverity, text: str) -> None:
    """Log a text."""
    if works("log"):
        _c().rclpy_logging_rcutils_log(severity, logger.name, text, "", "", 0)
        return
    # Each severity has a line of its own, because rclpy refuses another severity at a place that has logged before.
    if severity == LoggingSeverity.ERROR:
        logger.error(text)
    elif severity == LoggingSeverity.WARN:
        logger.warning(text)
    else:
        logger.info(text)


def endpoints(node: Node, topic: str, *, writers: bool) -> list[TopicEndpointInfo]:
    """Return the writers or readers of a topic, which is named in full."""
    if not works("endpoints"):
        return list((node.get_publishers_info_by_topic if writers else node.get_subscriptions_info_by_topic)(topic))
    ask = _c().rclpy_get_publishers_info_by_topic if writers else _c().rclpy_get_subscriptions_info_by_topic
    with node.handle:
        return [TopicEndpointInfo(**result) for result in ask(node.handle, topic, False)]


def options() -> dict[str, bool]:
    """Return the options with which a node is created, so that `keep_overrides` finds its overrides."""
    return {} if works("overrides") else {"automatically_declare_parameters_from_overrides": True}


def keep_overrides(node: Node) -> None:
    """Store the overrides of a new node, created with `options`, and leave them to be declared."""
    if works("overrides"):
        return
    node.softrig_overrides = {n: p for n, p in node.get_parameters_by_prefix("").items() if n not in OF_ROS}
    for name in node.softrig_overrides:
        node.undeclare_parameter(name)


def overrides(node: Node) -> Mapping[str, Parameter]:
    """Return the parameters from a node's arguments and files, declared or not."""
    return node._parameter_overrides if works("overrides") else node.softrig_overrides  # type: ignore[no-any-return]


class _Known(Mapping[str, Any]):
    """The parameters of a node, read by public methods."""

    def __init__(self, node: Node, ask: Callable[[str], Any], missing: Callable[[str], Any]) -> None:
        self._node, self._ask, self._missing = node, ask, missing

    def __getitem__(self, name: str) -> Any:
        if not self._node.has_parameter(name):
            raise KeyError(name)
        # A parameter without a value raises ParameterUninitializedException.
        with suppress(Exception):
            return self._ask(name)
        return self._missing(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._node.get_parameters_by_prefix(""))

    def __len__(self) -> int:
        return len(list(iter(self)))


def parameters(node: Node) -> Mapping[str, Parameter]:
    """Return the parameters of a node by name; one without a value is not set."""
    if works("parameters"):
        return node._parameters  # type: ignore[no-any-return]
    return _Known(node, node.get_parameter, lambda name: Parameter(name, Parameter.Type.NOT_SET))


def descriptors(node: Node) -> Mapping[str, Any]:
    """Return the descriptors of a node's parameters by name."""
    if works("parameters"):
        return node._descriptors  # type: ignore[no-any-return]
    return _Known(node, node.describe_parameter, node.describe_parameter)


def make_empty(node: Node, name: str, kind: Parameter.Type) -> None:
    """Set the type of a parameter that is an empty list: rclpy treats it as bytes."""
    if works("parameters"):
        node._parameters[name] = Parameter(name, kind, [])
        node.describe_parameter(name).type = kind.value


def leave_to_us(node: Node, subscription: Any) -> None:
    """Remove a subscription from the executor's wait set, so that softrig takes its messages; see
    `works("subscriptions")` first.
    """
    node._subscriptions.remove(subscription)


def leave_to_executor(node: Node, subscription: Any) -> None:
    """Return a subscription to the executor's wait set."""
    node._subscriptions.append(subscription)


def executor() -> Any:
    """Return the executor that calls the node's callbacks."""
    if works("events_executor"):
        return importlib.import_module("rclpy.experimental.events_executor").EventsExecutor()
    return importlib.import_module("rclpy.executors").SingleThreadedExecutor()


def leave_requests_to_us(node: Node, service: Any) -> None:
    """Remove a service from the executor's wait set, so that softrig takes its requests; see `works("requests")`."""
    node._services.remove(service)


def services(node: Node) -> list[Any]:
    """Return the services that the executor serves."""
    return list(node.services)


def next_request(service: Any) -> tuple[Any, Any]:
    """Return the oldest request of a service and its header; twice None if there is none."""
    with service.handle:
        return service.handle.service_take_request(service.srv_type.Request)  # type: ignore[no-any-return]


def client_of(header: Any) -> bytes:
    """Return the identity of the reader that waits for the answer to a request; empty if it is not known.

    The header of a request contains it, but rclpy does not show it. The other fields read from the header are compared
    with those that rclpy shows.
    """
    if not works("client"):
        return b""
    # A pybind11 object is the head of a Python object and the address of a structure of C.
    address = ctypes.c_void_p.from_address(id(header) + object.__basicsize__).value
    if not address:
        return b""
    sent, received, reader, number = HEADER.unpack(ctypes.string_at(address, HEADER.size))
    shown = header.source_timestamp, header.received_timestamp, header.request_id.sequence_number
    return reader if (sent, received, number) == shown else b""


def answer_readers(node: Node, service: Any) -> set[bytes]:
    """Return the identities of the readers of a service's answers that the graph shows."""
    if not works("client"):
        return {b"a client"} if node.count_clients(service.srv_name) else set()
    topic = f"rr{service.service_name}Reply"  # the name that rmw_fastrtps gives it
    with node.handle:
        rows = _c().rclpy_get_subscriptions_info_by_topic(node.handle, topic, True)
    return {bytes(row["endpoint_gid"]) for row in rows}


def news(node: Node, handlers: Iterable[Any]) -> list[tuple[Callable[[Any], None], Any]]:
    """Return the callbacks of event handlers with a new status, each with that status."""
    handlers = list(handlers)
    with ExitStack() as stack:
        for handle in (node.context.handle, *handlers):
            stack.enter_context(handle)
        wait_set = _c().WaitSet(0, 0, 0, 0, 0, len(handlers), node.context.handle)
        wait_set.clear_entities()
        for handler in handlers:
            handler.add_to_wait_set(wait_set)
        wait_set.wait(0)
        return [(h.callback, h.take_data()) for h in handlers if h.is_ready(wait_set)]


def pending_messages(subscription: Any) -> Iterator[bytes]:
    """Return the messages that have arrived and that no executor has taken; none if rclpy does not provide them."""
    if not works("take_message"):
        return
    with subscription.handle:
        while (result := subscription.handle.take_message(subscription.msg_type, True)) is not None:
            yield result[0]


def signal_manager(kind: type) -> Any:
    """Return launch's handler of signals (3.4); None in another launch, which then ends at SIGTERM by itself."""
    return getattr(kind, "_AsyncSafeSignalManager__current", None)
