"""The scenario's pictures as they move: axes for each unit of a plot, curves of some thousand points at most."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, CrosshairTool, DataRange1d, HoverTool, InlineStyleSheet, Range1d, Span
from bokeh.plotting import figure
from softrig_core import Rig
from softrig_core.judge.units import pretty_unit
from softrig_core.rig.members import signal_units
from softrig_core.scenario.plot_entry import PlotEntry

from ..plots.curves import Curve, Source as Curves, envelope
from ..plots.style import MANY, axis_title, quantity
from .look import CHANGED, COLOURS, INK, SOFT
from .tracks import Pane

DASHED = ([6, 4], [2, 3], [11, 3, 2, 3])  # dashes of references, as in printed pictures
AXIS = 84  # pixels left of all pictures, so that their time axes are aligned
COLUMNS = 500  # pixel columns of a picture, each with at most four points of a curve
# Low pictures, so that the knobs below remain visible.
LOW = "@media (max-width: 800px) { :host { height: 230px !important; } }"
LEGEND = 3  # curves beside each other in the legend; more would need two lines on a narrow page
TOOLS = "xpan,box_zoom,xwheel_zoom,save"


class Picture:
    """One plot of a scenario over time, or one signal over another.

    Parameters
    ----------
    time : Range1d
        Shared by all pictures over time.
    cursor : Span
        Shared line at one time.
    changes : ColumnDataSource
        Column ``t``: when parameters changed.
    theme : {"light", "dark"}

    Attributes
    ----------
    figures : list
        Bokeh's, one for each unit.
    """

    def __init__(
        self, entry: PlotEntry, rig: Rig, time: Range1d, cursor: Span, changes: ColumnDataSource, theme: str
    ) -> None:
        self._entry = entry.model_copy(update={"window": None})  # the reader of the page chooses the window
        self._curves = Curves(Pane({}), rig)  # type: ignore[arg-type]
        self._theme = theme
        self.sources: dict[str, ColumnDataSource] = {}
        named = {name: self._curves.shown(self._entry, name) for name in entry.signals}
        if entry.x:
            self.figures = [self._plane(named)]
            return
        units: dict[str, list[str]] = {}
        for name, curve in named.items():
            units.setdefault(curve.unit, []).append(name)
        self.figures = [
            self._over_time(unit, names, named, time, cursor, changes, first=k == 0)
            for k, (unit, names) in enumerate(units.items())
        ]

    def _over_time(
        self,
        unit: str,
        names: Sequence[str],
        named: dict[str, Curve],
        time: Range1d,
        cursor: Span,
        changes: ColumnDataSource,
        *,
        first: bool,
    ) -> Any:
        title = axis_title(self._entry.quantity or quantity(unit), unit) or "value"
        result = figure(
            x_range=time,
            y_range=DataRange1d(only_visible=True),
            height=230,
            tools=TOOLS,
            active_drag="box_zoom",
            sizing_mode="stretch_width",
            title=self._entry.title if first else None,
            x_axis_label="t, s",
            y_axis_label=title,
        )
        result.vspan(x="t", source=changes, line_color=CHANGED[self._theme], line_dash="dotted", line_width=1)
        lines = self._lines(result, names, named)
        result.add_layout(cursor)
        text = f"$name: @y{{%.6g}} {pretty_unit(unit)} at @x{{%.6g}} s"
        result.add_tools(
            HoverTool(
                renderers=lines,
                mode="vline",
                line_policy="prev",
                tooltips=text,
                formatters={"@y": "printf", "@x": "printf"},
            ),
            CrosshairTool(dimensions="height", line_color=SOFT[self._theme], line_alpha=0.6),
        )
        return result

    def _plane(self, named: dict[str, Curve]) -> Any:
        over = self._curves.axis(f"{self._curves.topic(next(iter(named)))}/{self._entry.x}")
        unit = next(iter(named.values())).unit
        result = figure(
            height=380,
            tools="pan,box_zoom,wheel_zoom,reset,save",
            active_drag="box_zoom",
            match_aspect=True,
            sizing_mode="stretch_width",
            title=self._entry.title,
            x_axis_label=axis_title(over, unit),
            y_axis_label=axis_title(self._entry.quantity or quantity(unit), unit),
        )
        lines = self._lines(result, list(named), named)
        result.add_tools(
            HoverTool(
                renderers=lines,
                tooltips="$name: @x{%.6g}, @y{%.6g}",
                line_policy="nearest",
                formatters={"@y": "printf", "@x": "printf"},
            )
        )
        return result

    def _lines(self, value: Any, names: Sequence[str], named: dict[str, Curve]) -> list[Any]:
        lines, colours, dashes = [], iter(COLOURS[self._theme] * len(names)), iter(DASHED * len(names))
        alone = all(named[name].reference for name in names)
        for name in sorted(names, key=lambda n: named[n].reference):  # references are drawn on top
            curve = named[name]
            dark = curve.reference and not alone
            style: dict[str, Any] = {"line_color": INK[self._theme] if dark else next(colours)}
            style["line_width"] = 1.2 if dark else 1.4
            if curve.reference:
                style["line_dash"] = next(dashes)
            source = self.sources[name] = ColumnDataSource({"x": [], "y": []}, name=f"{self._entry.title}: {name}")
            lines.append(value.line("x", "y", source=source, legend_label=curve.label, name=curve.label, **style))
        value.legend.orientation, value.legend.click_policy, value.legend.ncols = "horizontal", "hide", "auto"
        if len(lines) > LEGEND:
            value.legend.ncols = LEGEND
        value.legend.location = "left"
        value.min_border_left = AXIS
        value.add_layout(value.legend[0], "above")
        value.toolbar.autohide = True
        value.stylesheets = [InlineStyleSheet(css=LOW)]
        return lines

    def show(self, pane: Pane, end: float) -> None:
        """Draw the data in a window of time; held values are drawn up to `end`, s."""
        self._curves.signals, self._curves.end = pane, end  # type: ignore[assignment]
        for name, source in self.sources.items():
            if self._entry.x:
                curve = self._curves.against(self._entry, name)[1]
                at = np.arange(0, len(curve.x), max(1, len(curve.x) // (4 * COLUMNS)))
                x, y = curve.x[at], curve.y[at]
            else:
                curve = self._curves.shown(self._entry, name)
                x, y = envelope(curve.x, curve.y, COLUMNS)
                if curve.held and len(x):
                    x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
            source.data = {"x": x, "y": y}

    def values(self, pane: Pane) -> dict[str, tuple[float | None, str]]:
        """Return the newest value and the unit of each signal, by its label; without signals drawn over another
        signal.
        """
        self._curves.signals, self._curves.end = pane, 0.0  # type: ignore[assignment]
        result: dict[str, tuple[float | None, str]] = {}
        for name in () if self._entry.x else self.sources:
            curve = self._curves.shown(self._entry, name)
            result[f"{self._entry.title}: {curve.label}"] = float(curve.y[-1]) if len(curve.y) else None, curve.unit
        return result


def plots_of(rig: Rig) -> tuple[PlotEntry, ...]:
    """Return the plots of a rig's scenario; if it has none, one for each topic.

    The reader chooses the window, so a plot of a part of another one would repeat that one.
    """
    if plots := rig.scenario.plots:
        complete = [(p.signals, p.x) for p in plots if p.window is None]
        return tuple(p for p in plots if p.window is None or (p.signals, p.x) not in complete)
    units = signal_units(rig)
    return tuple(
        PlotEntry(title=topic, signals={f"{topic}/{label}": "" for label in port.labels[:MANY]})
        for topic, port in rig.topics.items()
        if port.labels and f"{topic}/{port.labels[0]}" in units
    )
