"""What one sender has said on one topic, and the tick of it that a node waits for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

from ..model.schedule import Schedule
from .endpoint import Input

Counted = tuple[int, "tuple[float, ...] | None", bytes]  # stamp or number, values (None: refused), message

KEEP = object()  # a sporadic sender was silent at a tick
BAD = object()  # what was said at a tick was refused
_FOREVER = 1 << 62
AHEAD = 100_000  # messages that a sender may be ahead


class Pairing:
    """The messages of one sender on one topic, by their ticks.

    A tick needs the newest one up to `want`. What comes before its time is kept: with several plants, and from outside
    nodes, a sender may be ahead of us by some ticks.

    Parameters
    ----------
    topic : str
    schedule : Schedule
        Of the sender.
    sender : str
        Node name, for error messages.
    item : Input
        The port it feeds, or a stand-in that counts refusals of a /clock or acknowledgement.
    carries : bool
        Whether it feeds a port; a clock and an acknowledgement carry nothing but the stamp.
    earlier : bool
        Whether the awaited stamp is that of the last tick before ours: what a block has said about the end of the run.
    port : str
        Name of the sender's port if that is sporadic: silence is told by its acknowledgement.

    Attributes
    ----------
    want : int
        Awaited stamp, ns.
    have : bool
        Whether the sender has spoken up to there.
    same : bool
        Whether the sender has our period, so that it is due whenever we are, up to `until`.
    used : int
        The last awaited stamp up to which the sender had spoken.
    stamp : int or None
        Of the value that is held.
    reached : int
        The tick up to which its silences and acknowledgements tell.
    received : int
        Number of messages so far, of those that are paired by order; a plant does not count what it refuses.
    excused : int
        Stamp of the newest refused message that is answered: a better one that follows is too late.
    """

    def __init__(self, topic: str, schedule: Schedule, sender: str, item: Input, carries: bool = True,
                 earlier: bool = False, port: str = "") -> None:  # fmt: skip
        self.topic = topic
        self.schedule = schedule
        self.sender = sender
        self.item = item
        self.carries = carries
        self.earlier = earlier
        self.port = port
        self.used = self.reached = schedule.before(0)
        self.want = self.used if earlier else 0
        self.same = False
        self.until = _FOREVER if schedule.last is None else schedule.last
        self.have = earlier
        self.holds = 0  # until this time the awaited message serves
        self.stamp: int | None = None
        self.received = 0
        self.excused = -1
        self.said: dict[int, Any] = {}  # what was said at ticks that are not used yet
        self.queue: deque[Counted] = deque()  # of messages paired by order: what has come, and
        self.announced: deque[int] = deque()  # the ticks at which it was sent, as a sporadic sender tells them
        self.serve: Callable[[], None] = lambda: None  # brings the two together

    def may_come(self, position: int) -> bool:
        """Whether a message of this tick of the sender is new and possible."""
        last = self.schedule.last
        return (
            self.used < position and position not in self.said and self.schedule.due(position)
            and (last is None or position <= last) and len(self.said) < AHEAD
        )  # fmt: skip

    def put(self, position: int, found: Any) -> None:
        """Keep what was said at a tick, `KEEP` when it was nothing."""
        if not self.port:
            if position < self.want:
                self.said.clear()  # of a faster sender only the newest may serve, when the run ends before its time
            self.said[position] = found
            return
        # News of silence and messages overtake each other: only what is told without a gap counts.
        self.said[position] = found
        while (following := self.schedule.next(self.reached)) in self.said:
            self.reached = following
            if self.said[following] is KEEP:
                del self.said[following]
            elif following <= self.want:
                self.said = {p: said for p, said in self.said.items() if p >= following}

    def complete(self) -> bool:
        """Whether the sender has spoken up to the awaited tick."""
        return self.want <= self.used or self.want <= self.reached or (not self.port and self.want in self.said)

    def take(self) -> Any:
        """Give the newest of what was said up to the awaited tick, `KEEP` when that is nothing new; forget the rest."""
        self.have = True
        self.used = max(self.used, self.want)
        found = KEEP
        for position in sorted(p for p in self.said if p <= self.want):
            said = self.said.pop(position)
            if said is not KEEP:
                found = said
                self.stamp = position if said is not BAD else self.stamp
        return found
