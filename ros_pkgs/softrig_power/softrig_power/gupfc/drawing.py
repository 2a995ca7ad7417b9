"""The line with its GUPFC."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Quantity, Row, limited, readings
from softrig_core.drawing.shapes import Pen
from softrig_core.drawing.symbols import bus, converter, source


class Gupfc(Drawing):
    """One line of both circuits: bus voltages, series and shunt converters on their DC link, power at the far ends."""

    title = "GUPFC in the middle of a double-circuit line"
    bounds = (0.0, 0.0, 680.0, 390.0)

    def setup(self) -> None:
        """Read the device's reports and its commands."""
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
        for x, x_end in ((40, 110), (640, 570)):
            pen.line([(x, middle), (x_end, middle)], "line", 2.0)
            source(pen, (x, middle), 18.0)
        pen.line([(270, upper), (270, middle - 24)], "line", 2.0)
        for y, toward in ((upper, 1), (lower, -1)):
            pen.line([(330, y + 24 * toward), (330, middle)], "second", 3.0)
        pen.line([(294, middle), (330, middle)], "second", 3.0)
        converter(pen, (270, middle), 24.0)
        for y in (upper, lower):
            converter(pen, (330, y), 24.0)
        s = self.s
        pen.text((342, middle + 5), f"DC link {self.dc.text_of(row, '.0f')}", "second")
        pen.text((342, middle + 22), s["v_dc"].text_of(row, ".4f"), "second", 11.0)
        pen.text((262, upper + 50), s["v1"].text_of(row, ".4f"), "accent", anchor="end")
        for y, k, voltage in ((upper, 1, "v12"), (lower, 2, "v34")):
            below = -32 if y == upper else 42
            pen.text((330, y + below), s[voltage].text_of(row, ".3f"), "muted", 11.0, "middle")
            p, q = s[f"p{k}"], s[f"q{k}"]
            side = -1 if y == upper else 1
            share = limited(p(row) / 1.5, 1.0) * 62.0
            pen.arrow((424, y + 16 * side), (424 + share, y + 16 * side), "accent", 3.0, 11.0)
            share = limited(q(row) / 1.5, 1.0) * 62.0
            pen.arrow((424, y + 30 * side), (424 + share, y + 30 * side), "third", 3.0, 11.0)
        share = limited(s["p_sh"](row) / 0.5, 1.0) * 26.0
        pen.arrow((236, middle), (236, middle - share), "second", 3.0, 11.0)
        pen.text((228, middle + 5), s["p_sh"].text_of(row, ".3f"), "second", anchor="end")
        for y, name in ((upper + 60, "p12"), (lower - 48, "p34")):
            pen.text((338, y), s[name].text_of(row, ".3f"), "second", 11.0)
        for x, k in ((60, 1), (390, 2)):
            rows = []
            for name, role, text in (("p", "accent", "P"), ("q", "third", "Q")):
                wanted = self.wanted[f"{name}{k}"]
                shall = f" of {wanted.text_of(row, '.2f', unit='')}" if wanted.name else ""
                rows.append((f"{text} of circuit {k}", f"{s[f'{name}{k}'].text_of(row, '.3f')}{shall}", role))
            readings(pen, (float(x), 350.0), rows, 250.0)
