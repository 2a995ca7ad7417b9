"""Port numbers of DDS: the well-known ones of discovery, and others that were not used recently.

By default Fast DDS uses the lowest free numbers, so a node that is started after a killed one gets its ports in shared
memory. Until the lease of the dead node ends, the others still write to it. Each message creates its port again and
removes it, from several processes at the same time, together with the mutex that should keep them apart (Fast DDS
2.14, `~Port`, `open_port_internal`). In one of ten cases this also removes the port of the new node: it receives
nothing and no error is reported.

So each of our participants listens at numbers that repeat only after `AROUND` and for which no file is left. A writer
to the dead node keeps its port open for up to 40 s, until it finds that the port has no reader. Messages for a new
node with the same port name would go to that old port. Moreover, an abandoned port is judged by the time of its last
reader. The numbers can be chosen freely, since participants announce them to each other. Only the well-known ports of
RTPS 9.6.1 are fixed.

Two participants that start together must not use the same port either. A participant that gets no processor for 2 s
while it creates the port loses its mutex to the other one. It then finds the port locked and removes it by its name
(`Failed init_port`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Collection
from contextlib import suppress
from itertools import count
from pathlib import Path

BASE, GAIN = 7400, 250  # first of the well-known ports, and number of ports for each domain
WELL_KNOWN = {"offsetd0": 0, "offsetd1": 10, "offsetd2": 1}
STANDARD = 11  # offset of the user ports
HIGHEST = 65_535  # the last domain of all has no room for others
# Numbers within a domain's ports that no other participant has, even with two further ones for each of 32
# participants.
USER = range(76, 188)
# Fast DDS searches this many numbers below the base for the port of the topic on which ROS announces its nodes.
UNIQUE = 400
FLOWS = range(BASE - 3 * UNIQUE, BASE - UNIQUE)  # ports for the whole host; other participants take those above
AROUND = 18.0  # s; a lease is rarely longer, so the others have forgotten a dead node when its numbers return
# Processes that start within an eighth of `AROUND` begin their search at different numbers. When two
# took the same one within 45 ms, the slower one removed the port of the other (see above).
AT_ONCE = 50


def of_domain(domain: int) -> range:
    """Return the numbers of a domain."""
    return range(BASE + GAIN * domain, BASE + GAIN * (domain + 1))


def chosen(domain: int, used: Collection[int] = (), now: float | None = None) -> dict[str, int]:
    """Return the port parameters of a participant that begins now, as a Fast DDS profile names them.

    Parameters
    ----------
    used : collection of int
        Numbers for which files exist; they are chosen only if all numbers are used.
    now : float, optional
        s, of a clock that all processes of a host share.
    """
    turn = (time.monotonic() if now is None else now) / AROUND % 1
    flow = _free(FLOWS[:UNIQUE], int(turn * UNIQUE / AT_ONCE) * AT_ONCE + os.getpid() % AT_ONCE, used)
    base, user = flow + UNIQUE, STANDARD
    ports = of_domain(domain)
    if ports[-1] <= HIGHEST:
        numbers, beside = ports[USER[0] : USER[-1] + 1], 2 * _participants(domain)
        user = _free(numbers, int(turn * len(USER)), {n - beside for n in used}) - ports[0]
    offsets = WELL_KNOWN | {"offsetd3": user}
    return {"portBase": base} | {name: BASE - base + offset for name, offset in offsets.items()}


def _free(numbers: range, start: int, used: Collection[int]) -> int:
    """Return the first number that is not in use, counting up from `start` and wrapping around; else that one."""
    start %= len(numbers)
    return next((n for n in (*numbers[start:], *numbers[:start]) if n not in used), numbers[start])


def _participants(domain: int) -> int:
    """Return the number of participants of a domain on this host."""
    bound, first = udp_ports(), of_domain(domain)[WELL_KNOWN["offsetd1"]]
    return next(k for k in count() if first + 2 * k not in bound)


def udp_ports() -> set[int]:
    """Return the UDP ports of this host that are bound; empty if that cannot be read."""
    result = set()
    for table in (Path("/proc/net/udp"), Path("/proc/net/udp6")):
        with suppress(OSError):  # not Linux, or no IPv6
            result |= {int(line.split()[1].rpartition(":")[2], 16) for line in table.read_text().splitlines()[1:]}
    return result
