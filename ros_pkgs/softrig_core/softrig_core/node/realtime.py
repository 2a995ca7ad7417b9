"""Realtime: a node against the wall clock, for people, hardware and other people's nodes.

Stamps are ROS time: t_k = k * period counted from the Unix epoch, so all nodes of a host tick on one grid. A plant
moves by its timer and holds the newest command. A source has a timer. A block with required inputs answers a tick when
all of them that are due at its stamp are there, or, a stated part of its period after the first, with what it has.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from ..errors import RunError
from ..model.block import Block, Plant
from ..model.timebase import SECOND
from ..rig.options import RunOptions
from ..wire.recording import Sink
from .answering import Answering
from .departure import Departure
from .health import percentiles
from .middleware import Middleware
from .start import Handshake

CATCH_UP = SECOND  # a longer pause than this (a suspended host) is skipped, not simulated
END_GRACE = SECOND  # a node that waits for a sender ends this much after the end of the run all the same


class Realtime(Answering):
    """A block driven by the wall clock; see `Adapter` for the parameters."""

    open_ended = True
    status_every = 4  # a file takes longer than a tick

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self._started = middleware.now()
        block.realtime = True
        super().__init__(middleware, block, options, sink)
        self.tick_number: int | None = None
        self.skipped = 0
        self._lateness: deque[int] = deque(maxlen=5_000)  # the newest
        self._publish_tick = None  # nobody waits for ticks in real time
        if not self._by_messages:
            self._timer = middleware.timer(SECOND // 1000, self._tick)
            self._timer.cancel()
        self._departure = self._wait_for_others() if self.links.starter and not self.epoch else None
        if self._departure is None:
            self._begin_at(self.epoch)

    # start and end ---------------------------------------------------------------------------------------------

    def _wait_for_others(self) -> Departure:
        readers, inputs = self.links.readers, self.links.inputs
        wanted = [(o, list(readers.get(o.name, []))) for o in self.outputs]
        handshake = Handshake(self, [(i, inputs[i.name].node) for i in self.inputs if i.name in inputs], wanted)
        return Departure(self, handshake, self._begin_at)

    def _begin_at(self, epoch: int) -> None:
        """Run from now on; t = 0 is at `epoch`, or with the first tick when that is 0."""
        self.epoch = epoch
        self.state = "running"
        if not self._by_messages:
            self._timer.again(SECOND // 1000)

    def progress(self) -> None:
        """A node whose senders have ended before it does not wait for them beyond the end of the run."""
        if self._departure is not None:
            self.lacking = self._departure.handshake.lacking
        end = self.schedule.end
        if end is None or self.state != "running":
            return
        if self.middleware.now() > (self.epoch or self._started) + end + END_GRACE:
            self.finish()

    # plants and sources ----------------------------------------------------------------------------------------

    def _tick(self) -> None:
        if self.state != "running":
            self._timer.cancel()
            return
        now = self.middleware.now()
        if self.tick_number is None:
            # The first tick is the next point of the grid, or the common start that the runner gave.
            self.epoch = self.epoch or self.schedule.next(now)
            self.tick_number = -1
        due = self.schedule.held(now - self.epoch)
        number = self.schedule.tick(due)
        # Aimed at the next point of the wall clock's grid each time, so that no error adds up.
        self._timer.again(self.epoch + self.schedule.next(due) - now)
        if number <= self.tick_number:
            return
        self._lateness.append(now - self.epoch - due)
        behind = number - self.tick_number
        if self.tick_number >= 0 and behind > 1:
            self.missed += behind - 1
        if self.schedule.time(behind) > CATCH_UP:
            self.skipped += behind - 1
            behind = 1
        first = number - behind if self.tick_number >= 0 else number
        self.tick_number = number
        if isinstance(self.block, Plant):
            try:
                self._move(self.block, first, number, self._fresh_inputs(now))
            except (ArithmeticError, RunError) as error:
                self.broke(error)
                return
        else:
            self.t = due
            self._say(due)
        self._advance_to(due)

    def _move(self, plant: Plant, first: int, number: int, inputs: dict[str, Any]) -> None:
        """Move a plant from tick `first` to tick `number` and publish where it is."""
        for k in range(first, number):
            self.t = self.schedule.time(k)
            plant.advance(self.t, **inputs)
        self.t = t = self.schedule.time(number)
        stamp = self.epoch + t
        self.publish(t, stamp, plant.outputs(t))
        self._sent_at[stamp] = self.middleware.now()
        if len(self._sent_at) > 2 * self.block.STALE_PERIODS:
            del self._sent_at[next(iter(self._sent_at))]

    def _fresh_inputs(self, now: int) -> dict[str, Any]:
        """Newest commands; the safe value in place of a stale one."""
        inputs = self.values
        stale = now - self._stale_after
        for feed in self._awaited:
            if feed.arrived is not None and feed.arrived < stale and self._notice_silence(feed, now):
                inputs = inputs | {feed.item.name: feed.item.port.safe}
        return inputs

    def statistics(self) -> dict[str, Any]:
        """Missed deadlines, incomplete ticks, lateness of the timer and round trip from output to command, in ms."""
        figures: dict[str, Any] = {"missed_deadlines": self.missed}
        if self._by_messages:
            figures["incomplete_ticks"] = self.incomplete
        if self.skipped:
            figures["skipped_periods"] = self.skipped
        if lost := sum(feed.item.lost for feed in self.feeds.values()):
            figures["lost_arrays"] = lost
        figures |= percentiles("lateness", self._lateness) | percentiles("round_trip", self._round_trip)
        if self._lateness:
            figures["jitter_ms"] = figures["lateness_p99_ms"] - figures["lateness_p50_ms"]
        return figures
