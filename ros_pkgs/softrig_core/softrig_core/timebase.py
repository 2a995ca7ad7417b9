"""Integer time: nanoseconds, and periods that divide them exactly; how far a run may go by the clock on the wall."""

SECOND = 1_000_000_000  # ns


def to_ns(seconds: float) -> int:
    """Round a time in s to whole nanoseconds."""
    return round(seconds * SECOND)


def to_s(ns: int) -> float:
    """Return a time in ns as s."""
    return ns / SECOND


BEHIND = 0.25  # s by which a run may be late and still catch up; what is beyond is forgotten


class Pace:
    """Limit of a run's time at a pace, by the wall clock; a user may pause it or change the pace at any moment.

    In each case the part of a tick that has already been waited for is kept, so that the run never gets ahead by it.

    Parameters
    ----------
    pace : float
        Ratio of simulated to wall-clock time; 0: as fast as possible.
    """

    def __init__(self, pace: float) -> None:
        self.pace = pace
        self._mark: tuple[float, int] | None = None  # s of the wall, ns of the run, which the pace counts from
        self._stopped: float | None = None

    def change(self, pace: float, now: float) -> None:
        """Change the pace from `now` (s of the wall clock) on."""
        if self._mark is not None:
            since, first = self._mark
            now = now if self._stopped is None else self._stopped
            self._mark = (now - (now - since) * self.pace / pace, first) if pace else None
        self.pace = pace

    def stop(self, now: float) -> None:
        """Stop the time."""
        self._stopped = now if self._stopped is None else self._stopped

    def go_on(self, now: float) -> None:
        """Let the time run on."""
        if self._mark is not None and self._stopped is not None:
            self._mark = self._mark[0] + now - self._stopped, self._mark[1]
        self._stopped = None

    def begin(self) -> None:
        """Restart the count from the next position of the run."""
        self._mark = None

    def reach(self, now: float, t: int) -> int | None:
        """Return the time in ns up to which a run at `t` may continue; None if it has to wait."""
        rate = self.pace * SECOND
        since, first = self._mark = self._mark or (now, t)
        reached = first + round((now - since) * rate)
        if t >= reached:
            return None
        if reached - t > BEHIND * rate:
            self._mark, reached = (now, t), t
        return reached
