"""Port numbers of DDS: those at which a participant is found, and others that nobody has had lately.

Left to itself Fast DDS takes the lowest numbers that are free, so that a node which follows a killed one gets its ports
in shared memory. But until the lease of the dead one is over the others write to it: each message makes its port anew
and removes it, from several processes at once, with the mutex that was to keep them apart (Fast DDS 2.14, `~Port`,
`open_port_internal`). In one of ten cases the port of the new node goes with them: it hears nobody and no error is
told. So every participant of ours listens at numbers that come round again only after `AROUND`, and of which nobody has
left a file: who wrote to the dead one holds his port for up to 40 s, until he finds that nobody reads it, and what he
has for a new one of that name goes there. And a port that was left behind is judged by the time of its last reader.
They are free to choose: participants tell each other of them, only the well-known ones of RTPS 9.6.1 have to be where
they are expected.
Nor may two that begin together want the same port: who has no processor for 2 s while he makes it loses its mutex to
the other one, and then takes the port away by its name when he finds it locked (`Failed init_port`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection
from contextlib import suppress
from itertools import count
from pathlib import Path

BASE, GAIN = 7400, 250  # of the well-known ports: a domain has that many numbers
WELL_KNOWN = {"offsetd0": 0, "offsetd1": 10, "offsetd2": 1}
STANDARD = 11  # of the user ports
HIGHEST = 65_535  # the last domain of all has no room for others
USER = range(76, 188)  # of a domain's numbers, those that no other has, even two further for each of 32 participants
UNIQUE = 400  # Fast DDS looks for a port of its own for what ROS says of its nodes in so many below the base
FLOWS = range(BASE - 3 * UNIQUE, BASE - UNIQUE)  # of the whole host; other participants take those above
AROUND = 18.0  # s; a lease is seldom longer
AT_ONCE = 50  # processes that begin within an eighth of that, each with a number of its own to begin the search at


def of_domain(domain: int) -> range:
    """Return the numbers of a domain."""
    return range(BASE + GAIN * domain, BASE + GAIN * (domain + 1))


def chosen(domain: int, taken: Collection[int] = (), now: float | None = None) -> dict[str, int]:
    """Return the port parameters of a participant that begins now, as a Fast DDS profile names them.

    Parameters
    ----------
    taken : collection of int
        Numbers of which there are files; they are chosen only where there is no other.
    now : float, optional
        s, of a clock that all processes of a host share.
    """
    turn = (time.monotonic() if now is None else now) / AROUND % 1
    flow = _free(FLOWS[:UNIQUE], int(turn * UNIQUE / AT_ONCE) * AT_ONCE + os.getpid() % AT_ONCE, taken)
    base, user = flow + UNIQUE, STANDARD
    whole = of_domain(domain)
    if whole[-1] <= HIGHEST:
        numbers, beside = whole[USER[0] : USER[-1] + 1], 2 * _participants(domain)
        user = _free(numbers, int(turn * len(USER)), {n - beside for n in taken}) - whole[0]
    offsets = WELL_KNOWN | {"offsetd3": user}
    return {"portBase": base} | {name: BASE - base + offset for name, offset in offsets.items()}


def _free(numbers: range, at: int, taken: Collection[int]) -> int:
    """Return the first number from the one `at` a place on, round and round, that is not taken; else that one."""
    at %= len(numbers)
    return next((n for n in (*numbers[at:], *numbers[:at]) if n not in taken), numbers[at])


def _participants(domain: int) -> int:
    """Return how many there are; the next one listens twice as many ports further on than the first."""
    bound, first = udp_ports(), of_domain(domain)[WELL_KNOWN["offsetd1"]]
    return next(k for k in count() if first + 2 * k not in bound)


def udp_ports() -> set[int]:
    """Return the UDP ports of this host that somebody has bound; none where that cannot be seen."""
    result = set()
    for table in (Path("/proc/net/udp"), Path("/proc/net/udp6")):
        with suppress(OSError):  # not Linux, or no IPv6
            result |= {int(line.split()[1].rpartition(":")[2], 16) for line in table.read_text().splitlines()[1:]}
    return result
