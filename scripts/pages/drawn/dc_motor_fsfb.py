"""Step responses with and without state feedback, with the rise times that the paper states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from softrig_core import simulate

POSITION = "axis/state/axis/position"
PUBLISHED = {"without controller": ("dc_motor_fsfb_s7_baseline0", 4.013), "state feedback": ("dc_motor_fsfb_s7", 0.966)}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axis = figure.subplots()
    for k, (name, (scenario, rise)) in enumerate(PUBLISHED.items()):
        t, y = simulate(scenario).signals[POSITION]
        t, y = t[t <= 7.0], y[t <= 7.0]  # the record in the paper ends here
        y = y / y[-1]
        tenth = float(np.interp(0.1, y, t))
        axis.plot(t, y, f"C{k}", lw=1.2, label=f"{name}, here")
        axis.plot([tenth + rise], [0.9], "o", color=f"C{k}", mfc="none", ms=8, label=f"{name}, published rise time")
    axis.axhline(0.9, color="0.8", lw=0.6)
    axis.set_xlabel("time, s")
    axis.set_ylabel("position, of the last one in 7 s")
    axis.legend(fontsize=8, loc="lower right")
    figure.savefig(folder / "dc_motor_fsfb_published.png", dpi=110)
