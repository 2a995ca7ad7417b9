"""An input in real time: its newest messages by stamp, and whether that of a tick is there."""

from __future__ import annotations

from collections import deque
from typing import Any

from ..model.schedule import Schedule
from .endpoint import Input

KEPT = 64  # messages of a faster sender that may come before our tick is complete


class Feed:
    """What has come on one input.

    Parameters
    ----------
    item : Input
    schedule : Schedule, optional
        Of the sender, when the rig says who it is; otherwise its interval is learned from its stamps.
    awaited : bool
        Whether a tick waits for it: required, and the sender is never silent.

    Attributes
    ----------
    stamp : int or None
        Of the newest message, ns since the Unix epoch.
    arrived : int or None
        Wall-clock time at which it came.
    fresh : bool
        Whether something has come since the last answer.
    recent : deque of (stamp, value)
        The newest messages; those that no tick needs any more fall out when it is full.
    holds : int
        For ticks stamped before it what is due is there.
    """

    def __init__(self, item: Input, schedule: Schedule | None, awaited: bool) -> None:
        self.item = item
        self.schedule = schedule
        self.awaited = awaited
        self.by_arrival = item.port.delayed or not item.port.stamped
        self.stamp: int | None = None
        self.used: int | None = None  # stamp of the value that the last tick used
        self.arrived: int | None = None
        self.fresh = False
        self.bad: int | None = None  # stamp of a refused message
        self.interval = 0 if schedule is None else schedule.time(1)
        self.recent: deque[tuple[int, Any]] = deque(maxlen=KEPT)
        self.holds = 0

    def put(self, stamp: int, value: Any, now: int, stamped: bool = True) -> bool:
        """Take a good message; not one that comes after a newer one, or twice: the newest stamp counts."""
        newest = self.stamp
        if newest is None:
            self.stamp = stamp
        elif stamp > newest:
            if self.schedule is None:
                self.interval = stamp - newest
            self.stamp = stamp
        elif stamped and not self.by_arrival and stamp != self.bad:
            self.item.late += 1
            return False
        self.arrived = now
        self.fresh = True
        self.recent.append((stamp, value))
        return True

    def refuse(self, stamp: int, now: int) -> None:
        """Note a refused message: its tick need not wait for another."""
        self.stamp = stamp if self.stamp is None else max(stamp, self.stamp)
        self.arrived = now
        self.fresh = True
        self.bad = stamp

    def complete(self, t: int, epoch: int, period: int) -> bool:
        """Whether what is due at time `t` of the block is there."""
        if not self.awaited:
            return True
        if self.stamp is None:
            return False
        if self.by_arrival:
            return self.fresh or self.interval > period
        if self.schedule is not None:
            there = self.stamp >= epoch + self.schedule.held(t)
            if there and self.ready(epoch + t):
                self.holds = epoch + self.schedule.next(t)
            return there
        # by hand: a sender whose interval is not known yet is not waited for
        return self.interval == 0 or epoch + t - self.stamp < self.interval - 2 - period // 1000

    def ready(self, stamp: int) -> bool:
        """Whether there is a value for a tick stamped `stamp`."""
        return bool(self.recent) and (self.by_arrival or self.recent[0][0] <= stamp)

    def take(self, stamp: int) -> Any:
        """Give the value of a tick stamped `stamp`: the newest one not after it; None when there is none."""
        self.fresh = False
        recent = self.recent
        if self.by_arrival:
            stamp = max(stamp, self.stamp or 0)
        while len(recent) > 1 and recent[1][0] <= stamp:
            recent.popleft()
        if not recent or recent[0][0] > stamp:
            return None
        self.used = recent[0][0]
        return recent[0][1]

    def limit(self, periods: int) -> int:
        """Age in ns at which a silent sender is stale by its own interval."""
        return periods * self.interval
