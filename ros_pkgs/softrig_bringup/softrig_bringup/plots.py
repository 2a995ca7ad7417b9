"""Pictures of a run: one PNG a plot entry of the scenario, and an overview of every recorded signal."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from softrig_core.errors import ScenarioError
from softrig_core.model.port import XYZ
from softrig_core.rig.rig import Rig
from softrig_core.rig.scenario import PlotEntry
from softrig_core.wire.signals import Signals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

OVERVIEW = "overview.png"

# Okabe and Ito's colours, which stay apart for every kind of colour vision; yellow is left out (too pale on white).
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f5539")
_REFERENCE = "#222222"
_DPI = 110
_WIDTH = 10.0  # inch: 1100 pixels, the width of the report's column
_MANY = 8  # more curves than this in one axes get a colour scale instead of a legend
_PIXELS = 1100  # columns that a long signal is reduced to
_AXES = {"alpha_beta": ("α", "β", "0"), "dq": ("d", "q", "0"), "abc": ("a", "b", "c")}
STYLE: dict[Any, Any] = {
    "font.size": 10.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": "#666666",
    "axes.formatter.useoffset": False,
    "axes.formatter.limits": (-4, 6),
    "axes.formatter.use_mathtext": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.xmargin": 0.0,
    "figure.facecolor": "white",
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.borderaxespad": 0.3,
    "legend.borderpad": 0.0,
    "legend.frameon": False,
    "legend.handlelength": 1.6,
    "lines.linewidth": 1.4,
    "lines.solid_joinstyle": "round",
    "xtick.color": "#444444",
    "ytick.color": "#444444",
}


@dataclass(frozen=True)
class Curve:
    """One line of a picture.

    Parameters
    ----------
    label, unit : str
    x, y : float arrays of shape (n,)
    held : bool
        The value stays until the next sample: drawn as steps.
    reference : bool
        Drawn as a thin dark dashed line on top.
    """

    label: str
    unit: str
    x: Array
    y: Array
    held: bool = False
    reference: bool = False


def units(rig: Rig) -> dict[str, str]:
    """Give the unit of every signal of a rig by its name ``topic/channel/field``."""
    return {
        f"{topic}/{label}": unit
        for topic, port in rig.topics.items()
        for label, unit in zip(port.labels, port.units, strict=True)
    }


def check_plots(rig: Rig) -> None:
    """Check that the rig has the signals of its scenario's plots.

    Raises
    ------
    ScenarioError
        A plot names a signal that the rig does not have.
    """
    known = units(rig)
    for entry in rig.scenario.plots:
        if entry.x:
            names = list(entry.signals)
            names += [f"{_topic(name, rig.topics)}/{entry.x}" for name in names if name in known]
        else:
            names = [part for name in entry.signals for part in name.split(" - ", 1)]
        wrong = next((name for name in names if name not in known), None)
        if wrong is not None:
            raise ScenarioError(f"plot {entry.title!r}: no signal {wrong!r}; the rig has {', '.join(known)}")


def _topic(name: str, topics: Iterable[str]) -> str:
    """Give the topic of a signal."""
    return max((t for t in topics if name.startswith(f"{t}/")), key=len)


def pretty_unit(unit: str) -> str:
    """Set a unit as it is printed: ``kg m^2`` as kg m², ``ohm`` as Ω.

    Examples
    --------
    >>> pretty_unit("m/s^2")
    'm/s²'
    """
    raised = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
    unit = re.sub(r"\^(-?\d+)", lambda power: power[1].translate(raised), unit)
    return re.sub(r"\bohm\b", "Ω", unit)


def plot_name(number: int, title: str) -> str:
    """File name of a scenario's plot entry, counted from 1."""
    return f"plot_{number:02d}_{re.sub(r'[^a-z0-9]+', '_', title.lower()).strip('_')[:60]}.png"


def plot_run(signals: Signals, rig: Rig, directory: Path) -> list[Path]:
    """Draw the plots of the rig's scenario and the overview.

    Parameters
    ----------
    signals : Signals
        Of the run's recording; topics without a message give empty axes.
    rig : Rig
        Says units, which topics are held between samples, which are references.
    directory : Path
        An existing directory.

    Returns
    -------
    list of Path
        `plot_name` of each entry in its order, then ``overview.png``.

    Raises
    ------
    ScenarioError
        A plot names a signal that the rig does not have.
    """
    from matplotlib import rc_context

    check_plots(rig)
    source = _Source(signals, rig)
    paths = []
    with rc_context(STYLE):
        for number, entry in enumerate(rig.scenario.plots, 1):
            figure = _xy_figure(source, entry) if entry.x else _time_figure(source, entry)
            paths.append(directory / plot_name(number, entry.title))
            save_figure(figure, paths[-1], entry.title, rig.scenario.name)
    with rc_context(STYLE | {"lines.linewidth": 1.0}):
        paths.append(directory / OVERVIEW)
        save_figure(_overview(source), paths[-1], "Every recorded signal", rig.scenario.name)
    return paths


