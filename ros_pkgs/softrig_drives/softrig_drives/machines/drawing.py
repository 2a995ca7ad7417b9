"""A three-phase machine: currents in the stator's slots, the rotor, the current vector, the legs of the inverter."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen, Point, polar

from ..stator import CENTRE, PHASES, draw_stator

ROTOR = 106.0


class MachineDrawing(Drawing):
    """Cross-section with one pair of poles: the rotor turns by its electrical angle, as the current vector does."""

    title = "Three-phase machine: stator currents, rotor, duty ratios"

    def setup(self) -> None:
        """Shaft, currents, duty ratios, reference."""
        self.angle, self.speed, self.torque = (
            self.quantity("joint_states", f"shaft/{field}") for field in ("position", "velocity", "effort")
        )
        self.currents = [self.quantity("currents", axis) for axis in "xyz"]
        duties = "applied" if any(port.name == "applied" for port in self.plant.outputs) else "gates"
        self.duties = [self.quantity(duties, f"{name}/effort") for name in "abc"]
        self.voltage = self.quantity("dc_link", "voltage/position")
        self.pairs = self.p.pole_pairs
        self.full = 0.5 * self.p.trip_current
        self.magnet = getattr(self.p, "psi_f", 0.0) > 0.0 or hasattr(self.p, "k_e")

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Stator, rotor, current vector, then the inverter and the values."""
        a, b, c = currents = [limited(q(row) / self.full, 1.0) for q in self.currents]
        draw_stator(pen, currents, 10.0)
        self._rotor(pen, row)
        tip = (CENTRE[0] + ROTOR * (2 * a - b - c) / 3, CENTRE[1] - ROTOR * (b - c) / math.sqrt(3.0))
        pen.arrow(CENTRE, tip, "alarm", 3.5, 14.0)
        self._inverter(pen, row)
        rows = [("Speed", self.speed.text_of(row, ".1f"), "line"), ("Torque", self.torque.text_of(row, ".2f"), "line")]
        rows += [("DC voltage", self.voltage.text_of(row, ".0f"), "line")]
        rows += [
            (f"Current {name}", q.text_of(row, "+.1f"), role)
            for (name, role), q in zip(PHASES, self.currents, strict=True)
        ]
        readings(pen, (400.0, 196.0), rows, 210.0)

    def _rotor(self, pen: Pen, row: Row) -> None:
        turn = self.pairs * self.angle(row)
        pen.circle(CENTRE, ROTOR, "line", "faint")
        for side, role in ((0.0, "accent"), (math.pi, "second")):
            if self.magnet:
                pen.polygon([self._at(r, turn + side + w) for r, w in self._pole()], role, role, 0)
            else:  # the iron of the direct axis
                pen.line([CENTRE, self._at(ROTOR - 4.0, turn + side)], "muted", 26.0)
        pen.circle(CENTRE, 13.0, "line", "muted", 1.0)

    @staticmethod
    def _pole() -> list[tuple[float, float]]:
        arc = [-0.9 + 0.15 * k for k in range(13)]
        return [(ROTOR - 2.0, w) for w in arc] + [(ROTOR - 22.0, w) for w in reversed(arc)]

    @staticmethod
    def _at(radius: float, angle: float) -> Point:
        return polar(CENTRE, radius, angle)

    def _inverter(self, pen: Pen, row: Row) -> None:
        """Each leg as a bar: the share of the time at the upper rail."""
        left, top, bottom = 420.0, 50.0, 140.0
        pen.text((400.0, 28.0), "Inverter: duty ratios", "muted")
        pen.line([(left - 20, top), (left + 170, top)], "line", 2.0)
        pen.line([(left - 20, bottom), (left + 170, bottom)], "line", 2.0)
        for k, ((name, role), duty) in enumerate(zip(PHASES, self.duties, strict=True)):
            x, height = left + 10 + 60 * k, (bottom - top) * max(limited(duty(row), 1.0), 0.0)
            pen.box(x - 10, bottom - height, 20, height, role, role, 0)
            pen.text((x + 16, (top + bottom) / 2 + 5), name, role)
