"""The fleet of units."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen

from .units import Units


class Fleet(Drawing):
    """A bar a unit from its lower to its upper limit, filled up to its output, with its set point."""

    title = "Thermal units: outputs, set points, demand and cost"
    LEFT, WIDTH, TOP, HEIGHT = 40.0, 570.0, 40.0, 190.0

    def setup(self) -> None:
        """Output and set point of each unit, totals, demand."""
        units = Units.read(self.p.unit_table)
        self.names = units.ids
        self.low, self.high = units.p_min.tolist(), units.p_max.tolist()
        self.outputs = [self.quantity("state", f"{n}/position", p) for n, p in zip(units.ids, self.low, strict=True)]
        self.wanted = [self.quantity("setpoints", f"{n}/effort", p) for n, p in zip(units.ids, self.low, strict=True)]
        self.total, self.cost = (self.quantity("total", f"{name}/position") for name in ("output", "cost"))
        self.demand = self.quantity("demand", "demand_MW/position")

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Bars on one scale, then the sums."""
        n, top = len(self.names), max(self.high)
        step = self.WIDTH / n
        wide = min(0.62 * step, 40.0)
        foot = self.TOP + self.HEIGHT

        def y_of(power: float) -> float:
            return foot - self.HEIGHT * min(max(power / top, 0.0), 1.0)

        for k in range(5):
            y = y_of(top * k / 4)
            pen.line([(self.LEFT, y), (self.LEFT + self.WIDTH, y)], "faint", 1.0)
            pen.text((self.LEFT - 6, y + 4), f"{top * k / 4:.0f}", "muted", 10.0, "end")
        pen.text((self.LEFT - 6, self.TOP - 14), self.total.unit, "muted", 11.0, "end")
        for k, name in enumerate(self.names):
            x = self.LEFT + step * (k + 0.5) - wide / 2
            pen.box(x, y_of(self.high[k]), wide, y_of(self.low[k]) - y_of(self.high[k]), "muted", "paper", 1.0)
            pen.box(x, foot, wide, y_of(self.outputs[k](row)) - foot, "accent", "accent", 0)
            pen.line([(x - 2, y_of(self.wanted[k](row))), (x + wide + 2, y_of(self.wanted[k](row)))], "second", 2.0)
            pen.text((x + wide / 2, foot + 15), name if n <= 20 or k % 2 == 0 else "", "muted", 10.0, "middle")
        full = max(sum(self.high), 1.0)
        pen.box(self.LEFT, 276.0, self.WIDTH, 14.0, "muted", "paper", 1.0)
        pen.box(self.LEFT, 276.0, self.WIDTH * limited(self.total(row) / full, 1.0), 14.0, "accent", "accent", 0)
        x = self.LEFT + self.WIDTH * min(max(self.demand(row) / full, 0.0), 1.0)
        pen.line([(x, 270.0), (x, 296.0)], "alarm", 3.0)
        rows = [("Output of all units", self.total.text_of(row, ",.2f"), "accent")]
        rows += [("Demand", self.demand.text_of(row, ",.2f"), "alarm")] if self.demand.name else []
        readings(pen, (self.LEFT, 322.0), rows, 260.0)
        readings(pen, (350.0, 322.0), [("Cost", self.cost.text_of(row, ",.2f"), "line")], 260.0)
