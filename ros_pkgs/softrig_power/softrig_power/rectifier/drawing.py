"""The three-phase rectifier: grid, filter, converter, DC link and load."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.scope import scope
from softrig_core.drawing.shapes import Pen
from softrig_core.drawing.symbols import capacitor, converter, inductor, meter, resistor, source

PHASES = (("a", "x", "accent"), ("b", "y", "second"), ("c", "z", "third"))


class Rectifier(Drawing):
    """One line a phase into the converter; the DC voltage as a meter with its operating point dashed."""

    title = "Three-phase rectifier: grid currents, converter and DC link"
    trail = 2.0 / 50.0

    def setup(self) -> None:
        """Voltages and currents of both sides, load, command."""
        self.currents = [self.quantity("grid_current", axis) for _, axis, _ in PHASES]
        self.voltages = [self.quantity("grid_voltage", axis) for _, axis, _ in PHASES]
        self.v_dc, self.i_dc = (self.quantity("dc_link", f"{name}/position") for name in ("voltage", "current"))
        self.load = self.quantity("events", "load_resistance/position", self.p.R_L)
        self.command = next(
            (q for n in ("v_drop", "i_ref") if (q := self.quantity("command", f"{n}/effort")).name), None
        )
        self.v_g, self.v_ref = self.p.V_g, self.p.v_ref
        # twice the peak current at the operating point: the load may be doubled
        self.i_full = 2.2 * 2.0 * self.v_ref**2 / self.p.R_L / (3.0 * self.v_g)
        self.trail = 2.0 / self.p.f

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Circuit on top, waveforms and values below."""
        for k, ((name, _, role), current) in enumerate(zip(PHASES, self.currents, strict=True)):
            y = 52.0 + 44.0 * k
            pen.line([(46, y), (270, y)], role, 2.0)
            source(pen, (46, y), 16.0, role=role)
            pen.text((70, y - 7), name, role)
            inductor(pen, (120, y), (170, y), role)
            share = limited(current(row) / self.i_full, 1.0) * 22.0
            pen.arrow((220 - share, y - 12), (220 + share, y - 12), role, 2.0)
        pen.line([(46, 52), (46, 140)], "muted", 1.0)
        pen.text((145, 30), "L, R", "muted", anchor="middle")
        pen.line([(330, 62), (560, 62)], "line", 2.0)
        pen.line([(330, 134), (560, 134)], "line", 2.0)
        converter(pen, (300, 96), 44.0)
        capacitor(pen, (410, 62), (410, 134))
        pen.text((434, 102), "C", "muted")
        resistor(pen, (560, 70), (560, 126))
        pen.line([(560, 62), (560, 70)])
        pen.line([(560, 126), (560, 134)])
        pen.text((578, 102), self.load.text_of(row) if self.load.name in row else f"{self.load.rest:.1f} Ω", "line")
        share = limited(self.i_dc(row) / (2.2 * self.v_ref / self.p.R_L), 1.0) * 24.0
        pen.arrow((500 - share, 48), (500 + share, 48), "fourth", 2.0)
        pen.text((500, 36), self.i_dc.text_of(row), "fourth", anchor="middle")
        scale = 80.0 / (1.5 * self.v_ref)
        meter(pen, (366, 138), (12.0, 80.0), limited(self.v_dc(row) / (1.5 * self.v_ref), 1.0), "alarm")
        pen.line([(360, 138 - scale * self.v_ref), (384, 138 - scale * self.v_ref)], "reference", 1.5, dashed=True)
        pen.text((30, 192), "Grid currents", "muted")
        scope(pen, (30, 200, 280, 66), past, row, list(zip(self.currents, [r for *_, r in PHASES])), self.i_full)
        pen.text((30, 284), "Grid voltages", "muted")
        scope(pen, (30, 290, 280, 56), past, row, list(zip(self.voltages, [r for *_, r in PHASES])), 1.2 * self.v_g)
        rows = [("DC voltage", self.v_dc.text_of(row), "alarm")]
        rows.append(("Operating point", f"{self.v_ref:.1f} {self.v_dc.unit}", "reference"))
        rows += [("Command", self.command.text_of(row, ".2f"), "line")] if self.command else []
        rows += [(f"Current {name}", q.text_of(row, "+.1f"), role) for (name, _, role), q in zip(PHASES, self.currents)]
        readings(pen, (350.0, 208.0), rows, 250.0)