def envelope(x: Array, y: Array, columns: int = _PIXELS) -> tuple[Array, Array]:
    """Reduce a long signal to what can be seen: first, lowest, highest and last value of each pixel column.

    Parameters
    ----------
    x, y : float arrays of shape (n,)
        x ascending.
    columns : int
        Width of the axes in pixels.

    Returns
    -------
    x, y : float arrays of shape (at most 4 columns,)
        The signal itself when it is not longer than that.
    """
    if len(x) <= 4 * columns:
        return x, y
    column = np.floor((x - x[0]) * (columns / (x[-1] - x[0])))
    starts = np.flatnonzero(np.diff(column, prepend=-1.0))
    ends = np.append(starts[1:], len(x)) - 1
    middle = (x[starts] + x[ends]) / 2
    corners_x = np.stack([x[starts], middle, middle, x[ends]], axis=1)
    lowest, highest = np.fmin.reduceat(y, starts), np.fmax.reduceat(y, starts)
    corners_y = np.stack([y[starts], lowest, highest, y[ends]], axis=1)
    return corners_x.ravel(), corners_y.ravel()


class _Source:
    """The curves of a run by signal name."""

    def __init__(self, signals: Signals, rig: Rig) -> None:
        self.signals = signals
        self.topics = rig.topics
        self.units = units(rig)
        sampled = {p.topic for m in rig.members for p in (m.inputs if m.is_plant else m.outputs)}
        # commands applied by a plant come from it, but they are as held as those that it got
        self.held = sampled | {t for t, port in rig.topics.items() if port.fields == ("effort",)}
        self.recorded = [t for t in self.topics if t in signals.recording.topics]
        self.end = max(
            (signals.table(t).t[-1] for t in self.recorded if signals.recording.topics[t].times), default=0.0
        )

    def curve(self, name: str, label: str = "") -> Curve:
        """Give a signal over time; without points when nothing was published."""
        topic = self.topic(name)
        table = self.signals.table(topic)
        x, y = table.t, table.columns.get(name[len(topic) + 1 :], table.t[:0])
        held = topic in self.held
        if len(y) == 0:
            x = y
        elif held and x[-1] < self.end:
            x, y = np.append(x, self.end), np.append(y, y[-1])
        unit = pretty_unit(self.units[name])
        return Curve(label or name, unit, x, y, held, self.topics[topic].msgtype.startswith("trajectory_msgs"))

    def difference(self, first: str, second: str, label: str = "") -> Curve:
        """Give a signal less the newest value of another, at the samples of the first."""
        a, b = self.curve(first), self.curve(second)
        n = len(self.signals.table(self.topic(first)).t)  # without the end to which a held signal is drawn
        newest = np.searchsorted(b.x, a.x[:n], side="right") - 1
        both = newest >= 0
        return Curve(label or f"{first} - {second}", a.unit, a.x[:n][both], a.y[:n][both] - b.y[newest[both]])

    def topic(self, name: str) -> str:
        return _topic(name, self.topics)

    def names(self, topic: str) -> list[str]:
        """Give the signals of a topic."""
        return [f"{topic}/{label}" for label in self.topics[topic].labels]

    def axis(self, name: str) -> str:
        """Give what to call a signal beside its topic: the axis letter of its frame, or its label."""
        topic = self.topic(name)
        label = name[len(topic) + 1 :]
        return dict(zip(XYZ, _AXES.get(self.topics[topic].frame_id, ()), strict=False)).get(label, label)

    def shown(self, entry: PlotEntry, name: str) -> Curve:
        """Give a signal of a plot entry inside the entry's window."""
        first, minus, second = name.partition(" - ")
        if minus:
            curve = self.difference(first, second, entry.signals[name])
        else:
            curve = self.curve(name, entry.signals[name])
        inside = self._inside(entry, curve.x)
        return replace(curve, x=curve.x[inside], y=curve.y[inside])

    def against(self, entry: PlotEntry, name: str) -> tuple[str, Curve]:
        """Give the signal of the x axis and the curve over it."""
        over = f"{self.topic(name)}/{entry.x}"
        x, y = self.curve(over), self.curve(name, entry.signals[name])
        inside = self._inside(entry, y.x)
        return over, replace(y, x=x.y[inside], y=y.y[inside], held=False)

    @staticmethod
    def _inside(entry: PlotEntry, t: Array) -> slice:
        """The samples of the window, and one on either side so that lines reach its edges."""
        first, last = entry.window or (-np.inf, np.inf)
        return slice(max(0, int(np.searchsorted(t, first, "right")) - 1), int(np.searchsorted(t, last)) + 1)


