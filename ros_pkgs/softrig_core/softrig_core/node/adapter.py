"""What every node process does: parameters, endpoints, diagnostics, status file, spinning, ending.

The two ways to drive a block are its subclasses: `lockstep.Lockstep` and `realtime.Realtime`.
"""

from __future__ import annotations

import gc
import json
import math
import struct
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import rclpy
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future

from ..errors import RunError
from ..model.block import Block, Level, Observer, Plant
from ..model.port import Port, Sample
from ..model.schedule import Schedule
from ..model.timebase import SECOND
from ..rig.inprocess import check
from ..rig.options import Links, RunOptions
from ..wire.codec import Decoder
from ..wire.recording import ShardWriter, relative
from .messages import diagnostic_array, marker_array, message_class

# Depth 10: in lockstep at most two messages of a topic are ever under way; outside readers get some slack.
QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
WATCH_PERIOD = 0.25  # s: progress check, status file, flush of the shard


class Input:
    """A subscribed port: decoder, newest values and what was refused."""

    def __init__(self, port: Port) -> None:
        self.port = port
        self.decode = Decoder(port)
        self.publishers = 0
        self.refused = 0
        self.last_refusal = ""
        self.presses = 0  # of a button, by its service, that the block has not seen go down and up again


class Output:
    """A published port."""

    def __init__(self, port: Port, topic: str, number: int) -> None:
        self.port = port
        self.name = port.name
        self.delayed = port.delayed
        self.topic = topic
        self.number = number
        self.encode: Callable[[int, Sequence[float]], bytes] = port.layout().encode
        self.publish: Callable[[bytes], None] = _unbound
        self.readers = 0


