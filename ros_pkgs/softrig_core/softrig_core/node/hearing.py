"""What a node in real time hears: good messages by their stamps, bad ones refused, silence reported."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ..model.answer import Row
from ..model.block import Block, Level
from ..model.codec import readable_stamp
from ..model.port import Refused, Sample
from ..timebase import SECOND, to_ns
from ..wire.cdr import Pick
from .adapter import Adapter
from .endpoint import Input
from .feed import Feed
from .middleware import Receive


class Hearing:
    """The feeds of a node.

    Parameters
    ----------
    node : Adapter
    clock : callable
        Gives the wall-clock time, ns.
    take : callable
        Gets (feed, stamp, time of the tick that it belongs to, value, now) of each good message.
    refused : callable
        Gets (feed, time of its tick, now) of each bad one whose tick is known.

    Attributes
    ----------
    feeds : dict of str to Feed
        By input.
    stale : set of str
        Inputs whose senders have been silent for too long.
    """

    def __init__(
        self, node: Adapter, clock: Callable[[], int], take: Callable[[Feed, int, int, Any, int], object],
        refused: Callable[[Feed, int, int], object],
    ) -> None:  # fmt: skip
        self._node, self._clock, self._take, self._spoilt = node, clock, take, refused
        self.feeds: dict[str, Feed] = {}
        self.stale: set[str] = set()
        self._window = to_ns(node.options.stamp_window)
        watchdog = to_ns(node.options.watchdog) if node.is_plant else 0
        self.least = watchdog or node.schedule.time(node.block.STALE_PERIODS)  # ns after which a sender may be stale
        self._watchdog = watchdog

    # messages --------------------------------------------------------------------------------------------------

    def receiver(self, item: Input) -> Receive:
        """Give what keeps the good values of an input by stamp."""
        node = self._node
        link = node.links.inputs.get(item.name)
        silent = item.port.sporadic or (link is not None and link.sporadic) or item.name in node.links.free
        feed = Feed(item, node.peer(link) if link else None, not item.port.held and not silent)
        self.feeds[item.name] = feed
        node.step.stamps[item.name] = lambda: self._stamp(feed)
        record = node.foreign.get(item.name)
        delayed, stamped, partial = item.port.delayed, item.port.stamped, item.port.partial

        def receive(data: bytes) -> None:
            if self._rivals(item) or node.state != "running":
                return
            now = self._clock()
            try:
                stamp, values = item.decode(data)
                if stamped and stamp:
                    self._check_window(stamp, now, delayed)
            except Refused as error:
                node.refuse(item, str(error))
                if not node.is_plant:
                    self._refused(feed, data, now)
                return
            if not (stamped or node.in_order(item, stamp)):
                return
            # A delayed message tells when it was measured, one without a stamp nothing: the answer is due now.
            due = stamp if stamped and stamp and not delayed else self.grid_time(now)
            if not node.is_plant:
                node.epoch = node.epoch or node.schedule.held(due)
            if partial:
                item.decode.kept = values
            if record is not None and node.sink is not None:
                node.sink.add(record, now, data)
            self._keep(feed, stamp, due, Sample(stamp - node.epoch, values) if delayed else values, now)

        return receive

    def teller(self, item: Input, pick: Pick | None) -> Callable[[int, Row], None]:
        """Give what takes the values of an input from a node of this process: their stamp (ns), and the row.

        They have been checked by who said them.
        """
        node, feed = self._node, self.feeds[item.name]
        delayed, stamped = item.port.delayed, item.port.stamped

        def tell(stamp: int, row: Row) -> None:
            if self._rivals(item) or node.state != "running":
                return
            now = self._clock()
            sampled, values = row if isinstance(row, Sample) else (stamp - node.epoch, row)
            values = values if pick is None else pick(values)
            if not node.is_plant:
                node.epoch = node.epoch or node.schedule.held(stamp)
            due = stamp if stamped and not delayed else self.grid_time(now)
            self._keep(feed, stamp, due, Sample(sampled, values) if delayed else values, now)

        return tell

    def _keep(self, feed: Feed, stamp: int, due: int, value: Any, now: int) -> None:
        if feed.put(due, value, now, stamp > 0):
            if self.stale:
                self._recovered(feed)
            self._take(feed, stamp, due, value, now)

    def _stamp(self, feed: Feed) -> int | None:
        """Stamp of what the block gets of an input, ns from its t = 0."""
        stamp = feed.used if feed.used is not None else feed.stamp
        return None if stamp is None else stamp - self._node.epoch

    def grid_time(self, now: int) -> int:
        """Give the newest tick of ours at a time, both in ns of the wall clock."""
        epoch = self._node.epoch
        return epoch + self._node.schedule.held(now - epoch)

    def _check_window(self, stamp: int, now: int, delayed: bool) -> None:
        if stamp - now > self._window or (now - stamp > self._window and not delayed):
            off = (stamp - now) / SECOND
            raise Refused(f"stamp is {off:+.3g} s from now, expected at most {self._window / SECOND:g} s")

    def _refused(self, feed: Feed, data: bytes, now: int) -> None:
        """A refused message counts as that of its tick, which the block then answers by `Block.refused`."""
        stamp = 0
        if feed.item.port.stamped and not feed.by_arrival:
            stamp = readable_stamp(data) or 0
        if not stamp or abs(stamp - now) <= self._window:  # else nobody knows of which tick it is
            self._spoilt(feed, stamp or self.grid_time(now), now)

    # writers ---------------------------------------------------------------------------------------------------

    def on_matched(self, item: Input) -> None:
        """Two publishers on one input: neither is believed until one of them has gone."""
        if not item.port.held and self._rivals(item):
            self._node.values[item.name] = item.port.safe
            self.feeds[item.name].arrived = None

    def _rivals(self, item: Input) -> bool:
        if item.publishers <= 1:
            return False
        middleware = self._node.middleware
        who = ", ".join(sorted({p.name for p in middleware.publishers(middleware.resolve(item.port.topic))}))
        self._node.refuse(item, f"{item.publishers} publishers at once ({who}), expected one")
        return True

    def silent(self, feed: Feed, now: int) -> bool:
        """Whether a sender has been silent for too long; reports it once."""
        node, item = self._node, feed.item
        if feed.arrived is None or now - feed.arrived <= self.least:
            return False
        limit = self._watchdog or max(
            self.least, feed.limit(Block.STALE_PERIODS) if feed.schedule is not None or not node.is_plant else 0
        )
        if now - feed.arrived <= limit:
            return False
        if item.name not in self.stale:
            self.stale.add(item.name)
            kind, rest = ("command", "safe input") if node.is_plant else ("message", "the last one is held")
            text = f"no {kind} on {item.port.topic} for {limit / SECOND:g} s: {rest}"
            node.block.report(Level.ERROR, f"stale {item.port.topic}", text)
        return True

    def _recovered(self, feed: Feed) -> None:
        if feed.item.name in self.stale:
            self.stale.discard(feed.item.name)
            what = "commands are" if self._node.is_plant else "messages are"
            self._node.block.report(Level.WARN, f"recovered {feed.item.port.topic}", f"{what} back")
