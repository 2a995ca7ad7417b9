"""Set parameters and call buttons of a running rig from outside: for `softrig set`, and for a page in a browser.

The page's process exchanges JSON lines:

in     {"id": 7, "node": "law", "set": {"k": 3.0}}        parameters of one node, all or none
{"id": 8, "node": "plant", "call": "kick"}         a std_srvs/Trigger below the node
out    {"id": 7, "ok": true, "reason": ""}                of each, in the order in which the nodes answer
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from softrig_core.guard import secure_streams

from .messages import message_class
from .profile import joining, watch_ports

PATIENCE = 10.0  # s: for a node to be there, and again for it to answer


class Remote:
    """Clients of the services that have been requested.

    Parameters
    ----------
    answer : callable
        Gets the id of a request, whether it was done (None: no answer), and the reason if it was not.
    patience : float
        Timeout of the wait for a node, s.
    """

    def __init__(
        self, node: Node, answer: Callable[[Any, bool | None, str], object], patience: float = PATIENCE
    ) -> None:
        self._node = node
        self._answer = answer
        self._patience = patience
        self._parameters: dict[str, AsyncParameterClient] = {}
        self._triggers: dict[str, Any] = {}

    def ask(self, request: dict[str, Any]) -> None:
        """Send a node a request; an error in the request itself is answered immediately."""
        try:
            name = str(request["node"])
            if "set" in request:
                self._set(request["id"], name, request["set"])
            else:
                self._call(request["id"], name, f"{name}/{request['call']}")
        # An invalid request of one page must not end this process, which serves all pages.
        except Exception as error:
            self._answer(request.get("id"), False, str(error) or type(error).__name__)

    def _set(self, number: Any, node: str, values: dict[str, Any]) -> None:
        client = self._parameters.get(node)
        if client is None:
            client = self._parameters[node] = AsyncParameterClient(self._node, node)
        for value in values.values():
            for item in value if isinstance(value, list) else [value]:
                if isinstance(item, int) and not -(2**63) <= item < 2**63:
                    raise ValueError(f"a whole number of {item.bit_length()} bits, expected at most 63, or a real one")
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        self._when(
            client.services_are_ready,
            number,
            node,
            lambda: client.set_parameters_atomically(parameters),
            lambda result: (result.result.successful, result.result.reason),
        )

    def _call(self, number: Any, node: str, service: str) -> None:
        trigger = message_class("std_srvs/srv/Trigger")
        client = self._triggers.get(service)
        if client is None:
            client = self._triggers[service] = self._node.create_client(trigger, service)
        self._when(
            client.service_is_ready,
            number,
            node,
            lambda: client.call_async(trigger.Request()),
            lambda result: (result.success, result.message),
        )

    def _when(
        self,
        ready: Callable[[], bool],
        number: Any,
        node: str,
        send: Callable[[], Any],
        read: Callable[[Any], tuple[bool | None, str]],
    ) -> None:
        """Send when the node is present, and answer when it has answered; an error names a node that does neither in
        time.
        """
        limit = time.monotonic() + self._patience
        sent: list[Any] = []

        def check() -> None:
            nonlocal limit
            try:
                if not sent and ready():
                    sent.append(send())
                    limit = time.monotonic() + PATIENCE
                data = read(sent[0].result()) if sent and sent[0].done() else None
            # A value may not fit into a message; as above, one request must not end all pages.
            except Exception as error:
                data = (False, f"{type(error).__name__}: {error}")
            if data is None and time.monotonic() > limit:
                data = (None, f"{node} does not answer" if sent else f"no node {node} within {self._patience:g} s")
            if data is not None:
                self._node.destroy_timer(timer)
                self._answer(number, *data)

        timer = self._node.create_timer(0.01, check)


def set_parameters(wanted: Mapping[str, Mapping[str, Any]], patience: float) -> list[str]:
    """Set parameters of running nodes, those of one node all or none.

    Parameters
    ----------
    wanted : mapping
        Values by node and name.
    patience : float
        How long to wait for each node, s.

    Returns
    -------
    list of str
        What went wrong, a line a node.
    """
    refusals: list[str] = []
    waiting = set(wanted)

    def answer(node: str, done: bool | None, reason: str) -> None:
        waiting.remove(node)
        if not done:
            refusals.append(reason if done is None else f"{node} refuses {', '.join(wanted[node])}: {reason}")

    try:
        with joining():
            rclpy.init(args=[])
            person = Node(f"softrig_set_{os.getpid()}")
        remote = Remote(person, answer, patience)
        for node, values in wanted.items():
            remote.ask({"id": node, "node": node, "set": values})
        while waiting and rclpy.ok():
            rclpy.spin_once(person)
    finally:
        rclpy.try_shutdown()
    return refusals


def main() -> None:
    """Serve the lines of the standard input until it ends."""
    secure_streams()
    with joining():
        # No log files are written beside those of the run.
        rclpy.init(args=["--ros-args", "--disable-external-lib-logs"])
        node = Node(f"softrig_view_{os.getpid()}")
    watch_ports(node)
    executor = rclpy.get_global_executor()
    executor.add_node(node)

    def answer(number: Any, ok: bool | None, reason: str) -> None:
        print(json.dumps({"id": number, "ok": ok, "reason": reason}), flush=True)

    remote = Remote(node, answer)

    def listen() -> None:
        for line in sys.stdin:
            request = json.loads(line)
            executor.create_task(lambda request=request: remote.ask(request))
        rclpy.try_shutdown()

    threading.Thread(target=listen, daemon=True).start()
    try:
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
