"""How much of a topic was published before the recorder joined it: stamps of simulated time tell, or numbers."""

from __future__ import annotations

from softrig_core import SECOND
from softrig_core.wire.cdr import parse
from softrig_core.wire.stream import CdrError
from softrig_core.wire.types import ARRAY

from .stamps import is_stamped, stamp
from .topics import BagTopic

INTERVALS = 8  # that must agree before a topic is taken for one that speaks at each tick
SIMULATED = 10**8 * SECOND  # stamps of wall clocks are larger


class Join:
    """Looks at the first messages of a topic.

    Stamps of simulated time begin at 0: whoever speaks with one period and has a first stamp beyond that began earlier.
    A topic without a steady period, or on the wall clock, tells nothing, and neither does one with two messages.

    Attributes
    ----------
    open : bool
        Whether further messages are to be looked at.
    """

    def __init__(self, topic: BagTopic) -> None:
        self._numbered = topic.msgtype == ARRAY.name
        self._stamps: list[int] = []
        self._number = 0
        self.open = self._numbered or is_stamped(topic)

    def look(self, data: bytes) -> None:
        """Look at one more message."""
        if self._numbered:
            self.open = False
            try:
                self._number = parse(ARRAY.name, data).number or 0
            except CdrError:
                return  # of somebody's, in another byte order, say
            return
        self._stamps.append(stamp(data))
        first, last = self._stamps[0], self._stamps[-1]
        self.open = 0 < first < SIMULATED and len(self._stamps) <= INTERVALS and last >= first

    @property
    def missed(self) -> int:
        """Number of messages before the first that came; 0 where nothing tells."""
        if self._numbered:
            return self._number
        intervals = [b - a for a, b in zip(self._stamps, self._stamps[1:], strict=False)]
        if len(intervals) < 2 or not 0 < self._stamps[0] < SIMULATED:
            return 0
        mean = sum(intervals) / len(intervals)
        if mean <= 0 or any(abs(i - mean) > 1 for i in intervals):  # ticks are rounded to 1 ns
            return 0
        return round(self._stamps[0] / mean)
