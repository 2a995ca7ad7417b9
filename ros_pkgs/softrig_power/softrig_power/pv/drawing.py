"""The photovoltaic string with its converter."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.scope import plane
from softrig_core.drawing.shapes import Pen, polar
from softrig_core.drawing.symbols import diode, resistor

FULL_SUN = 1000.0  # W/m^2


class PvString(Drawing):
    """Modules as bright as their sun, bypass diodes, converter, load; where the string works, power over voltage."""

    title = "Photovoltaic string, converter and load"
    bounds = (0.0, 0.0, 640.0, 380.0)
    trail = 5.0

    def setup(self) -> None:
        """Sun on each module, string, converter, duty."""
        self.start = self.p.irradiance
        self.sun = [self.quantity("environment", f"g{k}/position", g) for k, g in enumerate(self.start, 1)]
        self.v, self.i_l, self.v_out, self.power = (
            self.quantity("converter", f"{name}/position") for name in ("v_in", "i_L", "v_out", "p_in")
        )
        self.current = self.quantity("port", "current/position")
        self.duty = self.quantity("duty", "duty/effort")
        module = self.p.module
        self.v_full = 1.05 * len(self.sun) * module.V_oc
        self.p_full = 0.8 * len(self.sun) * module.V_oc * module.I_sc

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """String on the left, converter above, plane and values below."""
        n = len(self.sun)
        high = 264.0 / n
        pen.line([(104, 40), (104, 30), (300, 30)], "line", 2.0)
        pen.line([(104, 40 + high * n), (104, 322), (300, 322)], "line", 2.0)
        for k, sun in enumerate(self.sun):
            y = 40.0 + high * k
            share = min(max(sun(row) / FULL_SUN, 0.0), 1.2)
            pen.line([(104, y), (104, y + high)], "line", 2.0)
            pen.box(72, y + 5, 64, high - 10, "line", "faint", 1.5)
            pen.box(72, y + high - 5, 64, -(high - 10) * min(share, 1.0), "accent", "accent", 0)
            for j in range(1, 4):
                pen.line([(72 + 16 * j, y + 5), (72 + 16 * j, y + high - 5)], "paper", 1.0)
            pen.line([(104, y + 2), (160, y + 2), (160, y + 8)], "muted", 1.2)
            pen.line([(104, y + high - 2), (160, y + high - 2), (160, y + high - 8)], "muted", 1.2)
            diode(pen, (160, y + high - 8), (160, y + 8), "muted", 7.0)
            middle = (36.0, y + high / 2 - 4)
            radius = 5.0 + 6.0 * share
            pen.circle(middle, radius, "second", "second", 0)
            for j in range(8):
                angle = math.pi * j / 4
                pen.line(
                    [polar(middle, radius + 2, angle), polar(middle, radius + 2 + 5 * share, angle)], "second", 1.5
                )
            pen.text((36.0, y + high - 4), sun.text_of(row, ".0f"), "muted", 10.0, "middle")
        pen.box(300, 80, 90, 190, "line", "faint", 2.0)
        pen.text((345, 130), "buck-", "line", 14.0, "middle")
        pen.text((345, 148), "boost", "line", 14.0, "middle")
        pen.text((345, 190), "duty", "muted", anchor="middle")
        pen.box(310, 200, 70, 10, "muted", "paper", 1.0)
        pen.box(310, 200, 70 * limited(self.duty(row), 1.0), 10, "third", "third", 0)
        pen.text((345, 232), self.duty.text_of(row, ".4f"), "third", 13.0, "middle")
        pen.line([(300, 30), (320, 30), (320, 80)], "line", 2.0)
        pen.line([(300, 322), (320, 322), (320, 270)], "line", 2.0)
        pen.line([(370, 80), (370, 30), (420, 30), (420, 130)], "line", 2.0)
        pen.line([(370, 270), (370, 322), (420, 322), (420, 220)], "line", 2.0)
        resistor(pen, (420, 130), (420, 220), half=11.0)
        share = limited(self.current(row) / 4.0, 1.0) * 26.0
        pen.arrow((240 - share, 20), (240 + share, 20), "second", 2.5)
        pen.text((240, 50), self.current.text_of(row, ".3f"), "second", anchor="middle")
        pen.text((230, 180), self.v.text_of(row, ".2f"), "accent", 15.0, "middle")
        pen.text((446, 60), "Power over voltage", "muted")
        plane(pen, (446, 68, 174, 116), past, row, self.v, self.power, (0.0, self.v_full, 0.0, self.p_full))
        pen.text((446, 198), f"0 V … {self.v_full:.0f} V", "muted", 11.0)
        pen.text((620, 198), f"0 W … {self.p_full:.0f} W", "muted", 11.0, "end")
        rows = [("Power", self.power.text_of(row), "line"), ("Voltage", self.v.text_of(row, ".2f"), "accent")]
        rows += [("Current", self.current.text_of(row, ".3f"), "second")]
        rows += [("Inductor", self.i_l.text_of(row, ".2f"), "line"), ("Output", self.v_out.text_of(row, ".2f"), "line")]
        readings(pen, (446.0, 230.0), rows, 174.0)
