"""Message objects, imported when a node needs them: classes by name, diagnostics, parameter descriptors."""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from softrig_core.block.block import Level
from softrig_core.block.params import Declaration
from softrig_core.block.port import WORLD
from softrig_core.block.scene import Marker
from softrig_core.kit.resource import prefixes
from softrig_core.timebase import SECOND

from ..below.tf_message import TF, tf_class


@cache
def message_class(msgtype: str) -> Any:
    """Import ``package/msg/Type`` of an installed interface package, and no other module.

    Raises
    ------
    ImportError
        There is no installed interface package of this name. Only such packages are imported, because a type named by a
        bag must not run other code.
    """
    package, kind, name = (*msgtype.split("/"), "", "")[:3]
    index = "share/ament_index/resource_index/rosidl_interfaces"
    if kind not in ("msg", "srv", "action") or not any((prefix / index / package).is_file() for prefix in prefixes()):
        if msgtype == TF:
            return tf_class()
        raise ImportError(f"{msgtype!r}: no installed interface package has this type")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def diagnostic_array(stamp: int, name: str, level: Level, text: str, values: Mapping[str, str]) -> Any:
    """Create a diagnostic_msgs/DiagnosticArray with one status.

    Parameters
    ----------
    stamp : int
        ns.
    name : str
        What the status is about, a node or a part of it.
    level : Level
        OK, WARN or ERROR.
    text : str
        The state in one line.
    values : mapping of str to str
        Figures by name.
    """
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

    array = DiagnosticArray()
    array.header.frame_id = WORLD
    array.header.stamp.sec, array.header.stamp.nanosec = stamp // SECOND, stamp % SECOND
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    # Two rigs on one /diagnostics differ only in their namespaces.
    rig = name.rpartition("/")[0]
    array.status = [DiagnosticStatus(level=bytes([level]), name=name, message=text, hardware_id=rig, values=pairs)]
    return array


def range_descriptor(declaration: Declaration) -> Any:
    """Return the ParameterDescriptor of a parameter: described, with its range, read-only unless live."""
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{declaration.unit}]" if declaration.unit else ""
    descriptor = ParameterDescriptor(
        description=declaration.doc + unit,
        read_only=not declaration.live,
        dynamic_typing=True,
        additional_constraints="may change while running, from the next tick on"
        if declaration.live
        else "fixed from the start on",
    )
    bounded = declaration.lower is not None or declaration.upper is not None
    if bounded and declaration.type is float:
        low = declaration.lower if declaration.lower is not None else -1.7e308
        high = declaration.upper if declaration.upper is not None else 1.7e308
        descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
    elif bounded and declaration.type is int:
        low = int(declaration.lower) if declaration.lower is not None else -(2**62)
        high = int(declaration.upper) if declaration.upper is not None else 2**62
        descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
    return descriptor


def marker_array(stamp: int, markers: Sequence[Marker]) -> Any:
    """Create a visualization_msgs/MarkerArray; stamp in ns.

    Parameters
    ----------
    stamp : int
        ns.
    markers : sequence of Marker
        The markers of a block.
    """
    from geometry_msgs.msg import Point as PointMessage
    from visualization_msgs.msg import Marker as MarkerMessage, MarkerArray

    array = MarkerArray()
    for marker in markers:
        message = MarkerMessage()
        message.header.frame_id = marker.frame_id
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        message.ns = marker.name
        message.type = getattr(MarkerMessage, marker.kind.upper())
        message.action = MarkerMessage.ADD
        message.pose.orientation.w = 1.0
        message.scale.x = float(marker.size)
        if marker.kind == "sphere_list":
            message.scale.y = message.scale.z = float(marker.size)
        red, green, blue, opacity = map(float, marker.color)
        message.color.r, message.color.g, message.color.b, message.color.a = red, green, blue, opacity
        message.points = [PointMessage(x=float(x), y=float(y), z=float(z)) for x, y, z in marker.points]
        array.markers.append(message)
    return array
