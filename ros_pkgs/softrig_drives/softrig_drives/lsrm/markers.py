"""The motor as lines: stator teeth on both sides, translator poles between them."""

from __future__ import annotations

from softrig_core import Marker
from softrig_core.block.scene import Point

from .machine import Geometry

FRAME = "stator"
STATOR_POLE = 0.021
TRANSLATOR_POLE = 0.013
TRANSLATOR_PITCH = 0.039
TRANSLATOR_POLES = 4
TEETH = 24
GAP = 0.002
DEPTH = 0.026
HALF_BODY = 0.02


def _tooth(x: float, width: float, foot: float, tip: float) -> tuple[Point, ...]:
    """Outline of a pole around x as pairs of points."""
    left, right = x - width / 2, x + width / 2
    a, b, c, d = (left, foot, 0.0), (left, tip, 0.0), (right, tip, 0.0), (right, foot, 0.0)
    return a, b, b, c, c, d


def stator(geometry: Geometry) -> Marker:
    """Teeth above and below, one at each multiple of the pitch; phase a is aligned with them at x = 0."""
    near = HALF_BODY + GAP
    points: tuple[Point, ...] = ()
    for n in range(-4, TEETH - 4):
        for side in (1.0, -1.0):
            points += _tooth(n * geometry.tau, STATOR_POLE, side * (near + DEPTH), side * near)
    return Marker(FRAME, "stator", "line_list", points, 0.001, (0.5, 0.5, 0.5, 1.0))


def translator(geometry: Geometry, x: float) -> Marker:
    """Body and poles of the moving part at the position x (m)."""
    points: tuple[Point, ...] = ()
    for n in range(TRANSLATOR_POLES):
        for side in (1.0, -1.0):
            points += _tooth(x + n * TRANSLATOR_PITCH, TRANSLATOR_POLE, side * HALF_BODY / 2, side * HALF_BODY)
    first, last = x - TRANSLATOR_PITCH / 2, x + (TRANSLATOR_POLES - 0.5) * TRANSLATOR_PITCH
    half = HALF_BODY / 2
    corners = ((first, half, 0.0), (last, half, 0.0), (last, -half, 0.0), (first, -half, 0.0))
    for n, corner in enumerate(corners):
        points += (corner, corners[(n + 1) % 4])
    return Marker(FRAME, "translator", "line_list", points, 0.001, (0.8, 0.3, 0.1, 1.0))
