"""A picture as a list of the few matplotlib calls that softrig's pictures need.

For pages, softrig writes it as SVG (`softrig_bringup.plots.svg`) in a hundredth of matplotlib's time. For papers,
matplotlib draws the same calls (`softrig_bringup.plots.printed`). Names and arguments are those of matplotlib, so that
functions that draw into one of these axes can draw into matplotlib's too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import wraps
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike
from softrig_core import Array

from .style import COLOURS

Dashes = str | tuple[float, Sequence[float]]
_Method = TypeVar("_Method", bound=Callable[..., Any])

MARKS = {"o": "o", "o-": "o", ".": ".", "x": "x"}  # marks of the line styles


@dataclass(eq=False)
class Artist:
    """Something in an axes that a legend can name."""

    label: str = ""
    zorder: float = 1.0
    color: str = "#000000"
    alpha: float = 1.0


@dataclass(eq=False)
class Line(Artist):
    """Points, joined or not; `up` where y is a share of the height of the axes."""

    x: Array = field(default_factory=lambda: np.empty(0))
    y: Array = field(default_factory=lambda: np.empty(0))
    linestyle: Dashes = "-"
    linewidth: float = 1.4
    marker: str = ""
    markersize: float = 6.0
    steps: bool = False
    up: bool = False
    clip_on: bool = True

    def get_ydata(self) -> Array:
        """Return the values."""
        return self.y

    def get_color(self) -> str:
        """Return the colour, as ``#rrggbb``."""
        return self.color


@dataclass(eq=False)
class Area(Artist):
    """A band between two curves, or a rectangle; `tall` where it has the height of the axes."""

    x: Array = field(default_factory=lambda: np.empty(0))
    low: Array = field(default_factory=lambda: np.empty(0))
    high: Array = field(default_factory=lambda: np.empty(0))
    linewidth: float = 0.0
    steps: bool = False
    tall: bool = False


@dataclass(eq=False)
class Rule(Artist):
    """A line across the axes, at a place of one of its directions."""

    axis: Literal["x", "y"] = "x"
    at: float = 0.0
    linestyle: Dashes = "-"
    linewidth: float = 1.4


@dataclass(eq=False)
class Cells(Artist):
    """Rectangles or dots with colours of their own: x0, y0, x1, y1 a row; dots have no extent but a size, points."""

    boxes: Array = field(default_factory=lambda: np.empty((0, 4)))
    colours: Sequence[str] = ()
    size: float = 0.0
    scale: tuple[float, float, str] = (0.0, 1.0, "viridis")


@dataclass(eq=False)
class Words(Artist):
    """Text at a point in data coordinates; with `across` x, with `up` y is a share of the axes instead."""

    text: str = ""
    x: float = 0.0
    y: float = 0.0
    offset: tuple[float, float] = (0.0, 0.0)
    up: bool = False
    across: bool = False
    rotation: float = 0.0
    ha: str = "left"
    va: str = "bottom"
    fontsize: float = 8.0
    boxed: bool = False

    def set_in_layout(self, counts: bool) -> None:
        """Accept matplotlib's layout option, which has no effect: texts inside axes are not part of the layout."""


@dataclass(frozen=True)
class Across:
    """Coordinates: one is data, the other a share of the axes."""

    data: Literal["x", "y"]


@dataclass(eq=False)
class Call:
    """One call, to be repeated on matplotlib's object of the same kind."""

    target: Any
    name: str
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    result: Any


def recorded(method: _Method) -> _Method:
    """Keep each call of a method in its figure as the caller wrote it, with its result."""

    @wraps(method)
    def call(target: Any, *args: Any, **kwargs: Any) -> Any:
        result = method(target, *args, **kwargs)
        getattr(target, "figure", target).calls.append(Call(target, method.__name__, args, kwargs, result))
        return result

    return cast(_Method, call)


