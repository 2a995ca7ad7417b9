"""Ports that the nodes of the fault location rig share."""

from __future__ import annotations

from softrig_core import Port, array, vector3

from .records.record import COLUMNS, GROUPS, TOPICS

LOCATION = ("x_km", "f_min", "f_max", "mode", "n_eval", "scatter_km")
VERDICT = ("status", "mode", "f_max")
OBJECTIVE = ("x_km", "mode_1", "mode_2", "mode_3")


def streams() -> tuple[Port, ...]:
    """Return the four sample streams of the ends: u_s, i_s, u_r, i_r."""
    return tuple(vector3(name, TOPICS[name], "abc", "V" if name[0] == "u" else "A") for name in GROUPS)


def record_port(samples: int) -> Port:
    """Return the record form: one row a sample, columns t and the twelve channels; sent once."""
    units = ("s", *("V" if c[0] == "u" else "A" for c in COLUMNS[1:])) * samples
    return array("record", "line/record", {"sample": samples, "channel": len(COLUMNS)}, units, sporadic=True)


def location_port() -> Port:
    """Return the place of the fault, sent when there is one."""
    units = ("km", "V", "V", "", "", "km")
    return array("location", "location", {", ".join(LOCATION): len(LOCATION)}, units, sporadic=True)
