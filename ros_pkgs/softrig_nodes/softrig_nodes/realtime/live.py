"""The table of senders in real time: the newest messages of each, and whether those of a tick are there."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from softrig_core.block.answer import Row
from softrig_core.block.block import Block, Level
from softrig_core.block.codec import readable_stamp
from softrig_core.block.fill import Pick, picked
from softrig_core.block.port import Port, Refused, Sample
from softrig_core.timebase import SECOND, to_ns

from ..adapter.adapter import Adapter
from ..adapter.sender import Sender
from .rivals import Rivals

KEPT = 64  # messages of a faster sender that may come before our tick is complete
GONE = SECOND  # ns by which one of several publishers may be late before another one is believed


class LiveSenders:
    """The senders of a node in real time.

    Parameters
    ----------
    clock : callable
        Returns the wall-clock time, ns.

    Attributes
    ----------
    stale : set of str
        Inputs whose senders have been silent for too long.
    window : int
        Largest difference of a stamp from now that is accepted, ns.
    least : int
        ns after which a sender may be stale.
    watchdog : int
        ns after which a command is stale; 0: a number of intervals of its sender.
    unrecorded : list of (due, number, message)
        Messages from outside that no tick has used: they are recorded at the first tick that is not before `due`, ns.
    on_value : callable
        Gets (row, stamp, time of the tick that it belongs to, value, now) of each valid message.
    excuse : callable
        Gets (row, time of its tick, now) of each invalid one whose tick is known.
    act : callable
        Called when all messages that arrived together have been passed to `on_value` or `excuse`.
    """

    on_value: Callable[[Live, int, int, Any, int], object]
    excuse: Callable[[Live, int, int], object]
    act: Callable[[], object]

    def __init__(self, node: Adapter, clock: Callable[[], int]) -> None:
        self.node = node
        self.clock = clock
        self.rows: list[Live] = []
        self.stale: set[str] = set()
        self.unrecorded: list[tuple[int, int, bytes]] = []
        self.window = to_ns(node.options.stamp_window)
        self.watchdog = to_ns(node.options.watchdog) if node.is_plant else 0
        self.least = self.watchdog or node.schedule.time(node.block.STALE_PERIODS)

    def row(self, port: Port, kind: type[Live]) -> Live:
        """Create the row of an input."""
        row = kind(self, port)
        self.rows.append(row)
        self.node.step.stamps[port.name] = row.held_stamp
        return row

    def record(self, stamp: int) -> None:
        """Record the inputs of the tick of a stamp, with that stamp, at which a repetition must provide them."""
        sink = self.node.record.sink
        if sink is not None:
            for due, number, data in self.unrecorded:
                if due <= stamp:
                    sink.add(number, stamp, data)
            self.unrecorded = [entry for entry in self.unrecorded if entry[0] > stamp]

    def record_late(self, stamp: int) -> None:
        """Record messages that arrived after the last tick, whose stamp is given."""
        for due in sorted({max(due, stamp) for due, _, _ in self.unrecorded}):
            self.record(due)

    def believe(self, stamp: int, delayed: bool = False) -> None:
        """Check that a stamp is close to the present time.

        Raises
        ------
        Refused
            It is not.
        """
        off = stamp - self.clock()
        # A delayed message may be old on purpose; a stamp from the future is wrong in any case.
        if off > self.window or (-off > self.window and not delayed):
            most = f"expected at most {self.window / SECOND:g} s"
            raise Refused(f"stamp is {off / SECOND:+.3g} s from now, {most}")

    def grid_time(self, now: int) -> int:
        """Return the newest tick of this node at a given time; both are ns of the wall clock."""
        epoch = self.node.epoch
        return epoch + self.node.schedule.held(now - epoch)


class Live(Sender):
    """A sender whose newest messages are used.

    Attributes
    ----------
    schedule : Schedule or None
        Schedule of the sender, if the rig names it; otherwise its interval is estimated from its stamps.
    awaited : bool
        Whether a tick waits for it: it is required, and its sender is never silent or reports when it was.
    by_arrival : bool
        Whether its messages belong to the tick at which they arrive: they do not contain the time of their tick.
    paired : bool
        Whether a node of the rig sends it: its value at a tick is then the newest stamped up to there, as in lockstep.
    expected : bool
        Whether a controller waits for it although it is optional: it is paired and its sender publishes at each of its
        ticks. After a wait that timed out it is expected again once a message has arrived.
    answered : int
        Stamp of the newest tick that has used it, ns.
    stamp : int or None
        Of the newest message, ns since the Unix epoch.
    arrived : int or None
        Wall-clock time at which it arrived.
    fresh : bool
        Whether a message has arrived since the last answer.
    bad : int or None
        Stamp of a rejected message.
    recent : deque of (stamp, value)
        The newest messages; the oldest are dropped when it is full.
    holds : int
        All messages for ticks stamped before this time have arrived.
    """

    def __init__(self, table: LiveSenders, port: Port) -> None:
        node = table.node
        link = node.links.inputs.get(port.name)
        super().__init__(node, port, link.node if link else "another node")
        self.table = table
        self.schedule = node.peer(link) if link else None
        unreported = link is None or not link.reports_silence
        silent = unreported and (port.sporadic or (link is not None and link.sporadic) or port.name in node.links.free)
        self.awaited = not port.held and not silent
        at_tick = link is not None and not link.delayed
        self.by_arrival = not port.stamped or (port.delayed and not at_tick)
        self.paired = link is not None and not self.by_arrival
        self._optional = self.expected = self.paired and not self.awaited and not silent
        self.answered = -1
        self.arrived: int | None = None
        self.fresh = False
        self.bad: int | None = None
        self.recent: deque[tuple[int, Any]] = deque(maxlen=KEPT)
        self.holds = 0
        self._used: int | None = None  # stamp of the value that the last tick used
        self._interval = 0 if self.schedule is None else self.schedule.time(1)
        self._rivals = Rivals()
        # Only a publisher that should publish at each tick can be noticed as gone by its silence.
        if self.awaited and unreported:
            self.numbered = self._numbered

    # what has come -------------------------------------------------------------------------------------------------

    def receive(self, data: bytes) -> None:
        """Receive the bytes of a message, and run the ticks that it completes."""
        super().receive(data)
        self.table.act()

    def _numbered(self, number: int | None) -> None:
        """Count the writers by a message's number; one that is silent for too long no longer blocks another."""
        if self.outside < 2:
            return
        before, silence = self._rivals.alone, max(self._silence(), GONE)
        self._rivals.receive(number, self.table.clock(), silence)
        if self._rivals.alone and not before and not self.local:
            text = f"of {self.publishers} publishers only one has published for {silence / SECOND:g} s: accepted"
            self.node.step.note(Level.WARN, f"rivals {self.port.topic}", text)

    @property
    def disputed(self) -> bool:
        """Return whether several nodes publish the topic and it is unknown which one is valid."""
        return self.publishers > 1 and (self.local or not self._rivals.alone)

    def deaf(self) -> bool:
        """Return whether messages are ignored: before the start, and while two publishers conflict."""
        return self._refuses() or self.node.state != "running"

    def read(self, data: bytes) -> tuple[int, Any]:
        """Return stamp and values; a stamp of 0 means: no stamp, now."""
        stamp, values = self.decode(data)
        if self.port.stamped and stamp:
            self.table.believe(stamp, self.port.delayed)
        return stamp, values

    def rejected(self, data: bytes) -> None:
        """Use a rejected message for its tick, which the block then answers by `Block.refused`."""
        table, now = self.table, self.table.clock()
        if self.node.is_plant:
            return
        stamp = 0 if self.by_arrival else readable_stamp(data) or 0
        # With a stamp that is far off it is unknown to which tick the message belongs.
        if not stamp or abs(stamp - now) <= table.window:
            table.excuse(self, stamp or table.grid_time(now), now)

    def accept(self, stamp: int, value: Any, data: bytes) -> None:
        """Store a message by its stamp; ignore one that arrives after a newer one, or twice."""
        if not (self.port.stamped or self.in_order(stamp)):
            return
        now = self.table.clock()
        # A delayed message is stamped when it was measured, and some have no stamp: they count for the present tick.
        due = stamp if stamp and not self.by_arrival else self.table.grid_time(now)
        self._begin(due)
        if self._number is not None:
            # Such a value is used by the next tick, whatever its stamp is, so it is recorded there (due 0).
            used_at_once = self.port.held and not self.paired
            self.table.unrecorded.append((0 if used_at_once else due, self._number, data))
        self._keep(stamp, due, self.value(stamp, value), now)

    def receiver(self, pick: Pick | None, unchecked: bool) -> Callable[[int, Row | None, int], None]:
        """Return the function for rows of a node of this process, checked by the publisher or not: stamp, row, now."""
        delayed = self.port.delayed

        def receive(stamp: int, row: Row | None, now: int) -> None:
            if row is None:
                self.acknowledge(stamp, False)
                return
            if self.outside and self._refuses():
                return
            sampled, values = row if isinstance(row, Sample) else (stamp - self.node.epoch, row)
            values = picked(pick, values)
            if not self.node.epoch:
                self._begin(stamp)
            due = self.table.grid_time(now) if self.by_arrival else stamp
            # A fault may publish invalid values on purpose, so its reader rejects them; all other outputs were checked
            # when published.
            if unchecked and (reason := self.port.beyond(values)):
                self.node.account.refuse(self, reason)
                if not self.node.is_plant:
                    self.table.excuse(self, due, now)
                return
            self._keep(stamp, due, Sample(sampled, values) if delayed else values, now)

        return receive

    def fed(self, now: int) -> None:
        """Handle a value that a node of the same process has put into the input."""
        self.arrived = now
        if self.table.stale:
            self._recovered()

    def acknowledge(self, stamp: int, published: bool) -> None:
        """Ignore the sender's report whether it published at a tick; this kind of row does not wait for it."""

    def _begin(self, stamp: int) -> None:
        """Set t = 0 of a controller that was started alone to the tick of its first message."""
        node = self.node
        if not node.epoch and not node.is_plant:
            node.epoch = node.schedule.held(stamp)

    def _keep(self, stamp: int, due: int, value: Any, now: int) -> None:
        newest = self.stamp
        if newest is None or due > newest:
            if self.schedule is None and newest is not None:
                self._interval = due - newest
            self.stamp = due
        # An older stamp is accepted only for the tick whose message was rejected: this may be the corrected one. A
        # message without a stamp, or one that counts by its arrival, is never late.
        elif stamp > 0 and not self.by_arrival and due != self.bad:
            self.late += 1
            return
        self.arrived = now
        self.fresh = True
        self.expected = self._optional
        self.recent.append((due, value))
        if due <= self.answered and self.paired:
            self.overdue += 1
        if self.table.stale:
            self._recovered()
        self.table.on_value(self, stamp, due, value, now)

    def excuse(self, stamp: int, now: int) -> None:
        """Store the stamp of a rejected message, so that its tick does not wait for another."""
        self.stamp = stamp if self.stamp is None else max(stamp, self.stamp)
        self.arrived = now
        self.fresh = True
        self.bad = stamp

    # what a tick needs ---------------------------------------------------------------------------------------------

    def lacks(self, stamp: int) -> bool:
        """Return whether something that the tick of a stamp waits for is not there."""
        return not (self.complete(stamp) and (self.ready(stamp) or not self.awaited))

    def complete(self, stamp: int) -> bool:
        """Return whether the inputs due at the tick of a stamp are there."""
        epoch, period = self.node.epoch, self.node.schedule.time(1)
        if not self.awaited and not self.expected:
            return True
        if self.stamp is None:
            return False
        if self.by_arrival:
            # A publisher slower than our ticks has no message for some of them.
            return self.fresh or self._interval > period
        if self.schedule is not None:
            complete = self.stamp >= epoch + self.schedule.held(stamp - epoch)
            if complete and self.ready(stamp):
                self.holds = epoch + self.schedule.next(stamp - epoch)
            return complete
        # Without a rig the interval is learned from two stamps; until then the publisher is not waited for.
        return self._interval == 0 or stamp - self.stamp < self._interval - 2 - period // 1000

    def ready(self, stamp: int) -> bool:
        """Return whether there is a value for the tick of a stamp."""
        return bool(self.recent) and (self.by_arrival or self.recent[0][0] <= stamp)

    def value_at(self, stamp: int) -> Any:
        """Return the value at the tick of a stamp: the newest one not after it; None if there is none."""
        self.fresh = False
        self.answered = stamp
        recent = self.recent
        if self.by_arrival:
            # Such a message belongs to the tick at which it arrives, so the newest one counts even if it arrived after
            # the time of this tick.
            stamp = max(stamp, self.stamp or 0)
        while len(recent) > 1 and recent[1][0] <= stamp:
            recent.popleft()
        if not recent or recent[0][0] > stamp:
            return None
        self._used = recent[0][0]
        return recent[0][1]

    def held_stamp(self) -> int | None:
        """Return the stamp of the value that the block gets, ns from its t = 0."""
        stamp = self._used if self._used is not None else self.stamp
        return None if stamp is None else stamp - self.node.epoch

    # silence, and too many -----------------------------------------------------------------------------------------

    def silent(self, now: int) -> bool:
        """Return whether the sender has been silent for too long; reports it once."""
        node, table = self.node, self.table
        # Nearly always this ends it, before the limit is computed.
        if self.arrived is None or now - self.arrived <= table.least:
            return False
        limit = self._silence()
        if now - self.arrived <= limit:
            return False
        if self.name not in table.stale:
            table.stale.add(self.name)
            kind, remaining = ("command", "safe input") if node.is_plant else ("message", "the last one is held")
            text = f"no {kind} on {self.port.topic} for {limit / SECOND:g} s: {remaining}"
            node.step.note(Level.ERROR, f"stale {self.port.topic}", text)
        return True

    def _silence(self) -> int:
        """Return the longest time without a message that is accepted, ns."""
        node, table = self.node, self.table
        learned = self.schedule is not None or not node.is_plant
        slower = min(Block.STALE_PERIODS, node.block.STALE_PERIODS) * self._interval
        return table.watchdog or max(table.least, slower if learned else 0)

    def _recovered(self) -> None:
        if self.name in self.table.stale:
            self.table.stale.discard(self.name)
            subject = "commands are" if self.node.is_plant else "messages are"
            self.node.step.note(Level.WARN, f"recovered {self.port.topic}", f"{subject} back")

    def on_matched(self) -> None:
        """Reject both of two publishers on one input until one of them has left or has been silent for long."""
        self._rivals.change()
        if not self.port.held and self._refuses():
            # The newest value may come from either publisher, and neither is accepted.
            self.node.values[self.name] = self.port.safe
            self.arrived = None

    def _refuses(self) -> bool:
        if not self.disputed:
            return False
        middleware = self.node.middleware
        names = ", ".join(sorted({p.name for p in middleware.publishers(middleware.resolve(self.port.topic))}))
        self.node.account.refuse(self, f"{self.publishers} publishers at the same time ({names}), expected one")
        return True