class Axis:
    """One direction of an axes: limits, which several axes may share, ticks and title.

    Parameters
    ----------
    margin : float
        Share of the data that the limits leave free on either side.
    """

    def __init__(self, margin: float) -> None:
        self.margin = margin
        self.fixed: tuple[float, float] | None = None
        self._low, self._high = math.inf, -math.inf
        self._asked = False
        self._sticky: set[float] = set()

    def see(self, values: ArrayLike, sticky: Sequence[float] = ()) -> None:
        """Extend the limits to include values; no margin is added beyond a sticky one."""
        self._asked = True
        known = np.asarray(values, float)
        known = known[np.isfinite(known)]
        if known.size:
            self._low, self._high = min(self._low, float(known.min())), max(self._high, float(known.max()))
        self._sticky |= set(sticky)

    def limits(self) -> tuple[float, float]:
        """Return lower and upper limit."""
        if self.fixed:
            return self.fixed
        if not self._asked:
            return 0.0, 1.0
        low, high = (self._low, self._high) if self._low <= self._high else (0.0, 0.0)
        if high - low <= 1e-15 * max(abs(low), abs(high)):
            wide = 0.05 * max(abs(low), abs(high)) or 0.05
            low, high = low - wide, high + wide
        room = self.margin * (high - low)
        return low if low in self._sticky else low - room, high if high in self._sticky else high + room

    def extent(self) -> tuple[float, float]:
        """Return the range of the visible data; the limits if there is none."""
        low, high = self.limits()
        return (max(low, self._low), min(high, self._high)) if self._low <= self._high else (low, high)


