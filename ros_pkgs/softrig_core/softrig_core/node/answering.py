"""When a law in real time answers: once all that is due at a tick has come, or some time after the first of it.

Where the law fails, its safe values are said.
"""

from __future__ import annotations

from ..errors import RunError, describe
from ..model.block import Block, Level
from ..model.timebase import SECOND
from ..rig.options import RunOptions
from ..wire.recording import Sink
from .feed import Feed
from .hearing import Hearing
from .middleware import Middleware


class Answering(Hearing):
    """An adapter that answers ticks by what it has heard; see `Adapter` for the parameters."""

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        super().__init__(middleware, block, options, sink)
        self.missed = 0
        self.incomplete = 0
        self._last_stamp: int | None = None
        self._unarmed = False  # whether the oldest pending tick has no limit yet
        self._period = self.schedule.time(1)
        self._patience = round(options.patience * self._period)
        self._stamped = [(n, f, f.recent) for n, f in self.feeds.items() if f.awaited and not f.by_arrival]
        used = {n: f for n, f in self.feeds.items() if f.awaited or not f.item.port.held}
        self._others = [(n, f) for n, f in used.items() if not f.awaited or f.by_arrival]
        if self._by_messages:
            self._deadline = middleware.timer(SECOND, self._give_up)
            self._deadline.cancel()

    def _begin(self, due: int, feed: Feed) -> None:
        """A message of the tick that `due` belongs to has come: answer what is complete, set the limit for the rest."""
        if due >= self._following:
            self._open(due)
        elif self._pending and feed is self._awaited[self._complete]:  # else the oldest tick waits for another one
            self._answer_complete()

    def _open(self, due: int) -> None:
        """Begin the tick that `due` belongs to, and answer what is complete."""
        stamp = self._grid_time(due)
        if stamp >= self.epoch:
            self._following = self.epoch + self.schedule.next(stamp - self.epoch)
            self._unarmed = self._unarmed or not self._pending
            self._pending.append(stamp)
        self._answer_complete()

    def _answer_complete(self) -> None:
        """Answer pending ticks, oldest first, as long as all that is due has come."""
        awaited, pending = self._awaited, self._pending
        while pending and self.state == "running":
            stamp = pending[0]
            for k in range(self._complete, len(awaited)):
                feed = awaited[k]
                if (feed.stamp == stamp and not feed.by_arrival) or stamp < feed.holds:
                    continue  # nearly always
                if not (feed.complete(stamp - self.epoch, self.epoch, self._period) and feed.ready(stamp)):
                    self._complete = k
                    if self._unarmed:
                        self._unarmed = False
                        self._deadline.again(self._patience)
                    return
            self._complete = 0
            self._answer(pending.popleft())
        if self._unarmed:
            self._unarmed = False
        else:
            self._deadline.cancel()

    def _give_up(self) -> None:
        """The oldest tick has waited long enough: answer with what is there."""
        self._deadline.cancel()
        if not self._pending or self.state != "running":
            return
        stamp = self._pending.popleft()
        self._complete = 0
        if all(f.ready(stamp) for f in self._awaited):  # else it lies before the first message
            self.incomplete += 1
            lacking = [
                f.item.port.topic for f in self._awaited if not f.complete(stamp - self.epoch, self.epoch, self._period)
            ]  # fmt: skip
            text = f"answered without what was due on {', '.join(lacking)}"
            self.block.report(Level.WARN, "incomplete", text)
            self._answer(stamp)
        elif not self._pending:
            self._following = stamp  # it may begin again
        self._answer_complete()
        if self._pending:
            self._deadline.again(self._patience)

    def _answer(self, stamp: int) -> None:
        if self._last_stamp is not None and stamp - self._last_stamp > self._period + 1:
            self.missed += (
                self.schedule.tick(stamp - self.epoch) - self.schedule.tick(self._last_stamp - self.epoch) - 1
            )
        self._last_stamp = stamp
        t = stamp - self.epoch
        now = self.middleware.now()
        stale, values = now - self._stale_after, self.values
        for name, feed, recent in self._stamped:
            if recent and recent[-1][0] == stamp:  # nearly always
                values[name] = recent[-1][1]
                feed.used = stamp
            elif (value := feed.take(stamp)) is not None:
                values[name] = value
            if feed.arrived is not None and feed.arrived < stale:
                self._notice_silence(feed, now)
        for name, feed in self._others:
            if (value := feed.take(stamp)) is not None:
                values[name] = value
            if feed.awaited and feed.arrived is not None and feed.arrived < stale:
                self._notice_silence(feed, now)
        if self._refusals:
            self._take_refusals(stamp)
        self.t = t
        self._say(t)
        self._advance_to(t)

    def _take_refusals(self, stamp: int) -> None:
        """Have the tick see what was refused up to it."""
        for feed in self._refusals:
            if feed.bad is not None and feed.bad <= stamp:
                self.bad, feed.bad = True, None
        self._refusals = [feed for feed in self._refusals if feed.bad is not None]

    def _say(self, t: int) -> None:
        """Publish the answer of tick `t`; the safe values when the law overflows or gives what nobody may send."""
        stamp = self.epoch + t
        try:
            self.publish(t, stamp, self.answer(t))
        except (ArithmeticError, ValueError, RunError) as error:
            self.block.report(Level.ERROR, "failed", f"{describe(error)}; safe output")
            self._said = {}
            self.publish(t, stamp, self.held(t))

    def _advance_to(self, t: int) -> None:
        self.t = t
        self.ticks += 1
        if self.buttons.pressed:
            self.buttons.release()
        if self.schedule.end is not None and t >= self.schedule.end:
            self.finish()
