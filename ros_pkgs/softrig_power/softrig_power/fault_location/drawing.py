"""The line with its fault."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row
from softrig_core.drawing.scope import scope
from softrig_core.drawing.shapes import Pen
from softrig_core.drawing.symbols import bus, ground, source

PHASES = (("x", "accent"), ("y", "second"), ("z", "third"))


class FaultedLine(Drawing):
    """The line between its buses, both ends' voltages and currents, the fault where it is and where it is located."""

    title = "Transmission line with a fault"
    LEFT, RIGHT, Y = 110.0, 530.0, 96.0

    def setup(self) -> None:
        """Measurements of both ends, the fault's current, the place found."""
        self.ends = {}
        for end in "sr":
            self.ends[end] = [[self.quantity(f"{kind}_{end}", axis) for axis, _ in PHASES] for kind in "ui"]
        self.fault = [self.quantity("fault_current", axis) for axis, _ in PHASES]
        self.place = self.quantity("location", "0")
        self.length = self.p.line.length
        self.x_km = self.p.fault.x_km
        self.some = self.p.fault.type != "none"
        self.volts = 1.25 * self.p.source.voltage * math.sqrt(2 / 3)
        self.trail = 0.04

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Line with its ends, fault and place found, then the oscillograms."""
        y = self.Y
        for x, x_end, name in ((40.0, self.LEFT, "S"), (600.0, self.RIGHT, "R")):
            pen.line([(x, y), (x_end, y)], "line", 2.0)
            source(pen, (x, y), 20.0)
            bus(pen, x_end, y - 36.0, y + 36.0, name)
        pen.line([(self.LEFT, y), (self.RIGHT, y)], "line", 2.5)
        for k in range(5):
            x = self.LEFT + (self.RIGHT - self.LEFT) * k / 4
            pen.line([(x, y + 44), (x, y + 50)], "muted", 1.0)
            pen.text((x, y + 64), f"{self.length * k / 4:g} km", "muted", 11.0, "middle")
        pen.line([(self.LEFT, y + 44), (self.RIGHT, y + 44)], "muted", 1.0)
        size = math.sqrt(sum(q(row) ** 2 for q in self.fault))
        on = min(size / 500.0, 1.0)
        x = self._at(self.x_km)
        bolt = [(0, -34), (-9, -12), (-2, -13), (-7, 4), (9, -17), (2, -16), (8, -34)]
        pen.polygon([(x + on * a, y - 2 + on * b) for a, b in bolt], "alarm", "alarm", 0)
        pen.line([(x, y), (x, y + 24 * on)], "alarm", 2.0)
        if self.some:
            ground(pen, (x, y + 24), "alarm" if self.some else "muted")
        result = self.place.name in row and math.isfinite(row[self.place.name])
        mark = self._at(self.place(row)) if result else self.LEFT
        wide = 7.0 if result else 0.0
        pen.polygon(
            [(mark, y + 42), (mark - wide, y + 42 - 1.6 * wide), (mark + wide, y + 42 - 1.6 * wide)],
            "third",
            "third",
            0,
        )
        pen.text((320, 28), f"located at {self.place.text_of(row, '.3f')}" if result else "", "third", 14.0, "middle")
        for left, end in ((30.0, "s"), (340.0, "r")):
            for top, quantity, name, full in ((196.0, 0, "Voltages", self.volts), (286.0, 1, "Currents", 8000.0)):
                values = self.ends[end][quantity]
                pen.text(
                    (left, top - 5), f"{name} at {end.upper()}, ±{full / 1e3:.0f} k{values[0].unit}", "muted", 12.0
                )
                scope(pen, (left, top, 270.0, 66.0), past, row, [(q, r) for q, (_, r) in zip(values, PHASES)], full)

    def _at(self, km: float) -> float:
        return self.LEFT + (self.RIGHT - self.LEFT) * min(max(km / self.length, 0.0), 1.0)
