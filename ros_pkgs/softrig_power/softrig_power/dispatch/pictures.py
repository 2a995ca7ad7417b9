"""Pictures of the economic dispatch: ``python -m softrig_power.dispatch.pictures DIRECTORY``."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .branch import branch_and_bound
from .certify import Optimiser
from .units import Units, cost_of


def cost_curve(axes: Any, units: Units, j: int, demands: Sequence[float]) -> None:
    """Draw the cost of one unit with its valve points and where it runs at each demand."""
    P = np.linspace(units.p_min[j], units.p_max[j], 2000)
    row = units.table[j]
    axes.plot(P, cost_of(row, P), color="0.4", lw=1.0, label="cost, equation (1)")
    ends = units.valve_points(j)
    axes.plot(ends, cost_of(row, ends), "|", color="k", ms=9, label="valve points and limits")
    optimiser = Optimiser(units)
    found = np.array([units.sorted_copies(optimiser.certified(d).P)[j] for d in demands])
    axes.scatter(found, cost_of(row, found), c=demands, cmap="viridis", zorder=3, label="runs here")
    axes.set(xlabel=f"output of unit {units.ids[j]} (MW)", ylabel="cost ($/h)")
    axes.legend()


def stacked(axes: Any, units: Units, demands: Sequence[float]) -> None:
    """Draw the proven outputs of all units over the demand, one on the other."""
    optimiser = Optimiser(units)
    P = np.array([units.sorted_copies(optimiser.certified(d).P) for d in demands])
    axes.stackplot(demands, P.T, edgecolor="white", lw=0.4, labels=[f"unit {i}" for i in units.ids])
    axes.set(xlabel="demand (MW)", ylabel="output (MW)", xlim=(demands[0], demands[-1]))
    axes.legend(ncols=2, fontsize="x-small", loc="upper left")


def proof(axes: Any, units: Units, demand: float, boxes: Sequence[int]) -> None:
    """Draw best cost and proven bound over the boxes looked at, from a rough start."""
    start = Optimiser(units, max_nodes=1).start(demand)
    found = [branch_and_bound(units, demand, start, 1e-3, n) for n in boxes]
    best = min(f.cost for f in found)
    axes.loglog(boxes, [f.cost - best + 1e-4 for f in found], drawstyle="steps-post", label="best less optimum")
    axes.loglog(
        boxes, [best - f.bound + 1e-4 for f in found], drawstyle="steps-post", label="optimum less proven bound"
    )
    axes.axhline(1e-3, color="0.5", ls="--", lw=1.0, label="tolerance")
    axes.set(xlabel="boxes", ylabel="$/h (+ 1e-4)", title=f"{len(units)} units, {demand:g} MW")
    axes.legend()


def main(arguments: Sequence[str]) -> int:
    """Draw all pictures into a directory."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    folder = Path(arguments[0] if arguments else ".")
    folder.mkdir(parents=True, exist_ok=True)
    thirteen, forty = Units.read("units_13"), Units.read("units_40")
    steps = [2**k for k in range(13)]
    pictures: dict[str, Callable[[Any], None]] = {
        "cost_curve": lambda axes: cost_curve(axes, thirteen, 0, np.arange(800.0, 2801.0, 100.0).tolist()),
        "stacked": lambda axes: stacked(axes, thirteen, np.arange(600.0, 2951.0, 25.0).tolist()),
        "proof_13": lambda axes: proof(axes, thirteen, 1800.0, steps),
        "proof_40": lambda axes: proof(axes, forty, 10500.0, steps),
    }
    for name, draw in pictures.items():
        figure = Figure(figsize=(8.0, 4.5), layout="constrained")
        FigureCanvasAgg(figure)  # type: ignore[no-untyped-call]
        draw(figure.subplots())
        figure.savefig(folder / f"economic_dispatch_{name}.png", dpi=110)
        print(folder / f"economic_dispatch_{name}.png")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
