"""The signals of several runs laid over each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from softrig_core import Array, Signals
from softrig_core.scenario.plot_entry import PlotEntry

from . import style as look
from .axes import draw, legend
from .canvas import Axes, Figure
from .curves import Curve, inside, reduced
from .named import LEAST, Shown
from .pictures import fitted, time_scale
from .style import PLAIN, Style, axis_title, quantity
from .svg import svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Printed

BAND = (0.1, 0.9)  # quantiles between which a band lies
_SAMPLES = 1000  # samples of a band


@dataclass(frozen=True)
class Overlay:
    """A run to draw over others.

    Parameters
    ----------
    label : str
        Text that distinguishes it from the others.
    group : str
        Equal for runs that are draws of the same case; otherwise the label.
    shown : mapping
        Of the signals of its plots.
    """

    label: str
    group: str
    plots: Sequence[PlotEntry]
    shown: Mapping[str, Shown]
    signals: Signals


Drawn = Sequence[tuple[Overlay, Curve]]  # overlays and curves of one signal


def draw_overlay(runs: Sequence[Overlay], note: str = "") -> Iterator[tuple[str, str]]:
    """Draw each plot over time that at least two runs share: title and SVG; see `overlay_figures`."""
    for entry, figure in _figures(runs, 110):
        figure.suptitle(entry.title + note)
        yield figure.title, svg(figure)


def overlay_figures(runs: Sequence[Overlay], style: Style = PLAIN) -> Iterator[tuple[PlotEntry, Printed]]:
    """Draw by matplotlib each plot over time that at least two runs share.

    Each signal has its own axes, each run or group of draws its own colour. A group of `LEAST` or more runs is its
    median and the band between the quantiles `BAND`. A reference that is the same in all runs is drawn once.
    """
    for entry, figure in _figures(runs, style.letters):
        yield entry, fitted(figure, entry.title, style)


def _figures(runs: Sequence[Overlay], width: int) -> Iterator[tuple[PlotEntry, Figure]]:
    for entry in _shared(runs):
        having = [run for run in runs if set(entry.signals) <= set(run.shown)]
        curves = {n: [(run, c) for run in having if len((c := _curve(run, n, entry.window)).x)] for n in entry.signals}
        if max(map(len, curves.values())) < 2:
            continue
        yield entry, _figure(having[0].shown, entry, curves, width)


def _shared(runs: Sequence[Overlay]) -> list[PlotEntry]:
    """Return the plots over time that show the same signals in at least two runs, each once."""
    every = [entry for run in runs for entry in run.plots if not entry.x and set(entry.signals) <= set(run.shown)]
    same: dict[tuple[Any, ...], list[PlotEntry]] = {}
    for entry in every:
        same.setdefault((frozenset(entry.signals), entry.window), []).append(entry)
    return [result[0] for result in same.values() if len(result) > 1]


def _figure(about: Mapping[str, Shown], entry: PlotEntry, curves: Mapping[str, Drawn], width: int) -> Figure:
    available = [n for n in entry.signals if curves[n]]
    names = [n for n in available if not about[n].reference] or available
    references = [n for n in available if n not in names]
    figure = Figure(figsize=(look.WIDTH, 1.3 + 2.3 * len(names)), dpi=look.DPI)
    axes = figure.column(len(names))
    scale, time = time_scale([[c for _, c in result] for result in curves.values()])
    messages: list[str] = []
    for ax, name in zip(axes, names, strict=True):
        same = [n for n in references if about[n].unit == about[name].unit]
        lines = [r for n in same if (r := _common([c for _, c in curves[n]], entry.signals[n]))]
        drawn = _overlaid(ax, curves[name], lines, scale)
        if [c.label for c in drawn] != messages:  # equal legends are drawn once
            legend(ax, drawn, "", width, noun="runs")
            messages = [c.label for c in drawn]
        label = entry.signals[name] or name
        unit = about[name].unit
        title = entry.quantity or (quantity(unit) if len(names) == 1 else "") or label
        ax.set_ylabel(axis_title(title, unit))
    if entry.window:
        axes[-1].set_xlim(entry.window[0] * scale, entry.window[1] * scale)
    axes[-1].set_xlabel(axis_title("Time", time))
    figure.align_ylabels()
    return figure


def _curve(run: Overlay, name: str, window: tuple[float, float] | None) -> Curve:
    about = run.shown[name]
    try:
        t, y = run.signals[name]
    except KeyError:  # the signal was not recorded
        t = y = np.array([])
    return inside(Curve(run.label, about.unit, t, y, about.held), window)


def _common(curves: Sequence[Curve], label: str) -> Curve | None:
    """Return a reference that is the same in all runs, over the length of each run."""
    if not curves:
        return None
    longest = max(curves, key=lambda c: len(c.x))
    if not all(np.array_equal(c.y, longest.y[: len(c.y)]) for c in curves):
        return None
    return Curve(label or "reference", longest.unit, longest.x, longest.y, longest.held, True)


def _overlaid(ax: Axes, drawn: Drawn, references: Sequence[Curve], scale: float) -> list[Curve]:
    """Draw runs one by one, and groups of draws as their median in a band; returns what was drawn, in order."""
    groups: dict[str, list[Curve]] = {}
    for run, curve in drawn:
        groups.setdefault(run.group, []).append(curve)
    bands: dict[str, tuple[Array, Array, Array]] = {}
    curves: list[Curve] = []
    for group, members in groups.items():
        if len(members) < LEAST:
            curves += map(reduced, members)
            continue
        t, low, middle, high = band(members)
        label = f"{group}: median of {len(members)} seeds, {BAND[0]:.0%} to {BAND[1]:.0%}".replace("%", " %")
        bands[label] = t, low, high
        curves.append(Curve(label, members[0].unit, t, middle, members[0].held))
    curves += map(reduced, references)
    draw(ax, curves, scale)
    for line, curve in zip(ax.lines, curves, strict=True):
        if curve.label in bands:
            t, low, high = bands[curve.label]
            ax.fill_between(
                t * scale,
                low,
                high,
                step="post" if curve.held else None,
                color=line.get_color(),
                alpha=0.25,
                linewidth=0,
                zorder=1.7,
            )
    return curves


def _linear(t: Array, curve: Curve) -> Array:
    """Return the values at some instants, linear between the samples, of which only those around them are read."""
    after = np.searchsorted(curve.x, t)
    around = np.unique(np.clip(np.concatenate([after - 1, after]), 0, len(curve.x) - 1))
    return np.interp(t, curve.x[around], curve.y[around])


def band(curves: Sequence[Curve]) -> tuple[Array, Array, Array, Array]:
    """Return median and quantiles of draws of one signal.

    Parameters
    ----------
    curves : sequence of Curve
        Each is held or linear between its samples; they are compared up to the end of the shortest.

    Returns
    -------
    t, low, middle, high : arrays of shape (n,)
    """
    t = np.linspace(max(c.x[0] for c in curves), min(c.x[-1] for c in curves), _SAMPLES)
    rows = [c.y[np.searchsorted(c.x, t, "right") - 1] if c.held else _linear(t, c) for c in curves]
    low, middle, high = np.quantile(np.array(rows), (BAND[0], 0.5, BAND[1]), axis=0)
    return t, low, middle, high
