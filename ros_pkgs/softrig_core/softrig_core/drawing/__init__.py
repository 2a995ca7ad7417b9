"""Plants as drawings: shapes computed from the published signals of a rig, for any display.

It uses no drawing library: `drawing_for` returns a `Drawing`, whose `frame` returns a list of shapes for one row of
signal values. A plant names its drawing by `Plant.DRAWN_BY`.
"""

from __future__ import annotations

from pkgutil import resolve_name

from ..block.scene import scene_of
from ..rig.members import Member
from ..rig.rig import Rig
from ..run.expand import rig_of
from .base import Drawing
from .robot import Robot
from .shapes import PALETTE, Circle, Line, Point, Polygon, Shape, Text, as_dict

__all__ = ["PALETTE", "Circle", "Drawing", "Line", "Point", "Polygon", "Shape", "Text", "as_dict", "drawing_for"]


def drawing_for(rig: Rig | str) -> Drawing | None:
    """Return the drawing of a rig's plant.

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
    result = ((kind, m) for m in rig.members if m.is_plant and (kind := _kind(m)) is not None)
    return next((kind(rig, member) for kind, member in result), None)


def _kind(member: Member) -> type[Drawing] | None:
    if name := member.block_class.DRAWN_BY:
        return resolve_name(name)
    return Robot if scene_of(member.block_class, member.params) is not None else None
