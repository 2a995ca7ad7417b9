"""Trajectory and functional, margins on one axis, the tank's level against its bound."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from softrig_core import Array, ByHand, SignalMap, simulate
from softrig_systems.pwa_delay.controllers import TankController
from softrig_systems.pwa_delay.plants import TankPlant
from softrig_systems.pwa_delay.proof.certify import Criterion, certified_margin
from softrig_systems.pwa_delay.proof.level import level_bound
from softrig_systems.pwa_delay.search import pwa_margin
from softrig_systems.pwa_delay.system import continuous_tank, pendulum, switched


def _figure(columns: int, height: float) -> tuple[Any, Any]:
    figure = Figure(figsize=(9.0, height), layout="constrained")
    return figure, figure.subplots(1, columns, squeeze=False)[0]


def trajectory(stable: SignalMap, beyond: SignalMap, path: Path) -> None:
    """Draw x2 over x1 with the switching lines, and V over time, of the certified delay and of one beyond."""
    figure, (plane, time) = _figure(2, 3.6)
    reach = 0.0
    for name, signals in (("0.0192 s", stable), ("0.03 s", beyond)):
        x1, x2 = (signals[f"pwa/state/{k}/position"][1] for k in ("x1", "x2"))
        plane.plot(x1, x2, lw=1.0, label=name)
        reach = max(reach, float(np.abs(x1).max()), float(np.abs(x2).max()))
        t, v = signals["lyapunov/V/position"]
        time.plot(t, v / v[0], lw=1.0, label=name)
    plane.plot([-reach, reach], [-reach, reach], "k--", lw=0.6)
    plane.plot([-reach, reach], [reach, -reach], "k--", lw=0.6)
    plane.set_xlabel("x1")
    plane.set_ylabel("x2")
    plane.legend(title="delay", fontsize=8)
    time.set_xlabel("time, s")
    time.set_ylabel("V of the delay 0.0192 s, of its first value")
    figure.savefig(path, dpi=110)


class Margins(NamedTuple):
    """Delay margins of one system (s): published theorem and simulation, certified two ways, simulated here."""

    name: str
    published: float | None
    published_true: float | None
    theorem1: float
    constant: float
    simulated: float


def margins(rows: Sequence[Margins], path: Path) -> None:
    """Draw the margins of each system on one axis, as shares of the simulated one."""
    figure, (axis,) = _figure(1, 2.6)
    styles = {"published": "s", "published_true": "D", "theorem1": "o", "constant": "^", "simulated": "|"}
    labels = {
        "published": "published, theorem",
        "published_true": "published, simulation",
        "theorem1": "Theorem 1",
        "constant": "constant delay",
        "simulated": "simulation",
    }
    for kind, marker in styles.items():
        points = [(getattr(row, kind) / row.simulated, k) for k, row in enumerate(rows) if getattr(row, kind)]
        axis.plot(*zip(*points, strict=True), marker, ms=12 if marker == "|" else 6, label=labels[kind])
    axis.set_yticks(range(len(rows)), [f"{r.name}\n{r.simulated:.4g} s" for r in rows], fontsize=8)
    axis.set_ylim(-0.6, len(rows) - 0.4)
    axis.set_xlabel("delay margin, share of the simulated one")
    axis.legend(fontsize=7, loc="upper left", ncols=2)
    figure.savefig(path, dpi=110)


def level(runs: Sequence[tuple[float, Array, Array]], path: Path) -> None:
    """Draw the lowest level over the delay: certified bound, and the levels reached with several kinds of delays.

    Parameters
    ----------
    runs : sequence of (delay in s, lowest level under the constant delay, lowest under jumping ones)
    path : Path
        PNG to write.
    """
    figure, (axis,) = _figure(1, 3.0)
    h = np.linspace(0.5, 6.6, 200)
    axis.plot(h, [level_bound(d).lowest for d in h], label="certified for every delay up to h")
    axis.plot([r[0] for r in runs], [float(r[1]) for r in runs], "o", ms=4, label="constant delay h")
    axis.plot([r[0] for r in runs], [float(r[2]) for r in runs], "x", ms=5, label="jumping between 0 and h, worst of 5")
    axis.axhline(0.0, color="k", lw=0.7)
    axis.set_xlabel("delay h, s")
    axis.set_ylabel("lowest level")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=110)


def _lowest(h: float, profile: str, seed: int) -> float:
    plant = ByHand(TankPlant(delay=h, profile=profile, seed=seed, x0=0.49, period=0.05, step=0.05))
    controller, lowest = ByHand(TankController(period=0.05)), 1.0
    for k in range(round(30.0 * h / 0.05)):
        now = plant.outputs(k)["level"]
        lowest = min(lowest, now[0])
        plant.advance(k, inflow=controller.update(k, level=now)["inflow"])
    return lowest


def draw(folder: Path) -> None:
    """Run what the pictures need and draw them into a folder."""
    trajectory(simulate("pwa_delay").signals, simulate("pwa_delay_beyond").signals, folder / "pwa_delay_trajectory.png")
    results = []
    for name, system, published, true, bracket, run in (
        ("switched", switched(), 0.0193, 0.0205, (0.018, 0.0205), (0.0195, 0.021, (-2.0, 0.0), 60.0)),
        ("pendulum", pendulum(), 0.18, 0.193, (0.25, 0.28), (0.40, 0.43, (1.0, 0.0), 200.0)),
        ("continuous tank", continuous_tank(), None, None, (7.0, 9.0), (11.0, 12.0, (1.0,), 3000.0)),
    ):
        certified = [
            certified_margin(system, c, low=bracket[0], high=bracket[1], width=1e-3)
            for c in (Criterion(cell_terms=True), Criterion("constant", cell_terms=True))
        ]
        best = [c.h if c is not None else 0.0 for c in certified]
        margin = pwa_margin(system, *run, width=1e-3 * run[0])
        results.append(Margins(name, published, true, best[0], best[1], margin.h))
    margins(results, folder / "pwa_delay_margins.png")
    delays = (1.0, 2.0, 4.0, 5.0, 5.97, 6.4)
    runs = [
        (h, np.array(_lowest(h, "constant", 0)), np.array(min(_lowest(h, "telegraph", s) for s in range(5))))
        for h in delays
    ]
    level(runs, folder / "pwa_delay_level.png")
