"""Symbols of circuits: each connects two points or is centred on one."""

from __future__ import annotations

import math

from .shapes import Pen, Point


def _frame(start: Point, end: Point) -> tuple[float, float, float, float, float]:
    dx, dy = end[0] - start[0], end[1] - start[1]
    length = math.hypot(dx, dy)
    return dx / length, dy / length, -dy / length, dx / length, length


def _at(start: Point, axes: tuple[float, float, float, float, float], along: float, across: float) -> Point:
    ux, uy, nx, ny, _ = axes
    return start[0] + along * ux + across * nx, start[1] + along * uy + across * ny


def resistor(pen: Pen, start: Point, end: Point, half: float = 8.0) -> None:
    """Draw a box, as in IEC 60617."""
    axes = _frame(start, end)
    corners = [(0, -half), (axes[4], -half), (axes[4], half), (0, half)]
    pen.polygon([_at(start, axes, a, b) for a, b in corners], "line", "paper")


def inductor(pen: Pen, start: Point, end: Point, role: str = "line") -> None:
    """Draw half circles."""
    axes = _frame(start, end)
    radius = axes[4] / 8
    points = []
    for k in range(4):
        for j in range(9):
            angle = math.pi * (1 - j / 8)
            points.append(_at(start, axes, radius * (2 * k + 1 + math.cos(angle)), -radius * math.sin(angle)))
    pen.line(points, role)


def capacitor(pen: Pen, start: Point, end: Point) -> None:
    """Draw two plates between two points, with their leads."""
    axes = _frame(start, end)
    a, b = axes[4] / 2 - 4.0, axes[4] / 2 + 4.0
    pen.line([start, _at(start, axes, a, 0)])
    pen.line([_at(start, axes, b, 0), end])
    for along in (a, b):
        pen.line([_at(start, axes, along, -16.0), _at(start, axes, along, 16.0)], "line", 2.5)


def source(pen: Pen, centre: Point, radius: float, *, dc: bool = False, role: str = "line") -> None:
    """Draw a voltage source: a circle with a wave, or with plus and minus."""
    x, y = centre
    pen.circle(centre, radius, role, "paper")
    if dc:
        pen.text((x, y - radius * 0.2), "+", role, radius * 0.6, "middle")
        pen.text((x, y + radius * 0.65), "−", role, radius * 0.6, "middle")
    else:
        wave = [
            (x + radius * 0.6 * (k / 8 - 1), y - radius * 0.35 * math.sin(math.pi * (k / 8 - 1))) for k in range(17)
        ]
        pen.line(wave, role)


def diode(pen: Pen, start: Point, end: Point, role: str, half: float) -> None:
    """Draw a diode that conducts from start to end."""
    axes = _frame(start, end)
    middle = axes[4] / 2
    pen.line([start, _at(start, axes, middle - half, 0)], role)
    pen.line([_at(start, axes, middle + half * 0.8, 0), end], role)
    corners = [(middle - half, -half), (middle + half * 0.8, 0), (middle - half, half)]
    pen.polygon([_at(start, axes, a, b) for a, b in corners], role, "paper")
    pen.line([_at(start, axes, middle + half * 0.8, -half), _at(start, axes, middle + half * 0.8, half)], role, 2.0)


def ground(pen: Pen, at: Point, role: str) -> None:
    """Draw the sign of earth below a point."""
    x, y = at
    pen.line([(x, y), (x, y + 8)], role)
    for k, half in enumerate((12.0, 8.0, 4.0)):
        pen.line([(x - half, y + 8 + 4 * k), (x + half, y + 8 + 4 * k)], role)


def bus(pen: Pen, x: float, top: float, bottom: float, name: str) -> None:
    """Draw a bus bar with its name above."""
    pen.line([(x, top), (x, bottom)], "line", 5.0)
    pen.text((x, top - 8), name, "muted", anchor="middle")


def converter(pen: Pen, centre: Point, half: float) -> None:
    """Draw a converter between alternating and direct current: a square with its diagonal."""
    x, y = centre
    pen.box(x - half, y - half, 2 * half, 2 * half, "line", "faint", 2.0)
    pen.line([(x - half, y + half), (x + half, y - half)])
    pen.text((x - half * 0.5, y - half * 0.15), "~", "line", half * 0.8, "middle")
    pen.text((x + half * 0.5, y + half * 0.75), "=", "line", half * 0.8, "middle")


def meter(pen: Pen, at: Point, size: tuple[float, float], share: float, role: str) -> None:
    """Draw a bar from the lower left corner of a frame upwards; a negative share is drawn downwards."""
    x, y = at
    width, height = size
    pen.box(x, y, width, -height, "muted", "", 1.0)
    pen.box(x, y, width, -height * share, role, role, 0)
