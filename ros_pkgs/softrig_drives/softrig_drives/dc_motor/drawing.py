"""The DC motor: its armature circuit and its load."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen, Point, polar
from softrig_core.drawing.symbols import inductor, resistor, source

CENTRE = (470.0, 150.0)
DISC = 100.0


class DcMotor(Drawing):
    """Armature circuit, motor and a disc on its shaft that turns as the shaft does; a dashed hand for the encoder."""

    title = "DC motor: armature circuit and shaft"

    def setup(self) -> None:
        """Shaft, true and measured where they differ, voltage, current and reference."""
        true = any(p.name == "true_state" for p in self.plant.outputs)
        port = "true_state" if true else "state"
        self.angle = self.quantity(port, "shaft/position")
        self.speed = self.quantity(port, "shaft/velocity")
        self.torque = self.quantity(port, "shaft/effort")
        self.encoder = self.quantity("state", "shaft/velocity") if true else None
        self.voltage = self.quantity("applied" if true else "command", "armature/effort")
        self.current = self.quantity("sensors", "current_a/position")
        self.reference = self.quantity("reference", "shaft/velocity")
        self.full = self.p.vmax

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Circuit, disc, values."""
        top, bottom = 70.0, 230.0
        # source, resistance, inductance, motor
        pen.line([(60, 120), (60, top), (110, top)])
        resistor(pen, (110, top), (170, top))
        pen.line([(170, top), (200, top)])
        inductor(pen, (200, top), (270, top))
        pen.line([(270, top), (310, top), (310, 116)])
        pen.line([(310, 184), (310, bottom), (60, bottom), (60, 180)])
        source(pen, (60, 150), 30.0, dc=True)
        pen.circle((310, 150), 34.0, "line", "faint", 2.0)
        pen.text((310, 156), "M", "line", 18.0, "middle")
        share = limited(self.current(row) / 2.0, 1.0)
        pen.arrow((185 - 22 * share, 45), (185 + 22 * share, 45), "accent", 2.5)
        pen.text((185, 32), self.current.text_of(row, ".3f"), "accent", anchor="middle")
        pen.text((140, 98), "R", "muted", anchor="middle")
        pen.text((235, 98), "L", "muted", anchor="middle")
        pen.text((104, 155), self.voltage.text_of(row, ".2f"), "second")
        level = limited(self.voltage(row) / self.full, 1.0)
        pen.box(10, 110, 10, 80, "muted", "", 1.0)
        pen.box(10, 150, 10, -40 * level, "second", "second", 0)
        pen.line([(344, 150), CENTRE], "line", 5.0)
        turning_disc(pen, CENTRE, DISC, self.angle(row))
        speed_arc(pen, CENTRE, DISC + 14, limited(self.speed(row) / 60.0, 1.0))
        rows = [("Speed", self.speed.text_of(row, ".2f"), "line")]
        if self.encoder is not None:
            rows += [("measured by the encoder", self.encoder.text_of(row, ".2f"), "muted")]
        rows += [("Reference", self.reference.text_of(row, ".2f"), "reference")] if self.reference.name else []
        rows += [("Angle", self.angle.text_of(row, ".2f"), "line"), ("Torque", self.torque.text_of(row, ".4f"), "line")]
        readings(pen, (40.0, 264.0), rows, 250.0, 21.0)


def turning_disc(pen: Pen, centre: Point, radius: float, angle: float) -> None:
    """Draw a disc whose spokes show how far it has turned, rad."""
    pen.circle(centre, radius, "line", "faint", 2.0)
    for k in range(3):
        pen.line(
            [polar(centre, 14.0, angle + 2 * math.pi * k / 3), polar(centre, radius, angle + 2 * math.pi * k / 3)],
            "accent" if k == 0 else "muted",
            4.0 if k == 0 else 2.0,
        )
    pen.circle(polar(centre, radius - 12.0, angle), 6.0, "accent", "accent")
    pen.circle(centre, 12.0, "line", "paper", 2.0)


def speed_arc(pen: Pen, centre: Point, radius: float, share: float) -> None:
    """Draw an arc from the top in proportion to the speed, to the left for a positive speed."""
    end = math.pi / 2 + share * 0.75 * math.pi
    pen.arc(centre, radius, math.pi / 2, end, "second", 3.0)
    tip = polar(centre, radius, end)
    turn = math.copysign(math.pi / 2, share) if share else 0.0
    size = min(10.0, abs(share) * 60.0)
    ahead = polar(tip, size, end + turn)
    pen.polygon([ahead, polar(tip, 0.5 * size, end), polar(tip, -0.5 * size, end)], "second", "second", 0)
