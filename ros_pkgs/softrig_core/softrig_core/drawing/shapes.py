"""The elements of a drawing: lines, polygons, circles and text with roles in place of colours."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

Point = tuple[float, float]

# Colour of each role on light and on dark ground; the hues are those of `plots.style`, which every kind of colour
# vision tells apart.
PALETTE = {
    "line": ("#222222", "#e8e8e8"),
    "muted": ("#6b6b6b", "#a0a0a0"),
    "faint": ("#e4e7ea", "#343a40"),  # fills of bodies, guides
    "paper": ("#ffffff", "#16191d"),  # the ground, to hide what is behind
    "accent": ("#0072b2", "#56b4e9"),  # what moves, the main quantity
    "second": ("#d55e00", "#ff9e4a"),
    "third": ("#009e73", "#2fd3a4"),
    "fourth": ("#b0508b", "#e09cc4"),
    "reference": ("#555555", "#bbbbbb"),  # desired values
    "alarm": ("#cc3311", "#ff7a66"),  # a limit, a fault
}


@dataclass(frozen=True, slots=True)
class Line:
    """A line through points, with round corners."""

    points: tuple[Point, ...]
    role: str = "line"
    width: float = 1.5
    dashed: bool = False


@dataclass(frozen=True, slots=True)
class Polygon:
    """A closed shape; `fill` is a role or empty, a width of 0 leaves the edge out."""

    points: tuple[Point, ...]
    role: str = "line"
    fill: str = ""
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Circle:
    """A circle; `fill` is a role or empty."""

    centre: Point
    radius: float
    role: str = "line"
    fill: str = ""
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Text:
    """A line of text that begins, has its middle or ends at a point of its baseline."""

    at: Point
    text: str
    role: str = "line"
    size: float = 13.0
    anchor: str = "start"


Shape = Line | Polygon | Circle | Text


def as_dict(shape: Shape) -> dict[str, Any]:
    """Return a shape as plain JSON, with its ``kind``."""
    return {"kind": type(shape).__name__.lower()} | asdict(shape)


class Pen:
    """Collects shapes in painter's order; x to the right, y down, a tenth of a unit is the finest step."""

    def __init__(self) -> None:
        self.shapes: list[Shape] = []

    def line(self, points: Iterable[Point], role: str = "line", width: float = 1.5, *, dashed: bool = False) -> None:
        """Draw a line."""
        self.shapes.append(Line(tuple(map(_fine, points)), role, width, dashed))

    def polygon(self, points: Iterable[Point], role: str = "line", fill: str = "", width: float = 1.5) -> None:
        """Draw a closed shape."""
        self.shapes.append(Polygon(tuple(map(_fine, points)), role, fill, width))

    def box(
        self, x: float, y: float, width: float, height: float, role: str = "line", fill: str = "", edge: float = 1.5
    ) -> None:
        """Draw a rectangle from its upper left corner; a negative height grows upwards."""
        self.polygon([(x, y), (x + width, y), (x + width, y + height), (x, y + height)], role, fill, edge)

    def circle(self, centre: Point, radius: float, role: str = "line", fill: str = "", width: float = 1.5) -> None:
        """Draw a circle."""
        self.shapes.append(Circle(_fine(centre), round(radius, 1), role, fill, width))

    def text(self, at: Point, text: str, role: str = "line", size: float = 13.0, anchor: str = "start") -> None:
        """Write a line."""
        self.shapes.append(Text(_fine(at), text, role, size, anchor))

    def arrow(self, start: Point, end: Point, role: str = "line", width: float = 2.0, head: float = 9.0) -> None:
        """Draw an arrow; one shorter than its head has a smaller head."""
        dx, dy = end[0] - start[0], end[1] - start[1]
        length = math.hypot(dx, dy)
        ux, uy = (dx / length, dy / length) if length else (1.0, 0.0)
        size = min(head, length)
        foot = (end[0] - size * ux, end[1] - size * uy)
        side = 0.4 * size
        self.line([start, foot], role, width)
        self.polygon(
            [end, (foot[0] - side * uy, foot[1] + side * ux), (foot[0] + side * uy, foot[1] - side * ux)], role, role, 0
        )

    def arc(self, centre: Point, radius: float, start: float, end: float, role: str, width: float) -> None:
        """Draw an arc between two angles, rad, counter-clockwise from the right."""
        angles = [start + (end - start) * k / 23 for k in range(24)]
        self.line([polar(centre, radius, a) for a in angles], role, width)


def polar(centre: Point, radius: float, angle: float) -> Point:
    """Return the point at an angle, rad, counter-clockwise from the right as it is seen."""
    return centre[0] + radius * math.cos(angle), centre[1] - radius * math.sin(angle)


def _fine(point: Point) -> Point:
    return round(point[0], 1), round(point[1], 1)
