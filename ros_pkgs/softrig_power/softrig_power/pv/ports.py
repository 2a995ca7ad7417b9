"""Ports that several nodes of the photovoltaic rig share."""

from __future__ import annotations

from softrig_core import Port, scalars


def array_port(name: str) -> Port:
    """Return the port of the string, ``pv/port``; the current is positive when it generates."""
    return scalars(name, "pv/port", {"voltage": "V", "current": "A", "temperature": "degC"})


def environment(modules: int, *, held: bool = False) -> Port:
    """Return the irradiance and cell temperature of each module, ``pv/environment`` with g1.., t1..."""
    units = {f"g{k}": "W/m^2" for k in range(1, modules + 1)} | {f"t{k}": "degC" for k in range(1, modules + 1)}
    return scalars("environment", "pv/environment", units, held=held)
