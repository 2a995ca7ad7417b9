"""Three dimensions on a sheet: a camera that sees everything from one side and a little above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .shapes import Point

Place = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def turned(q: Quaternion, p: Place) -> Place:
    """Turn a place by a unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    tx, ty, tz = 2 * (y * p[2] - z * p[1]), 2 * (z * p[0] - x * p[2]), 2 * (x * p[1] - y * p[0])
    return p[0] + w * tx + y * tz - z * ty, p[1] + w * ty + z * tx - x * tz, p[2] + w * tz + x * ty - y * tx


def times(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product of two rotations: first b, then a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )


def plus(a: Place, b: Place) -> Place:
    """Add two places."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@dataclass(frozen=True)
class Camera:
    """Parallel projection along the line of sight.

    Parameters
    ----------
    azimuth, elevation : float
        Direction of the viewer, rad: azimuth from x towards y, elevation above the ground.
    scale : float
        Units a metre.
    origin : (float, float)
        Position of the origin of space in the drawing.
    """

    azimuth: float
    elevation: float
    scale: float = 1.0
    origin: Point = (0.0, 0.0)

    def __call__(self, p: Place) -> Point:
        """Return where a place is seen."""
        ca, sa = math.cos(self.azimuth), math.sin(self.azimuth)
        along = ca * p[0] + sa * p[1]  # towards the camera, on the ground
        right, up = ca * p[1] - sa * p[0], math.cos(self.elevation) * p[2] - math.sin(self.elevation) * along
        return self.origin[0] + self.scale * right, self.origin[1] - self.scale * up

    def nearness(self, p: Place) -> float:
        """Return how far towards the camera a place is, m."""
        ca, sa = math.cos(self.azimuth), math.sin(self.azimuth)
        return math.cos(self.elevation) * (ca * p[0] + sa * p[1]) + math.sin(self.elevation) * p[2]

    def fitted(self, points: Sequence[Place], left: float, top: float, width: float, height: float) -> Camera:
        """Return a camera that shows these places in a rectangle, as large as possible."""
        raw = Camera(self.azimuth, self.elevation)
        xs, ys = zip(*map(raw, points), strict=True)
        scale = min(width / max(max(xs) - min(xs), 1e-9), height / max(max(ys) - min(ys), 1e-9))
        middle = (max(xs) + min(xs)) / 2, (max(ys) + min(ys)) / 2
        origin = left + width / 2 - scale * middle[0], top + height / 2 - scale * middle[1]
        return Camera(self.azimuth, self.elevation, scale, origin)
