"""Pictures of a study: figures over the varied parameters, distributions, maps, searches, bands of signals."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import Array

from ..plots.canvas import Axes, Cells, Figure
from ..plots.named import plot_name
from ..plots.overlay import BAND
from ..plots.pictures import note, places, save_figure
from ..plots.shades import shades
from ..plots.style import COLOURS, DPI, WIDTH, axis_title, quantity
from .definition import Search, Study
from .table import label
from .work import absent, value_of

Row = Mapping[str, Any]
TICKS = 12  # values of a parameter up to which each has a tick
LOST = "#b3261e"  # colour of points without a value
FEW = 3  # histograms that can be distinguished when they overlap
MOST = 6  # figures, and groups of curves, that fit in a picture


def draw_study(
    study: Study, rows: Sequence[Row], signals: Iterable[Row], folder: Path, units: Mapping[str, str], also: str = ""
) -> list[Path]:
    """Draw the pictures that suit the study's form.

    Parameters
    ----------
    rows : sequence
        By number.
    signals : iterable
        Rows with the key ``signals``; read once.
    units : mapping
        Unit of each figure, parameter (``node.name``) and signal.
    also : str
        pdf or png: a file of this kind beside each SVG, by matplotlib.

    Returns
    -------
    list of Path
        Of the pictures, in their order.
    """
    paths = []
    for number, (title, figure) in enumerate(_figures(study, rows, signals, units), 1):
        paths.append(folder / plot_name(number, title))
        save_figure(figure, paths[-1], title, study.name, also)
    return paths


def _figures(
    study: Study, rows: Sequence[Row], signals: Iterable[Row], units: Mapping[str, str]
) -> Iterator[tuple[str, Figure]]:
    names = chosen(study, rows)
    varied = numeric(rows)
    if not names:
        return
    if study.search:
        yield f"Search: {study.search.figure.replace('_', ' ')}", _history(study.search, rows, units)
        yield "Search: parallel coordinates", _parallel(study.search, rows)
    for parameter in varied[:3]:
        yield f"Figures over {parameter}", _over(rows, parameter, names, units, banded=parameter in study.grid)
    if len(varied) == 2:
        yield f"Map of {names[0].replace('_', ' ')}", _map(rows, varied, names[0], units)
    if len(rows) > 4 and not study.search and (not varied or study.grid or study.draws):
        yield "Distribution over the runs", _distribution(study, rows, names, units)
    if study.signals:
        yield from _bands(study, signals, units)


def chosen(study: Study, rows: Sequence[Row]) -> list[str]:
    """Figures that are drawn: those that the study names, or the first that were measured."""
    measured = list(
        dict.fromkeys(
            k for row in rows for k, v in row["figures"].items() if v is not None or k in row.get("never", ())
        )
    )
    named = [*study.figures, *(s.figure for s in study.summaries.values())]
    return [n for n in dict.fromkeys(named or measured) if n in measured][:MOST]


def numeric(rows: Sequence[Row]) -> list[str]:
    """Return the parameters that every run has, with more than one value, all of them numbers."""
    values_of: dict[str, list[Any]] = {}
    for row in rows:
        for name, value in row["overrides"].items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            values_of.setdefault(name, []).append(value if number else None)
    # Parameters that only one case sets have no place on an axis for the others.
    every = {name: {*values} for name, values in values_of.items() if len(values) == len(rows)}
    return [name for name, values in every.items() if None not in values and len(values) > 1]


def _axes(count: int, height: float = 2.6) -> tuple[Figure, list[Axes]]:
    columns = min(2, count)
    figure = Figure(figsize=(WIDTH, height * -(-count // columns) + 0.6), dpi=DPI)
    return figure, [figure.add_subplot(cell) for cell in places(figure, count, columns)]


def _name(figure: str, units: Mapping[str, str]) -> str:
    return axis_title(figure.replace("_", " "), units.get(figure, ""))


def _columns(rows: Iterable[Row], parameter: str, figure: str) -> tuple[Array, Array]:
    """Values of a parameter and of a figure: infinity for never, NaN for not measured."""
    pairs = [(row["overrides"][parameter], value_of(row, figure)) for row in rows if parameter in row["overrides"]]
    return np.array([x for x, _ in pairs], float), np.array([y for _, y in pairs], float)


def _over(
    rows: Sequence[Row], parameter: str, names: Sequence[str], units: Mapping[str, str], *, banded: bool
) -> Figure:
    """Draw figures over a parameter; runs without a value are counted at the top and enter the median as infinity."""
    figure, axes = _axes(len(names))
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["case"], []).append(row)
    most = 1
    for ax, name in zip(axes, names, strict=True):
        for case, members in list(groups.items())[:MOST]:
            named = f"{case}, n = {len(members)}" if case else None
            x, y = _columns(members, parameter, name)
            points = np.unique(x)
            sure = np.isfinite(y)
            if banded:
                most = max(most, *(int((x == v).sum()) for v in points))
                middle = np.array([_median(y[x == v]) for v in points])
                (line,) = ax.plot(points, middle, "o-", markersize=3, label=named)
                ends = [(v, y[(x == v) & sure]) for v in points if ((x == v) & sure).any()]
                ax.fill_between(
                    [v for v, _ in ends],
                    [w.min() for _, w in ends],
                    [w.max() for _, w in ends],
                    color=line.get_color(),
                    alpha=0.2,
                    linewidth=0,
                )
                for v in points:
                    if lost := absent(y[x == v]):
                        _lost(ax, [v], f"{case}: {lost}" if case else lost)
                if len(points) <= TICKS:
                    ax.set_xticks(points)
            else:
                ax.plot(x[sure], y[sure], ".", markersize=3, alpha=0.6, label=named)
                _lost(ax, x[~sure], "")
        every = [value_of(row, name) for row in rows]
        if lost := absent(every):
            ax.set_title(lost, loc="right", fontsize=9, color=LOST)
        ax.set_xlabel(axis_title(parameter, units.get(parameter, "")))
        ax.set_ylabel(_name(name, units))
        ax.margins(x=0.05)
    if banded and most > 1:
        note(
            figure,
            f"line: median of the runs at a value, those that never get there counted as the largest; band: "
            f"least to greatest of up to {most} runs",
        )
    if len(groups) > 1:
        axes[0].legend(fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return figure


def _median(values: Array) -> float:
    """Return the median, with infinity for an event that never happens; NaN, which is not drawn, if that is the
    median.
    """
    known = values[~np.isnan(values)]
    middle = float(np.median(known)) if known.size else np.nan
    return middle if np.isfinite(middle) else np.nan


def _lost(ax: Axes, x: Sequence[float] | Array, text: str) -> None:
    """Mark the runs without a value at the top of the axes."""
    for v in x:
        ax.plot([v], [0.96], "x", color=LOST, markersize=6, transform=ax.get_xaxis_transform(), clip_on=False, zorder=4)
        if text:
            ax.annotate(
                text,
                (v, 0.96),
                (0, -6),
                xycoords=ax.get_xaxis_transform(),
                textcoords="offset points",
                ha="center",
                va="top",
                fontsize=8,
                color=LOST,
            )


def _map(rows: Sequence[Row], varied: Sequence[str], name: str, units: Mapping[str, str]) -> Figure:
    """Draw a figure over two parameters, a map a case, all of one scale."""
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(row["case"], []).append(row)
    several = len(groups) > 1
    figure, axes = _axes(min(MOST, len(groups)), 3.0 if several else 4.5)
    known = [v for row in rows if (v := row["figures"].get(name)) is not None]
    scale = {"cmap": "viridis", "vmin": min(known), "vmax": max(known)}
    for ax, (case, members) in zip(axes, groups.items(), strict=False):
        drawn = _map_of(ax, members, varied, name, scale)
        ax.set_xlabel(axis_title(varied[0], units.get(varied[0], "")))
        ax.set_ylabel(axis_title(varied[1], units.get(varied[1], "")))
        if several:
            lost = absent(value_of(row, name) for row in members)
            ax.set_title(f"{case}, {len(members)} runs" + (f", ×: {lost}" if lost else ""), loc="left", fontsize=9)
    lost = absent(value_of(row, name) for row in rows)
    messages = [f"×: {lost}"] if lost and not several else []
    messages += [f"the first {MOST} of {len(groups)} cases"] if len(groups) > MOST else []
    if messages:
        note(figure, ", ".join(messages))
    figure.colorbar(drawn, ax=axes, label=_name(name, units))
    return figure


def _map_of(ax: Axes, rows: Sequence[Row], varied: Sequence[str], name: str, scale: Mapping[str, Any]) -> Cells:
    """Draw the map of one case, missing values as crosses; return the data of its colour bar."""
    placed = [row for row in rows if all(p in row["overrides"] for p in varied)]
    sure = [row["figures"].get(name) is not None for row in placed]
    x, y = (np.array([row["overrides"][p] for row in placed], float) for p in varied)
    z = np.array([row["figures"].get(name) for row in placed], float)
    at_x, at_y = np.unique(x), np.unique(y)
    if at_x.size * at_y.size <= 4 * x.size:  # the points form a grid, with at most three quarters of its places empty
        mean = np.full((at_y.size, at_x.size), np.nan)
        for i, v in enumerate(at_y):
            for j, u in enumerate(at_x):
                cell = z[(x == u) & (y == v) & sure]
                mean[i, j] = cell.mean() if cell.size else np.nan
        drawn = ax.pcolormesh(at_x, at_y, mean, shading="nearest", **scale)
        for set_ticks, ticks in ((ax.set_xticks, at_x), (ax.set_yticks, at_y)):
            if len(ticks) <= TICKS:
                set_ticks(ticks)
    else:
        drawn = ax.scatter(x[sure], y[sure], c=z[sure], s=8, **scale)
        ax.margins(x=0.03)  # space for points at the edge
    if not all(sure):
        ax.plot(x[~np.array(sure)], y[~np.array(sure)], "x", color=LOST, markersize=7, clip_on=False)
    ax.grid(False)
    return drawn


def _distribution(study: Study, rows: Sequence[Row], names: Sequence[str], units: Mapping[str, str]) -> Figure:
    figure, axes = _axes(len(names))
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(label(study, row), []).append(row)
    for ax, name in zip(axes, names, strict=True):
        values = [[v for r in members if (v := r["figures"].get(name)) is not None] for members in groups.values()]
        lost = {group: absent(value_of(row, name) for row in members) for group, members in groups.items()}
        if text := absent(value_of(row, name) for row in rows):
            ax.set_title(text, loc="right", fontsize=9, color=LOST)
        if len(groups) == 1 or (study.draws and len(groups) <= FEW and any(values)):
            edges = np.histogram_bin_edges(np.concatenate(values), min(40, max(8, max(map(len, values)) // 10)))
            several = len(groups) > 1
            for k, (group, sample) in enumerate(zip(groups, values, strict=True)):
                named = f"{group}, n = {len(sample)}" if several else None
                ax.hist(sample, bins=edges.tolist(), color=COLOURS[k], label=named, alpha=0.6 if several else None)
            ax.set_xlabel(_name(name, units))
            ax.set_ylabel("Runs")
        else:
            ax.boxplot(
                values,
                orientation="horizontal",
                tick_labels=[
                    f"{g}, n = {len(v)}" + (f" ({lost[g]})" if lost[g] else "")
                    for g, v in zip(groups, values, strict=True)
                ],
                flierprops={"markersize": 3},
            )
            ax.set_xlabel(_name(name, units))
            ax.tick_params(axis="y", labelsize=7)
        ax.margins(x=0.03)
    if axes[0].get_legend_handles_labels()[0]:
        axes[0].legend(fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2)
    return figure


def _history(search: Search, rows: Sequence[Row], units: Mapping[str, str]) -> Figure:
    figure, (ax,) = _axes(1, 3.5)
    n, y = (
        np.array([f(row) for row in rows], float) for f in (lambda r: r["number"], lambda r: value_of(r, search.figure))
    )
    sure = np.isfinite(y)
    good = sure & [all(limits.holds(value_of(row, f)) for f, limits in search.subject_to.items()) for row in rows]
    ax.plot(n[good], y[good], ".", markersize=4, alpha=0.5, label="run")
    if not good.all():
        ax.plot(n[sure & ~good], y[sure & ~good], "x", markersize=4, alpha=0.5, color=LOST, label="beyond the limits")
    better = np.minimum if search.aim == "minimise" else np.maximum
    ax.plot(n[good], better.accumulate(y[good]), drawstyle="steps-post", label="best so far")
    if text := absent(value_of(row, search.figure) for row in rows):
        ax.set_title(text, loc="right", fontsize=9, color=LOST)
    ax.set_xlabel("Run")
    ax.set_ylabel(_name(search.figure, units))
    ax.margins(x=0.03)
    ax.legend()
    return figure


def _parallel(search: Search, rows: Sequence[Row]) -> Figure:
    figure, (ax,) = _axes(1, 4.0)
    names = [n for n in numeric(rows) if n in search.parameters]
    sure = [row for row in rows if row["figures"].get(search.figure) is not None]
    if search.aim == "minimise":
        sure = sure[::-1]
    # Drawn last, so that the best run is on top.
    sure.sort(key=lambda r: r["figures"][search.figure], reverse=search.aim == "minimise")
    columns = [np.array([r["overrides"][n] for r in sure], float) for n in names]
    columns.append(np.array([r["figures"][search.figure] for r in sure], float))
    spans = [(c.min(), np.ptp(c) or 1.0) for c in columns]
    shares = np.linspace(0.0, 1.0, max(2, len(sure)))
    colours = shades("viridis", shares)
    for k in range(len(sure)):
        ax.plot(
            range(len(columns)),
            [(c[k] - lo) / span for c, (lo, span) in zip(columns, spans, strict=True)],
            color=colours[k],
            alpha=0.2 + 0.6 * shares[k],
            linewidth=0.8,
        )
    ticks = [f"{n}\n{lo:.4g} to {lo + span:.4g}" for n, (lo, span) in zip([*names, search.figure], spans, strict=True)]
    ax.set_xticks(range(len(columns)), ticks, fontsize=8)
    ax.set_yticks([])
    ax.margins(x=0.05)
    return figure


def _bands(study: Study, signals: Iterable[Row], units: Mapping[str, str]) -> Iterator[tuple[str, Figure]]:
    """Median of each group of runs, and the band between the quantiles."""
    groups: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in signals:
        name = label(study, row)
        if "signals" not in row or (name not in groups and len(groups) >= MOST):
            continue
        for signal, curves in row["signals"].items():
            if curves["x"]:
                groups.setdefault(name, {}).setdefault(signal, []).append(curves)
    for signal in study.signals:
        figure, (ax,) = _axes(1, 3.8)
        for name, curves in groups.items():
            sampled = [k for k in curves.get(signal, []) if len(k["x"]) == study.samples]
            if not sampled:
                continue
            t = np.linspace(0.0, sampled[0]["end"], study.samples)
            low, middle, high = np.quantile([k["x"] for k in sampled], (BAND[0], 0.5, BAND[1]), axis=0)
            share = f"median of {len(sampled)}, {BAND[0]:.0%} to {BAND[1]:.0%}".replace("%", " %")
            (line,) = ax.plot(t, middle, label=f"{name}: {share}" if len(sampled) > 1 else name)
            if len(sampled) > 1:
                ax.fill_between(t, low, high, color=line.get_color(), alpha=0.25, linewidth=0)
        ax.set_xlabel(axis_title("Time", "s"))
        ax.set_ylabel(axis_title(quantity(units.get(signal, "")) or "Value", units.get(signal, "")))
        ax.legend(fontsize=9, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
        yield f"Signal {signal}", figure
