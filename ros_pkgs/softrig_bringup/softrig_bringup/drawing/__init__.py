"""Plants as drawings: shapes that follow from what a rig publishes, for whoever puts them on a screen.

No drawing library: `drawing_for` gives a `Drawing`, its `frame` a list of shapes for one row of signal values. The view
patches them into a page, ``softrig animate`` strings them together.
"""

from __future__ import annotations

from importlib import import_module

from softrig_core import Rig, rig_of
from softrig_core.rig.members import Member

from .base import Drawing
from .shapes import PALETTE, Circle, Line, Point, Polygon, Shape, Text, as_dict

__all__ = ["PALETTE", "Circle", "Drawing", "Line", "Point", "Polygon", "Shape", "Text", "as_dict", "drawing_for"]

# by the class of the plant; what inherits from it is drawn as it
_DRAWN = {
    "softrig_drives.dc_axis.plant.DcAxisPlant": "dc_drives.DcAxis",
    "softrig_drives.dc_motor.plant.DcMotorPlant": "dc_drives.DcMotor",
    "softrig_drives.induction_dtc.plant.ImPlant": "induction.InductionMotor",
    "softrig_drives.lsrm.plant.LsrmPlant": "lsrm.ReluctanceMotor",
    "softrig_power.dispatch.fleet.UnitFleet": "network.Fleet",
    "softrig_power.fault_location.plant.LinePlant": "network.FaultedLine",
    "softrig_power.gupfc.plant.GupfcPlant": "network.Gupfc",
    "softrig_power.pv.plant.PvPlant": "pv.PvString",
    "softrig_power.rectifier.plant.RectifierPlant": "rectifier.Rectifier",
    "softrig_systems.optimal_control.plants.OcpPlant": "optimal.OptimalControl",
    "softrig_systems.optimal_control.plants.SpacecraftPlant": "optimal.Spacecraft",
    "softrig_systems.pwa_delay.plants.PendulumPlant": "delay.Pendulum",
    "softrig_systems.pwa_delay.plants.SwitchedDelayPlant": "delay.StatePlane",
    "softrig_systems.pwa_delay.plants.TankPlant": "delay.Tank",
    "softrig_systems.tcp_aqm.network.Network": "queue.Bottleneck",
}


def drawing_for(rig: Rig | str) -> Drawing | None:
    """Give the drawing of a rig's plant.

    Parameters
    ----------
    rig : Rig or str
        Or name or file of a scenario.

    Returns
    -------
    Drawing or None
        Of the first plant that can be drawn; none where nothing can.
    """
    rig = rig_of(rig) if isinstance(rig, str) else rig
    for member in rig.members:
        found = _drawn(member) if member.is_plant else None
        if found is not None:
            return found(rig, member)
    return None


def _drawn(member: Member) -> type[Drawing] | None:
    for base in member.block_class.__mro__:
        if place := _DRAWN.get(f"{base.__module__}.{base.__qualname__}"):
            module, _, name = place.partition(".")
            drawing: type[Drawing] = getattr(import_module(f"{__name__}.{module}"), name)
            return drawing
    if member.block_class.scene(member.params) is not None:
        from .robot import Robot

        return Robot
    return None
