"""The plane of the first two states."""

from __future__ import annotations

from collections.abc import Sequence

from .base import Drawing, Row, readings
from .scope import plane, scope
from .shapes import Pen


class StatePlane(Drawing):
    """Drawing of the path of the first two states in their plane; a single state is drawn over time."""

    title = "State of a piecewise affine system with delay"
    trail = 3.0

    def setup(self) -> None:
        """Name the states, the cell and the delay."""
        port = next(p for p in self.plant.outputs if p.name == "state")
        self.names = [label.rpartition("/")[0] or label for label in port.labels if not label.endswith("/effort")]
        self.states = [self.quantity("state", label) for label in port.labels if not label.endswith("/effort")]
        self.cell, self.delay = (self.quantity("mode", f"{name}/position") for name in ("cell", "delay"))
        self.reach = 1.4 * max([*map(abs, self._start()), 1e-6])

    def _start(self) -> Sequence[float]:
        return tuple(self.p.x0)

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Draw the plane, or time, on the left and the values on the right."""
        r = self.reach
        if len(self.states) > 1:
            x, y = self.states[:2]
            plane(pen, (50.0, 24.0, 300.0, 300.0), past, row, x, y, (-r, r, -r, r), 120)
            pen.text((200.0, 344.0), self.names[0], "muted", anchor="middle")
            pen.text((40.0, 178.0), self.names[1], "muted", anchor="end")
        else:
            scope(pen, (50.0, 60.0, 330.0, 230.0), past, row, [(self.states[0], "accent")], r, 150)
            pen.text((50.0, 310.0), f"the last {self.trail:g} s", "muted")
        pen.text((54.0, 38.0), f"±{r:.3g} {self.states[0].unit}".rstrip(), "muted", 11.0)
        self.values(pen, row)

    def values(self, pen: Pen, row: Row) -> None:
        """Write states, cell and delay."""
        rows = [(n, q.text_of(row, ".4f"), "accent") for n, q in zip(self.names, self.states, strict=True)]
        rows += [("Cell", self.cell.text_of(row, ".0f"), "line")] if self.cell.name else []
        rows += [("Delay", self.delay.text_of(row, ".4f"), "line")] if self.delay.name else []
        readings(pen, (410.0, 120.0), rows, 200.0)
