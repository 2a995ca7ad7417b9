"""What a node in real time hears: good messages by their stamps, bad ones refused, silence reported."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

from ..model.block import Block, Level
from ..model.port import Refused, Sample
from ..model.timebase import SECOND, to_ns
from ..rig.options import RunOptions
from ..wire.cdr import Layout, Pick
from ..wire.codec import readable_stamp
from ..wire.recording import Sink
from .adapter import Adapter
from .endpoint import Input
from .feed import Feed
from .middleware import Direct, Message, Middleware, Receive, Row, Send, SendRow, one_by_one


class Hearing(Adapter):
    """An adapter that keeps what comes by stamp; see `Adapter` for the parameters."""

    def __init__(self, middleware: Middleware, block: Block, options: RunOptions, sink: Sink | None = None) -> None:
        self.feeds: dict[str, Feed] = {}
        self._numbers_of: dict[Send, tuple[Feed, Pick | None]] = {}  # by the function that takes them
        self._contested = False  # whether an input has two writers
        self.stale: set[str] = set()
        # the newest: they are sorted for each status file, between two ticks
        self._round_trip: deque[int] = deque(maxlen=5_000)
        self._sent_at: dict[int, int] = {}
        self._pending: deque[int] = deque()  # stamps of ticks that have begun, oldest first
        self._following = -1  # stamp of the tick after the newest one that has begun
        self._refusals: list[Feed] = []  # whose tick has not been answered
        self._complete = 0  # so many of the awaited inputs are there for the oldest pending tick
        self._window = to_ns(options.stamp_window)
        middleware.join(self._take_together)
        super().__init__(middleware, block, options, sink)
        self.epoch = options.epoch
        self._awaited = [f for f in self.feeds.values() if f.awaited]
        self._stale_after = (to_ns(options.watchdog) if self.is_plant else 0) or self.schedule.time(block.STALE_PERIODS)
        self._by_messages = not self.is_plant and bool(self._awaited)

    # what a subclass says -------------------------------------------------------------------------------------

    def _begin(self, due: int, feed: Feed) -> None:
        """React to a message of the tick that `due` belongs to."""
        raise NotImplementedError

    def _open(self, due: int) -> None:
        """Begin the tick that `due` belongs to."""
        raise NotImplementedError

    def _answer_complete(self) -> None:
        """Answer pending ticks."""
        raise NotImplementedError

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
        window, clock, apart = self._window, self.middleware.now, one_by_one(parts)

        def receive_row(row: Row) -> None:
            stamp, messages = row
            now = clock()
            usual = -window <= stamp - now <= window and self.epoch and not self.stale and not self._contested
            if not usual or self.state != "running" or not self._by_messages:
                apart(row)
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
        if feed.item.port.stamped and not feed.by_arrival:
            stamp = readable_stamp(data) or 0
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

    # silence ---------------------------------------------------------------------------------------------------

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
