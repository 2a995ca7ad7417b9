"""The linear switched reluctance motor: the translator between the stator's teeth, seen from the translator."""

from __future__ import annotations

import math
from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.shapes import Pen

from .markers import DEPTH, GAP, HALF_BODY, STATOR_POLE, TRANSLATOR_PITCH, TRANSLATOR_POLE

SCALE = 2250.0  # units a metre
AXIS = 128.0  # y of the middle
LEFT, RIGHT = 20.0, 620.0
MIDDLE = 320.0
PHASES = (("a", "accent"), ("b", "second"), ("c", "third"), ("d", "fourth"))
TEETH = 7  # on each side; one more than is seen comes in while one goes out


class ReluctanceMotor(Drawing):
    """The stator passes the translator, whose poles a to d lie 39 mm apart over a pitch of 52 mm."""

    title = "Linear switched reluctance motor: translator, stator teeth and phase currents"
    bounds = (0.0, 0.0, 640.0, 400.0)

    def setup(self) -> None:
        """Motion, currents, forces, reference and load."""
        motion = [self.quantity("joint_states", f"translator/{field}") for field in ("position", "velocity", "effort")]
        self.position, self.speed, self.force = motion
        self.currents = [self.quantity("phase_currents", f"{name}/position") for name, _ in PHASES]
        self.reference = self.quantity("reference", "translator/velocity")
        self.mass = self.quantity("load", "mass/effort")
        self.pitch = self.p.tau
        self.full = self.p.trip_current

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Stator, translator, then currents and values."""
        x = self.position(row)
        self._stator(pen, x)
        self._translator(pen, row)
        self._currents(pen, row)
        rows = [
            ("Position", self.position.text_of(row, ".4f"), "line"),
            ("Speed", self.speed.text_of(row, ".3f"), "line"),
        ]
        rows += [("Reference", self.reference.text_of(row, ".3f"), "reference")] if self.reference.name else []
        rows += [("Force", self.force.text_of(row), "line")]
        rows += [("Load", self.mass.text_of(row), "line")] if self.mass.name else []
        readings(pen, (400.0, 290.0), rows, 210.0)

    def _stator(self, pen: Pen, x: float) -> None:
        """Draw two yokes with their teeth, which move to the left when the translator moves to the right."""
        near, depth = (HALF_BODY + GAP) * SCALE, DEPTH * SCALE
        pole, pitch = STATOR_POLE * SCALE, self.pitch * SCALE
        # the tooth pattern is at pole a when it is aligned; it repeats with each pitch
        first = self._place(0) - (x % self.pitch) * SCALE
        first -= math.floor((self._place(0) - LEFT) / pitch) * pitch
        for side in (-1.0, 1.0):
            inner, outer = AXIS + side * near, AXIS + side * (near + depth * 0.62)
            back = AXIS + side * (near + depth)
            for n in range(TEETH):
                left = min(max(first + n * pitch - pole / 2, LEFT), RIGHT)
                right = min(max(first + n * pitch + pole / 2, LEFT), RIGHT)
                pen.polygon([(left, outer), (left, inner), (right, inner), (right, outer)], "muted", "faint", 1.2)
            pen.polygon([(LEFT, outer), (RIGHT, outer), (RIGHT, back), (LEFT, back)], "muted", "faint", 1.2)
            pen.line([(LEFT, outer), (RIGHT, outer)], "faint", 2.5)  # teeth and yoke are one

    def _place(self, pole: int) -> float:
        return MIDDLE + (pole - 1.5) * TRANSLATOR_PITCH * SCALE

    def _translator(self, pen: Pen, row: Row) -> None:
        half, tip, wide = HALF_BODY / 2 * SCALE, HALF_BODY * SCALE, TRANSLATOR_POLE * SCALE
        left, right = self._place(0) - 44.0, self._place(3) + 44.0
        for k, (_, role) in enumerate(PHASES):
            share = limited(self.currents[k](row) / self.full, 1.0)
            for side in (-1.0, 1.0):
                centre = self._place(k)
                for x in (centre - wide / 2 - 13.0, centre + wide / 2):
                    y = AXIS + side * half
                    pen.box(x, y, 13.0, side * (tip - half - 4.0), role, "paper", 1.0)
                    pen.box(x, y, 13.0, side * (tip - half - 4.0) * abs(share), role, role, 0)
                pen.box(centre - wide / 2, AXIS + side * (half - 1.0), wide, side * (tip - half + 1.0), "line", "faint")
        pen.box(left, AXIS - half, right - left, 2 * half, "line", "faint")
        for k, (name, role) in enumerate(PHASES):
            pen.line(
                [(self._place(k) - wide / 2 + 1.2, AXIS - half), (self._place(k) + wide / 2 - 1.2, AXIS - half)],
                "faint",
                3.0,
            )
            pen.line(
                [(self._place(k) - wide / 2 + 1.2, AXIS + half), (self._place(k) + wide / 2 - 1.2, AXIS + half)],
                "faint",
                3.0,
            )
            pen.text((self._place(k), AXIS - 2.0), name, role, 15.0, "middle")
        push = limited(self.force(row) / 40.0, 1.0) * 110.0
        pen.arrow((MIDDLE, AXIS + 11.0), (MIDDLE + push, AXIS + 11.0), "alarm", 4.0, 13.0)

    def _currents(self, pen: Pen, row: Row) -> None:
        pen.text((30.0, 268.0), "Phase currents", "muted")
        for k, ((name, role), current) in enumerate(zip(PHASES, self.currents, strict=True)):
            y = 290.0 + 22.0 * k
            pen.text((30.0, y), name, role)
            pen.box(50.0, y - 11.0, 200.0, 12.0, "muted", "paper", 1.0)
            pen.box(50.0, y - 11.0, 200.0 * limited(abs(current(row)) / self.full, 1.0), 12.0, role, role, 0)
            pen.text((330.0, y), current.text_of(row, ".2f"), role, anchor="end")
