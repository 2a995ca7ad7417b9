"""The cost of a unit, the outputs over the demand, the proofs of optimality."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from softrig_power.dispatch.branch import branch_and_bound
from softrig_power.dispatch.certify import Optimiser
from softrig_power.dispatch.units import Units


def stacked(axes: Any, units: Units, demands: Sequence[float]) -> None:
    """Draw the proven outputs of all units over the demand, one on the other."""
    optimiser = Optimiser(units)
    P = np.array([units.sorted_copies(optimiser.certified(d).P) for d in demands])
    axes.stackplot(demands, P.T, edgecolor="white", lw=0.4, labels=[f"unit {i}" for i in units.ids])
    axes.set(xlabel="demand (MW)", ylabel="output (MW)", xlim=(demands[0], demands[-1]))
    axes.legend(ncols=2, fontsize="x-small", loc="upper left")


def proof(axes: Any, units: Units, demand: float, boxes: Sequence[int]) -> None:
    """Draw best cost and proven bound over the examined boxes, from a rough start."""
    start = Optimiser(units, max_nodes=1).start(demand)
    results = [branch_and_bound(units, demand, start, 1e-3, n) for n in boxes]
    best = min(f.cost for f in results)
    axes.loglog(boxes, [f.cost - best + 1e-4 for f in results], drawstyle="steps-post", label="best less optimum")
    axes.loglog(
        boxes, [best - f.bound + 1e-4 for f in results], drawstyle="steps-post", label="optimum less proven bound"
    )
    axes.axhline(1e-3, color="0.5", ls="--", lw=1.0, label="tolerance")
    axes.set(xlabel="boxes", ylabel="$/h (+ 1e-4)", title=f"{len(units)} units, {demand:g} MW")
    axes.legend()


def draw(folder: Path) -> None:
    """Draw all pictures into a folder."""
    thirteen, forty = Units.read("units_13"), Units.read("units_40")
    steps = [2**k for k in range(13)]
    pictures: dict[str, Callable[[Any], None]] = {
        "stacked": lambda axes: stacked(axes, thirteen, np.arange(600.0, 2951.0, 25.0).tolist()),
        "proof_40": lambda axes: proof(axes, forty, 10500.0, steps),
    }
    for name, picture in pictures.items():
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        picture(figure.subplots())
        figure.savefig(folder / f"economic_dispatch_{name}.png", dpi=110)
