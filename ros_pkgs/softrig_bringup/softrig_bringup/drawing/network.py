"""Networks of power: the line with its GUPFC, the line with its fault, the fleet of units."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_power.dispatch.units import Units

from .base import Drawing, Quantity, Row, held, readings
from .scope import scope
from .shapes import Pen
from .symbols import bus, converter, ground, source

PHASES = (("x", "accent"), ("y", "second"), ("z", "third"))


class Gupfc(Drawing):
    """One line of both circuits: bus voltages, series and shunt converters on their DC link, power at the far ends."""

    title = "GUPFC in the middle of a double-circuit line"
    bounds = (0.0, 0.0, 680.0, 390.0)

    def setup(self) -> None:
        """What the device tells of itself, and what it shall do."""
        names = ("p1", "q1", "p2", "q2", "v1", "v_dc", "p_sh", "p12", "p34", "v12", "v34")
        self.s = {name: self.quantity("status", f"{name}/position") for name in names}
        self.wanted = {}
        for k in (1, 2):
            for name in "pq":
                self.wanted[f"{name}{k}"] = self._reference(k, name)
        self.dc = self.quantity("dc_link", "voltage/position")

    def _reference(self, circuit: int, name: str) -> Quantity:
        topic = f"series_{circuit}/reference"
        return self.signal(next((t for t in self.rig.topics if t.endswith(topic)), ""), f"{name}/position")

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Sources, buses, lines, converters, flows."""
        upper, lower, middle = 90.0, 290.0, 190.0
        for y in (upper, lower):
            pen.line([(110, y), (570, y)], "line", 2.0)
        for x, name in ((110, "A"), (570, "B")):
            bus(pen, x, 60.0, 320.0, name)
        for x, y, name in ((270, upper, "1"), (390, upper, "2"), (270, lower, "3"), (390, lower, "4")):
            bus(pen, x, y - 26.0, y + 26.0, name)
        for x, to in ((40, 110), (640, 570)):
            pen.line([(x, middle), (to, middle)], "line", 2.0)
            source(pen, (x, middle), 18.0)
        pen.line([(270, upper), (270, middle - 24)], "line", 2.0)
        for y, toward in ((upper, 1), (lower, -1)):
            pen.line([(330, y + 24 * toward), (330, middle)], "second", 3.0)
        pen.line([(294, middle), (330, middle)], "second", 3.0)
        converter(pen, (270, middle), 24.0)
        for y in (upper, lower):
            converter(pen, (330, y), 24.0)
        s = self.s
        pen.text((342, middle + 5), f"DC link {self.dc.said(row, '.0f')}", "second")
        pen.text((342, middle + 22), s["v_dc"].said(row, ".4f"), "second", 11.0)
        pen.text((262, upper + 50), s["v1"].said(row, ".4f"), "accent", anchor="end")
        for y, k, voltage in ((upper, 1, "v12"), (lower, 2, "v34")):
            below = -32 if y == upper else 42
            pen.text((330, y + below), s[voltage].said(row, ".3f"), "muted", 11.0, "middle")
            p, q = s[f"p{k}"], s[f"q{k}"]
            side = -1 if y == upper else 1
            share = held(p(row) / 1.5, 1.0) * 62.0
            pen.arrow((424, y + 16 * side), (424 + share, y + 16 * side), "accent", 3.0, 11.0)
            share = held(q(row) / 1.5, 1.0) * 62.0
            pen.arrow((424, y + 30 * side), (424 + share, y + 30 * side), "third", 3.0, 11.0)
        share = held(s["p_sh"](row) / 0.5, 1.0) * 26.0
        pen.arrow((236, middle), (236, middle - share), "second", 3.0, 11.0)
        pen.text((228, middle + 5), s["p_sh"].said(row, ".3f"), "second", anchor="end")
        for y, name in ((upper + 60, "p12"), (lower - 48, "p34")):
            pen.text((338, y), s[name].said(row, ".3f"), "second", 11.0)
        for x, k in ((60, 1), (390, 2)):
            rows = []
            for name, role, text in (("p", "accent", "P"), ("q", "third", "Q")):
                wanted = self.wanted[f"{name}{k}"]
                shall = f" of {wanted.said(row, '.2f', unit='')}" if wanted.name else ""
                rows.append((f"{text} of circuit {k}", f"{s[f'{name}{k}'].said(row, '.3f')}{shall}", role))
            readings(pen, (float(x), 350.0), rows, 250.0)


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
        for x, to, name in ((40.0, self.LEFT, "S"), (600.0, self.RIGHT, "R")):
            pen.line([(x, y), (to, y)], "line", 2.0)
            source(pen, (x, y), 20.0)
            bus(pen, to, y - 36.0, y + 36.0, name)
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
        found = self.place.name in row and math.isfinite(row[self.place.name])
        mark = self._at(self.place(row)) if found else self.LEFT
        wide = 7.0 if found else 0.0
        pen.polygon([(mark, y + 42), (mark - wide, y + 42 - 1.6 * wide), (mark + wide, y + 42 - 1.6 * wide)],
                    "third", "third", 0)  # fmt: skip
        pen.text((320, 28), f"located at {self.place.said(row, '.3f')}" if found else "", "third", 14.0, "middle")
        for left, end in ((30.0, "s"), (340.0, "r")):
            for top, which, name, full in ((196.0, 0, "Voltages", self.volts), (286.0, 1, "Currents", 8000.0)):
                values = self.ends[end][which]
                pen.text(
                    (left, top - 5), f"{name} at {end.upper()}, ±{full / 1e3:.0f} k{values[0].unit}", "muted", 12.0
                )
                scope(pen, (left, top, 270.0, 66.0), past, row, [(q, r) for q, (_, r) in zip(values, PHASES)], full)

    def _at(self, km: float) -> float:
        return self.LEFT + (self.RIGHT - self.LEFT) * min(max(km / self.length, 0.0), 1.0)


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

        def at(power: float) -> float:
            return foot - self.HEIGHT * min(max(power / top, 0.0), 1.0)

        for k in range(5):
            y = at(top * k / 4)
            pen.line([(self.LEFT, y), (self.LEFT + self.WIDTH, y)], "faint", 1.0)
            pen.text((self.LEFT - 6, y + 4), f"{top * k / 4:.0f}", "muted", 10.0, "end")
        pen.text((self.LEFT - 6, self.TOP - 14), self.total.unit, "muted", 11.0, "end")
        for k, name in enumerate(self.names):
            x = self.LEFT + step * (k + 0.5) - wide / 2
            pen.box(x, at(self.high[k]), wide, at(self.low[k]) - at(self.high[k]), "muted", "paper", 1.0)
            pen.box(x, foot, wide, at(self.outputs[k](row)) - foot, "accent", "accent", 0)
            pen.line([(x - 2, at(self.wanted[k](row))), (x + wide + 2, at(self.wanted[k](row)))], "second", 2.0)
            pen.text((x + wide / 2, foot + 15), name if n <= 20 or k % 2 == 0 else "", "muted", 10.0, "middle")
        full = max(sum(self.high), 1.0)
        pen.box(self.LEFT, 276.0, self.WIDTH, 14.0, "muted", "paper", 1.0)
        pen.box(self.LEFT, 276.0, self.WIDTH * held(self.total(row) / full, 1.0), 14.0, "accent", "accent", 0)
        x = self.LEFT + self.WIDTH * min(max(self.demand(row) / full, 0.0), 1.0)
        pen.line([(x, 270.0), (x, 296.0)], "alarm", 3.0)
        rows = [("Output of all units", self.total.said(row, ",.2f"), "accent")]
        rows += [("Demand", self.demand.said(row, ",.2f"), "alarm")] if self.demand.name else []
        readings(pen, (self.LEFT, 322.0), rows, 260.0)
        readings(pen, (350.0, 322.0), [("Cost", self.cost.said(row, ",.2f"), "line")], 260.0)
