"""Systems with delay: the tank at the end of a pipe, the pendulum."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen, Point


class Tank(Drawing):
    """A pipe with the water in transit, a tank with its level, a drain."""

    title = "Water tank at the end of a pipe"
    CELLS = 30

    def setup(self) -> None:
        """Level, inflow commanded, cell and delay of the pipe."""
        self.level = self.quantity("level", "level/position", self.p.x0)
        self.inflow = self.quantity("inflow", "inflow/effort")
        self.cell, self.delay = (self.quantity("mode", f"{name}/position") for name in ("cell", "delay"))
        self.switch = self.p.switch
        self.full = 2.0 * max(self.switch, self.p.x0)
        self.flow = self.p.A * self.p.phi * max(self.p.k_low * self.switch, 1e-9)  # below the switch at its most
        self.trail = max(self.p.delay, 0.1)

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Pipe above, tank below, values on the right."""
        pen.box(30.0, 50.0, 330.0, 26.0, "line", "paper", 1.5)
        rows = [*past, row]
        wide = 328.0 / self.CELLS
        for k in range(self.CELLS):  # the command of a delay ago leaves at the right
            earlier = rows[max(0, len(rows) - 1 - round(k / (self.CELLS - 1) * (len(rows) - 1)))]
            share = limited(self.inflow(earlier) / self.flow, 1.0)
            pen.box(31.0 + wide * k, 75.0, wide - 1.0, -24.0 * max(share, 0.0), "accent", "accent", 0)
            # Red: removed flow.
            pen.box(31.0 + wide * k, 51.0, wide - 1.0, 24.0 * max(-share, 0.0), "alarm", "alarm", 0)
        outflow = max(limited(self.inflow(rows[0]) / self.flow, 1.0), 0.0)
        pen.text((30.0, 40.0), f"pipe, {self.delay.text_of(row, '.2f')} long", "muted")
        filled = min(max(self.level(row) / self.full, 0.0), 1.05)
        pen.box(360.0, 63.0, 10.0 * outflow, 255.0 - 200.0 * filled, "accent", "accent", 0)
        pen.box(240.0, 318.0, 170.0, -200.0 * filled, "accent", "accent", 0)
        pen.line([(240.0, 100.0), (240.0, 320.0), (410.0, 320.0), (410.0, 100.0)], "line", 3.0)
        y = 318.0 - 200.0 * self.switch / self.full
        pen.line([(232.0, y), (418.0, y)], "reference", 1.5, dashed=True)
        pen.text((226.0, y + 4), f"{self.switch:g}", "muted", anchor="end")
        pen.line([(410.0, 312.0), (440.0, 312.0)], "line", 6.0)
        pen.box(440.0, 312.0, 8.0, 26.0 * math.sqrt(filled), "accent", "accent", 0)
        values = [("Level", self.level.text_of(row, ".4f"), "accent"), ("Inflow", self.inflow.text_of(row), "line")]
        values += [("Delay", self.delay.text_of(row, ".2f"), "line"), ("Cell", self.cell.text_of(row, ".0f"), "line")]
        readings(pen, (450.0, 130.0), values, 165.0)


class Pendulum(Drawing):
    """The pendulum, as it is and as its controller sees it, with the torque at its joint."""

    title = "Pendulum whose controller sees it late"
    trail = 1.5
    JOINT = (210.0, 150.0)
    LENGTH = 130.0

    def setup(self) -> None:
        """Name angle and speed, the late angle, the torque; at rest it hangs down."""
        self.angle, self.speed = (self.quantity("state", f"joint/{name}") for name in ("position", "velocity"))
        self.late = self.quantity("delayed_state", "joint/position")
        self.torque = self.quantity("torque", "joint/effort")

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Late pendulum dashed behind the true one."""
        pen.line([(self.JOINT[0] - 70, self.JOINT[1]), (self.JOINT[0] + 70, self.JOINT[1])], "muted", 4.0)
        rows = [*past, row]
        path = [self._tip(self.angle(rows[max(0, len(rows) - 1 - round(k / 39 * (len(rows) - 1)))])) for k in range(40)]
        pen.line(path, "second", 1.4)
        pen.line([self.JOINT, (self.JOINT[0], self.JOINT[1] + 1.2 * self.LENGTH)], "faint", 1.5)
        if self.late.name:
            pen.line([self.JOINT, self._tip(self.late(row))], "reference", 2.0, dashed=True)
            pen.circle(self._tip(self.late(row)), 16.0, "reference", "", 1.2)
        pen.line([self.JOINT, self._tip(self.angle(row))], "line", 5.0)
        pen.circle(self._tip(self.angle(row)), 18.0, "line", "accent", 2.0)
        share = limited(self.torque(row) / 1.0, 1.0)
        pen.arc(self.JOINT, 34.0, -math.pi / 2, -math.pi / 2 + share * 0.8 * math.pi, "alarm", 4.0)
        pen.circle(self.JOINT, 7.0, "line", "paper", 2.0)
        rows_ = [("Angle", self.angle.text_of(row, ".4f"), "accent")]
        rows_ += [("as the controller sees it", self.late.text_of(row, ".4f"), "reference")] if self.late.name else []
        rows_ += [
            ("Speed", self.speed.text_of(row, ".4f"), "line"),
            ("Torque", self.torque.text_of(row, ".4f"), "alarm"),
        ]
        readings(pen, (370.0, 130.0), rows_, 245.0)

    def _tip(self, angle: float) -> Point:
        return (self.JOINT[0] + self.LENGTH * math.sin(angle), self.JOINT[1] + self.LENGTH * math.cos(angle))
