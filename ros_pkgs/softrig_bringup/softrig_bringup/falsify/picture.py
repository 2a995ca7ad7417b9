"""The picture of a falsification: the unchanged run and the worst one overlaid, with violations shaded."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from softrig_core import Run, figures_of
from softrig_core.rig.members import signal_units
from softrig_core.verdict.figures import SIGNALS
from softrig_core.verdict.requirements import Judge

from ..plots import style as look
from ..plots.axes import draw, draw_marks, legend
from ..plots.canvas import Figure
from ..plots.curves import Curve
from ..plots.marks import marks_of
from ..plots.pictures import save_figure, time_scale
from ..plots.style import axis_title, quantity


def draw_worst(runs: Mapping[str, Run], requirement: str, path: Path, title: str, also: str = "") -> None:
    """Draw the signals of a requirement in several runs, a row a signal.

    Parameters
    ----------
    runs : mapping of str to Run
        By label; the intervals in which the last one violates the requirement are shaded.
    path : Path
        The SVG.
    also : str
        pdf or png: a file of this kind beside it, by matplotlib.
    """
    *_, last = runs.values()
    figure_of = next(f for f in figures_of(last.rig) if f.name == requirement)
    judge = figure_of.function
    if isinstance(judge, Judge):
        signals = judge.signals
    else:
        named = (figure_of.arguments.get(k) for k in SIGNALS)
        signals = {name: name for name in named if isinstance(name, str)}
    units = signal_units(last.rig)
    stepped = {
        f"{t}/{label}"
        for m in last.rig.members
        if not m.is_plant
        for p in m.outputs
        for t, label in ((p.topic, x) for x in p.labels)
    }
    rows = {
        name: [Curve(label, units[signal], *run.signals[signal], signal in stepped) for label, run in runs.items()]
        for name, signal in signals.items()
    }
    different = {n: c for n, c in rows.items() if any(not np.array_equal(c[0].y, curve.y) for curve in c[1:])}
    # A reference that is the same in all runs shows nothing, unless there is nothing else.
    rows = different or rows
    first = next(iter(signals.values()), "")  # a requirement is marked on each of its signals
    marks = [m for m in marks_of(last.rig, last.signals).get(first, ()) if m.name == requirement]
    figure = Figure(figsize=(look.WIDTH, 1.3 + 2.3 * len(rows)), dpi=look.DPI)
    axes = figure.column(len(rows))
    scale, time = time_scale(rows.values())
    for k, (ax, (name, curves)) in enumerate(zip(axes, rows.items(), strict=True)):
        draw(ax, curves, scale)
        entries = draw_marks(ax, marks, scale)
        if k == 0:
            legend(ax, curves, "", 110, entries)
        unit = units[signals[name]]
        ax.set_ylabel(axis_title((quantity(unit) if len(rows) == 1 else "") or name, unit))
    axes[-1].set_xlabel(axis_title("Time", time))
    figure.align_ylabels()
    save_figure(figure, path, title, last.rig.scenario.name, also)
