"""Step responses of both laws of the ideal simulation, with the numbers of the paper's Table II."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from softrig_core import simulate

SPEED = "motor/state/shaft/velocity"
# Table II: rise time (10 to 90 %) and settling time (2 %) in s, overshoot as a part of the step.
PUBLISHED = {
    "sliding mode": ("dc_motor_smc", 0.6070, 1.0899, 0.0),
    "PID": ("dc_motor_smc_a3", 0.1830, 1.0014, 0.224793),
}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    axis = figure.subplots()
    for k, (law, (scenario, rise, settling, overshoot)) in enumerate(PUBLISHED.items()):
        t, speed = simulate(scenario).signals[SPEED]
        axis.plot(t, speed, f"C{k}", lw=1.2, label=f"{law}, here")
        top = int(np.argmax(speed))
        tenth = float(np.interp(0.1, speed[: top + 1], t[: top + 1]))
        points = [(tenth + rise, 0.9), (settling, 0.98)]
        if overshoot:
            points.append((float(t[top]), 1.0 + overshoot))
        axis.plot(*zip(*points, strict=True), "o", color=f"C{k}", mfc="none", ms=8, label=f"{law}, Table II")
    axis.axhspan(0.98, 1.02, color="0.9", lw=0)
    axis.axhline(0.9, color="0.8", lw=0.6)
    axis.set_xlim(0.0, 1.6)
    axis.set_xlabel("time, s")
    axis.set_ylabel("speed, of the step")
    axis.legend(fontsize=8, loc="lower right")
    figure.savefig(folder / "dc_motor_smc_published.png", dpi=110)
