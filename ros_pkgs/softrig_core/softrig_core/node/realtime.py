"""Realtime: a node against the wall clock, for people, hardware and other people's nodes.

Stamps are ROS time: t_k = k * period counted from the Unix epoch, so all nodes of a host tick on one grid. A
plant moves by its timer and holds the newest command; a block with required inputs answers each new message
of its first one; a source has a timer.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from ..model.block import Block, Level, Plant
from ..model.port import Refused, Sample
from ..model.schedule import Schedule
from ..model.timebase import SECOND, to_ns
from ..rig.options import RunOptions
from .adapter import Adapter, Input, percentiles

CATCH_UP = SECOND  # a longer pause than this (a suspended host) is skipped, not simulated


class Realtime(Adapter):
    """A block driven by the wall clock; see `Adapter` for the parameters."""

    open_ended = True

    def __init__(self, node: Node, block: Block, options: RunOptions) -> None:
        self.arrived: dict[str, int] = {}
        self.stale: set[str] = set()
        self.tick_number: int | None = None
        self.missed = 0
        self.skipped = 0
        # the newest: they are sorted for each status file, between two ticks
        self._lateness: deque[int] = deque(maxlen=5_000)
        self._round_trip: deque[int] = deque(maxlen=5_000)
        self._sent_at: dict[int, int] = {}
        self._last_due: int | None = None
        block.realtime = True
        super().__init__(node, block, options)
        self.epoch = options.epoch
        required = [i for i in self.inputs if not i.port.held]
        self._pacer = None if isinstance(block, Plant) or not required else required[0].port.name
        self._required = [i.port.name for i in required]
        if self._pacer is None:
            self._timer = node.create_timer(0.001, self._tick, clock=self._steady)
        self.state = "running"

    def receiver(self, item: Input) -> Callable[[bytes], None]:
        """Keep the newest good value; the first required input of a controller makes it answer."""
        name = item.port.name
        self.values[name] = None if item.port.held else item.port.safe
        plant = isinstance(self.block, Plant)

        def receive(data: bytes) -> None:
            if item.publishers > 1:
                self.refuse(item, f"{item.publishers} publishers at once ({self._who(item)}), expected one")
                return
            try:
                stamp, values = item.decode(data)
            except Refused as error:
                self.refuse(item, str(error))
                self.bad = True
                if name == self._pacer:
                    now = time.time_ns()
                    self._answer(self.schedule.held(now))
                return
            now = time.time_ns()
            # A delayed message tells when it was measured, one without a stamp nothing: the answer is due now.
            due = stamp if item.port.stamped and not item.port.delayed else self.schedule.held(now)
            if not plant:
                self.epoch = self.epoch or due
            self.values[name] = Sample(stamp - self.epoch, values) if item.port.delayed else values
            self.arrived[name] = now
            if name in self.stale:
                self.stale.discard(name)
                self.block.report(Level.WARN, f"recovered {item.port.topic}", "commands are back")
            if self.sink is not None and name in self.foreign:
                self.sink.add(self.foreign[name], now, data)
            if plant:
                sent = self._sent_at.get(stamp)
                if sent is not None:
                    self._round_trip.append(now - sent)
            elif name == self._pacer:
                self._answer(due)

        return receive

    def on_matched(self, item: Input | None) -> None:
        """Two publishers on one input: neither is believed until one of them has gone."""
        if item is not None and item.publishers > 1 and not item.port.held:
            self.refuse(item, f"{item.publishers} publishers at once ({self._who(item)}), expected one")
            self.values[item.port.name] = item.port.safe
            self.arrived.pop(item.port.name, None)

    def _who(self, item: Input) -> str:
        infos = self.node.get_publishers_info_by_topic(item.port.topic)
        return ", ".join(sorted({i.node_name for i in infos}))

    # controllers -----------------------------------------------------------------------------------------------

    def _answer(self, stamp: int) -> None:
        if any(name not in self.arrived for name in self._required):
            return
        due = self.schedule.tick(stamp)
        if due == self._last_due or stamp < self.epoch:
            return
        if self._last_due is not None and due > self._last_due + 1:
            self.missed += due - self._last_due - 1
        self._last_due = due
        t = stamp - self.epoch
        self.publish(t, stamp, self.answer(t))
        self._advance_to(t)

    def now(self) -> int:
        """Wall-clock time."""
        return time.time_ns()

    def _advance_to(self, t: int) -> None:
        self.t = t
        self.ticks += 1
        self.release()
        if self.schedule.end is not None and t >= self.schedule.end:
            self.finish()

    # plants and sources ----------------------------------------------------------------------------------------

    def _tick(self) -> None:
        now = time.time_ns()
        if self.tick_number is None:
            # The first tick is the next point of the grid, or the common start that the runner gave.
            self.epoch = self.epoch or self.schedule.next(now)
            self.tick_number = -1
        due = self.schedule.held(now - self.epoch)
        number = self.schedule.tick(due)
        # Aimed at the next point of the wall clock's grid each time, so that no error adds up.
        self._timer.timer_period_ns = max(1000, self.epoch + self.schedule.next(due) - now)
        self._timer.reset()
        if number <= self.tick_number:
            return
        self._lateness.append(now - self.epoch - due)
        behind = number - self.tick_number
        if self.tick_number >= 0 and behind > 1:
            self.missed += behind - 1
        if self.schedule.time(behind) > CATCH_UP:
            self.skipped += behind - 1
            behind = 1
        if isinstance(self.block, Plant):
            inputs = self._fresh_inputs(now)
            for k in range(number - behind if self.tick_number >= 0 else number, number):
                self.block.advance(self.schedule.time(k), **inputs)
        self.tick_number = number
        t, stamp = due, self.epoch + due
        if isinstance(self.block, Plant):
            self.publish(t, stamp, self.block.outputs(t))
            self._sent_at[stamp] = time.time_ns()
            while len(self._sent_at) > 2 * self.block.STALE_PERIODS:
                del self._sent_at[next(iter(self._sent_at))]
        else:
            self.publish(t, stamp, self.answer(t))
        self._advance_to(t)

    def _fresh_inputs(self, now: int) -> dict[str, Any]:
        """Newest commands; the safe value in place of a stale one."""
        inputs = dict(self.values)
        for item in self.inputs:
            name = item.port.name
            if item.port.held or name not in self.arrived:
                continue
            link = self.links.inputs.get(name)
            limit = to_ns(self.options.watchdog) or max(
                self.schedule.time(self.block.STALE_PERIODS),
                Schedule(link.period).time(Block.STALE_PERIODS) if link else 0,
            )
            if now - self.arrived[name] > limit:
                inputs[name] = item.port.safe
                if name not in self.stale:
                    self.stale.add(name)
                    text = f"no command on {item.port.topic} for {limit / SECOND:g} s: safe input"
                    self.block.report(Level.ERROR, f"stale {item.port.topic}", text)
        return inputs

    def statistics(self) -> dict[str, Any]:
        """Missed deadlines, lateness of the timer and round trip from output to command, in ms."""
        figures: dict[str, Any] = {"missed_deadlines": self.missed}
        if self.skipped:
            figures["skipped_periods"] = self.skipped
        figures |= percentiles("lateness", self._lateness) | percentiles("round_trip", self._round_trip)
        if self._lateness:
            figures["jitter_ms"] = figures["lateness_p99_ms"] - figures["lateness_p50_ms"]
        return figures
