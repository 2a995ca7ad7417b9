"""Realtime: a node against the wall clock, for people, hardware and other people's nodes.

Stamps are ROS time: t_k = k * period counted from the Unix epoch, so all nodes of a host tick on one grid. A plant
moves by its timer and holds the newest command. A source has a timer. A block with required inputs answers a tick when
all of them that are due at its stamp are there, or, a stated part of its period after the first, with what it has.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from ..errors import RunError, describe
from ..model.block import Block, Level, Plant
from ..model.port import Port, Refused, Sample
from ..model.timebase import SECOND, to_ns
from ..rig.options import RunOptions
from ..wire.cdr import Layout, Pick
from ..wire.recording import Sink
from .adapter import Adapter
from .departure import Departure
from .endpoint import Input
from .feed import Feed
from .health import percentiles
from .middleware import Direct, Message, Middleware, Receive, Row, Send, SendRow
from .start import Handshake
from .tick import END, TICK, TickReader

CATCH_UP = SECOND  # a longer pause than this (a suspended host) is skipped, not simulated
END_GRACE = SECOND  # a node that waits for a sender ends this much after the end of the run all the same


class Realtime(Adapter):
    """A block driven by the wall clock; see `Adapter` for the parameters."""

    open_ended = True
    status_every = 4  # a file takes longer than a tick

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.feeds: dict[str, Feed] = {}
        self._numbers_of: dict[Send, tuple[Feed, Pick | None]] = {}  # by the function that takes them
        self._contested = False  # whether an input has two writers
        self.stale: set[str] = set()
        self.tick_number: int | None = None
        self.missed = 0
        self.incomplete = 0
        self.skipped = 0
        # the newest: they are sorted for each status file, between two ticks
        self._lateness: deque[int] = deque(maxlen=5_000)
        self._round_trip: deque[int] = deque(maxlen=5_000)
        self._sent_at: dict[int, int] = {}
        self._pending: deque[int] = deque()  # stamps of ticks that have begun, oldest first
        self._last_stamp: int | None = None
        self._following = -1  # stamp of the tick after the newest one that has begun
        self._unarmed = False  # whether the oldest pending tick has no limit yet
        self._refusals: list[Feed] = []  # whose tick has not been answered
        self._complete = 0  # so many of the awaited inputs are there for the oldest pending tick
        self._window = to_ns(options.stamp_window)
        self._started = middleware.now()
        block.realtime = True
        middleware.join(self._take_together)
        super().__init__(middleware, block, options, sink)
        if not block.ENDS:
            self._publish_tick = None  # nobody waits for ticks in real time, they only tell the end
        self.epoch = options.epoch
        self._period = self.schedule.time(1)
        self._patience = round(options.patience * self._period)
        self._awaited = [f for f in self.feeds.values() if f.awaited]
        self._stamped = [(n, f, f.recent) for n, f in self.feeds.items() if f.awaited and not f.by_arrival]
        used = {n: f for n, f in self.feeds.items() if f.awaited or not f.item.port.held}
        self._others = [(n, f) for n, f in used.items() if not f.awaited or f.by_arrival]
        self._stale_after = (to_ns(options.watchdog) if self.is_plant else 0) or self.schedule.time(block.STALE_PERIODS)
        self._by_messages = not self.is_plant and bool(self._awaited)
        if self._by_messages:
            self._deadline = middleware.timer(SECOND, self._give_up)
            self._deadline.cancel()
        else:
            self._timer = middleware.timer(SECOND // 1000, self._tick)
            self._timer.cancel()
        for node in self.links.enders:
            if node != middleware.name:
                self._follow_end(node)
        self._departure = self._wait_for_others() if self.links.starter and not self.epoch else None
        if self._departure is None:
            self._begin_at(self.epoch)

    def _wait_for_others(self) -> Departure:
        readers, inputs = self.links.readers, self.links.inputs
        wanted = [(o, list(readers.get(o.name, []))) for o in self.outputs]
        if self.block.ENDS:
            wanted.append((self.tick_output, self.links.tick_readers))
        handshake = Handshake(self, [(i, inputs[i.name].node) for i in self.inputs if i.name in inputs], wanted)
        return Departure(self, handshake, self._begin_at)

    def _begin_at(self, epoch: int) -> None:
        """Run from now on; t = 0 is at `epoch`, or with the first tick when that is 0."""
        self.epoch = epoch
        self.state = "running"
        if not self._by_messages:
            self._timer.again(SECOND // 1000)

    # messages --------------------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> tuple[Receive, Direct | None]:
        """Keep the newest good values by stamp; what is due makes a block answer."""
        link = self.links.inputs.get(item.name)
        silent = item.port.sporadic or (link is not None and link.sporadic) or item.name in self.links.free
        feed = Feed(item, self.peer(link) if link else None, not item.port.held and not silent)
        self.feeds[item.name] = feed
        self.values[item.name] = item.port.initial
        record = self.foreign.get(item.name)
        delayed, stamped, partial = item.port.delayed, item.port.stamped, item.port.partial

        def receive(data: bytes) -> None:
            if self._rivals(item):
                return
            if self.state != "running":
                return
            now = self.middleware.now()
            stamp = 0
            try:
                stamp, values = item.decode(data)
                if stamped and stamp:
                    self._check_window(stamp, now, delayed)
            except Refused as error:
                self.refuse(item, str(error))
                if not self.is_plant:
                    self._refused(feed, data, now)
                return
            if not (stamped or self.in_order(item, stamp)):
                return
            # A delayed message tells when it was measured, one without a stamp nothing: the answer is due now.
            due = stamp if stamped and stamp and not delayed else self._grid_time(now)
            if not self.is_plant:
                self.epoch = self.epoch or self.schedule.held(due)
            if partial:
                item.decode.kept = values
            if record is not None and self.sink is not None:
                self.sink.add(record, now, data)
            self._take(feed, stamp, due, Sample(stamp - self.epoch, values) if delayed else values, now)

        def direct(layout: Layout, greatest: float) -> Send | None:
            if greatest > item.decode.bound or delayed or not stamped or partial or record is not None:
                return None
            try:
                pick = item.decode.pick(layout)
            except Refused:  # each message will be, with its reason
                return None
            window, encode, clock = self._window, layout.encode, self.middleware.now

            def receive_numbers(message: Message) -> None:
                stamp, sent = message
                if self.state != "running":
                    return
                values = sent if pick is None else pick(sent)
                now = clock()
                if not -window <= stamp - now <= window or item.publishers > 1 or not self.epoch:
                    receive(encode(stamp, sent))
                elif self._by_messages and feed.awaited and not self.stale:  # as `_take`
                    feed.put(stamp, values, now)
                    if stamp >= self._following or feed is self._awaited[self._complete]:
                        self._begin(stamp, feed)
                else:
                    self._take(feed, stamp, stamp, values, now)

            if feed.awaited and feed.schedule is not None:
                self._numbers_of[receive_numbers] = feed, pick
            return receive_numbers

        return receive, direct

    def _take_together(self, parts: Sequence[tuple[int, Send]]) -> SendRow:
        """Take what another node says together: what a tick waits for is looked at once; see `Join`."""
        found = [(k, *self._numbers_of[call]) for k, call in parts if call in self._numbers_of]
        known = [(k, feed, feed.recent.append, pick) for k, feed, pick in found]
        rest = [(k, call) for k, call in parts if call not in self._numbers_of]
        feeds = {feed for _, feed, _ in found}
        window, clock = self._window, self.middleware.now

        def receive_row(row: Row) -> None:
            stamp, messages = row
            now = clock()
            usual = -window <= stamp - now <= window and self.epoch and not self.stale and not self._contested
            if not usual or self.state != "running" or not self._by_messages:
                for k, call in parts:
                    call((stamp, messages[k]))
                return
            for k, feed, keep, pick in known:  # as `Feed.put`
                keep((stamp, messages[k] if pick is None else pick(messages[k])))
                feed.arrived = now
                if stamp > (feed.stamp or 0):
                    feed.stamp = stamp
            for k, call in rest:
                call((stamp, messages[k]))
            if stamp >= self._following:
                self._open(stamp)
            elif self._pending and self._awaited[self._complete] in feeds:
                self._answer_complete()

        return receive_row

    def _take(self, feed: Feed, stamp: int, due: int, value: Any, now: int) -> None:
        """Keep a good message; `due` is the time of the tick that it belongs to."""
        feed.put(due, value, now)
        if self.stale:
            self._recovered(feed)
        if self._by_messages:
            if feed.awaited:
                self._begin(due, feed)
            elif feed.item.port.held:
                self.values[feed.item.name] = value
            return
        self.values[feed.item.name] = value
        if self.is_plant:
            sent = self._sent_at.get(stamp)
            if sent is not None:
                self._round_trip.append(now - sent)

    def _rivals(self, item: Input) -> bool:
        """Whether an input has two publishers, none of which is believed."""
        if item.publishers <= 1:
            return False
        self.refuse(item, f"{item.publishers} publishers at once ({self._who(item)}), expected one")
        return True

    def _check_window(self, stamp: int, now: int, delayed: bool) -> None:
        if stamp - now > self._window or (now - stamp > self._window and not delayed):
            off = (stamp - now) / SECOND
            raise Refused(f"stamp is {off:+.3g} s from now, expected at most {self._window / SECOND:g} s")

    def _refused(self, feed: Feed, data: bytes, now: int) -> None:
        """A refused message counts as that of its tick, which the block then answers by `Block.refused`."""
        stamp = 0
        if feed.item.port.stamped and not feed.by_arrival and len(data) >= 12 and data[1] == 1:
            stamp = int.from_bytes(data[4:8], "little", signed=True) * SECOND + int.from_bytes(data[8:12], "little")
        if stamp and abs(stamp - now) > self._window:
            return  # nobody knows of which tick it is
        if not self._by_messages:
            self.bad = True
            return
        due = stamp or self._grid_time(now)
        if not self.epoch:
            return
        feed.refuse(due, now)
        if feed not in self._refusals and (feed.awaited or not feed.item.port.held):
            self._refusals.append(feed)
        if feed.awaited:
            self._begin(due, feed)

    def _grid_time(self, now: int) -> int:
        return self.epoch + self.schedule.held(now - self.epoch)

    def on_matched(self, item: Input) -> None:
        """Two publishers on one input: neither is believed until one of them has gone."""
        self._contested = any(i.publishers > 1 for i in self.inputs)
        if not item.port.held and self._rivals(item):
            self.values[item.name] = item.port.safe
            self.feeds[item.name].arrived = None

    def _who(self, item: Input) -> str:
        return ", ".join(sorted({p.name for p in self.middleware.publishers(self.middleware.resolve(item.port.topic))}))

    def _follow_end(self, node: str) -> None:
        topic = f"{self.namespace}/{node}/tick"
        item, read = Input(Port("stamp", topic, TICK)), TickReader()
        self.paces.append(item)

        def receive(data: bytes) -> None:
            try:
                _, sent = read(data)
            except Refused as error:
                self.refuse(item, str(error))
                return
            if END in sent:
                self.finish()

        self.middleware.subscribe(topic, TICK, receive, lambda count: None)

    # controllers -----------------------------------------------------------------------------------------------

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

    def _notice_silence(self, feed: Feed, now: int) -> bool:
        """Whether a sender has been silent for too long; reports it once."""
        if feed.arrived is None or now - feed.arrived <= self._stale_after:  # the least that the limit can be
            return False
        name, item = feed.item.name, feed.item
        limit = to_ns(self.options.watchdog) if self.is_plant else 0
        limit = limit or max(
            self.schedule.time(self.block.STALE_PERIODS),
            feed.limit(Block.STALE_PERIODS) if feed.schedule is not None or not self.is_plant else 0,
        )
        if now - feed.arrived <= limit:
            return False
        if name not in self.stale:
            self.stale.add(name)
            kind, rest = ("command", "safe input") if self.is_plant else ("message", "the last one is held")
            text = f"no {kind} on {item.port.topic} for {limit / SECOND:g} s: {rest}"
            self.block.report(Level.ERROR, f"stale {item.port.topic}", text)
        return True

    def _recovered(self, feed: Feed) -> None:
        if feed.item.name in self.stale:
            self.stale.discard(feed.item.name)
            what = "commands are" if self.is_plant else "messages are"
            self.block.report(Level.WARN, f"recovered {feed.item.port.topic}", f"{what} back")

    def now(self) -> int:
        """Wall-clock time."""
        return self.middleware.now()

    def age(self, name: str) -> int | None:
        """Age of an input at the tick under way: from the stamp of what the block got to the tick's."""
        feed = self.feeds[name]
        stamp = feed.used if self._by_messages and feed.used is not None else feed.stamp
        value = self.values[name]
        if isinstance(value, Sample):
            return self.t - value.stamp
        return None if stamp is None else max(0, self.epoch + self.t - stamp)

    def _advance_to(self, t: int) -> None:
        self.t = t
        self.ticks += 1
        if self.buttons.pressed:
            self.buttons.release()
        if (self.schedule.end is not None and t >= self.schedule.end) or self.block.ended:
            self.finish()

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
