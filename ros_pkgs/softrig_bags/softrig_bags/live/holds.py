"""Detection of times in which a tool's process was suspended: publishers may then have dropped it."""

from __future__ import annotations

import time
from collections.abc import Callable
from xml.etree import ElementTree

from softrig_nodes.processes.executables import given_profile

# The defaults of Fast DDS in s, where the profile sets neither.
LEASE, ANNOUNCEMENT = 20.0, 3.0


class Holds:
    """Detects from the gaps between its own wake-ups that the process was suspended for a while.

    A publisher that receives nothing from a reader for the lease duration drops it. Messages that it sends until it has
    discovered the reader again do not reach the reader. The middleware does not report this loss, and no counter shows
    it.

    Parameters
    ----------
    limit : float
        Longest gap in s after which no publisher drops the reader.
    clock : callable
        Returns s, from a clock that continues while the machine sleeps.

    Attributes
    ----------
    gaps : list of (float, int)
        Length of each longer gap in s, and the number of messages before it.
    """

    def __init__(self, limit: float, clock: Callable[[], float] | None = None) -> None:
        self.limit = limit
        self.gaps: list[tuple[float, int]] = []
        self._clock = clock or (lambda: time.clock_gettime(time.CLOCK_BOOTTIME))
        self._last = self._clock()

    def wake(self, messages: Callable[[], int]) -> bool:
        """Note that the process runs; if it was stopped before, ask how many messages it has, and return True."""
        now = self._clock()
        gap, self._last = now - self._last, now
        if gap > self.limit:
            self.gaps.append((gap, messages()))
        return gap > self.limit

    def __str__(self) -> str:
        return ", ".join(f"{gap:.1f} s after message {count}" for gap, count in self.gaps)


def patience() -> float:
    """Return the longest silence in s after which no publisher forgets this process: its lease less an announcement.

    Raises
    ------
    OSError, xml.etree.ElementTree.ParseError
        The profile cannot be read; Fast DDS would not have started with it.
    """
    root = ElementTree.parse(given_profile()).getroot()
    return _seconds(root, "leaseDuration", LEASE) - _seconds(root, "leaseAnnouncement", ANNOUNCEMENT)


def _seconds(root: ElementTree.Element, tag: str, default: float) -> float:
    for element in root.iter():
        if element.tag.rpartition("}")[2] == tag:
            texts = {e.tag.rpartition("}")[2]: (e.text or "0").strip() for e in element}
            if "INFINIT" in f"{texts.get('sec')}{texts.get('nanosec')}{element.text}":
                return float("inf")
            return float(texts.get("sec", 0)) + float(texts.get("nanosec", 0)) * 1e-9
    return default
