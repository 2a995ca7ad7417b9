"""Something to look at: what a block's `markers` method gives and a node publishes as a MarkerArray."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Marker:
    """A set of points drawn as lines or balls.

    Parameters
    ----------
    frame_id : str
        Frame of the points.
    name : str
        Namespace of the marker; one marker a name.
    kind : {"line_list", "line_strip", "sphere_list"}
        A line for each pair of points, one line through all, or a ball at each.
    points : tuple of (x, y, z)
        m.
    size : float
        Width of the lines or diameter of the balls, m.
    color : tuple of 4 floats
        Red, green, blue, opacity, each from 0 to 1.
    """

    frame_id: str
    name: str
    kind: Literal["line_list", "line_strip", "sphere_list"]
    points: tuple[Point, ...]
    size: float
    color: tuple[float, float, float, float] = (0.2, 0.4, 0.8, 1.0)


def marker_array(stamp: int, markers: Sequence[Marker]) -> Any:
    """Make a visualization_msgs/MarkerArray; stamp in ns."""
    from geometry_msgs.msg import Point as PointMessage
    from visualization_msgs.msg import Marker as MarkerMessage
    from visualization_msgs.msg import MarkerArray

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
