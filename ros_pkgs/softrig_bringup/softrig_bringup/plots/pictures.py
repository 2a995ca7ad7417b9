"""The pictures of a run: one a plot entry of its scenario, and an overview of every recorded signal."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace as changed
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softrig_core import Rig, Signals
from softrig_core.guard import replace
from softrig_core.judge.units import pretty_unit
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.verdict.result import Result

from . import style as look
from .axes import UNIT, draw, draw_logic, draw_marks, fold_exponents, is_logic, legend, styles
from .canvas import Axes, Figure, Place
from .curves import Curve, Source, by_unit, check_plots, reduced
from .marks import Mark, marks_of
from .named import OVERVIEW, plot_name
from .printed import printed
from .style import PLAIN, Style, axis_title, quantity
from .svg import svg

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Printed

UNDATED: dict[str, Any] = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # equal runs give equal files


def plot_entry(signals: Signals, rig: Rig, entry: PlotEntry, style: Style = PLAIN) -> Printed:
    """Draw one plot of a run by matplotlib; see `plot_run` for signals and rig."""
    source = Source(signals, rig)
    marks = marks_of(rig, signals)
    figure = _xy_figure(source, entry) if entry.x else _time_figure(source, entry, marks, style.letters)
    return fitted(figure, entry.title, style)


def fitted(drawn: Figure, title: str, style: Style) -> Printed:
    """Draw a picture by matplotlib, with a width, a size and kind of letters, and a title."""
    wanted, font, inches, serif = style
    sizes = {"font.size": font, "legend.fontsize": font, "axes.titlesize": font} if font else {}
    figure = printed(drawn, sizes | (look.SERIF if serif else {}))
    if inches:
        wide, high = figure.get_size_inches()
        figure.set_size_inches(inches, high * max(inches / wide, 0.7))
    for ax in figure.axes if font else ():
        for text in (*ax.texts, *(box.get_texts() if (box := ax.get_legend()) else ())):
            text.set_fontsize(font)
    if wanted and title:
        figure.suptitle(title, x=0.008, ha="left", fontsize=font or 12, fontweight="bold")
    fold_exponents(figure)
    return figure


def write_figure(figure: Printed, path: Path, **how: Any) -> None:
    """Write a picture, whole or not at all, its letters as letters in every format, equal figures as equal files."""
    from matplotlib import rc_context

    # First to memory: on a full disk, writers of matplotlib leave half a file, and the one of PDF hides the reason.
    content, form = BytesIO(), path.suffix[1:]
    with rc_context(look.FONTS):
        figure.savefig(content, format=form, metadata=UNDATED.get(form), **how)
    replace(path, content.getvalue())


def plot_run(
    signals: Signals,
    rig: Rig,
    directory: Path,
    also: str = "",
    most: int | None = None,
    results: Iterable[Result] = (),
) -> list[Path]:
    """Draw the plots of the rig's scenario and the overview.

    Parameters
    ----------
    signals : Signals
        Of the run's recording; topics without a message are listed but not drawn.
    rig : Rig
        Provides the units, which topics are held between samples, and which are references.
    directory : Path
        An existing directory.
    also : str
        ``pdf`` or ``png``: matplotlib also writes a file of this kind beside each SVG; empty: none.
    most : int, optional
        Only the first plots, and the overview if there are fewer.
    results : iterable of Result
        See `marks_of`.

    Returns
    -------
    list of Path
        `plot_name` of each entry in its order, then ``overview.svg``. An entry has no picture if its signals all belong
        to an external node that did not publish them.

    Raises
    ------
    ScenarioError
        A plot names a signal that the rig does not have.
    """
    check_plots(rig)
    source = Source(signals, rig)
    marks = marks_of(rig, signals, results)
    paths = []
    outside = {p.topic for m in rig.members if m.external for p in m.outputs} & set(source.silent)
    for number, entry in enumerate(rig.scenario.plots[:most], 1):
        drawn = [signal for name in entry.signals for signal in name.split(" - ", 1)]
        if outside and all(source.topic(signal) in outside for signal in drawn):
            continue
        figure = _xy_figure(source, entry) if entry.x else _time_figure(source, entry, marks)
        paths.append(directory / plot_name(number, entry.title))
        save_figure(figure, paths[-1], entry.title, rig.scenario.name, also)
    if most is not None and len(paths) >= most:
        return paths
    paths.append(directory / OVERVIEW)
    save_figure(_overview(source), paths[-1], "Every recorded signal", rig.scenario.name, also)
    return paths


def save_figure(figure: Figure, path: Path, title: str, run: str, also: str = "") -> None:
    """Write a picture with its title and, small, the name of the run.

    Parameters
    ----------
    path : Path
        The SVG.
    also : str
        pdf, png, or empty: a file of this kind beside it, by matplotlib.
    """
    figure.suptitle(title, x=0.008, ha="left", fontsize=12, fontweight="bold")
    figure.text(0.992, 0.992, run, ha="right", va="top", fontsize=8, color=look.SOFT)
    replace(path, svg(figure))
    if also:
        drawn = printed(figure)
        fold_exponents(drawn)
        write_figure(drawn, path.with_suffix(f".{also}"))


def _time_figure(source: Source, entry: PlotEntry, marks: Mapping[str, Sequence[Mark]], width: int = 110) -> Figure:
    """Signals over time: one row a unit, without those that were never published."""
    curves = [source.shown(entry, name) for name in entry.signals]
    rows = by_unit([c for c in curves if len(c.x)])
    figure = Figure(figsize=(look.WIDTH, 1.6 + 2.3 * max(1, len(rows))), dpi=look.DPI)
    axes = figure.column(max(1, len(rows)))
    scale, time = time_scale(rows.values())
    for ax, (unit, row) in zip(axes, rows.items(), strict=False):
        if is_logic(row):
            draw_logic(ax, row, scale)
            continue
        draw(ax, row, scale)
        _limit_time(ax, entry, scale)
        entries = draw_marks(ax, [m for c in row for m in marks.get(c.signal, ())], scale)
        ax.set_ylabel(_value_title(row, unit, entry.quantity))
        if len(row) > 1 or entries:
            legend(ax, row, "", width, entries)
    _limit_time(axes[-1], entry, scale)
    if not rows:
        axes[0].set_axis_off()
    missing = [c.label for c in curves if not len(c.x)]
    if missing:
        note(figure, f"nothing published: {', '.join(missing)}")
    figure.align_ylabels()
    axes[-1].set_xlabel(axis_title("Time", time))
    return figure


def _limit_time(ax: Axes, entry: PlotEntry, scale: float) -> None:
    if entry.window:
        ax.set_xlim(entry.window[0] * scale, entry.window[1] * scale)


def _value_title(row: Sequence[Curve], unit: str, title: str = "") -> str:
    """Return a value axis's title: that of the entry, else the quantity of the unit, else the only curve's label."""
    name = title or quantity(unit) or (row[0].label if len(row) == 1 else "") or ("Value" if unit else "")
    return axis_title(name, unit)


def note(figure: Figure, text: str) -> None:
    """Report below a picture what it leaves out."""
    figure.supxlabel(text, fontsize=9, color=look.SOFT, x=0.008, ha="left")


def _xy_figure(source: Source, entry: PlotEntry) -> Figure:
    """Signals against another signal of their topic; a true shape where both axes have the same unit."""
    figure = Figure(figsize=(0.7 * look.WIDTH, 0.64 * look.WIDTH), dpi=look.DPI)
    ax = figure.subplots()
    results = [source.against(entry, name) for name in entry.signals]
    curves = [curve for _, curve in results]
    for curve, style in zip(curves, styles(curves), strict=True):
        ax.plot(curve.x, curve.y, label=curve.label, **style)
    ax.margins(0.05)
    over = _joined(source.units[name] for name, _ in results)
    unit = entry.unit or _joined(c.unit for c in curves)
    ax.set_xlabel(axis_title(_joined(source.axis(name) for name, _ in results), over))
    ax.set_ylabel(axis_title(entry.quantity or _joined(source.axis(name) for name in entry.signals), unit))
    if over == unit:
        ax.set_aspect("equal", adjustable="datalim")
    legend(ax, curves, "", 70)
    return figure


def _overview(source: Source) -> Figure:
    """Every signal over time, one small axes for each unit of each topic, topics down the columns."""
    panels = list(_panels(source))
    columns = 1 if len(panels) < 4 else 2
    rows = max(1, -(-len(panels) // columns))
    figure = Figure(figsize=(look.WIDTH, 0.9 + 1.55 * rows), dpi=look.DPI, line=1.0)
    scale, time = time_scale([row for _, _, row in panels])
    axes: list[Axes] = []
    for cell, (topic, unit, row) in zip(places(figure, len(panels), columns), panels, strict=True):
        ax = figure.add_subplot(cell, sharex=axes[0] if axes else None)
        axes.append(ax)
        ax.tick_params(labelsize=8, labelbottom=False)
        if cell.rowspan.stop == rows:
            ax.tick_params(labelbottom=True)
            ax.set_xlabel(axis_title("Time", time), fontsize=9)
        if is_logic(row):
            row, title = _without_field(row, topic)
            draw_logic(ax, row, scale)
            ax.set_title(title, loc="left", fontsize=9)
            continue
        draw(ax, row, scale)
        ax.set_ylabel(pretty_unit(unit), gid=UNIT)
        if len(row) == 1:
            ax.set_title(f"{topic}/{row[0].label}", loc="left", fontsize=9)
        else:
            legend(ax, *_without_field(row, topic), 55)
    figure.align_ylabels()
    if source.silent:
        note(figure, f"nothing published on {', '.join(source.silent)}")
    return figure


def places(figure: Figure, count: int, columns: int) -> list[Place]:
    """Divide a figure into full columns: with an odd number the first plot has the whole width.

    Parameters
    ----------
    count : int
        Of axes.
    columns : {1, 2}
    """
    if not count:
        return []
    rows = -(-count // columns)
    grid = figure.add_gridspec(rows, columns)
    wide = columns * rows - count
    results = [grid[0, :]] if wide else []
    return results + [grid[row, column] for column in range(columns) for row in range(wide, rows)]


def _panels(source: Source) -> Iterator[tuple[str, str, list[Curve]]]:
    for topic in source.published:
        for unit, row in by_unit([reduced(source.curve(n, source.axis(n))) for n in source.names(topic)]).items():
            yield topic, unit, row


def _without_field(row: Sequence[Curve], topic: str) -> tuple[list[Curve], str]:
    """Move the field that all labels end with to the title: ``joint1`` below ``joint_states/*/position``."""
    fields = {curve.label.partition("/")[2] for curve in row}
    field = fields.pop() if len(fields) == 1 else ""
    if not field:
        return list(row), topic
    return [changed(curve, label=curve.label.partition("/")[0]) for curve in row], f"{topic}/*/{field}"


def time_scale(groups: Iterable[Sequence[Curve]]) -> tuple[float, str]:
    """Return factor and unit of the time axis: milliseconds for very short runs, seconds for all others."""
    longest = max((c.x[-1] for group in groups for c in group if len(c.x)), default=0.0)
    return (1e3, "ms") if 0.0 < longest < 0.1 else (1.0, "s")


def _joined(words: Iterable[str]) -> str:
    """Return the different words in their order, joined."""
    return ", ".join(dict.fromkeys(w for w in words if w))