def _time_figure(source: _Source, entry: PlotEntry) -> Figure:
    """Signals over time: one row a unit."""
    from matplotlib.figure import Figure

    curves = [source.shown(entry, name) for name in entry.signals]
    if entry.unit:
        curves = [replace(c, unit=pretty_unit(entry.unit)) for c in curves]
    rows = _by_unit(curves)
    figure = Figure(figsize=(_WIDTH, 1.6 + 2.3 * len(rows)), dpi=_DPI, layout="constrained")
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    scale, time = _time_scale([curves])
    for ax, (unit, row) in zip(axes, rows.items(), strict=True):
        if _is_logic(row):
            _draw_logic(ax, row, scale)
            continue
        _draw(ax, row, scale)
        if len(row) == 1:
            ax.set_ylabel(_axis(row[0].label, unit))
        else:
            ax.set_ylabel(unit)
            _legend(ax, row, "", 110)
    figure.align_ylabels()
    if entry.window:
        axes[-1].set_xlim(entry.window[0] * scale, entry.window[1] * scale)
    axes[-1].set_xlabel(f"time ({time})")
    return figure


def _xy_figure(source: _Source, entry: PlotEntry) -> Figure:
    """Signals against another signal of their topic; a true shape where both axes have the same unit."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(0.7 * _WIDTH, 0.64 * _WIDTH), dpi=_DPI, layout="constrained")
    ax = figure.subplots()
    found = [source.against(entry, name) for name in entry.signals]
    curves = [curve for _, curve in found]
    for curve, style in zip(curves, _styles(curves), strict=True):
        ax.plot(curve.x, curve.y, label=curve.label, **style)
    ax.margins(0.05)
    over = _joined(pretty_unit(source.units[name]) for name, _ in found)
    unit = pretty_unit(entry.unit) or _joined(c.unit for c in curves)
    ax.set_xlabel(_axis(_joined(source.axis(name) for name, _ in found), over))
    ax.set_ylabel(_axis(_joined(source.axis(name) for name in entry.signals), unit))
    if over == unit:
        ax.set_aspect("equal", adjustable="datalim")
    _legend(ax, curves, "", 70)
    return figure


def _overview(source: _Source) -> Figure:
    """Every signal over time, one small axes for each unit of each topic, topics down the columns."""
    from matplotlib.figure import Figure

    panels = [
        (topic, unit, row)
        for topic in source.recorded
        for unit, row in _by_unit([source.curve(n, source.axis(n)) for n in source.names(topic)]).items()
    ]
    columns = 1 if len(panels) < 4 else 2
    rows = max(1, -(-len(panels) // columns))
    figure = Figure(figsize=(_WIDTH, 0.9 + 1.55 * rows), dpi=_DPI, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    scale, time = _time_scale([row for _, _, row in panels])
    for ax, (topic, unit, row) in zip(grid, panels, strict=False):
        ax.tick_params(labelsize=8)
        if _is_logic(row):
            row, title = _without_field(row, topic)
            _draw_logic(ax, row, scale)
            ax.set_title(title, loc="left", fontsize=9)
            continue
        _draw(ax, row, scale)
        ax.set_ylabel(unit)
        if len(row) == 1:
            ax.set_title(f"{topic}/{row[0].label}", loc="left", fontsize=9)
        else:
            _legend(ax, *_without_field(row, topic), 55)
    figure.align_ylabels()
    for ax in grid[len(panels) :]:
        ax.set_visible(False)
    for last in {min(rows * (column + 1), len(panels)) - 1 for column in range(columns)} if panels else ():
        grid[last].tick_params(labelbottom=True)
        grid[last].set_xlabel(f"time ({time})", fontsize=9)
    return figure


def _without_field(row: Sequence[Curve], topic: str) -> tuple[list[Curve], str]:
    """Move the field that all labels end with to the title: ``joint1`` below ``joint_states/*/position``."""
    fields = {curve.label.partition("/")[2] for curve in row}
    field = fields.pop() if len(fields) == 1 else ""
    if not field:
        return list(row), topic
    return [replace(curve, label=curve.label.partition("/")[0]) for curve in row], f"{topic}/*/{field}"


def _by_unit(curves: Sequence[Curve]) -> dict[str, list[Curve]]:
    rows: dict[str, list[Curve]] = {}
    for curve in curves:
        rows.setdefault(curve.unit, []).append(curve)
    return rows


