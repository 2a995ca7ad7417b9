"""Ports that several nodes of the GUPFC rig share; vectors in per unit, frame alpha_beta."""

from __future__ import annotations

from softrig_core import Port, command, scalars, vector3


def measured(name: str) -> Port:
    """Return the port of a measured space vector: x = alpha, y = beta, pu, as defined in `measurement`."""
    return vector3(name, name, "alpha_beta", "pu")


def converter_command(name: str, topic: str, first: str, unit: str, **options: object) -> Port:
    """Return the port of a converter command.

    Parameters
    ----------
    first : {"sigma", "magnitude"}
        What sets the amplitude: conduction angle (rad) or voltage (pu).
    unit : str
        Of `first`.
    **options
        Of the port.

    Returns
    -------
    Port
        Channels `first`, angle (rad, of the voltage at the tick) and omega (rad/s, with which the angle turns on).
        The safe value is no command at all (omega = 0), which blocks the converter.
    """
    return command(name, topic, (first, "angle", "omega"), [unit, "rad", "rad/s"], **options)


TRACE = ("v_sh", "v12", "u1", "i_sh")
"""Waveforms of the trace; each has a column for alpha and one for beta."""

SHUNT = converter_command("shunt", "shunt/command", "sigma", "rad")
SERIES = {k: converter_command(f"series_{k}", f"series_{k}/command", "magnitude", "pu") for k in (1, 2)}
SERIES_REFERENCE = {k: scalars("reference", f"series_{k}/reference", {"p": "pu", "q": "pu"}, held=True) for k in (1, 2)}
SHUNT_REFERENCE = scalars("reference", "shunt/reference", {"v": "pu"}, held=True)
DC_LINK = scalars("dc_link", "dc_link", {"voltage": "V"})
STATUS = scalars(
    "status",
    "gupfc/status",
    dict.fromkeys(("p1", "q1", "p2", "q2", "v1", "v_dc", "p_sh", "p12", "p34", "v12", "v34"), "pu"),
)
