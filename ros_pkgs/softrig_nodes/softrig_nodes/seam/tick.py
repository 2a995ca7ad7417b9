"""The acknowledgement of a tick: a std_msgs/Header on ``<node>/tick`` whose frame_id lists what was published.

A follower acknowledges several ticks together, and the clock may be some ticks ahead of it. So no tick waits for it,
and it works in parallel to the others.
"""

from __future__ import annotations

from collections.abc import Iterable

from softrig_core.block.port import Refused
from softrig_core.block.schedule import Schedule
from softrig_core.wire.cdr import Layout, parse
from softrig_core.wire.stream import CdrError

TICK = "std_msgs/msg/Header"
LAG = 4  # ticks of the clock: it is ahead by less than 9, and a reader's queue in DDS holds ten messages


def acknowledged(schedule: Schedule, t: int) -> bool:
    """Return whether a follower acknowledges its tick `t` (ns) and all before it."""
    ends = schedule.end is not None and schedule.next(t) >= schedule.end
    return ends or (schedule.tick(t) + 1) % _together(schedule) == 0


def needed(schedule: Schedule, clock: Schedule, t: int) -> int:
    """Return the tick of a follower that must be answered before the clock leaves tick `t`, both in ns.

    At the end of the run it is the newest one: the clock waits for a node that is still at work then.
    """
    if clock.end is not None and clock.next(t) >= clock.end:
        return schedule.awaited(t)
    k = (clock.tick(t) - LAG) // schedule.every
    # Only every so many ticks are acknowledged, so the tick is rounded down to one that is.
    return schedule.time(k - (k + 1) % _together(schedule))


def _together(schedule: Schedule) -> int:
    """Return how many of its ticks a follower acknowledges together."""
    return max(1, LAG // schedule.every)


class TickWriter:
    """Makes acknowledgements; the few layouts are cached."""

    def __init__(self) -> None:
        self._layouts: dict[tuple[str, ...], Layout] = {}

    def __call__(self, t: int, sent: Iterable[str]) -> bytes:
        """Return the bytes that acknowledge tick `t` and name the sporadic ports that published."""
        key = tuple(sent)
        if key not in self._layouts:
            self._layouts[key] = Layout(TICK, " ".join(key))
        return self._layouts[key].encode(t, ())


class TickReader:
    """Reads acknowledgements of one node."""

    def __init__(self) -> None:
        self._known: dict[bytes, frozenset[str]] = {}

    def __call__(self, data: bytes) -> tuple[int, frozenset[str]]:
        """Return the stamp in ns and the names of what was published.

        Raises
        ------
        Refused
            Malformed bytes.
        """
        # Behind the stamp the bytes repeat from tick to tick, so they are parsed once. Other encodings than CDR in
        # little endian are left to the parser.
        sent = self._known.get(data[12:]) if data[:4] == b"\x00\x01\x00\x00" else None
        if sent is None:
            try:
                message = parse(TICK, data)
            except CdrError as error:
                raise Refused(str(error)) from None
            sent = frozenset(message.frame_id.split())
            # The limit bounds the memory that a publisher of ever new texts can take.
            if data[:4] == b"\x00\x01\x00\x00" and len(self._known) < 64:
                self._known[bytes(data[12:])] = sent
            return message.stamp or 0, sent
        seconds = int.from_bytes(data[4:8], "little", signed=True)
        return seconds * 1_000_000_000 + int.from_bytes(data[8:12], "little"), sent