class Adapter:
    """A block as a node.

    Parameters
    ----------
    node : rclpy.node.Node
    block : Block
    options : RunOptions
    """

    open_ended = False  # whether being stopped is a normal end

    def __init__(self, node: Node, block: Block, options: RunOptions) -> None:
        self.node = node
        self._name = node.get_name()
        self.block = block
        self.options = options
        by_hand = Links(owns_clock=isinstance(block, Plant) and options.mode == "lockstep")
        self.links = Links.model_validate_json(options.links) if options.links else by_hand
        self.schedule = Schedule(block.p.period, self.links.base or None, options.duration, block.speaks_at_end())
        self.state: Literal["starting", "running", "done", "failed"] = "starting"
        self.ticks = 0
        self.t = 0
        self.values: dict[str, Any] = {}  # newest value of each input, as the block gets it
        self.epoch = 0  # ns added to a block's time for the stamp on the wire
        self.error: BaseException | None = None
        self.bad = False  # an input of this tick was refused
        self.waits_for: list[str] = []  # the senders whose silence ended the run
        self.finished: Future[None] = Future()
        self._logged: set[str] = set()
        inputs, outputs = block.ports(block.p)
        self.inputs = [Input(p) for p in inputs]
        names = [node.resolve_topic_name(p.topic) for p in outputs]
        self.outputs = [Output(p, name, i) for i, (p, name) in enumerate(zip(outputs, names, strict=True))]
        recorded = [(relative(o.topic), o.port.msgtype) for o in self.outputs]
        # What an outside node sends is recorded by its (first) reader, at the tick at which it takes effect.
        records = self.links.records
        outside = [
            p.name for p in inputs if (p.name not in self.links.inputs if records is None else p.name in records)
        ]
        self.foreign = {name: len(recorded) + k for k, name in enumerate(outside)}
        recorded += [
            (relative(node.resolve_topic_name(i.port.topic)), i.port.msgtype)
            for i in self.inputs if i.port.name in self.foreign
        ]  # fmt: skip
        self.extra_numbers = len(recorded)
        if self.links.owns_clock:
            recorded.append(("/clock", "rosgraph_msgs/msg/Clock"))
        self.sink = ShardWriter(Path(options.shard), recorded) if options.shard else None
        for item in self.inputs:
            self.subscribe(item)
        for output in self.outputs:
            self.advertise(output)
        self._diagnostics = node.create_publisher(message_class("diagnostic_msgs/msg/DiagnosticArray"),
                                                  "/diagnostics", QOS)  # fmt: skip
        self._figures = (
            node.create_publisher(message_class("diagnostic_msgs/msg/DiagnosticArray"), "~/metrics", QOS)
            if isinstance(block, Observer) else None
        )  # fmt: skip
        self._publish_latched()
        shows = type(block).markers is not Block.markers
        marker_array_class = message_class("visualization_msgs/msg/MarkerArray") if shows else None
        self._markers = node.create_publisher(marker_array_class, "~/markers", QOS) if shows else None
        self._pressed: list[Input] = []
        for item in self.inputs:
            if item.port.msgtype == "std_msgs/msg/Bool" and item.port.name not in self.links.inputs:
                self._offer_press(item)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._seconds = 0
        node.create_timer(WATCH_PERIOD, self._watch, clock=self._steady)

    # endpoints -------------------------------------------------------------------------------------------------

    def subscribe(self, item: Input) -> None:
        """Subscribe raw bytes with matched and QoS events."""

        def matched(status: Any) -> None:
            item.publishers = status.current_count
            self.on_matched(item)

        self.node.create_subscription(
            message_class(item.port.msgtype), item.port.topic, self.receiver(item), QOS, raw=True,
            event_callbacks=SubscriptionEventCallbacks(matched=matched),
        )  # fmt: skip

    def advertise(self, output: Output) -> None:
        """Create the publisher of an output."""

        def matched(status: Any) -> None:
            output.readers = status.current_count
            self.on_matched(None)

        publisher = self.node.create_publisher(
            message_class(output.port.msgtype), output.port.topic, QOS,
            event_callbacks=PublisherEventCallbacks(matched=matched),
        )  # fmt: skip
        # what publish(bytes) ends in, without its type checks: worth 5 % of a lockstep loop
        output.publish = publisher.handle.publish_raw

    def _publish_latched(self) -> None:
        """Publish the block's texts for whoever comes, now or later."""
        profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        string = message_class("std_msgs/msg/String")
        for topic, text in self.block.latched().items():
            self.node.create_publisher(string, topic, profile).publish(string(data=text))

    def _offer_press(self, item: Input) -> None:
        """Offer a push button as a service too: ``~/NAME`` presses it for one tick."""

        def press(request: Any, response: Any) -> Any:
            if not item.presses:
                if self.values[item.port.name] == (1.0,):
                    response.success, response.message = False, f"{item.port.name} is held down by its topic"
                    return response
                self._push(item, True)
                self._pressed.append(item)
            item.presses += 1
            response.success, response.message = True, f"{item.port.name} pressed"
            return response

        self.node.create_service(message_class("std_srvs/srv/Trigger"), f"~/{item.port.name}", press)

    def _push(self, item: Input, down: bool) -> None:
        self.values[item.port.name] = (float(down),)
        if self.sink is not None and item.port.name in self.foreign:
            self.sink.add(self.foreign[item.port.name], self.now(), item.port.layout().encode(0, (down,)))

    def release(self) -> None:
        """Move the buttons that a service pressed; called after each tick.

        A block sees each press as one tick down and at least one up, however fast the calls come.
        """
        for item in self._pressed[:]:
            if self.values[item.port.name] == (1.0,):
                self._push(item, False)
                continue
            item.presses -= 1
            if item.presses:
                self._push(item, True)
            else:
                self._pressed.remove(item)

    def now(self) -> int:
        """Time in ns under which what comes from outside is recorded."""
        raise NotImplementedError

    def receiver(self, item: Input) -> Callable[[bytes], None]:
        """Give the callback for the raw messages of an input."""
        raise NotImplementedError

    def on_matched(self, item: Input | None) -> None:
        """React to a change of peers; `item` is the input whose publishers changed, if any."""

    def publish(self, t: int, stamp: int, found: Mapping[str, Any]) -> None:
        """Check, encode, publish and record a block's answer of tick `t`.

        All messages go out in one burst: a reader that wakes for the first finds the others already there, and
        recording takes place while it works. (Each wake-up between two messages costs as much as the law.)
        """
        burst = []
        try:
            for output in self.outputs:
                values, at = found[output.name], stamp
                if output.delayed:
                    at, values = values[0] + self.epoch, values[1]
                total = sum(values)
                if total - total != 0.0:  # NaN or infinity
                    check(found, output.port, self._name, t)
                burst.append((output, output.encode(at, values)))
        except (KeyError, TypeError, ValueError, struct.error):
            for output in self.outputs:
                check(found, output.port, self._name, t)  # says which value is wrong
            raise
        for output, data in burst:
            output.publish(data)
        if self.sink is not None:
            for output, data in burst:
                self.sink.add(output.number, stamp, data)

    def answer(self, t: int) -> Any:
        """Give what a block that is not a plant sends at `t`; it does not see a tick of which something was refused."""
        if not self.bad:
            return self.block.update(t, **self.values)
        self.bad = False
        found = self.block.refused(t)
        return found or {o.name: Sample(t, o.port.safe) if o.delayed else o.port.safe for o in self.outputs}

    # health ----------------------------------------------------------------------------------------------------

    def refuse(self, item: Input, reason: str) -> None:
        """Count a bad message and log it once; it never reaches the block."""
        item.refused += 1
        if item.last_refusal != reason:
            item.last_refusal = reason
            kind = reason.split()[0]  # not the whole: a wrong stamp is another each time
            self.log_once(f"{item.port.topic}: {kind}", Level.ERROR, f"refused on {item.port.topic}: {reason}")

    def log_once(self, key: str, level: Level, text: str) -> None:
        """Log a text the first time its key appears."""
        if key not in self._logged:
            self._logged.add(key)
            logger = self.node.get_logger()
            if level == Level.ERROR:  # rclpy forbids one call site to log at two severities
                logger.error(text)
            elif level == Level.WARN:
                logger.warning(text)
            else:
                logger.info(text)

    def fail(self, text: str) -> None:
        """End the run with an error."""
        if self.error is None:
            self.error = RunError(text)
        self.finish("failed")

    def finish(self, state: Literal["done", "failed"] = "done") -> None:
        """Stop spinning."""
        self.state = state
        if not self.finished.done():
            self.finished.set_result(None)

    def progress(self) -> None:
        """Check for stalls and missing peers; called every `WATCH_PERIOD`."""

    def busy(self) -> bool:
        """Whether peers that wait for this node are to be patient."""
        return False

    def statistics(self) -> dict[str, Any]:
        """Figures of the run for the status file."""
        return {}

    def _watch(self) -> None:
        if self.sink is not None:
            self.sink.flush()
        for key, (level, text, _) in self.block.reports.items():
            self.log_once(key, level, text)
        self.progress()
        self.write_status()
        if self._markers is not None and self.state == "running":
            self._markers.publish(marker_array(self.now(), self.block.markers()))
        self._seconds += 1
        if self._seconds % round(1 / WATCH_PERIOD) == 0:
            self._publish_diagnostics()

    def _publish_diagnostics(self) -> None:
        refused = sum(i.refused for i in self.inputs)
        level = Level.ERROR if refused else max((r[0] for r in self.block.reports.values()), default=Level.OK)
        text = next((i.last_refusal for i in self.inputs if i.refused), "") or self.state
        values = {"ticks": str(self.ticks), **{f"refused {i.port.topic}": str(i.refused) for i in self.inputs}}
        values |= {key: f"{count} x {text}" for key, (_, text, count) in self.block.reports.items()}
        values |= {key: str(value) for key, value in self.statistics().items()} | dict(self.block.health())
        now = time.time_ns()
        self._diagnostics.publish(diagnostic_array(now, self.node.get_fully_qualified_name(), level, text, values))
        if self._figures is not None and isinstance(self.block, Observer):
            figures = {name: f"{value:.9g} {unit}".strip() for name, (value, unit) in self.block.status().items()}
            self._figures.publish(diagnostic_array(self.t, self.node.get_name(), Level.OK, "", figures))

    def write_status(self) -> None:
        """Write the status file, if one is wanted."""
        if not self.options.status:
            return
        status = {
            "state": self.state, "t": self.t, "ticks": self.ticks,
            "error": str(self.error) if self.error else "", "waits_for": self.waits_for,
            "refused": {i.port.topic: [i.refused, i.last_refusal] for i in self.inputs if i.refused},
            "reports": {key: [int(level), text, n] for key, (level, text, n) in self.block.reports.items()},
            "busy": self.busy(),
            "cpu_s": round(time.process_time(), 3),
            "peak_memory_mb": _peak_memory(),
            **self.statistics(),
        }  # fmt: skip
        if isinstance(self.block, Observer) and self.state == "done":
            status["figures"] = {k: v for k, v in self.block.status().items() if math.isfinite(v[0])}
        path = Path(self.options.status)
        new = path.with_suffix(".new")
        new.write_text(json.dumps(status))
        new.replace(path)

    def run(self) -> int:
        """Spin until finished, failed or stopped; gives the exit status."""
        from rclpy.experimental.events_executor import EventsExecutor

        executor = EventsExecutor()
        executor.add_node(self.node)
        gc.collect()
        gc.freeze()
        stopped = False
        try:
            while rclpy.ok() and not self.finished.done():
                # without a timeout this executor never delivers anything (rclpy 7.1)
                executor.spin_until_future_complete(self.finished, 5.0)
            if self.state == "done":
                self.drain()
            stopped = not self.finished.done()
        except (KeyboardInterrupt, ExternalShutdownException):
            stopped = True
        except (RunError, OSError) as error:
            self.error, self.state = error, "failed"
        except Exception as error:  # a law or a plant that failed: the executor has printed the traceback
            if rclpy.ok():
                text = f"failed at t = {self.t / SECOND:.9g} s: {type(error).__name__}: {error}"
                self.error, self.state = RunError(text), "failed"
            else:  # a signal has shut the context down under a callback that was about to publish
                stopped = True
        if self.sink is not None:
            try:
                self.sink.close()
            except OSError as error:
                self.error, self.state = error, "failed"
        if stopped and self.state != "failed":
            self.state = "done" if self.schedule.end is None or self.open_ended else "failed"
            self.error = None if self.state == "done" else RunError("stopped before the end of the run")
        try:
            self.write_status()
        except OSError as error:
            self.error, self.state = self.error or error, "failed"
        if self.error is not None:
            print(f"{self.node.get_name()}: {self.error}", file=sys.stderr, flush=True)
        return 3 if self.state == "failed" else 0

    def drain(self) -> None:
        """Wait until every reader has the last messages."""
        for publisher in self.node.publishers:
            publisher.wait_for_all_acked(Duration(seconds=2))


def percentiles(name: str, samples: Iterable[int]) -> dict[str, float]:
    """Give p50, p99 and maximum of times in ns as ``<name>_p50_ms`` and so on; nothing without samples."""
    ordered = sorted(samples)
    if not ordered:
        return {}
    n = len(ordered)
    picked = {"p50": ordered[n // 2], "p99": ordered[n * 99 // 100], "max": ordered[-1]}
    return {f"{name}_{key}_ms": value / 1e6 for key, value in picked.items()}


def _peak_memory() -> float | None:
    """Largest resident size in MB; getrusage would count that of the parent before exec too."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:  # not Linux
        return None
    return round(int(status.split("VmHWM:")[1].split()[0]) / 1024, 1)


def _unbound(data: bytes) -> None:
    raise RuntimeError("output is not advertised yet")
