"""Integer time: nanoseconds, and periods that divide them exactly."""

SECOND = 1_000_000_000  # ns


def to_ns(seconds: float) -> int:
    """Round a time in s to whole nanoseconds."""
    return round(seconds * SECOND)


def to_s(ns: int) -> float:
    """Give a time in ns as s."""
    return ns / SECOND
