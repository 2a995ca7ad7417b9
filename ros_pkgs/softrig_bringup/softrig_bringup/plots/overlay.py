"""The signals of several runs laid over each other."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from softrig_core import Signals
from softrig_core.rig.scenario import PlotEntry

from . import style as look
from .axes import draw, fold_exponents, legend
from .curves import Array, Curve, Shown
from .figures import time_scale
from .style import axis_title, quantity

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

BAND = (0.1, 0.9)  # quantiles between which a band lies
LEAST = 3  # runs that a band needs; fewer are drawn one by one
PICTURES = 6  # of one system
_SAMPLES = 1000  # of a band


@dataclass(frozen=True)
class Overlay:
    """A run to be laid over others.

    Parameters
    ----------
    label : str
        What tells it apart.
    group : str
        The same for runs that differ in their seed alone.
    plots : sequence of PlotEntry
    shown : mapping
        Of the signals of its plots.
    signals : Signals
    """

    label: str
    group: str
    plots: Sequence[PlotEntry]
    shown: Mapping[str, Shown]
    signals: Signals


def draw_overlay(runs: Sequence[Overlay]) -> Iterator[tuple[str, bytes]]:
    """Draw each plot over time that at least two runs share: title and PNG.

    Each signal has its own axes, each run or group of draws its own colour. A group of `LEAST` or more runs is its
    median and the band between the quantiles `BAND`. A reference that is the same in all runs is drawn once.

    Parameters
    ----------
    runs : sequence of Overlay
    """
    from matplotlib import rc_context

    for number, (title, entry) in enumerate(_shared(runs).items()):
        if number == PICTURES:
            return
        with rc_context(look.style()):
            figure = _figure(runs, entry)
            figure.suptitle(title, x=0.008, ha="left", fontsize=12, fontweight="bold")
            fold_exponents(figure)
            file = io.BytesIO()
            figure.savefig(file, format="png")
        yield title, file.getvalue()


def _shared(runs: Sequence[Overlay]) -> dict[str, PlotEntry]:
    """Give the plots over time that show the same signals in at least two runs, by title."""
    found: dict[str, PlotEntry] = {}
    every = [entry for run in runs for entry in run.plots if not entry.x and set(entry.signals) <= set(run.shown)]
    for entry in every:
        same = [e for e in every if e.signals.keys() == entry.signals.keys() and e.window == entry.window]
        if len(same) > 1 and all(e.signals.keys() != entry.signals.keys() or e.window != entry.window
                                 for e in found.values()):  # fmt: skip
            found[entry.title] = entry
    return found


def _figure(runs: Sequence[Overlay], entry: PlotEntry) -> Figure:
    from matplotlib.figure import Figure as New

    having = [run for run in runs if set(entry.signals) <= set(run.shown)]
    about = having[0].shown
    names = [n for n in entry.signals if not about[n].reference] or list(entry.signals)
    references = [n for n in entry.signals if n not in names]
    figure = New(figsize=(look.WIDTH, 1.3 + 2.3 * len(names)), dpi=look.DPI, layout="constrained")
    axes = figure.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
    curves = {n: [(run, c) for run in having if len((c := _curve(run, n)).x)] for n in entry.signals}
    scale, time = time_scale([[c for _, c in found] for found in curves.values()])
    said: list[str] = []
    for ax, name in zip(axes, names, strict=True):
        same = [n for n in references if about[n].unit == about[name].unit]
        lines = [r for n in same if (r := _common([c for _, c in curves[n]], entry.signals[n]))]
        drawn = _overlaid(ax, curves[name], lines, scale)
        if [c.label for c in drawn] != said:  # once, if it is the same below
            legend(ax, drawn, "", 110)
            said = [c.label for c in drawn]
        label = entry.signals[name] or name
        unit = about[name].unit
        title = entry.quantity or (quantity(unit) if len(names) == 1 else "") or label
        ax.set_ylabel(axis_title(title, unit))
    if entry.window:
        axes[-1].set_xlim(entry.window[0] * scale, entry.window[1] * scale)
    axes[-1].set_xlabel(axis_title("Time", time))
    figure.align_ylabels()
    return figure


def _curve(run: Overlay, name: str) -> Curve:
    about = run.shown[name]
    try:
        t, y = run.signals[name]
    except KeyError:  # nothing was recorded of it
        t = y = np.array([])
    return Curve(run.label, about.unit, t, y, about.held)


def _common(curves: Sequence[Curve], label: str) -> Curve | None:
    """Give a reference that is the same in all runs, as far as each of them goes."""
    if not curves:
        return None
    longest = max(curves, key=lambda c: len(c.x))
    if not all(np.array_equal(c.y, longest.y[: len(c.y)]) for c in curves):
        return None
    return Curve(label or "reference", longest.unit, longest.x, longest.y, longest.held, True)


def _overlaid(
    ax: Axes, found: Sequence[tuple[Overlay, Curve]], references: Sequence[Curve], scale: float
) -> list[Curve]:
    """Draw runs one by one, and groups of draws as their median in a band; gives what was drawn, in order."""
    groups: dict[str, list[Curve]] = {}
    for run, curve in found:
        groups.setdefault(run.group, []).append(curve)
    bands: dict[str, tuple[Array, Array, Array]] = {}
    curves: list[Curve] = []
    for group, mine in groups.items():
        if len(mine) < LEAST:
            curves += mine
            continue
        t, low, middle, high = band(mine)
        label = f"{group}: median of {len(mine)} seeds, {BAND[0]:.0%} to {BAND[1]:.0%}".replace("%", " %")
        bands[label] = t, low, high
        curves.append(Curve(label, mine[0].unit, t, middle))
    curves += references
    draw(ax, curves, scale)
    for line, curve in zip(ax.lines, curves, strict=True):
        if curve.label in bands:
            t, low, high = bands[curve.label]
            ax.fill_between(t * scale, low, high, color=line.get_color(), alpha=0.25, linewidth=0, zorder=1.7)
    return curves


def band(curves: Sequence[Curve]) -> tuple[Array, Array, Array, Array]:
    """Give median and quantiles of draws of one signal.

    Parameters
    ----------
    curves : sequence of Curve
        Each held, or taken as straight between its samples; compared as long as all of them go.

    Returns
    -------
    t, low, middle, high : arrays of shape (n,)
    """
    t = np.linspace(max(c.x[0] for c in curves), min(c.x[-1] for c in curves), _SAMPLES)
    rows = [c.y[np.searchsorted(c.x, t, "right") - 1] if c.held else np.interp(t, c.x, c.y) for c in curves]
    low, middle, high = np.quantile(np.array(rows), (BAND[0], 0.5, BAND[1]), axis=0)
    return t, low, middle, high
