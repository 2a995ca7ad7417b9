"""Whether a loop swings for good: turning points of the measured signal that do not come nearer to each other."""

from __future__ import annotations

from collections import deque

SWINGS = 8  # in a row, from one turning point to the next
KEPT = 0.9  # share of the first half of them that the second half has at least, when they do not decay
ALIKE = 0.5  # of the largest of them, each
LONGEST = 3  # times the longest time between turning points without another one ends the swing
BAND = 0.02  # of the reference, smaller swings do not count


class LimitCycle:
    """Watches the measured signal of a loop.

    A loop that settles, near its reference or not, has swings that fall; one in a limit cycle has not, nor has one that
    diverges. Each new reference begins anew.
    """

    def __init__(self) -> None:
        self._reference = 0.0
        self._clear(0.0)

    def _clear(self, y: float) -> None:
        self._swings: deque[float] = deque(maxlen=SWINGS)
        self._spans: deque[int] = deque(maxlen=SWINGS)  # samples from one turning point to the next
        self._since = 0
        self._turn, self._far, self._up = y, y, True

    def sample(self, y: float, reference: float) -> float:
        """Take one sample in; give the mean swing (peak to peak), 0 while there is none that lasts.

        Parameters
        ----------
        y, reference : float
            In the unit of the signal.
        """
        if reference != self._reference:
            self._reference = reference
            self._clear(y)
        self._since += 1
        if (y > self._far) == self._up and y != self._far:
            self._far = y
        elif abs(y - self._far) > BAND * abs(reference):
            self._swings.append(abs(self._far - self._turn))
            self._spans.append(self._since)
            self._since = 0
            self._turn, self._far, self._up = self._far, y, not self._up
        if self._spans and self._since > LONGEST * max(self._spans):  # it has come to rest
            self._clear(y)
        if len(self._swings) < SWINGS or min(self._swings) < ALIKE * max(self._swings):
            return 0.0
        swings = list(self._swings)
        before, after = sum(swings[: SWINGS // 2]), sum(swings[SWINGS // 2 :])
        return after / (SWINGS // 2) if after >= KEPT * before else 0.0
