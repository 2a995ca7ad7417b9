"""The clock of a real-time rig that a user can pause: all nodes stop at the same time and resume from there.

The stop time is announced in advance. From then on the clocks of the nodes lag behind the wall clock by the length of
the pause. Ticks, stamps and timeouts use this clock, so a pause makes nothing late or stale. The state of the clock is
published with the start of the run (`node.adapter.departure`), as words: ``ahead=NS`` (relative to the wall clock),
``from=NS`` and ``until=NS``, the interval in which it is stopped. Hardware cannot be paused, so a rig with a node that
is not ours has no such clock.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from softrig_core.timebase import SECOND

from ..adapter.adapter import Adapter

LEAD = SECOND // 20  # ns from the message that the clock stands or goes on to when it does: what a message may take
NEVER = 2**63 - 1


class Stand:
    """Pauses and resumes the clock of a node.

    Parameters
    ----------
    goes_by : callable
        Gets the clock that the node uses from now on: a function that returns ns.
    """

    def __init__(self, node: Adapter, goes_by: Callable[[Callable[[], int]], object]) -> None:
        self._node, self._goes_by = node, goes_by
        self._own = self._clock = node.middleware.now
        self._ahead, self._until = 0, NEVER
        self._publish: Callable[[Sequence[str]], object]

    @property
    def stopping(self) -> bool:
        """Return whether the clock stands, or will at a known time."""
        return self._until != NEVER

    def follow(self, ns: int) -> None:
        """Follow the clock of the rig, which is ahead of this host's by `ns`."""
        host = self._own
        self._own = lambda: host() + ns
        self._go_by(self._own)

    def _go_by(self, clock: Callable[[], int]) -> None:
        self._clock = clock
        self._goes_by(clock)

    def serve(self, publish: Callable[[Sequence[str]], object]) -> None:
        """Pause the rig when the node of its clock gets a request (`seam.hold`); `publish` sends it to the others."""
        self._publish = publish
        node = self._node
        node.hold.begin(node.middleware, self._turn)
        if node.hold.held:
            self._turn()

    def receive(self, words: Iterable[str]) -> None:
        """Pause or resume as the received message demands."""
        messages = {key: int(value) for key, _, value in (word.partition("=") for word in words) if value}
        if not messages.keys() >= {"ahead", "from", "until"}:
            return
        clock, ahead, first, until = self._own, messages["ahead"], messages["from"], messages["until"]
        self._ahead, self._until = ahead, until
        # `first` keeps the clock from going back when `ahead` becomes smaller.
        self._go_by(lambda: min(max(clock() + ahead, first), until))

    def _turn(self) -> None:
        """Pause or resume the rig as its `Hold` requires."""
        node, now, ahead = self._node, self._clock(), self._ahead
        hold, epoch, schedule = node.hold, node.epoch, node.schedule
        # The clock stands and is to continue: from where it stands, not from the wall clock's time.
        if now >= self._until and (hold.steps or not hold.held):
            ahead = now - self._own() - LEAD
        # The clock stops at a tick that is far enough ahead for the message to reach all nodes; before the start it
        # stops at t = 0.
        soon = schedule.next(now + LEAD - epoch) if now + LEAD > epoch else 0
        # A stop time that was announced earlier stays valid: other nodes may have stopped there already.
        until = min(self._until, epoch + soon) if hold.held else NEVER
        if hold.steps:
            until = epoch + schedule.time(schedule.tick(until - epoch) + hold.steps)
        hold.steps = 0
        words = [f"ahead={ahead}", f"from={now}", f"until={until}"]
        self.receive(words)
        self._publish(words)
