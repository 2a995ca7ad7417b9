"""The interface of a node for the usual ROS tools: diagnostics, figures, markers, texts, buttons."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from importlib.util import find_spec
from typing import Any

from rclpy.qos import DurabilityPolicy, QoSProfile
from softrig_core.block.block import Block, Level, Observer
from softrig_core.block.port import Port

from ..adapter.account import WATCH_PERIOD
from ..adapter.adapter import Adapter
from ..ros.messages import diagnostic_array, marker_array, message_class
from ..ros.ros import QOS, ServingNode
from .following import PACKAGE, Following, action_type, followed
from .frames import Frames

HOLDS = ("pause", "resume", "step")  # services of std_srvs/Trigger below the name of the clock's node


class Faces:
    """Publishes diagnostics each second, figures of an observer, markers and latched texts; offers buttons."""

    def __init__(self, node: ServingNode, adapter: Adapter) -> None:
        self._name = node.get_fully_qualified_name()
        self._adapter = adapter
        block = adapter.block
        array = message_class("diagnostic_msgs/msg/DiagnosticArray")
        self._diagnostics = node.create_publisher(array, "/diagnostics", QOS)
        self._figures = node.create_publisher(array, "~/metrics", QOS) if isinstance(block, Observer) else None
        shows = type(block).markers is not Block.markers
        markers = message_class("visualization_msgs/msg/MarkerArray") if shows else None
        self._markers = node.create_publisher(markers, "~/markers", QOS) if shows else None
        _publish_latched(node, block)
        # In a domain of its own a rig has no viewers.
        if adapter.options.frames and (not adapter.options.links or adapter.links.public):
            Frames(node, adapter)
        for port in adapter.step.inputs:
            if port.msgtype == "std_msgs/msg/Bool" and port.name not in adapter.links.inputs:
                _offer_trigger(node, port.name, partial(adapter.buttons.press, port))
        if (reference := followed(adapter)) is not None:
            _offer_following(node, adapter, reference)
        if adapter.pauses:
            for name in HOLDS:
                _offer_trigger(node, name, partial(adapter.hold.ask, name))
            if adapter.options.mode == "lockstep" and find_spec("simulation_interfaces") is not None:
                _offer_simulation(node, adapter)
        self._measured: Future[tuple[int, Mapping[str, tuple[float, str]]]] | None = None
        self._executor = ThreadPoolExecutor(1) if adapter.options.mode == "realtime" else None
        self._checks = 0
        adapter.middleware.timer(WATCH_PERIOD, self._check)

    def _check(self) -> None:
        adapter = self._adapter
        if self._markers is not None and _read(self._markers) and adapter.state == "running":
            self._markers.publish(marker_array(adapter.drive.now(), adapter.step.markers()))
        if self._measured is not None and self._measured.done():
            self._publish_figures(*self._measured.result())
            self._measured = None
        self._checks += 1
        if self._checks % 4 == 0:
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        block = self._adapter.block
        if self._figures is not None and _read(self._figures):
            self._measure(block)
        if not _read(self._diagnostics):
            return
        adapter, reports = self._adapter, self._adapter.step.reports
        listened = adapter.inputs + adapter.paces
        refused = sum(i.refused for i in listened)
        level = Level.ERROR if refused else max((r[0] for r in reports.values()), default=Level.OK)
        text = next((i.last_refusal for i in listened if i.refused), "") or adapter.state
        values = {"ticks": str(adapter.ticks), **{f"refused {i.port.topic}": str(i.refused) for i in adapter.inputs}}
        values |= {f"refused {i.port.topic}": str(i.refused) for i in adapter.paces if i.refused}
        values |= {key: f"{count} x {text}" for key, (_, text, count) in reports.items()}
        values |= {key: str(value) for key, value in adapter.drive.statistics().items()} | dict(adapter.step.health())
        self._diagnostics.publish(diagnostic_array(time.time_ns(), self._name, level, text, values))

    def _measure(self, block: Any) -> None:
        """Measure the figures outside of the tick: for a long window this takes longer than many ticks.

        The measured data are an immutable value, so ticks in the meantime do not change them.
        """
        t, x = self._adapter.t, self._adapter.step.x
        if self._executor is None:
            self._publish_figures(t, block.status(x))
        elif self._measured is None:
            self._measured = self._executor.submit(lambda: (t, block.status(x)))

    def _publish_figures(self, t: int, status: Mapping[str, tuple[float, str]]) -> None:
        figures = {name: f"{value:.9g} {unit}".strip() for name, (value, unit) in status.items()}
        assert self._figures is not None
        self._figures.publish(diagnostic_array(t, self._adapter.middleware.name, Level.OK, "", figures))


def _offer_trigger(node: ServingNode, name: str, ask: Callable[[], tuple[bool, str]]) -> None:
    """Offer a std_srvs/Trigger; `ask` returns whether it was possible, and the text of the answer."""

    def answer(request: Any, response: Any) -> Any:
        response.success, response.message = ask()
        return response

    node.create_service(message_class("std_srvs/srv/Trigger"), f"~/{name}", answer)


def _offer_simulation(node: ServingNode, adapter: Adapter) -> None:
    """Offer the services of other simulators; a run does not fail if an optional package is missing."""
    # Imported here, because it imports actions, which other nodes do not need.
    from . import simulation

    try:
        types = simulation.types()
    except Exception as error:  # rosidl raises a bare one
        text = f"the services of simulation_interfaces are not offered: {error}"
        adapter.middleware.log(Level.WARN, text)
    else:
        simulation.Simulation(node, adapter, types)


def _offer_following(node: ServingNode, adapter: Adapter, port: Port) -> None:
    """Offer trajectories to a reference, the action where its type is installed."""
    kind = None
    if find_spec(PACKAGE) is not None:
        try:
            kind = action_type()
        except Exception as error:  # rosidl raises a bare one
            adapter.middleware.log(Level.WARN, f"the action follow_joint_trajectory is not offered: {error}")
    Following(node, adapter, port, kind)


def _read(publisher: Any) -> bool:
    """Return whether a topic has subscribers; without them, work that takes longer than a tick is skipped."""
    return bool(publisher.get_subscription_count())


def _publish_latched(node: ServingNode, block: Block) -> None:
    """Publish the block's texts, latched for late subscribers."""
    profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    string = message_class("std_msgs/msg/String")
    for topic, text in block.latched().items():
        node.create_publisher(string, topic, profile).publish(string(data=text))