class Axes:
    """One coordinate system of a picture.

    Parameters
    ----------
    place : Place, optional
        In its grid; none: the whole.
    share : Axes, optional
        With which it has its x axis in common.
    """

    def __init__(self, figure: Figure, place: Place, share: Axes | None = None) -> None:
        self.figure = figure
        self.place = place
        self.items: list[Artist] = []
        self.x: Axis = share.x if share else Axis(0.0)
        self.y: Axis = Axis(0.05)
        self.titles = {"x": "", "y": ""}
        self.sizes = {"x": 10.0, "y": 10.0}
        self.ticks: dict[str, tuple[list[float], list[str] | None] | None] = {"x": None, "y": None}
        self.tick_sizes = {"x": 10.0, "y": 10.0}
        self.whole = False
        self.numbered = True  # whether numbers are printed below the axes
        self.dashes = True  # whether ticks at the y axis have a length
        self.gridded = {"x": True, "y": True}
        self.unit_alone = False
        self.heads: dict[str, tuple[str, float, str]] = {}
        self.named: tuple[list[tuple[Artist, str]], str, int, float] | None = None
        self.on = True
        self.equal = False
        self._next = 0

    @property
    def lines(self) -> list[Line]:
        """Lines that were drawn, in order."""
        return [item for item in self.items if isinstance(item, Line)]

    @recorded
    def plot(
        self,
        x: ArrayLike,
        y: ArrayLike,
        form: str = "-",
        *,
        label: str | None = None,
        color: str | None = None,
        linestyle: Dashes = "-",
        linewidth: float | None = None,
        marker: str = "",
        markersize: float = 6.0,
        alpha: float | None = None,
        drawstyle: str = "default",
        zorder: float = 2.0,
        transform: Across | None = None,
        clip_on: bool = True,
    ) -> list[Line]:
        """Draw a line or marks."""
        if color is None:
            color = COLOURS[self._next % len(COLOURS)]
            self._next += 1
        line = Line(
            label=label or "",
            zorder=zorder,
            color=color,
            alpha=1.0 if alpha is None else alpha,
            x=np.asarray(x, float),
            y=np.asarray(y, float),
            linestyle="" if form in (".", "x") else linestyle,
            linewidth=self.figure.line if linewidth is None else linewidth,
            marker=marker or MARKS.get(form, ""),
            markersize=markersize,
            steps=drawstyle == "steps-post",
            up=transform is not None,
            clip_on=clip_on,
        )
        self.items.append(line)
        if transform is None:
            known = np.isfinite(line.x) & np.isfinite(line.y)
            self.x.see(line.x[known])
            self.y.see(line.y[known])
        else:
            self.x.see(line.x)
        return [line]

    @recorded
    def fill_between(
        self,
        x: ArrayLike,
        low: ArrayLike,
        high: ArrayLike,
        *,
        color: str,
        alpha: float,
        linewidth: float = 0.0,
        zorder: float = 1.0,
        step: Literal["post"] | None = None,
    ) -> Area:
        """Fill the area between two curves."""
        x = np.asarray(x, float)
        low, high = np.broadcast_to(np.asarray(low, float), x.shape), np.broadcast_to(np.asarray(high, float), x.shape)
        area = Area("", zorder, color, alpha, x, low, high, linewidth, step == "post")
        self.items.append(area)
        self.x.see(x)
        self.y.see([*low, *high])
        return area

    @recorded
    def axvspan(
        self, start: float, end: float, *, color: str, alpha: float, linewidth: float = 0.0, zorder: float = 1.0
    ) -> Area:
        """Shade an interval of x."""
        area = Area("", zorder, color, alpha, np.array([start, end]), np.zeros(2), np.ones(2), linewidth, tall=True)
        self.items.append(area)
        self.x.see(area.x)
        return area

    @recorded
    def axvline(self, at: float, *, color: str, linestyle: Dashes, linewidth: float, zorder: float = 2.0) -> Rule:
        """Draw a line from bottom to top."""
        rule = Rule("", zorder, color, 1.0, "x", at, linestyle, linewidth)
        self.items.append(rule)
        self.x.see([at])
        return rule

    @recorded
    def axhline(self, at: float, *, color: str, linewidth: float) -> Rule:
        """Draw a line from left to right."""
        rule = Rule("", 2.0, color, 1.0, "y", at, "-", linewidth)
        self.items.append(rule)
        self.y.see([at])
        return rule

    @recorded
    def annotate(
        self,
        text: str,
        xy: tuple[float, float],
        xytext: tuple[float, float],
        *,
        xycoords: tuple[str, str] | Across,
        textcoords: str,
        ha: str,
        va: str,
        fontsize: float,
        color: str,
        rotation: float = 0.0,
        zorder: float = 3.0,
        bbox: Mapping[str, Any] | None = None,
    ) -> Words:
        """Write a text at a point, some points of type beside it."""
        up = xycoords == ("data", "axes fraction") or xycoords == Across("x")
        label = Words(
            "", zorder, color, 1.0, text, *xy, xytext, up, xycoords == Across("y"), rotation, ha, va, fontsize,
            bbox is not None,
        )  # fmt: skip
        self.items.append(label)
        return label

    @recorded
    def scatter(self, x: Array, y: Array, *, c: Array, s: float, cmap: str, vmin: float, vmax: float) -> Cells:
        """Draw dots whose colours are values."""
        dots = Cells(
            boxes=np.stack([x, y, x, y], axis=1),
            colours=_colours(c, cmap, vmin, vmax),
            size=s,
            scale=(vmin, vmax, cmap),
        )
        self.items.append(dots)
        self.x.see(x)
        self.y.see(y)
        return dots

    @recorded
    def pcolormesh(
        self, x: Array, y: Array, values: Array, *, shading: Literal["nearest"], cmap: str, vmin: float, vmax: float
    ) -> Cells:
        """Draw a map: a rectangle about each pair of x and y."""
        edges_x, edges_y = _edges(x), _edges(y)
        x0, y0 = (a.ravel() for a in np.meshgrid(edges_x[:-1], edges_y[:-1]))
        x1, y1 = (a.ravel() for a in np.meshgrid(edges_x[1:], edges_y[1:]))
        cells = Cells(
            boxes=np.stack([x0, y0, x1, y1], axis=1),
            colours=_colours(values.ravel(), cmap, vmin, vmax),
            scale=(vmin, vmax, cmap),
        )
        self.items.append(cells)
        self.x.see(edges_x, (edges_x[0], edges_x[-1]))
        self.y.see(edges_y, (edges_y[0], edges_y[-1]))
        return cells

    @recorded
    def hist(
        self,
        values: Sequence[float],
        *,
        bins: Sequence[float],
        color: str,
        label: str | None = None,
        alpha: float | None = None,
    ) -> None:
        """Draw how many values lie in each bin."""
        counts, edges = np.histogram(values, bins)
        boxes = np.stack([edges[:-1], 0.0 * counts, edges[1:], counts], axis=1)
        bars = Cells(label or "", 1.0, color, 1.0 if alpha is None else alpha, boxes, [color] * len(counts))
        self.items.append(bars)
        self.x.see(edges)
        self.y.see([0.0, *counts], (0.0,))

    @recorded
    def boxplot(
        self,
        values: Sequence[Sequence[float]],
        *,
        orientation: Literal["horizontal"],
        tick_labels: Sequence[str],
        flierprops: Mapping[str, Any],
    ) -> None:
        """Draw quartiles, values within 1.5 interquartile ranges, and outliers, one row for each group."""
        for row, group in enumerate(values, 1):
            for line in _box(np.asarray(group, float), float(row), flierprops["markersize"]):
                self.items.append(line)
                self.x.see(line.x)
        self.y.fixed = (0.5, len(values) + 0.5)
        self.ticks["y"] = [float(k) for k in range(1, len(values) + 1)], list(tick_labels)

    def get_xlim(self) -> tuple[float, float]:
        """Return the limits of x."""
        return self.x.limits()

    def get_ylim(self) -> tuple[float, float]:
        """Return the limits of y."""
        return self.y.limits()

    @recorded
    def set_xlim(self, low: float, high: float) -> None:
        """Set the limits of x."""
        self.x.fixed = (low, high)

    @recorded
    def set_ylim(self, low: float, high: float) -> None:
        """Set the limits of y."""
        self.y.fixed = (low, high)

    @recorded
    def margins(self, both: float | None = None, *, x: float | None = None, y: float | None = None) -> None:
        """Set the free share of the data range beside the data."""
        for axis, share in ((self.x, x), (self.y, y)):
            share = both if both is not None else share
            if share is not None:
                axis.margin = share

    @recorded
    def set_xlabel(self, text: str, *, fontsize: float | None = None) -> None:
        """Set the title of the x axis."""
        self.titles["x"], self.sizes["x"] = text, fontsize or 10.0

    @recorded
    def set_ylabel(self, text: str, *, gid: str | None = None) -> None:
        """Set the title of the y axis; `gid` marks a title that is only a unit."""
        self.titles["y"], self.unit_alone = text, gid is not None

    @recorded
    def set_title(self, text: str, *, loc: Literal["left", "right"], fontsize: float, color: str | None = None) -> None:
        """Write a title above the axes."""
        self.heads[loc] = text, fontsize, color or "#222222"

    @recorded
    def set_xticks(
        self, ticks: Sequence[float] | Array, labels: Sequence[str] | None = None, *, fontsize: float | None = None
    ) -> None:
        """Set the ticks of the x axis and their labels."""
        self._set_ticks("x", ticks, labels)
        if fontsize:
            self.tick_sizes["x"] = fontsize

    @recorded
    def set_yticks(self, ticks: Sequence[float] | Array, labels: Sequence[str] | None = None) -> None:
        """Set the ticks of the y axis and their labels."""
        self._set_ticks("y", ticks, labels)

    def _set_ticks(self, axis: str, ticks: Sequence[float] | Array, labels: Sequence[str] | None) -> None:
        results = [float(t) for t in ticks]
        self.ticks[axis] = results, None if labels is None else list(labels)
        along = self.x if axis == "x" else self.y
        if results:  # as in matplotlib, the limits include each tick
            low, high = along.limits()
            if along.fixed or min(results) < low or max(results) > high:
                along.fixed = min(low, *results), max(high, *results)

    @recorded
    def whole_numbers(self) -> None:
        """Set ticks of the x axis at whole numbers only."""
        self.whole = True

    @recorded
    def tick_params(
        self,
        *,
        axis: Literal["both", "y"] = "both",
        labelsize: float | None = None,
        labelbottom: bool | None = None,
        length: float | None = None,
    ) -> None:
        """Set the size of the tick labels, whether they are drawn below the axis, and whether ticks have a length."""
        if labelsize:
            self.tick_sizes |= dict.fromkeys(("x", "y") if axis == "both" else (axis,), labelsize)
        if labelbottom is not None:
            self.numbered = labelbottom
        if length is not None:
            self.dashes = length > 0.0

    @recorded
    def grid(self, visible: bool = True, axis: Literal["both", "x", "y"] = "both") -> None:
        """Show or hide lines of the grid."""
        self.gridded |= dict.fromkeys(("x", "y") if axis == "both" else (axis,), visible)

    @recorded
    def set_aspect(self, aspect: Literal["equal"], *, adjustable: Literal["datalim"]) -> None:
        """Use the same scale for both axes."""
        self.equal = True

    @recorded
    def set_axis_off(self) -> None:
        """Show no axes."""
        self.on = False

    def get_xaxis_transform(self) -> Across:
        """Return coordinates with x as data and y as a share of the axes."""
        return Across("x")

    def get_yaxis_transform(self) -> Across:
        """Return coordinates with y as data and x as a share of the axes."""
        return Across("y")

    def get_legend_handles_labels(self) -> tuple[list[Artist], list[str]]:
        """Return the labelled elements, and their labels."""
        named = [item for item in self.items if item.label]
        return named, [item.label for item in named]

    @recorded
    def legend(
        self,
        handles: Sequence[Artist] | None = None,
        labels: Sequence[str] | None = None,
        *,
        title: str | None = None,
        ncols: int = 1,
        fontsize: float = 10.0,
        **how: Any,
    ) -> None:
        """Draw a legend above the axes; `how` applies only to print."""
        if handles is None or labels is None:
            handles, labels = self.get_legend_handles_labels()
        self.named = list(zip(handles, labels, strict=True)), title or "", ncols, fontsize


