"""Power of the string under each search with one seed, with power and tracking time of the paper's Table III."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from softrig_core import simulate

POWER = "converter/state/p_in/position"
# Table III, first pattern: published power (W) and tracking time (s).
PUBLISHED = {
    "ISSA": ("pv_mppt", 115.59, 1.22),
    "SSA": ("pv_mppt_ssa", 115.58, 1.35),
    "PSO": ("pv_mppt_pso", 115.56, 1.53),
    "DE": ("pv_mppt_de", 115.45, 1.76),
    "FA": ("pv_mppt_fa", 115.52, 2.92),
    "P&O": ("pv_mppt_perturb_observe", 108.5, 0.76),
}


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    figure = Figure(figsize=(9.0, 4.2), layout="constrained")
    axes = figure.subplots(2, 3, sharex=True, sharey=True)
    for axis, (search, (scenario, power, tracked)) in zip(axes.flat, PUBLISHED.items(), strict=True):
        run = simulate(scenario)
        axis.plot(*run.signals[POWER], lw=0.7, label="here, one seed")
        axis.plot([tracked], [power], "o", color="C3", mfc="none", ms=8, label="published")
        axis.axhline(run.figures["gmpp"], color="k", lw=0.6, ls="--", label="maximum")
        axis.set_title(search, fontsize=9)
        axis.set_ylim(0.0, 130.0)
    axes[0, 2].legend(fontsize=7, loc="lower right")
    for axis in axes[1]:
        axis.set_xlabel("time, s")
    for row in axes:
        row[0].set_ylabel("power, W")
    figure.savefig(folder / "pv_mppt_published.png", dpi=110)
