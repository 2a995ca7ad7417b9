"""Something to look at: what a block's `markers` method gives and a node publishes as a MarkerArray."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
