"""A robot in three dimensions from its description and joint positions."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from random import Random
from xml.etree import ElementTree

from ..block.scene import Scene, scene_of
from .base import Drawing, Row, limited, readings, tail
from .projection import Camera, Place, plus, times, turned
from .shapes import Pen, Point

ROOM = (16.0, 16.0, 400.0, 328.0)  # left, top, width, height of what the robot may reach
ELEVATION = math.radians(16.0)
ASIDE = math.radians(24.0)  # rotated from the widest view, so that depth is visible
POSTURES = 150
PATH = 40  # points of the tip's path
GRID = 4  # lines on the ground a direction


class Robot(Drawing):
    """Links from joint to joint, their shadow on the ground, the path of the tip, the reference as a dashed skeleton.

    All links are drawn with the same thickness, because only their positions matter.
    """

    trail = 1.5

    def setup(self) -> None:
        """Read the joints of the description, and place the camera."""
        scene = scene_of(self.plant.block_class, self.p)
        assert scene is not None
        self.scene: Scene = scene
        port = next(p for p in self.plant.outputs if p.name == scene.port)
        names = [label.rpartition("/")[0] for label in port.labels if label.endswith("/position")]
        self.joints = [self.quantity(scene.port, f"{name}/position") for name in names]
        self.names = names
        self.torques = [self.quantity(scene.port, f"{name}/effort") for name in names]
        self.wanted = [self.quantity("reference", f"{name}/position") for name in names]
        pushed = next((p.name for p in self.plant.inputs if "force/x" in p.labels), "")
        self.push = [self.quantity(pushed, f"force/{axis}") for axis in "xyz"] if pushed else []
        self.fixed = scene.fixed()
        # from the base to the tip; a link without a known parent is drawn from the base
        chain = [*scene.moving([0.0] * len(names)), *self.fixed]
        self.links = [(pose.parent, pose.child) for pose in chain]
        self.base = scene.base
        robot = ElementTree.fromstring(scene.description)
        self.title = f"{robot.get('name', 'robot').replace('_', ' ').capitalize()} from its URDF and joint positions"
        self.camera, self.ground = self._view()

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Draw ground, shadow, path and links; then the values."""
        q = [joint(row) for joint in self.joints]
        positions = self._places(q)
        self._floor(pen, positions)
        path = [self.scene.tip([joint(r) for joint in self.joints]) for r in tail(past, row, PATH)]
        pen.line([self.camera(p) for p in path], "second", 1.6)
        if any(w.name for w in self.wanted):
            ghost = self._places([w(row) if w.name in row else x for w, x in zip(self.wanted, q, strict=True)])
            for parent, child in self.links:
                pen.line([self.camera(ghost[parent]), self.camera(ghost[child])], "reference", 1.2, dashed=True)
        self._body(pen, positions)
        tip = positions[self.links[-1][1]] if self.links else positions[self.base]
        self._force(pen, row, tip)
        rows = []
        for name, joint, torque in zip(self.names, self.joints, self.torques, strict=True):
            rows += [(re.sub(r"_|(?<=\D)(?=\d)", " ", name).capitalize(), joint.text_of(row, ".3f"), "line")]
            rows += [("torque", torque.text_of(row), "muted")] if torque.name else []
        if self.push:
            size = math.hypot(*(f(row) for f in self.push))
            rows += [("Force", f"{size:.1f} {self.push[0].unit}", "alarm")]
        readings(pen, (430.0, max(40.0, 190.0 - 11.0 * len(rows))), rows, 190.0)

    def _places(self, q: Sequence[float]) -> dict[str, Place]:
        """Return the place of each frame in the base, m."""
        frames: dict[str, tuple[Place, tuple[float, float, float, float]]] = {
            self.base: ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
        }
        left = [*self.scene.moving(q), *self.fixed]
        while left:
            ready = [pose for pose in left if pose.parent in frames]
            if not ready:
                break
            for pose in ready:
                position, turn = frames[pose.parent]
                frames[pose.child] = plus(position, turned(turn, pose.position)), times(turn, pose.rotation)
            left = [pose for pose in left if pose.child not in frames]
        return {name: position for name, (position, _) in frames.items()}

    def _view(self) -> tuple[Camera, float]:
        """Return the camera that shows the robot's work largest, and half the side of the ground."""
        limits = _limits(self.scene.description)
        draw = Random(0)
        points: list[Place] = [(0.0, 0.0, 0.0)]
        tips = []
        for _ in range(POSTURES):
            q = [draw.uniform(*limits.get(name, (-math.pi, math.pi))) for name in self.names]
            positions = list(self._places(q).values())
            if min(p[2] for p in positions) > -0.02:  # above the ground, as robots are
                points += positions
                tips.append(positions[-1])
        tips = tips or [(1.0, 0.0, 1.0)]

        def width(azimuth: int) -> float:
            xs = [Camera(math.radians(azimuth), ELEVATION)(p)[0] for p in tips]
            return max(xs) - min(xs)

        # with x, which is forward, to the right, unless another side shows more
        azimuth = max(range(-180, 1, 15), key=width)
        if width(-90) > 0.8 * width(azimuth):
            azimuth = -90
        camera = Camera(math.radians(azimuth) + ASIDE, ELEVATION)
        side = 0.6 * max(max(abs(p[0]), abs(p[1])) for p in points)
        points += [(x, y, 0.0) for x in (-side, side) for y in (-side, side)]
        return camera.fitted(points, *ROOM), side

    def _floor(self, pen: Pen, positions: dict[str, Place]) -> None:
        side = self.ground
        for k in range(GRID + 1):
            offset = side * (2.0 * k / GRID - 1.0)
            pen.line([self.camera((offset, -side, 0.0)), self.camera((offset, side, 0.0))], "faint", 1.0)
            pen.line([self.camera((-side, offset, 0.0)), self.camera((side, offset, 0.0))], "faint", 1.0)
        for parent, child in self.links:
            a, b = positions[parent], positions[child]
            pen.line([self.camera((a[0], a[1], 0.0)), self.camera((b[0], b[1], 0.0))], "faint", 9.0)

    def _body(self, pen: Pen, positions: dict[str, Place]) -> None:
        """Return the stand, then the links from the farthest to the nearest, all in one style."""
        stands = [(a, b) for a, b in self.links if a == self.base]
        links = [(a, b) for a, b in self.links if a != self.base]
        for a, b in stands:
            pen.line([self.camera(positions[a]), self.camera(positions[b])], "muted", 5.0)
        links.sort(key=lambda link: sum(self.camera.nearness(positions[frame]) for frame in link))
        for a, b in links:
            ends: list[Point] = [self.camera(positions[a]), self.camera(positions[b])]
            pen.line(ends, "line", 15.0)
            pen.line(ends, "accent", 12.0)
        for a in dict.fromkeys(a for a, _ in self.links if a != self.base):
            pen.circle(self.camera(positions[a]), 6.0, "line", "paper")
        pen.circle(self.camera(positions[self.links[-1][1]]), 5.0, "line", "second")

    def _force(self, pen: Pen, row: Row, tip: Place) -> None:
        if self.push:
            reach = [limited(f(row) / 100.0, 1.5) * 0.4 for f in self.push]
            pen.arrow(
                self.camera(tip),
                self.camera((tip[0] + reach[0], tip[1] + reach[1], tip[2] + reach[2])),
                "alarm",
                3.5,
                12.0,
            )


def _limits(description: str) -> dict[str, tuple[float, float]]:
    """Return the range of each joint with limits, rad or m, at most half a turn to either side."""
    result = {}
    for joint in ElementTree.fromstring(description).iterfind("joint"):
        limit = joint.find("limit")
        if limit is not None and joint.get("type") != "continuous":
            low, high = float(limit.get("lower", 0.0)), float(limit.get("upper", 0.0))
            result[str(joint.get("name"))] = max(low, -math.pi), min(high, math.pi)
    return result
