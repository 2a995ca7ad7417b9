"""Plants of the optimal control problems: any statement's states and controls, and the spacecraft."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings, tail
from softrig_core.drawing.projection import Camera, Place
from softrig_core.drawing.shapes import Pen
from softrig_core.drawing.state_plane import StatePlane
from softrig_core.drawing.symbols import meter

CORNERS = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if sum(p != q for p, q in zip(CORNERS[a], CORNERS[b])) == 1]


class OptimalControl(StatePlane):
    """Drawing of the path of the states, and of the control as a bar."""

    title = "States and control of an optimal control problem"

    def setup(self) -> None:
        """States and control of the statement."""
        super().setup()
        self.problem = self.p.statement()
        self.controls = [self.quantity("command", f"{name}/effort") for name in self.problem.controls]

    def _start(self) -> Sequence[float]:
        return tuple(self.p.statement().x0)

    def values(self, pen: Pen, row: Row) -> None:
        """Write states and controls."""
        rows = [(n, q.text_of(row, ".4f"), "accent") for n, q in zip(self.names, self.states, strict=True)]
        rows += [
            (n, q.text_of(row, ".4f"), "second") for n, q in zip(self.problem.controls, self.controls, strict=True)
        ]
        readings(pen, (410.0, 120.0), rows, 200.0)
        for k, control in enumerate(self.controls):
            x = 500.0 + 26.0 * k
            meter(pen, (x, 290.0), (16.0, 60.0), 0.0, "second")
            pen.box(x, 260.0, 16.0, -30.0 * limited(control(row) / self.reach, 1.0), "second", "second", 0)


class Spacecraft(Drawing):
    """The body from its own axes: the momentum vector moves in it, the torques push about its axes."""

    title = "Spacecraft: momentum in axes of the body, rates and torques"
    trail = 20.0
    AXES = (("x", "accent"), ("y", "second"), ("z", "third"))

    def setup(self) -> None:
        """Rates and torques; scales from the start."""
        statement = self.p.statement()
        self.inertia = self.p.inertia
        self.rates = [self.quantity("state", f"{name}/velocity") for name in statement.states]
        self.torques = [self.quantity("command", f"{name}/effort") for name in statement.controls]
        self.momentum = max(math.hypot(*(i * w for i, w in zip(self.inertia, statement.x0, strict=True))), 1e-12)
        self.rate = max([*map(abs, statement.x0), 1e-12])
        # half sides of the box of even density with these moments
        total = sum(self.inertia)
        sides = [math.sqrt(max(total - 2 * i, 0.05 * total)) for i in self.inertia]
        self.half: Place = (sides[0] / max(sides), sides[1] / max(sides), sides[2] / max(sides))
        self.camera = Camera(math.radians(-55.0), math.radians(22.0), 88.0, (200.0, 190.0))

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Box, axes, momentum with its path, values."""
        camera = self.camera
        corners = [camera((x * self.half[0], y * self.half[1], z * self.half[2])) for x, y, z in CORNERS]
        for face in ((1, 3, 7, 5), (4, 5, 7, 6), (0, 1, 5, 4)):  # the face on top, and the two visible sides
            pen.polygon([corners[k] for k in face], "muted", "faint", 1.2)
        for a, b in EDGES:
            pen.line([corners[a], corners[b]], "muted", 1.0)
        for k, (name, role) in enumerate(self.AXES):
            unit: Place = (float(k == 0), float(k == 1), float(k == 2))
            end = camera((1.5 * unit[0], 1.5 * unit[1], 1.5 * unit[2]))
            pen.arrow(camera((0.0, 0.0, 0.0)), end, role, 1.5)
            pen.text((end[0] + 6, end[1] - 4), name, role)
        pen.line([camera(self._place(r)) for r in tail(past, row, 80)], "alarm", 1.4)
        pen.arrow(camera((0.0, 0.0, 0.0)), camera(self._place(row)), "alarm", 4.0, 14.0)
        rows = [(f"Rate {n}", q.text_of(row, "+.5f"), role) for (n, role), q in zip(self.AXES, self.rates, strict=True)]
        rows += [
            (f"Torque {n}", q.text_of(row, "+.4f"), role) for (n, role), q in zip(self.AXES, self.torques, strict=True)
        ]
        readings(pen, (410.0, 130.0), rows, 200.0)
        pen.text((410.0, 280.0), "Arrow: angular momentum", "alarm")

    def _place(self, row: Row) -> Place:
        h = [1.5 * limited(i * w(row) / self.momentum, 1.3) for i, w in zip(self.inertia, self.rates, strict=True)]
        return h[0], h[1], h[2]
