"""Decide when a controller in real time runs: when all due messages have arrived, or some time after the first."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from softrig_core.block.block import Level

from .live import KEPT, Live, LiveSenders


class Answering:
    """The ticks of a controller that have begun.

    Parameters
    ----------
    answer : callable
        Called with the time of the tick that must run now, ns from t = 0.
    """

    def __init__(self, table: LiveSenders, answer: Callable[[int], object]) -> None:
        self._node = node = table.node
        self._table, self._answer = table, answer
        self.missed = 0
        self.incomplete = 0
        self.dropped = 0
        self._pending: deque[int] = deque()  # stamps of ticks that have begun, oldest first
        self._following = -1  # stamp of the tick after the newest one that has begun
        self._refusals: list[Live] = []  # inputs that refused a message of a tick that is not answered yet
        self._complete = 0  # number of awaited inputs that have arrived for the oldest pending tick
        self._last_stamp: int | None = None
        self._unarmed = False  # whether the oldest pending tick has no limit yet
        self._period = node.schedule.time(1)
        self._patience = round(node.options.patience * self._period)
        self._required = [f for f in table.rows if f.awaited]
        self.awaited = [*self._required, *(f for f in table.rows if f.expected)]
        self._used = [f for f in table.rows if f.awaited or f.paired or not f.port.held]
        # The period here is never used: `again` sets the time limit of each tick.
        self._deadline = node.middleware.timer(1_000_000_000, self._give_up)
        self._deadline.cancel()

    def process(self, row: Live, stamp: int, due: int, value: object, now: int) -> None:
        """Process a valid message of the tick that `due` belongs to."""
        if row.awaited:
            if due >= self._following:
                self._begin(due)
        # A held input from outside the rig is used from its arrival on; one of the rig is picked by its stamp when a
        # tick is answered.
        elif not row.paired and row.port.held:
            self._node.values[row.name] = value

    def excuse(self, row: Live, due: int, now: int) -> None:
        """Process a rejected message of the tick that `due` belongs to."""
        # Before t = 0 is set there is no tick that could be answered.
        if not self._node.epoch:
            return
        row.excuse(due, now)
        if row not in self._refusals and (row.awaited or not row.port.held):
            self._refusals.append(row)
        if row.awaited and due >= self._following:
            self._begin(due)

    def _begin(self, due: int) -> None:
        """Begin the tick that `due` belongs to."""
        node = self._node
        stamp = self._table.grid_time(due)
        # Messages from before t = 0 belong to no tick.
        if stamp >= node.epoch:
            self._following = node.epoch + node.schedule.next(stamp - node.epoch)
            # Most ticks are complete at once, so the timer of the limit is set only when the oldest tick lacks
            # something.
            self._unarmed = self._unarmed or not self._pending
            self._pending.append(stamp)

    def act(self) -> None:
        """Run the complete ticks, and set the time limit for the others."""
        if self._pending:
            self._answer_complete()

    def _answer_complete(self) -> None:
        """Run pending ticks, oldest first, as long as all their due messages have arrived."""
        node, awaited, pending = self._node, self.awaited, self._pending
        if len(pending) > 1:
            self._drop()
        while pending and node.state == "running":
            stamp = pending[0]
            # What has arrived for this tick stays there, so the look goes on at the input that lacked something last
            # time.
            for k in range(self._complete, len(awaited)):
                row = awaited[k]
                # Nearly always this decides it, without a call.
                if (row.stamp == stamp and not row.by_arrival) or stamp < row.holds:
                    continue
                if row.lacks(stamp):
                    self._complete = k
                    if self._unarmed:
                        self._unarmed = False
                        self._deadline.again(self._patience)
                    return
            self._complete = 0
            self._answer_tick(pending.popleft())
            # The limit that runs was that of the tick before.
            if pending and not self._unarmed:
                self._deadline.cancel()
                self._unarmed = True
        if self._unarmed:
            self._unarmed = False
        else:
            self._deadline.cancel()

    def _drop(self) -> None:
        """Drop ticks that are older than the window or than the stored messages: the controller is far behind."""
        # A tick whose messages have dropped out of a full row can no longer be answered with the right ones.
        oldest_kept = [f.recent[0][0] for f in self._required if len(f.recent) == KEPT and not f.by_arrival]
        oldest, before = max([self._table.clock() - self._table.window, *oldest_kept]), self.dropped
        while len(self._pending) > 1 and self._pending[0] < oldest:
            self._pending.popleft()
            self._complete = 0
            self.dropped += 1
        if self.dropped > before:
            text = f"{self.dropped} ticks dropped: the controller is too slow, or was stopped"
            self._node.step.note(Level.ERROR, "dropped", text)

    def _give_up(self) -> None:
        """Answer the oldest tick with the present inputs, because it has waited long enough."""
        node = self._node
        self._deadline.cancel()
        if not self._pending or node.state != "running":
            return
        stamp = self._pending.popleft()
        self._complete = 0
        # Without a value for a required input the tick lies before that input's first message and cannot be answered.
        if all(f.ready(stamp) for f in self._required):
            self.incomplete += 1
            lacking = [f for f in self.awaited if not f.complete(stamp)]
            for row in lacking:
                # A held input that did not arrive in time is not waited for again until it has arrived, or each tick
                # would be late.
                row.expected = False
            topics = ", ".join(f.port.topic for f in lacking)
            node.step.note(Level.WARN, "incomplete", f"answered without what was due on {topics}")
            self._answer_tick(stamp)
        elif not self._pending:
            # The messages that are still missing may begin this tick again.
            self._following = stamp
        self._answer_complete()
        if self._pending:
            self._deadline.again(self._patience)

    def count_missed(self, end: int) -> None:
        """Count the ticks up to the end of the run for which no message has arrived."""
        if self._last_stamp is not None and end > self._last_stamp:
            node, schedule = self._node, self._node.schedule
            newest = schedule.held(end - node.epoch)  # the end itself need not be a tick of a slow node
            self.missed += schedule.tick(newest) - schedule.tick(self._last_stamp - node.epoch)
            self._last_stamp = end

    def _between(self, stamp: int) -> int:
        """Return the number of ticks between the newest that was answered and another one."""
        node, last = self._node, self._last_stamp
        # Stamps are rounded to ns, so neighbouring ticks may be 1 ns further apart than the period.
        if last is None or stamp - last <= self._period + 1:
            return 0
        return node.schedule.tick(stamp - node.epoch) - node.schedule.tick(last - node.epoch) - 1

    def _answer_tick(self, stamp: int) -> None:
        """Answer the tick of a stamp with the newest values up to it."""
        node, now = self._node, self._table.clock()
        missed = self._between(stamp)
        self.missed += missed
        self._last_stamp = stamp
        for row in self._used:
            if (value := row.value_at(stamp)) is not None:
                node.values[row.name] = value
            if row.awaited:
                row.silent(now)
        if self._refusals:
            for row in self._refusals:
                if row.bad is not None and row.bad <= stamp:
                    node.step.bad, row.bad = True, None
            self._refusals = [row for row in self._refusals if row.bad is not None]
        node.step.unanswered = missed
        self._answer(stamp - node.epoch)
