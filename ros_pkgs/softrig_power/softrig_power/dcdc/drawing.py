"""The converter: source, switch, inductor, diode, capacitor and load, with the voltages and currents on them."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen
from softrig_core.drawing.symbols import inductor, resistor, source

TOP, BOTTOM = 80.0, 240.0


class Converter(Drawing):
    """Circuit of the buck or the boost converter; the duty ratio as a bar at the switch."""

    title = "DC/DC converter"

    def setup(self) -> None:
        """Voltages, current, duty ratio."""
        self.v_out = self.quantity("converter", "v_out/position")
        self.current = self.quantity("converter", "i_mean/position")
        self.v_in = self.quantity("converter", "v_in/position")
        self.duty = self.quantity("duty", "switch/effort")
        self.boost = self.p.topology == "boost"

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Circuit from left to right, then the values."""
        pen.line([(70, 130), (70, TOP), (130, TOP)])
        pen.line([(70, 190), (70, BOTTOM), (520, BOTTOM)])
        source(pen, (70, 160), 30.0, dc=True)
        coil, contact = ((130.0, 220.0), 270.0) if self.boost else ((270.0, 360.0), 160.0)
        inductor(pen, (coil[0], TOP), (coil[1], TOP))
        if self.boost:
            pen.line([(220, TOP), (520, TOP)])
            pen.line([(contact, TOP), (contact, 130)])
            pen.line([(contact, 190), (contact, BOTTOM)])
            pen.polygon([(320, TOP - 12), (320, TOP + 12), (344, TOP)], "line", "line", 1.0)
            pen.line([(344, TOP - 12), (344, TOP + 12)], "line", 2.0)
            corner = (contact - 10, 190.0)
        else:
            pen.line([(130, TOP), (140, TOP)])
            pen.line([(200, TOP), (270, TOP)])
            pen.line([(360, TOP), (520, TOP)])
            pen.line([(235, TOP), (235, BOTTOM)])
            pen.polygon([(223, 172), (247, 172), (235, 148)], "line", "line", 1.0)
            pen.line([(223, 148), (247, 148)], "line", 2.0)
            corner = (contact, TOP + 30)
        share = limited(self.duty(row), 1.0)
        pen.box(corner[0], corner[1], 20, -60, "muted", "", 1.0)
        pen.box(corner[0], corner[1], 20, -60 * max(share, 0.0), "second", "second", 0)
        pen.line([(430, TOP), (430, 150)])
        pen.line([(414, 150), (446, 150)], "line", 3.0)
        pen.line([(414, 160), (446, 160)], "line", 3.0)
        pen.line([(430, 160), (430, BOTTOM)])
        pen.line([(520, TOP), (520, 120)])
        resistor(pen, (520, 120), (520, 200))
        pen.line([(520, 200), (520, BOTTOM)])
        size = limited(self.current(row) / 10.0, 1.0)
        middle = 0.5 * (coil[0] + coil[1])
        pen.arrow((middle - 22 * size, TOP - 26), (middle + 22 * size, TOP - 26), "accent", 2.5)
        rows = [
            ("Output", self.v_out.text_of(row, ".2f"), "line"),
            ("Current, mean", self.current.text_of(row, ".2f"), "accent"),
        ]
        rows += [
            ("Input", self.v_in.text_of(row, ".1f"), "muted"),
            ("Duty ratio", self.duty.text_of(row, ".3f"), "second"),
        ]
        readings(pen, (70.0, 280.0), rows, 260.0, 21.0)
