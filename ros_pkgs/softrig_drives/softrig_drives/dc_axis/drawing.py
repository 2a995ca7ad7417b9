"""The DC axis: the carriage that the motor moves."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen


class DcAxis(Drawing):
    """A carriage on a spindle over its scale, where it shall be and where the controller thinks it is."""

    title = "DC axis: carriage, spindle and motor"
    LEFT, RIGHT, RAIL = 120.0, 610.0, 200.0

    def setup(self) -> None:
        """True and fed back position, set position, voltage."""
        self.position, self.speed = (self.quantity("true_state", f"axis/{f}") for f in ("position", "velocity"))
        self.fed = self.quantity("feedback", "axis/position")
        self.wanted = self.quantity("model", "position_set/position")
        self.target = self.quantity("controller_state", "set_point/position")
        self.voltage = self.quantity("command", "armature/effort")
        self.limit = self.p.u_limit_v
        self.reach = self._reach()
        self.per_turn = self.p.mm_per_rev

    def _reach(self) -> float:
        """Return half the scale: 1.5 times the sum that the presses of the buttons may reach, mm."""
        params = [m.params for m in self.rig.members]
        step = max((p.step_mm for p in params if hasattr(p, "step_mm")), default=10.0)
        presses = [len(getattr(p, name, ())) for p in params for name in ("forward", "reverse")]
        return 1.5 * step * max([*presses, 1])

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Rail with its scale, motor, spindle, carriage, marks."""
        y = self.RAIL
        pen.box(30.0, y - 30.0, 70.0, 52.0, "line", "faint", 2.0)
        pen.text((65.0, y + 2.0), "M", "line", 18.0, "middle")
        level = limited(self.voltage(row) / self.limit, 1.0)
        pen.box(36.0, y - 48.0, 58.0, 9.0, "muted", "", 1.0)
        pen.box(65.0, y - 48.0, 29.0 * level, 9.0, "second", "second", 0)
        pen.text((65.0, y - 56.0), self.voltage.text_of(row, ".2f"), "second", anchor="middle")
        pen.line([(100.0, y - 4.0), (self.RIGHT, y - 4.0)], "muted", 7.0)
        turn = 2 * math.pi * self.position(row) / self.per_turn
        for k in range(24):  # the thread runs along the spindle as it turns
            x = 112.0 + (self.RIGHT - 112.0) * ((k + turn / (2 * math.pi)) % 24) / 24
            pen.line([(x - 3, y - 8), (min(x + 3, self.RIGHT), y)], "paper", 1.2)
        pen.line([(self.LEFT, y + 24.0), (self.RIGHT, y + 24.0)], "line", 2.0)
        for k in range(9):
            mark = self.reach * (k / 4 - 1)
            pen.line([(self.at(mark), y + 24.0), (self.at(mark), y + 32.0)], "line", 1.2)
            pen.text((self.at(mark), y + 47.0), f"{mark:g}".replace("-", "−"), "muted", 11.0, "middle")
        pen.text((self.RIGHT, y + 64.0), self.position.unit, "muted", 11.0, "end")
        x = self.at(self.position(row))
        if self.fed.name:
            pen.box(self.at(self.fed(row)) - 34.0, y - 40.0, 68.0, 58.0, "reference", "", 1.0)
        pen.box(x - 34.0, y - 40.0, 68.0, 58.0, "line", "accent", 2.0)
        pen.polygon([(x, y + 24.0), (x - 6.0, y + 14.0), (x + 6.0, y + 14.0)], "line", "paper", 1.5)
        for quantity, role, height in ((self.target, "alarm", 96.0), (self.wanted, "reference", 76.0)):
            if quantity.name:
                x_mark = self.at(quantity(row))
                pen.line([(x_mark, y + 24.0), (x_mark, y - height)], role, 1.6, dashed=True)
        rows = [
            ("Position", self.position.text_of(row, ".2f"), "accent"),
            ("Speed", self.speed.text_of(row, ".2f"), "line"),
        ]
        rows += [("Fed back (outline)", self.fed.text_of(row, ".2f"), "line")] if self.fed.name else []
        readings(pen, (40.0, 292.0), rows, 230.0)
        rows = [("Set point (dashed)", self.target.text_of(row, ".1f"), "alarm")] if self.target.name else []
        rows += [("Set position", self.wanted.text_of(row, ".2f"), "reference")] if self.wanted.name else []
        readings(pen, (360.0, 292.0), rows, 240.0)

    def at(self, position: float) -> float:
        """Return the x of a position, mm, on the scale."""
        middle = (self.LEFT + self.RIGHT) / 2
        return middle + limited(position / self.reach, 1.0) * (self.RIGHT - self.LEFT) / 2
