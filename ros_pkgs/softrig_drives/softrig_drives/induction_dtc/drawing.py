"""The induction motor: currents in the stator's slots, the rotor, the flux they make."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Quantity, Row, limited, readings, tail
from softrig_core.drawing.shapes import Pen, Point, polar

from ..stator import CENTRE, OUTER, PHASES, THIRD, draw_stator

ROTOR = 108.0
BARS = 14


class InductionMotor(Drawing):
    """Cross-section with one pair of poles: the rotor turns by its electrical angle, as the flux does."""

    title = "Induction motor: stator currents, rotor and stator flux"
    trail = 0.02

    def setup(self) -> None:
        """Shaft, currents, fluxes, switches."""
        shaft = [self.quantity("joint_states", f"shaft/{field}") for field in ("position", "velocity", "effort")]
        self.angle, self.speed, self.torque = shaft
        self.currents = [self.quantity("currents_true", axis) for axis in "xyz"]
        self.flux = [self.quantity("flux_true", axis) for axis in "xy"]
        self.estimate = [self.quantity("flux_estimate", axis) for axis in "xy"]
        self.switches = [self.quantity("switches", f"{name}/effort") for name in ("Sa", "Sb", "Sc")]
        self.reference = self.quantity("speed_ref", "shaft/velocity")
        self.pairs = self.p.pole_pairs
        self.rated = self.p.trip_current / 4.0  # the trip is at 4 times the rated peak
        self.full = 1.05  # Wb, at the rim of the rotor; set by what a 400 V, 50 Hz machine can have: U/w = 1.04 Wb

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Stator, rotor, vectors, then the inverter and the values."""
        self._machine(pen, row)
        self._flux(pen, row, past)
        self._inverter(pen, row)
        i = [q.text_of(row, "+.1f") for q in self.currents]
        psi = math.hypot(*(q(row) for q in self.flux))
        known = self.flux[0].name in row
        rows = [("Speed", self.speed.text_of(row), "line")]
        rows += [("Reference", self.reference.text_of(row), "reference")] if self.reference.name else []
        rows += [("Torque", self.torque.text_of(row), "line")]
        rows += [("Stator flux", f"{psi:.3f} {self.flux[0].unit}" if known else self.flux[0].text_of({}), "line")]
        rows += [(f"Current {name}", text, role) for (name, role), text in zip(PHASES, i, strict=True)]
        readings(pen, (400.0, 196.0), rows, 210.0)

    def _machine(self, pen: Pen, row: Row) -> None:
        draw_stator(pen, [limited(q(row) / self.rated, 1.6) for q in self.currents], 6.6)
        for k, (name, role) in enumerate(PHASES):
            axis = k * THIRD
            pen.line([polar(CENTRE, OUTER + 2, axis), polar(CENTRE, OUTER + 10, axis)], role, 2.0)
            point = polar(CENTRE, OUTER + 19, axis)
            pen.text((point[0], point[1] + 4.5), name, role, 14.0, "middle")
        pen.circle(CENTRE, ROTOR, "line", "faint")
        turn = self.pairs * self.angle(row)
        for bar in range(BARS):
            pen.circle(polar(CENTRE, ROTOR - 11, turn + 2.0 * math.pi * bar / BARS), 5.0, "muted", "paper", 1.0)
        mark = [polar(CENTRE, ROTOR - r, turn + w) for r, w in ((20.0, 0.0), (33.0, 0.07), (33.0, -0.07))]
        pen.polygon(mark, "muted", "muted", 0)
        pen.circle(CENTRE, 13.0, "line", "muted", 1.0)

    def _flux(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        pen.line([self._tip(r, self.flux) for r in tail(past, row, 40)], "alarm", 1.2)
        if self.estimate[0].name:
            pen.arrow(CENTRE, self._tip(row, self.estimate), "reference", 1.6)
        tip = self._tip(row, self.flux)
        pen.arrow(CENTRE, tip, "alarm", 3.5, 14.0)
        beside = polar(tip, 16.0, math.atan2(CENTRE[1] - tip[1], tip[0] - CENTRE[0]) + 1.2)
        pen.text((beside[0], beside[1] + 5), "ψ", "alarm", 16.0, "middle")

    def _tip(self, row: Row, vector: Sequence[Quantity]) -> Point:
        alpha, beta = (limited(q(row) / self.full, 1.3) for q in vector)
        return CENTRE[0] + ROTOR * alpha, CENTRE[1] - ROTOR * beta

    def _inverter(self, pen: Pen, row: Row) -> None:
        """Draw three half bridges: each phase is connected to the upper or the lower rail."""
        left, top, bottom = 420.0, 50.0, 140.0
        pen.text((400.0, 28.0), "Inverter", "muted")
        pen.line([(left - 20, top), (left + 170, top)], "line", 2.0)
        pen.line([(left - 20, bottom), (left + 170, bottom)], "line", 2.0)
        pen.text((left + 176, top + 5), "+", "muted")
        pen.text((left + 176, bottom + 5), "−", "muted")
        for k, ((name, role), switch) in enumerate(zip(PHASES, self.switches, strict=True)):
            x, middle = left + 10 + 60 * k, (top + bottom) / 2
            y_end = middle - 24 if switch(row) > 0.5 else middle + 24
            pen.line([(x, top), (x, middle - 24)], "line")
            pen.line([(x, bottom), (x, middle + 24)], "line")
            pen.circle((x, middle - 24), 3.0, "line", "paper")
            pen.circle((x, middle + 24), 3.0, "line", "paper")
            pen.line([(x + 24, middle), (x, y_end)], role, 3.0)
            pen.circle((x + 24, middle), 3.0, role, role)
            pen.text((x + 31, middle + 5), name, role)
