"""Topics of the network and its queue controller; a user's own controller only needs these."""

from __future__ import annotations

from softrig_core import Port, command, scalars

STATE = scalars("state", "network/state", {"window": "packet", "queue": "packet", "rtt": "s"})
TRUTH = scalars(
    "truth",
    "network/truth",
    {
        "window": "packet",
        "queue": "packet",
        "rtt": "s",
        "window_delayed": "packet",
        "rtt_delayed": "s",
        "served": "packet",
    },
)
COMMAND = command("command", "aqm/command", ("drop_probability",), "1")
HEALTH = scalars("health", "aqm/health", {"s": "packet/s", "integral": "packet s", "saturated": ""})
REFERENCE = command("reference", "aqm/reference", ("queue",), "packet", held=True)
EVENT_UNITS = {"flows": "1", "capacity": "packet/s", "propagation": "s", "disturbance": "packet/s"}


def events(now: tuple[float, float, float, float]) -> Port:
    """Return the port of the network's changes: any of the channels; `now` has the values until the first one."""
    units = list(EVENT_UNITS.values())
    return command("events", "network/events", tuple(EVENT_UNITS), units, held=True, partial=True, safe=now)