@dataclass(frozen=True)
class Place:
    """A part of a grid: rows and columns, the last not in it."""

    grid: Grid
    key: Any
    rowspan: range
    colspan: range


@dataclass(eq=False)
class Grid:
    """Rows and columns that a picture is divided into."""

    rows: int
    columns: int

    def __getitem__(self, key: tuple[int, int | slice]) -> Place:
        row, column = key
        across = range(self.columns)[column] if isinstance(column, slice) else range(column, column + 1)
        return Place(self, key, range(row, row + 1), across)


class Figure:
    """A picture.

    Parameters
    ----------
    figsize : (float, float)
        Width and height, inches.
    dpi : float
        Pixels an inch.
    line : float
        Width of lines, points.
    """

    def __init__(self, figsize: tuple[float, float], *, dpi: float, line: float = 1.4) -> None:
        self.size = figsize
        self.dpi = dpi
        self.line = line
        self.axes: list[Axes] = []
        self.calls: list[Call] = []
        self.title = ""
        self.run = ""
        self.below = ""
        self.bar: tuple[Cells, str] | None = None

    def column(self, rows: int) -> list[Axes]:
        """Divide into rows that have their x axis in common."""
        grid = Grid(rows, 1)
        result: list[Axes] = []
        for k in range(rows):
            result.append(Axes(self, grid[k, 0], result[0] if result else None))
            result[-1].numbered = k == rows - 1
        self.axes += result
        array = np.empty((rows, 1), object)
        array[:, 0] = result
        self.calls.append(Call(self, "subplots", (rows, 1), {"sharex": True, "squeeze": False}, array))
        return result

    @recorded
    def subplots(self) -> Axes:
        """Create one axes of the whole."""
        axes = Axes(self, Grid(1, 1)[0, 0])
        self.axes.append(axes)
        return axes

    @recorded
    def add_gridspec(self, rows: int, columns: int) -> Grid:
        """Divide into rows and columns."""
        return Grid(rows, columns)

    @recorded
    def add_subplot(self, place: Place, sharex: Axes | None = None) -> Axes:
        """Create an axes of a part of a grid."""
        axes = Axes(self, place, sharex)
        self.axes.append(axes)
        return axes

    @recorded
    def suptitle(self, text: str, **how: Any) -> None:
        """Write the title of the picture; `how` applies only to print, as in the next two methods."""
        self.title = text

    @recorded
    def supxlabel(self, text: str, **how: Any) -> None:
        """Write a title below all axes."""
        self.below = text

    @recorded
    def text(self, x: float, y: float, text: str, **how: Any) -> None:
        """Write a small text in the upper right corner."""
        self.run = text

    @recorded
    def align_ylabels(self) -> None:
        """Do nothing; an SVG of softrig always aligns the titles of y axes."""

    @recorded
    def colorbar(self, cells: Cells, *, ax: Sequence[Axes], label: str) -> None:
        """Draw the colour scale at the right of all axes."""
        self.bar = cells, label


