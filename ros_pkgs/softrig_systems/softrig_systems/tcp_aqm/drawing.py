"""The bottleneck of a TCP network."""

from __future__ import annotations

from collections.abc import Sequence

from softrig_core.drawing.base import Drawing, Row, limited, readings
from softrig_core.drawing.scope import scope
from softrig_core.drawing.shapes import Pen

CELLS = 40


class Bottleneck(Drawing):
    """Senders whose windows fill a queue, the packets that are dropped before it, the link that empties it."""

    title = "TCP senders, bottleneck queue and link"
    trail = 10.0
    LEFT, WIDTH, Y, HEIGHT = 220.0, 280.0, 90.0, 64.0

    def setup(self) -> None:
        """Name window and queue, drops, and references."""
        self.window, self.queue, self.rtt = (
            self.quantity("state", f"{name}/position") for name in ("window", "queue", "rtt")
        )
        self.dropped = self.quantity("command", "drop_probability/effort")
        self.wanted = self.quantity("reference", "queue/effort")
        self.flows = self.quantity("events", "flows/effort", float(self.p.N))
        self.capacity = self.quantity("events", "capacity/effort", float(self.p.C))
        self.full = float(self.p.q_max)
        self.w_max = float(self.p.w_max)

    def draw(self, pen: Pen, row: Row, past: Sequence[Row]) -> None:
        """Senders, queue, link; below the queue over time and values."""
        middle = self.Y + self.HEIGHT / 2
        share = limited(self.window(row) / self.w_max, 1.0)
        for k in range(5):
            y = 42.0 + 38.0 * k
            pen.line([(72, y + 9), (self.LEFT - 46, middle)], "muted", 1.2)
            pen.box(30, y, 42, 18, "line", "faint", 1.5)
            pen.box(30, y, 42 * share, 18, "third", "third", 0)
        pen.text((30, 30), f"{self.flows(row):.0f} senders", "muted")
        drop = min(max(self.dropped(row), 0.0), 1.0)
        pen.arrow((self.LEFT - 46, middle), (self.LEFT - 4, middle), "line", 2.0)
        # half of a full arrow stands for a drop probability of 5 %
        pen.arrow((self.LEFT - 30, middle), (self.LEFT - 30, middle + 70.0 * drop / (drop + 0.05)), "alarm", 3.0)
        pen.text((self.LEFT - 22, middle + 64), f"dropped {self.dropped.text_of(row, '.4f')}", "alarm")
        pen.box(self.LEFT, self.Y, self.WIDTH, self.HEIGHT, "line", "paper", 2.0)
        filled = limited(self.queue(row) / self.full, 1.0)
        cell = self.WIDTH / CELLS
        for k in range(CELLS):  # the head of the queue is at the link
            fill = min(max(filled * CELLS - k, 0.0), 1.0)
            right = self.LEFT + self.WIDTH - cell * k - 1.0
            pen.box(right, self.Y + 6, -(cell - 2.0) * fill, self.HEIGHT - 12, "accent", "accent", 0)
        x = self.LEFT + self.WIDTH * (1.0 - limited(self.wanted(row) / self.full, 1.0))
        if self.wanted.name:
            pen.line([(x, self.Y - 12), (x, self.Y + self.HEIGHT + 12)], "reference", 2.0, dashed=True)
        pen.arrow((self.LEFT + self.WIDTH, middle), (610, middle), "line", 3.0, 12.0)
        pen.text(
            (614, middle - 14), f"{self.capacity(row):.0f} {self.capacity.unit or 'packet/s'}", "muted", anchor="end"
        )
        pen.text((self.LEFT, self.Y - 18), "Queue", "muted")
        pen.text((self.LEFT + self.WIDTH, self.Y - 18), self.queue.text_of(row), "accent", 15.0, "end")
        pen.text((30, 246), f"Queue of the last {self.trail:g} s, 0 to {self.full:.0f} {self.queue.unit}", "muted")
        half = self.full / 2
        curves = [(lambda r: self.wanted(r) - half, "reference")] if self.wanted.name else []
        scope(pen, (30, 254, 340, 90), past, row, [*curves, (lambda r: self.queue(r) - half, "accent")], half, 120)
        rows = [("Window of each", self.window.text_of(row, ".2f"), "third")]
        rows += [("Round trip", self.rtt.text_of(row, ".3f"), "line")]
        rows += [("Set point", self.wanted.text_of(row), "reference")] if self.wanted.name else []
        readings(pen, (400.0, 276.0), rows, 210.0)