def _time_scale(groups: Sequence[Sequence[Curve]]) -> tuple[float, str]:
    """Milliseconds for runs that are over at once, seconds for all others."""
    longest = max((c.x[-1] for group in groups for c in group if len(c.x)), default=0.0)
    return (1e3, "ms") if 0.0 < longest < 0.1 else (1.0, "s")


def _draw(ax: Axes, curves: Sequence[Curve], scale: float) -> None:
    """Draw curves over time, those with the most ink below the others."""
    ink = [float(np.abs(np.diff(c.y)).sum()) for c in curves]
    for curve, style, own in zip(curves, _styles(curves), ink, strict=True):
        x, y = envelope(curve.x * scale, curve.y)
        steps = len(y) == len(curve.y) and (curve.held or _quantised(y))
        marker = "o" if len(x) == 1 else ""
        order = 2.0 + sum(other > own for other in ink) / len(ink)
        ax.plot(
            x,
            y,
            marker=marker,
            drawstyle="steps-post" if steps else "default",
            label=curve.label,
            **({"zorder": order} | style),
        )
    if not any(len(c.x) for c in curves):
        ax.text(0.5, 0.5, "nothing published", transform=ax.transAxes, ha="center", va="center", color="#888888")
        ax.set_yticks([])
    _open_limits(ax)


def _is_logic(curves: Sequence[Curve]) -> bool:
    """Whether the curves are switches or buttons: several, all of them 0 or 1."""
    return 1 < len(curves) <= _MANY and all(len(c.y) and np.isin(c.y, (0.0, 1.0)).all() for c in curves)


def _draw_logic(ax: Axes, curves: Sequence[Curve], scale: float) -> None:
    """Draw switches one above the other, as a logic analyser does."""
    places = [1.4 * i for i in range(len(curves))][::-1]
    for curve, place, style in zip(curves, places, _styles(curves), strict=True):
        x, y = envelope(curve.x * scale, curve.y)
        ax.plot(x, y + place, drawstyle="steps-post" if len(y) == len(curve.y) else "default", **style)
    ax.set_yticks([place + 0.5 for place in places], [curve.label for curve in curves])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")


def _quantised(y: Array) -> bool:
    """Whether a signal jumps between few values, as an encoder's speed or a switch does."""
    return 8 * len(np.unique(y)) < len(y)


def _open_limits(ax: Axes) -> None:
    """Keep rounding noise of a constant signal from filling the axes."""
    low, high = ax.get_ylim()
    least = 1e-6 * max(abs(low), abs(high), 1e-6)
    if high - low < least:
        ax.set_ylim((low + high) / 2 - 1e3 * least, (low + high) / 2 + 1e3 * least)


def _styles(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """Line style of each curve: references dark and dashed, the others by colour, then by dashes."""
    if len(curves) > _MANY:
        from matplotlib import colormaps

        shades = colormaps["cividis"](np.linspace(0.0, 0.95, len(curves)))
        return [{"color": shade, "linewidth": 0.8} for shade in shades]
    dashed = (0, (5, 3))
    own = iter([{"color": c, "linestyle": line} for line in ("-", dashed) for c in _COLOURS])
    if all(curve.reference for curve in curves):
        return [next(own) | {"linestyle": dashed} for _ in curves]
    reference = {"color": _REFERENCE, "linewidth": 1.0, "linestyle": dashed, "zorder": 3.0}
    return [reference if curve.reference else next(own) for curve in curves]


def _legend(ax: Axes, curves: Sequence[Curve], title: str, width: int) -> None:
    """Put the legend above the axes, where it covers no data; `width` is that of the axes in letters."""
    if len(curves) > _MANY:
        text = f"{len(curves)} signals, dark to light from first to last"
        ax.set_title(f"{title}: {text}" if title else text, loc="left", fontsize=9)
        return
    longest = max(len(c.label) for c in curves) + 6
    ax.legend(
        ax.lines[: len(curves)],
        [curve.label for curve in curves],
        title=title or None,
        alignment="left",
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=min(len(curves), max(1, width // longest)),
        fontsize=9,
        title_fontsize=9,
    )


def _joined(words: Iterable[str]) -> str:
    """The different words, in their order."""
    return ", ".join(dict.fromkeys(w for w in words if w))


def _axis(label: str, unit: str) -> str:
    return f"{label} ({unit})" if unit else label


def save_figure(figure: Figure, path: Path, title: str, run: str) -> None:
    """Write a picture with its title and, small, the name of the run."""
    figure.suptitle(title, x=0.008, ha="left", fontsize=12, fontweight="bold")
    figure.text(0.992, 0.992, run, ha="right", va="top", fontsize=8, color="#888888")
    figure.savefig(path)