def _colours(values: Array, scale: str, low: float, high: float) -> list[str]:
    from .shades import shades

    return shades(scale, (values - low) / ((high - low) or 1.0))


def _edges(centres: Array) -> Array:
    """Return the borders of cells about places, in the middle between neighbours."""
    if len(centres) < 2:
        return np.array([centres[0] - 0.5, centres[0] + 0.5])
    middle = (centres[1:] + centres[:-1]) / 2
    return np.concatenate([[2 * centres[0] - middle[0]], middle, [2 * centres[-1] - middle[-1]]])


def _box(values: Array, row: float, size: float) -> Iterator[Line]:
    """Return the lines of a box plot of one group (Tukey's: whiskers to the last values within 1.5 box lengths)."""
    if not values.size:
        return
    low, middle, high = np.percentile(values, (25, 50, 75))
    reach = 1.5 * (high - low)
    within = values[(values >= low - reach) & (values <= high + reach)]
    first, last = min(within.min(), low), max(within.max(), high)
    half = 0.25
    thin: dict[str, Any] = {"linewidth": 1.0, "color": "#222222", "zorder": 2.0}
    corners = [low, high, high, low, low], [row - half, row - half, row + half, row + half, row - half]
    for x, y in (corners, ([first, low], [row, row]), ([high, last], [row, row])):
        yield Line(x=np.array(x), y=np.array(y), **thin)
    for edge in (first, last):
        yield Line(x=np.array([edge, edge]), y=np.array([row - half / 2, row + half / 2]), **thin)
    yield Line(x=np.array([middle, middle]), y=np.array([row - half, row + half]), color=COLOURS[1], linewidth=1.0)
    beyond = values[(values < low - reach) | (values > high + reach)]
    if beyond.size:
        yield Line(x=beyond, y=np.full(beyond.size, row), color="#222222", linestyle="", marker="o", markersize=size)
