"""Lockstep: a node answers tick k when everything stamped t_k has arrived, at any speed of the host.

Nothing here looks at a clock to decide a number; wall-clock time only ends a run that makes no progress.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from rclpy._rclpy_pybind11 import RCLError
from rclpy.node import Node, NodeNameNonExistentError

from ..model.block import Block, Plant
from ..model.port import Port, Refused, Sample
from ..model.schedule import Schedule
from ..model.solver import Solver
from ..model.timebase import SECOND
from ..rig.options import InputLink, RunOptions
from ..wire.cdr import Layout
from ..wire.codec import Decoder
from .adapter import QOS, Adapter, Input, percentiles
from .messages import message_class
from .solving import Solving, hear_busy

SETTLED = 10  # checks of 20 ms in a row in which the endpoints of external nodes have not changed
GONE_AFTER = 0.5  # s without the awaited message after its only sender has vanished


class Pairing:
    """The awaited message of one paired topic.

    Parameters
    ----------
    topic : str
    schedule : Schedule
        Of the sender.
    sender : str
        Node name, for error messages.
    item : Input or None
        The port it feeds; None for a clock or an acknowledgement, which carry nothing but the stamp.
    """

    def __init__(self, topic: str, schedule: Schedule, sender: str, item: Input | None) -> None:
        self.topic = topic
        self.schedule = schedule
        self.sender = sender
        self.item = item
        self.want = 0
        self.holds = 0  # until this time the awaited message serves
        self.have = False
        self.received = 0  # by order: number of messages so far
        self.ahead: tuple[int, Any] | None = None


class Lockstep(Adapter):
    """A block driven tick by tick; see `Adapter` for the parameters."""

    def __init__(self, node: Node, block: Block, options: RunOptions) -> None:
        self.pairings: list[Pairing] = []
        self.missing = 0
        self._tick = 0
        self.ready = False
        self._publish_clock: Callable[[bytes], None] | None = None
        self._publish_tick: Callable[[bytes], None] | None = None
        self._clock_layout = Layout("rosgraph_msgs/msg/Clock")
        self._tick_layout = Layout("builtin_interfaces/msg/Time")
        self._is_plant = isinstance(block, Plant)
        self._since = time.monotonic()
        self._heard = 0  # messages of faster peers between two ticks
        self._progress = (-1, 0)
        self._rivals: Input | None = None
        self._outside_found: list[tuple[str, str]] = []
        self._unread: list[str] = []
        self._settled = 0
        self._durations: deque[int] = deque(maxlen=100_000)
        self._sent = self._first = 0
        super().__init__(node, block, options)
        links = self.links
        name = node.get_fully_qualified_name()
        if links.owns_clock:
            self._clock_publisher = node.create_publisher(message_class("rosgraph_msgs/msg/Clock"), "/clock", QOS)
            self._publish_clock = self._clock_publisher.handle.publish_raw
        if links.acknowledges:
            self._tick_publisher = node.create_publisher(message_class("builtin_interfaces/msg/Time"), "~/tick", QOS)
            self._publish_tick = self._tick_publisher.publish
        if links.clock is not None:
            self._pace("/clock", "rosgraph_msgs/msg/Clock", self._peer(links.clock), links.clock.node)
        for peer, period in links.acks.items():
            schedule = self._peer(InputLink(period=period, node=peer))
            self._pace(f"{name.rsplit('/', 1)[0]}/{peer}/tick", "builtin_interfaces/msg/Time", schedule, peer)
        self._await(0)
        self._starter = node.create_timer(0.02, self._start, clock=self._steady)
        self._solving = Solving(node, block, self._steady, self._step) if isinstance(block, Solver) else None
        hear_busy(node, self._patient)

    # peers -----------------------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> Callable[[bytes], None]:
        """Paired inputs wait for their stamp; other held inputs take the newest value."""
        link = self.links.inputs.get(item.port.name)
        if link is None and item.port.held and item.port.name not in self.options.paired:
            self.values[item.port.name] = None
            return self._held(item)
        self.values[item.port.name] = item.port.safe
        pairing = (
            Pairing(item.port.topic, self._peer(link), link.node, item)
            if link else Pairing(item.port.topic, Schedule(self.schedule.period), "another node", item)
        )  # fmt: skip
        self.pairings.append(pairing)
        return self._paired(pairing, item)

    def _peer(self, link: InputLink) -> Schedule:
        return Schedule(link.period, self.schedule.clock, self.options.duration, link.at_end)

    def _held(self, item: Input) -> Callable[[bytes], None]:
        def receive(data: bytes) -> None:
            try:
                stamp, values = item.decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                self.bad = True
                return
            self.values[item.port.name] = Sample(stamp, values) if item.port.delayed else values
            if self.sink is not None and item.port.name in self.foreign:
                self.sink.add(self.foreign[item.port.name], self.t, data)

        return receive

    def _paired(self, pairing: Pairing, item: Input) -> Callable[[bytes], None]:
        name, decode, delayed = item.port.name, item.decode, item.port.delayed
        # stamps that are acquisition times, and messages without one, are paired by counting
        by_order = delayed or not item.port.stamped
        record = self.foreign.get(name)

        def receive(data: bytes) -> None:
            if self.state in ("done", "failed"):
                return
            position = pairing.schedule.time(pairing.received)
            pairing.received += 1
            try:
                stamp, values = decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                # A controller answers a tick with a bad measurement too; a plant waits for a good command.
                at = position if by_order else _stamp(data)
                if not self._is_plant and not pairing.have and at == pairing.want:
                    self.bad = True
                    self._arrived(pairing)
                return
            if not by_order:
                position = stamp
            if position == pairing.want and not pairing.have:
                if record is not None and self.sink is not None:
                    self.sink.add(record, self.t, data)
                self.values[name] = Sample(stamp, values) if delayed else values
                self._arrived(pairing)
            elif self.schedule.before(pairing.want) < position < pairing.want and pairing.schedule.due(position):
                self._heard += 1  # a faster sender between two of our ticks
            elif position == pairing.schedule.next(pairing.want) and self.links.plants > 1 and pairing.ahead is None:
                pairing.ahead = (position, Sample(stamp, values) if delayed else values)
            else:
                got, want = position / SECOND, pairing.want / SECOND
                twice = " (already there)" if pairing.have else ""
                self.refuse(item, f"stamp {got:.9g} s from {pairing.sender}, expected {want:.9g} s{twice}")

        return receive

    def now(self) -> int:
        """Time of the tick under way."""
        return self.t

    def _pace(self, topic: str, msgtype: str, schedule: Schedule, sender: str) -> None:
        pairing = Pairing(topic, schedule, sender, None)
        self.pairings.append(pairing)
        decode = Decoder(Port("stamp", topic, msgtype))

        def receive(data: bytes) -> None:
            stamp, _ = decode(data)
            self._heard += 1
            if stamp == pairing.want and not pairing.have:
                self._arrived(pairing)
            elif stamp == schedule.next(pairing.want) and pairing.ahead is None:
                pairing.ahead = (stamp, None)

        self.node.create_subscription(message_class(msgtype), topic, receive, QOS, raw=True)

    def on_matched(self, item: Input | None) -> None:
        """A second publisher on a paired topic makes the run ambiguous: it ends, naming both."""
        paired = {p.item.port.name for p in self.pairings if p.item}
        if item is not None and item.publishers > 1 and item.port.name in paired and self.state != "done":
            self._rivals = item
            self.state = "failed"  # from here on no message counts; `progress` ends the run when the names are known

    def _start(self) -> None:
        """Begin when every declared peer is matched, both ways."""
        if self.ready or self.state != "starting":
            return
        if self._unmatched():
            return
        self._starter.cancel()
        self.ready = True
        self.state = "running"
        self._since = time.monotonic()
        if self._is_plant:
            self._send(0)
        if not self.missing:
            self._step()

    def _unmatched(self) -> list[str]:
        """Describe the peers that are not there yet."""
        node, links = self.node, self.links
        absent = []
        for pairing in self.pairings:
            if not self._publishers(pairing) or (pairing.item is not None and not pairing.item.publishers):
                absent.append(
                    f"no publisher on {pairing.topic} (expected from {pairing.sender}{self._other_type(pairing)})"
                )
        wanted = {o.topic: list(links.readers.get(o.name, [])) for o in self.outputs if o.name in links.readers}
        if links.outside:
            absent += self._outside_readers(wanted)
        if links.owns_clock:
            wanted["/clock"] = links.clock_readers
        if links.acknowledges:
            wanted[f"{node.get_fully_qualified_name()}/tick"] = [""]
        for topic, names in wanted.items():
            there = {i.node_name for i in node.get_subscriptions_info_by_topic(topic)}
            for name in names:
                if name and name not in there:
                    absent.append(f"{name} does not subscribe {topic}")
            counted = next((o.readers for o in self.outputs if o.topic == topic), node.count_subscribers(topic))
            if counted < len(names) and all(n in there for n in names):
                absent.append(f"{topic} has {counted} readers of {len(names)}")
        if not self.options.links:
            # By hand nobody says who reads what, and some outputs may stay unread: those that are not read for a
            # while after all senders have come. Only a plant may do without any reader.
            unread = [o.topic for o in self.outputs if not o.readers]
            self._settled = self._settled + 1 if unread == self._unread and not absent else 0
            self._unread = unread
            if self._settled < SETTLED or (len(unread) == len(self.outputs) and not self._is_plant):
                absent += [f"nobody subscribes {topic}" for topic in unread]
        return absent

    def _publishers(self, pairing: Pairing) -> int:
        return self.node.count_publishers(self.node.resolve_topic_name(pairing.topic))

    def _outside_readers(self, wanted: dict[str, list[str]]) -> list[str]:
        """Add the external nodes that subscribe our outputs, once discovery has told all that they subscribe."""
        node, absent, found = self.node, [], []
        for topic in self.links.outside:
            infos = node.get_publishers_info_by_topic(topic)
            if not infos:
                absent.append(f"no publisher on {topic} (expected from an external node)")
                continue
            with suppress(NodeNameNonExistentError, RCLError):  # discovery knows the topic before the node
                inputs = node.get_subscriber_names_and_types_by_node(infos[0].node_name, infos[0].node_namespace)
                found += [(o.topic, infos[0].node_name) for o in self.outputs if o.topic in dict(inputs)]
        for topic, name in found:
            if name not in wanted.get(topic, []):
                wanted.setdefault(topic, []).append(name)
        # A node announces its endpoints one by one: what it subscribes counts when it has not changed for a while.
        self._settled = self._settled + 1 if found == self._outside_found else 0
        self._outside_found = found
        if not absent and self._settled < SETTLED:
            absent.append("external nodes are still announcing what they subscribe")
        return absent

    def _other_type(self, pairing: Pairing) -> str:
        types = dict(self.node.get_topic_names_and_types()).get(self.node.resolve_topic_name(pairing.topic), [])
        other = [t for t in types if pairing.item is not None and t != pairing.item.port.msgtype]
        return f"; the topic exists with type {', '.join(other)}" if other else ""

    # ticks -----------------------------------------------------------------------------------------------------

    def _await(self, t: int) -> None:
        """Set what tick `t` needs."""
        missing = 0
        for pairing in self.pairings:
            if t < pairing.holds:
                continue  # a slower sender: its last message still holds
            want = pairing.schedule.awaited(t)
            pairing.holds = pairing.schedule.next(t)
            if want == pairing.want and t:
                continue  # at the end time: commands of the last tick are held
            pairing.want = want
            if pairing.ahead is not None and pairing.ahead[0] == want:
                if pairing.item is not None:
                    self.values[pairing.item.port.name] = pairing.ahead[1]
                pairing.ahead = None
                pairing.have = True
            else:
                pairing.have = False
                missing += 1
        self.missing = missing

    def _arrived(self, pairing: Pairing) -> None:
        pairing.have = True
        self.missing -= 1
        if not self.missing and self.ready:
            self._step()

    def _step(self) -> None:
        """Answer ticks as long as nothing is missing."""
        while not self.missing and self.state == "running":
            if self._is_plant:
                self._advance(self.t)
            elif self._solving is not None and not self._solving.finished(self.t, None if self.bad else self.values):
                return
            else:
                self._update(self.t)

    def _advance(self, t: int) -> None:
        """Move the plant over one period and publish where it is."""
        last = self.schedule.last
        if last is not None and t >= last:
            self.finish()
            return
        self.block.advance(t, **self.values)  # type: ignore[attr-defined]
        self.t = t = self._next()
        self.release()
        self.ticks += 1
        self._send(t)
        self._await(t)
        if last is not None and t >= last:
            self.finish()

    def _send(self, t: int) -> None:
        """Publish the plant's outputs at `t` and the clock."""
        self.publish(t, t, self.block.outputs(t))  # type: ignore[attr-defined]
        if self._publish_clock is not None:
            data = self._clock_layout.encode(t, ())
            self._publish_clock(data)
            if self.sink is not None:
                self.sink.add(self.extra_numbers, t, data)
        if self._publish_tick is not None:
            self._publish_tick(self._tick_layout.encode(t, ()))
        now = time.perf_counter_ns()
        if self._sent:
            self._durations.append(now - self._sent)
        else:
            self._first = now
        self._sent = now

    def _update(self, t: int) -> None:
        """Answer one tick of a block that is not a plant."""
        self.publish(t, t, self.answer(t))
        if self._publish_tick is not None:
            self._publish_tick(self._tick_layout.encode(t, ()))
        self.ticks += 1
        self.t = self._next()
        self.release()
        self._await(self.t)
        if self.schedule.last is not None and self.t > self.schedule.last:
            self.finish()

    def _next(self) -> int:
        self._tick += 1
        return self.schedule.time(self._tick)

    def answer(self, t: int) -> Any:
        """Give what a block that is not a plant sends; a solver has begun with this tick before."""
        return super().answer(t) if self._solving is None or self.bad else self._solving.block.end(t)

    def busy(self) -> bool:
        """Whether a solver is at work."""
        return self._solving is not None and self._solving.block.working

    def statistics(self) -> dict[str, Any]:
        """Wall-clock time of a plant's ticks: all in s, each in ms; once they are over, for sorting them takes time."""
        if self.state == "running":
            return {}
        return {"running_s": (self._sent - self._first) / 1e9} | percentiles("tick", self._durations)

    # stalls ----------------------------------------------------------------------------------------------------

    def _patient(self) -> None:
        """A solver is at work somewhere in the rig: the time without progress begins anew."""
        self._heard += 1

    def progress(self) -> None:
        """End the run when a peer is gone, stalls or never came."""
        now = time.monotonic()
        if self._rivals is not None:
            topic = self._rivals.port.topic
            infos = self.node.get_publishers_info_by_topic(topic)
            names = sorted({f"{i.node_namespace.rstrip('/')}/{i.node_name}" for i in infos})
            if not any("UNKNOWN" in n for n in names) or now - self._since > self.options.timeout:
                self.fail(f"{len(infos)} publishers on {topic} ({', '.join(names)}), expected exactly one")
            return
        if self.state == "starting":
            limit = self.options.start_timeout
            if limit and now - self._since > limit:
                self.fail(f"not all peers after {limit:g} s: {'; '.join(self._unmatched())}")
            return
        if self.state != "running":
            return
        if self._progress != (self.t, self._heard):
            self._progress, self._since = (self.t, self._heard), now
            return
        waited = now - self._since
        lacking = [p for p in self.pairings if not p.have]
        gone = [p for p in lacking if not self._publishers(p) or (p.item and not p.item.publishers)]
        if lacking and (waited > self.options.timeout or (gone and waited > GONE_AFTER)):
            lacking = gone or lacking
            what = ", ".join(
                f"{p.topic} from {p.sender}{' (gone)' if p in gone else ''}"
                f"{'; last refused: ' + p.item.last_refusal if p.item and p.item.last_refusal else ''}"
                for p in lacking
            )
            self.waits_for = [p.sender for p in lacking]
            self.fail(f"nothing stamped t = {self.t / SECOND:.9g} s within {waited:.1f} s on {what}")


def _stamp(data: bytes) -> int:
    """The stamp of a refused message, as far as it can be read."""
    if len(data) < 12 or data[1] != 1:
        return -1
    return int.from_bytes(data[4:8], "little", signed=True) * SECOND + int.from_bytes(data[8:12], "little")
