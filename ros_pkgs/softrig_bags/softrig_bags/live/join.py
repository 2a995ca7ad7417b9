"""Number of messages that were published before the recorder joined a topic, from simulated-time stamps or numbers."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction

from softrig_core import SECOND
from softrig_core.wire.cdr import parse
from softrig_core.wire.stream import CdrError
from softrig_core.wire.types import ARRAY

from ..content.stamps import is_stamped, stamp
from ..content.topics import BagTopic

# So many intervals must agree before a topic counts as one with a message at each tick.
INTERVALS = 8
# Stamps of wall clocks are larger: 10^8 s after 1970 is 1973, and no simulation lasts three years.
SIMULATED = 10**8 * SECOND


class Join:
    """Examines the first messages of a topic to find how many were missed.

    Stamps of simulated time begin at 0. If a topic has a constant period and its first stamp is a multiple of that
    period, either messages were missed or the topic itself begins late. A certificate that reports from some tick on is
    such a late topic. `missed` distinguishes the two cases. Missed messages cannot be detected on a topic without a
    constant period, on the wall clock, or with only two messages. The same holds for a topic with a message at every
    fourth tick from the third on (the acknowledgements of a follower).

    Attributes
    ----------
    open : bool
        Whether further messages are to be examined.
    """

    def __init__(self, topic: BagTopic) -> None:
        self._numbered = topic.msgtype == ARRAY.name
        self._stamps: list[int] = []
        self._number = 0
        self.open = self._numbered or is_stamped(topic)

    def inspect(self, data: bytes) -> None:
        """Look at one more message."""
        if self._numbered:
            self.open = False
            try:
                self._number = parse(ARRAY.name, data).number or 0
            except CdrError:
                # Another writer may use another byte order; such messages have no number that could be read.
                return
            return
        self._stamps.append(stamp(data))
        first, last = self._stamps[0], self._stamps[-1]
        self.open = 0 < first < SIMULATED and len(self._stamps) <= INTERVALS and last >= first

    @property
    def from_start(self) -> bool:
        """Return whether the first message has the first stamp of simulated time."""
        return self._stamps[:1] == [0]

    @property
    def number(self) -> int:
        """Number that the first message of a numbered topic has; 0 for other topics."""
        return self._number

    @property
    def periods(self) -> int:
        """Number of periods from t = 0 to the first stamp; 0 if it cannot be determined."""
        intervals = [b - a for a, b in zip(self._stamps, self._stamps[1:], strict=False)]
        if len(intervals) < 2 or not 0 < self._stamps[0] < SIMULATED:
            return 0
        mean = Fraction(sum(intervals), len(intervals))
        # Ticks are rounded to 1 ns, so equal intervals may differ by that.
        if mean <= 0 or any(abs(i - mean) > 1 for i in intervals):
            return 0
        count = round(self._stamps[0] / mean)
        # The error of the mean interval grows with the number of intervals before the first stamp.
        remaining = abs(self._stamps[0] - count * mean)
        # A first stamp that is no multiple of the interval comes from a topic that begins late by itself.
        return count if remaining <= 1 + Fraction(count, len(intervals)) else 0


def missed(joins: Iterable[tuple[str, Join]]) -> dict[str, int]:
    """Return the number of messages missed at the start, for each topic that missed any.

    A rig waits for its recorder on every topic before it sends anything. So if one topic was recorded from t = 0 on, no
    topic was joined late, and a topic that begins later does so by itself.

    Parameters
    ----------
    joins : iterable of (str, Join)
        Topics of one recording; a name occurs once for each of its types.
    """
    known = list(joins)
    waited = any(join.from_start for _, join in known)
    results: dict[str, int] = {}
    for name, join in known:
        results[name] = results.get(name, 0) + join.number + (0 if waited else join.periods)
    return {name: n for name, n in results.items() if n}
