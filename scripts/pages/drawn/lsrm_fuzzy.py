"""The dips of the speed when 8 kg are put on, with those of the paper's Table III."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from softrig_core import simulate

CRUISE = 0.5  # m/s
SPEED = "joint_states/translator/velocity"
# Table III, full load: overshoot in %, that is, the dip below 0.5 m/s.
PUBLISHED = {"fuzzy": ("lsrm_fuzzy_n2", 2.8), "MRAC": ("lsrm_fuzzy_n2_mrac", 3.0), "PI": ("lsrm_fuzzy_n2_pi", 6.0)}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axis = figure.subplots()
    for k, (law, (scenario, dip)) in enumerate(PUBLISHED.items()):
        t, speed = simulate(scenario).signals[SPEED]
        late = t > 1.0
        t, speed = t[late], speed[late]
        axis.plot(t, speed, f"C{k}", lw=1.0, label=f"{law}, here")
        at = float(t[int(np.argmin(speed[t < 1.3]))])
        axis.plot([at], [CRUISE * (1.0 - dip / 100.0)], "o", color=f"C{k}", mfc="none", ms=8, label=f"{law}, Table III")
    axis.set_xlim(0.99, 1.5)
    axis.set_xlabel("time, s")
    axis.set_ylabel("speed, m/s")
    axis.legend(fontsize=8, ncols=3, loc="lower right")
    figure.savefig(folder / "lsrm_fuzzy_dips.png", dpi=110)
