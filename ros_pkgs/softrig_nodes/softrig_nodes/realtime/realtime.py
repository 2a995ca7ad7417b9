"""Realtime: a node against the wall clock, for people, hardware and other people's nodes.

Stamps are ROS time: t_k = k * period counted from the Unix epoch, so all nodes of a host tick on one grid. A plant
advances by its timer and holds the newest command. A source has a timer. A block with required inputs answers a tick
when all inputs due at its stamp have arrived; a stated part of its period after the first one it answers with those
that it has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Set
from functools import partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from softrig_core.block.answer import Row, Rows
from softrig_core.block.block import Level, Plant
from softrig_core.block.fill import Pick
from softrig_core.block.gathering import STRETCH, gather
from softrig_core.block.link import Link
from softrig_core.block.port import Port
from softrig_core.block.schedule import Schedule
from softrig_core.errors import RunError
from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter
from ..adapter.departure import Departure
from ..adapter.handshake import Handshake
from ..seam.endpoint import Input, Output
from ..seam.health import percentiles
from ..seam.middleware import Timer
from .answering import Answering
from .live import Live, LiveSenders
from .sporadic import Sporadic, listen
from .stand import Stand

AGAIN = 10.0  # s between two reports of a silence that lasts
SOON = SECOND // 1000  # ns from the beginning to the first look at the clock
CATCH_UP = SECOND  # a longer pause than this (a suspended host) is skipped, not simulated
END_GRACE = SECOND  # ns after the end of the run after which a node ends that still waits for a publisher


@runtime_checkable
class Unjudged(Protocol):
    """A block whose runs can be impossible to judge, such as one on a board that never answered."""

    def void(self, x: Any) -> str:
        """Return why a run that ends with this state must not be judged; empty: it may be."""


class Realtime(Link):
    """Makes the ticks of a node ready: by the wall clock, and for a controller also by the messages that are due."""

    # Writing the file may take longer than a tick.
    status_every = 4

    def __init__(self, node: Adapter) -> None:
        self.node = node
        self._started = node.middleware.now()
        node.block.realtime = True
        self.clock = node.middleware.now
        self._stand = Stand(node, self._go_by)
        self.senders = LiveSenders(node, self.now)
        self._sent: deque[tuple[int, int]] = deque(maxlen=2 * node.block.STALE_PERIODS)  # stamps and times of sending
        # Only the newest are kept, because they are sorted for each status file, between two ticks.
        self._round_trip: deque[int] = deque(maxlen=5_000)
        self._lateness: deque[int] = deque(maxlen=5_000)
        self._longest = self._latest = -CATCH_UP
        self.tick_number = -1
        self.skipped = 0
        self._silence_reported_at = 0.0
        self._missed = self._late = 0
        self._period = node.schedule.time(1)
        self._local_readers: dict[Realtime, list[tuple[int, Callable[[int, Row | None, int], None]]]] = {}
        node.epoch = node.options.epoch
        super().__init__(node.step)
        gather(node.step, STRETCH // node.step.schedule.time(1))
        node.begin(self)
        self._commands = [f for f in self.senders.rows if f.awaited and node.is_plant]
        block = node.block
        self._idle = isinstance(block, Plant) and block.AWAITS_COMMAND and not node.options.links
        self.senders.on_value, self.senders.excuse, self.senders.act = self._on_value, self._excuse, lambda: None
        self._answering: Answering | None = None
        self._paired: list[Live] = []  # inputs that it takes by stamp; a controller does so when it answers
        self._fed: list[Live] = []  # inputs that neighbours fill
        self._rivals: list[Live] = []  # inputs among them that other processes write, too
        self._begun: Callable[[], object] | None = None
        self._newest: Callable[[], object] | None = None  # runs its newest tick, unless messages make it answer
        self.departure: Departure | None = None
        self._over = False  # the last tick is answered
        self._moved = 0  # tick of a plant's state, if native code has already advanced it
        self.before_reading: Callable[[], object] = lambda: None  # brings the state of the step up to date

    def connect(self, output: Output, reader: Realtime, row: Live, pick: Pick | None) -> None:
        """Pass the messages of an output to a node of this process, too."""
        self._local_readers.setdefault(reader, []).append((output.number, row.receiver(pick, output.port.unchecked)))

    def follow(self, begun: Callable[[], object], newest: Callable[[], object]) -> None:
        """Follow the ticks of a `Beat`: it fills the inputs and triggers the ticks; the node waits for no message."""
        self._begun, self._newest = begun, newest
        self._fed = [f for f in self.senders.rows if f.local]

    def _by_itself(self) -> Callable[[], object]:
        """Run ticks when the due messages have arrived, or by a timer; return the callable that starts this."""
        node, senders = self.node, self.senders
        if not node.is_plant and any(f.awaited for f in senders.rows):
            self._answering = answering = Answering(senders, self._answer)
            senders.on_value, senders.excuse, senders.act = answering.process, answering.excuse, answering.act
            return lambda: None
        self._paired = [f for f in senders.rows if f.paired]
        self._timer = node.middleware.timer(SOON, self._tick)
        self._timer.cancel()
        self._newest = self._tick
        return lambda: self._timer.again(SOON)

    def join(self, local: Set[str]) -> None:
        """Begin, or wait for the others if t = 0 must be agreed; `local` are the other nodes of this process."""
        node = self.node
        # A `Beat` may have set it already by `follow`.
        self._begun = self._begun or self._by_itself()
        acknowledgements = listen(
            self.senders, [r for r in self.senders.rows if isinstance(r, Sporadic) and r.publisher not in local]
        )
        # With a given epoch the nodes need not agree on a start.
        if node.links.starter and not node.epoch:
            readers, inputs = node.links.readers, node.links.inputs
            wanted = [(o, list(readers.get(o.name, []))) for o in node.outgoing.outputs]
            awaited = [(i, inputs[i.name].node) for i in node.inputs if i.name in inputs]
            awaited += [(i, i.publisher) for i in acknowledgements]
            wanted.append((node.outgoing.tick_output, node.links.silence_readers))
            shake = Handshake(node, awaited, wanted, local)
            self.departure = Departure(node, shake, local, self._begin_at, self._stand.receive)
        else:
            self._begin_at(node.epoch, 0)

    # start and end ---------------------------------------------------------------------------------------------

    def _begin_at(self, epoch: int, ahead: int) -> None:
        """Run from now on; t = 0 is at `epoch`, or with the first tick when that is 0.

        The clock of the rig is `ahead` of ours, ns.
        """
        if ahead:
            self._stand.follow(ahead)
            text = f"the clock of the rig is {ahead / SECOND:+.3f} s from this one: followed"
            self.node.step.note(Level.WARN, "clock", text)
        self.node.epoch = epoch
        # The first tick has no time for generating these functions.
        self.node.step.make()
        self.node.state = "running"
        self._silence_reported_at = self.node.middleware.steady()
        if self._idle:
            topics = ", ".join(row.port.topic for row in self._commands)
            self.node.middleware.log(Level.OK, f"stays at t = 0 until it is commanded on {topics}")
        assert self._begun is not None
        self._begun()
        if self.node.pauses and self.departure is not None:
            self._stand.serve(self.departure.announce)

    def progress(self) -> None:
        """Report a silence again while it lasts; end a node whose publishers ended before it when the run is over."""
        node = self.node
        if self.departure is not None:
            node.lacking = self.departure.handshake.lacking
        if not node.ticks and self._answering is not None and node.state == "running":
            self._report_unreceived()
        if self.senders.stale and node.middleware.steady() > self._silence_reported_at + AGAIN:
            self._silence_reported_at = node.middleware.steady()
            for row in sorted(self.senders.rows, key=lambda row: row.name):
                if row.name in self.senders.stale:
                    node.middleware.log(Level.ERROR, node.step.reports[f"stale {row.port.topic}"][1])
        # A plant that has not been commanded moves its t = 0 with the clock, so its run would never end by that.
        end, begun = node.schedule.end, self._started if self._idle else node.epoch or self._started
        if end is not None and node.state == "running" and self.now() > begun + end + END_GRACE:
            # A process that stood over the end may look here before the timer of its last tick fires.
            if self._newest is not None:
                self._newest()
            if self._answering is not None:
                self._answering.count_missed(node.epoch + end)
            if node.state == "running":
                node.finish()

    def _report_unreceived(self) -> None:
        """Report inputs that a controller has never received although they have a publisher."""
        node, now = self.node, self.node.middleware.steady()
        unheard = sorted(r.port.topic for r in self.senders.rows if r.awaited and r.stamp is None and r.publishers)
        if not unheard:
            self._silence_reported_at = now
        elif now > self._silence_reported_at + AGAIN:
            self._silence_reported_at = now
            text = f"has received nothing on {', '.join(unheard)} for {AGAIN:g} s, though it is published"
            node.middleware.log(Level.ERROR, text)

    def now(self) -> int:
        """Wall-clock time."""
        return self.clock()

    def record(self, number: int, data: bytes) -> None:
        """Record a message from outside at the tick that uses it."""
        self.senders.unrecorded.append((0, number, data))

    @property
    def t(self) -> int:
        """Time of the newest tick."""
        return self.node.step.t

    @property
    def missed(self) -> int:
        """Ticks that were not answered at their time."""
        return self._missed if self._answering is None else self._answering.missed

    @property
    def incomplete(self) -> int:
        """Return the number of ticks that ran without all due messages."""
        return 0 if self._answering is None else self._answering.incomplete

    def _go_by(self, clock: Callable[[], int]) -> None:
        # Native ticks follow the wall clock, and would pass the time of a stop while Python's thread does not run.
        self.before_reading()
        self.clock = clock

    def busy(self) -> bool:
        """Return whether a person has stopped the clock of the rig."""
        return self.node.hold.held

    # messages --------------------------------------------------------------------------------------------------

    def row(self, port: Port) -> Live:
        """Create the row of an input: it stores the good values by stamp; a due one makes a block answer."""
        link = self.node.links.inputs.get(port.name)
        return self.senders.row(port, Sporadic if link is not None and link.reports_silence else Live)

    def on_matched(self, item: Input) -> None:
        """Reject both of two publishers on one input until one of them has left or has been silent for long."""
        assert isinstance(item, Live)
        item.on_matched()
        self._rivals = [f for f in self._fed if f.outside]

    def _on_value(self, row: Live, stamp: int, due: int, value: Any, now: int) -> None:
        # A message of the rig belongs to a tick, at which `_use` picks it by its stamp. Any other counts from its
        # arrival on.
        if not row.paired:
            self.node.values[row.name] = value
        self.commanded(stamp, now)

    def commanded(self, stamp: int, now: int) -> None:
        """Handle the command for a plant's tick."""
        # The newest stamps are at the end, and a command answers one of them.
        for published, sent in reversed(self._sent):
            if published <= stamp:
                if published == stamp:
                    self._round_trip.append(now - sent)
                    self._longest = max(self._longest, now - sent)
                return

    def _excuse(self, row: Live, due: int, now: int) -> None:
        self.node.step.bad = True

    def send(self, t: int, rows: Rows, numbers: tuple[float, ...]) -> None:
        """Publish; readers of this process receive the messages after the current callback has returned."""
        node = self.node
        node.outgoing.publish(t, rows, numbers)
        stamp = node.epoch + t
        for reader, targets in self._local_readers.items():
            node.middleware.post(partial(reader.receive_local, targets, stamp, rows))

    def changed(self, t: int, values: Mapping[str, Any]) -> None:
        """Record new parameters."""
        node = self.node
        node.record.change(node.epoch + t, node.middleware.name, values)

    def receive_local(
        self, targets: list[tuple[int, Callable[[int, Row | None, int], None]]], stamp: int, rows: Rows
    ) -> None:
        """Receive the outputs of a node of this process at a tick: all of them before this node runs because of one."""
        if self.node.state != "running":
            return
        now = self.clock()
        for k, tell in targets:
            tell(stamp, rows[k], now)
        self.senders.act()

    # ticks -----------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        """Run the newest tick by the timer of a plant or a source."""
        node, schedule = self.node, self.node.schedule
        if node.state != "running":
            self._timer.cancel()
            return
        now = self.clock()
        # The first tick is the next point of the grid, or the common start that was given.
        node.epoch = node.epoch or schedule.next(now)
        self._idle = self._idle and any(row.stamp is None for row in self._commands)
        # Until it gets a command, a plant started alone publishes its t = 0 at each period, and t = 0 moves with the
        # clock.
        if self._idle:
            node.epoch, self.tick_number = schedule.held(now), -1
        due = newest(self._timer, schedule, now - node.epoch)
        self.tick(schedule.tick(due), due, now)

    def tick(self, number: int, due: int, now: int) -> None:
        """Advance a plant, or run another node, at its newest tick: its number and time (ns from t = 0), now."""
        node, end = self.node, self.node.schedule.end
        # A process that was stopped over the end of the run still answers its last tick.
        if end is not None and due > end:
            due = node.schedule.held(end)
            number = node.schedule.tick(due)
            # `_ticked` leaves at a tick that lies exactly at the end. If the end lies between two ticks, the node
            # leaves here, when its timer fires for the first time after the end.
            if number <= self.tick_number:
                self._leave()
        if number <= self.tick_number or node.state != "running" or self._over:
            return
        # With two publishers on an input neither is accepted, so there is nothing to answer with.
        if self._rivals and any(f.deaf() for f in self._rivals) and not node.is_plant:
            return
        late = now - node.epoch - due
        self._lateness.append(late)
        if late > self._latest:
            self._latest = late
        if late >= self._period:
            self._late += 1
        behind = number - self.tick_number if self.tick_number >= 0 else 0
        unanswered = max(behind - 1, 0)
        if behind > 1:
            self._missed += behind - 1
            if node.schedule.time(behind) > CATCH_UP:
                self.skipped += behind - 1
                behind = 1
        self.tick_number = number
        if not node.is_plant:
            node.step.unanswered = unanswered
            self._answer(due)
            return
        try:
            # A late plant makes up for each missed period, so its state is at the time that it publishes.
            for k in range(max(number - behind, self._moved), number):
                self._move(k)
            node.step.answer(due)
        except RunError as error:
            node.broke(error)
            return
        self._sent.append((node.epoch + due, self.clock()))
        self._ticked(due)

    def _move(self, k: int) -> None:
        """Advance a plant from tick k to the next one."""
        node, schedule = self.node, self.node.schedule
        t = schedule.time(k)
        self._use(t)
        # Staleness is judged at the time of the tick: a plant that is late itself must not declare its controllers
        # silent.
        node.step.advance(t, self._fresh_inputs(node.epoch + schedule.time(k + 1)))

    # native ticks ----------------------------------------------------------------------------------------------

    def disturbed(self) -> bool:
        """Return whether something from outside takes part in its ticks: messages, or a person who stops the clock."""
        return bool(
            self.senders.unrecorded
            or self._rivals
            or self._stand.stopping
            or any(row.outside or row.stamp is not None for row in self.senders.rows if not row.local)
        )

    def move_on(self) -> None:
        """Advance a plant to its next tick, which native code will answer."""
        if self.node.is_plant and self._moved <= self.tick_number:
            try:
                self._move(self.tick_number)
            except RunError as error:
                self.node.broke(error)
            self._moved = self.tick_number + 1

    def count_native(self, ticks: range, spans: NDArray[np.int64]) -> None:
        """Count native ticks.

        Parameters
        ----------
        ticks : range
            By their numbers.
        spans : array of int64, shape (n, 2)
            How late each began, and how long it took, ns.
        """
        node = self.node
        if not ticks:
            return
        node.ticks += len(ticks)
        self.tick_number, self._moved = ticks[-1], ticks.stop
        node.step.t = node.schedule.time(ticks[-1])
        late, durations = spans.T
        self._lateness.extend(late.tolist())
        self._latest = max(self._latest, int(late.max()))
        self._late += int((late >= self._period).sum())
        if self._commands:
            self._round_trip.extend(durations.tolist())
            self._longest = max(self._longest, int(durations.max()))

    def send_all(self, times: NDArray[np.int64], numbers: NDArray[np.float64], stamps: NDArray[np.int64]) -> None:
        """Record answers of native code, which has published them."""
        self.node.outgoing.keep(times, numbers)

    def settle(self) -> None:
        """Bring the state of the step up to date with its native ticks."""
        self.before_reading()

    # ticks by the clock or by messages -------------------------------------------------------------------------

    def _use(self, t: int) -> None:
        """Hold the values of tick `t`, and record those from outside."""
        if self._paired or self.senders.unrecorded:
            stamp = self.node.epoch + t
            for row in self._paired:
                if (value := row.value_at(stamp)) is not None:
                    self.node.values[row.name] = value
            if self.senders.unrecorded:
                self.senders.record(stamp)

    def _fresh_inputs(self, now: int) -> dict[str, Any]:
        """Return the current commands; a command that is stale at the time of a tick is replaced by the safe value."""
        inputs = self.node.values
        for row in self._commands:
            if row.disputed or row.silent(now):
                inputs = inputs | {row.name: row.port.safe}
        return inputs

    def _answer(self, t: int) -> None:
        """Publish the outputs of tick `t`; the safe values if the controller overflows or returns invalid ones."""
        node, step = self.node, self.node.step
        if self._over:
            return
        self._use(t)
        try:
            step.answer(t)
        except RunError as error:
            # Arithmetic errors and rejected values may pass as the loop moves on; anything else is a mistake in the
            # block's code.
            if not isinstance(error.__cause__, ArithmeticError | ValueError | None):
                node.broke(error)
                return
            text = str(error).removeprefix(f"{step.name}: ")
            node.step.note(Level.ERROR, "failed", f"{text}; safe output")
            # Without an answer before it, `held` returns the safe values.
            step.last_answer = ()
            step.hand_on(t, step.checked(step.held()))
        self._ticked(t)

    def _ticked(self, t: int) -> None:
        node = self.node
        node.ticks += 1
        if node.buttons.pressed:
            node.buttons.release()
        if node.schedule.end is not None and t >= node.schedule.end:
            self._leave()

    def _leave(self) -> None:
        """Finish, after a bounded wait for the last messages of external nodes, which it records."""
        if not self._over:
            self._over = True
            self.senders.record_late(self.node.epoch + self.node.t)
            self.node.overheard.over()
        if self.node.overheard.complete():
            block = self.node.step.block
            if isinstance(block, Unjudged) and (why := block.void(self.node.step.x)):
                self.node.fail(why)
            else:
                self.node.finish()

    def on_last_message(self) -> None:
        """See `Drive.on_last_message`."""
        if self._over and self.node.state == "running":
            self._leave()

    def counts(self) -> dict[str, int]:
        """Missed deadlines, incomplete and dropped ticks, lost and late messages so far."""
        figures: dict[str, Any] = {"missed_deadlines": self.missed}
        if self._answering is not None:
            figures["incomplete_ticks"] = self._answering.incomplete
            if self._answering.dropped:
                figures["dropped_ticks"] = self._answering.dropped
        if self.skipped:
            figures["skipped_periods"] = self.skipped
        for key, count in (("lost_arrays", "lost"), ("late_messages", "late"), ("overdue_messages", "overdue")):
            if number := sum(getattr(item, count) for item in self.node.inputs):
                figures[key] = number
        return figures

    def statistics(self) -> dict[str, Any]:
        """Return the counts, ticks begun when the next was due, lateness and round trip from output to command in ms.

        The largest is of all ticks, the percentiles are of the newest.
        """
        figures: dict[str, Any] = {**self.counts()} | ({"late_ticks": self._late} if self._late else {})
        figures |= percentiles("lateness", self._lateness, self._latest)
        figures |= percentiles("round_trip", self._round_trip, self._longest)
        if self.node.step.native != (0, ""):
            figures["native"] = self.node.step.native
        if self._lateness:
            figures["jitter_ms"] = figures["lateness_p99_ms"] - figures["lateness_p50_ms"]
        return figures


def newest(timer: Timer, schedule: Schedule, t: int) -> int:
    """Return the newest tick at a time t (both ns from t = 0), and have the timer fire at the next one.

    It is computed from the grid of the wall clock each time, so that errors do not accumulate.
    """
    due = schedule.held(t)
    timer.again(schedule.next(due) - t, schedule.time(1))
    return due
