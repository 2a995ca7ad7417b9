"""Topics of the rectifier."""

from __future__ import annotations

from softrig_core import Port, array, command, scalars, vector3

from .quality import FIGURES

DC_LINK = scalars("dc_link", "dc_link", {"voltage": "V", "current": "A"})
GRID_CURRENT = vector3("grid_current", "grid/current", "abc", "A")
GRID_VOLTAGE = vector3("grid_voltage", "grid/voltage", "abc", "V")
POWER_QUALITY = scalars("power_quality", "power_quality", FIGURES)
V_DROP = command("command", "v_drop/command", ("v_drop",), "V")
I_REF = command("command", "v_drop/command", ("i_ref",), "A")


def events(load: float, amplitude: float) -> Port:
    """Events, any of the three in a message; the others keep their value, at first the nominal one."""
    units = {"load_resistance": "ohm", "grid_amplitude": "V", "h5_amplitude": "V"}
    return scalars("events", "events", units, held=True, partial=True, safe=(load, amplitude, 0.0))


WAVEFORM_CHANNELS = ("i_a", "i_b", "i_c", "v_ga", "v_dc")


def waveform(samples: int) -> Port:
    """Currents of the grid, voltage of its phase a and DC voltage over the period that ends at t."""
    units = ("A", "A", "A", "V", "V") * samples
    return array("waveform", "waveform", {"sample": samples, "channel": len(WAVEFORM_CHANNELS)}, units)
