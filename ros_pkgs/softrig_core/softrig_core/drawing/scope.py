"""A small oscilloscope inside a drawing: the newest part of some signals over time, or one signal over another."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from .base import Row, limited
from .shapes import Pen

Box = tuple[float, float, float, float]
Reading = Callable[[Row], float]


def scope(
    pen: Pen,
    box: Box,
    past: Sequence[Row],
    row: Row,
    curves: Sequence[tuple[Reading, str]],
    full: float,
    points: int = 50,
) -> None:
    """Draw signals over the past, now at the right edge.

    Parameters
    ----------
    box : (left, top, width, height)
    past, row
        As `Drawing.frame` has them.
    curves : sequence of (function of a row, role)
    full : float
        Value at the upper edge; the lower one is its negative.
    points : int
        Of each curve.
    """
    left, top, width, height = box
    middle = top + height / 2
    pen.box(left, top, width, height, "muted", "", 1.0)
    pen.line([(left, middle), (left + width, middle)], "faint", 1.0)
    rows = _newest(past, row, points)
    for reading, role in curves:
        ys = [middle - limited(reading(r) / full, 1.0) * height / 2 for r in rows]
        pen.line([(left + width * k / (points - 1), y) for k, y in enumerate(ys)], role, 1.5)


def _newest(past: Sequence[Row], row: Row, points: int) -> list[Row]:
    """Pick rows evenly; the first represents those before it."""
    rows = [*past, row]
    step = max((len(rows) - 1) / (points - 1), 1.0)
    return [rows[max(0, len(rows) - 1 - round(step * (points - 1 - k)))] for k in range(points)]


def plane(
    pen: Pen,
    box: Box,
    past: Sequence[Row],
    row: Row,
    x: Reading,
    y: Reading,
    full: tuple[float, float, float, float],
    points: int = 60,
) -> None:
    """Draw the path of a pair of values and its present point.

    Parameters
    ----------
    box : (left, top, width, height)
    past, row
        As `Drawing.frame` has them.
    x, y : function of a row
    full : 4 floats
        Values at the left, right, lower and upper edge.
    """
    left, top, width, height = box
    x0, x1, y0, y1 = full

    def to_page(r: Row) -> tuple[float, float]:
        across, up = (x(r) - x0) / (x1 - x0), (y(r) - y0) / (y1 - y0)
        return left + width * min(max(across, 0.0), 1.0), top + height * (1 - min(max(up, 0.0), 1.0))

    pen.box(left, top, width, height, "muted", "", 1.0)
    if x0 < 0 < x1:
        axis = left - width * x0 / (x1 - x0)
        pen.line([(axis, top), (axis, top + height)], "faint", 1.0)
    if y0 < 0 < y1:
        axis = top + height * (1 + y0 / (y1 - y0))
        pen.line([(left, axis), (left + width, axis)], "faint", 1.0)
    pen.line([to_page(r) for r in _newest(past, row, points)], "accent", 1.8)
    pen.circle(to_page(row), 5.0, "accent", "accent")
