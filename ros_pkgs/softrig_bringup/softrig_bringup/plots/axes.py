"""Drawing into one axes: curves, switches, marks of expectations, legends, axis titles."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from softrig_core import Array

from . import style as look
from .canvas import Artist, Axes
from .curves import Curve, envelope, inked, logical
from .marks import NAMED, Mark
from .shades import shades

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Printed


UNIT = "unit"  # id of an axis title that is a unit alone
_BAND: dict[str, Any] = {"color": look.ACCEPTED, "alpha": 0.3, "linewidth": 1.0, "zorder": 1.5}
_VIOLATED: dict[str, Any] = {"color": look.VIOLATED, "alpha": 0.18, "linewidth": 0.0, "zorder": 1.4}
_LIMIT: dict[str, Any] = {"color": look.ACCEPTED, "linestyle": "-.", "linewidth": 1.3, "zorder": 1.6}
_PUBLISHED: dict[str, Any] = {"color": look.PUBLISHED, "linestyle": ":", "linewidth": 1.6, "zorder": 2.95}


def draw(ax: Axes, curves: Sequence[Curve], scale: float) -> None:
    """Draw curves over time, those with the most ink below the others, references on top.

    Parameters
    ----------
    scale : float
        From seconds to the unit of the time axis.
    """
    ink = [inked(c.y) if c.ink is None else c.ink for c in curves]
    for curve, style, amount in zip(curves, styles(curves), ink, strict=True):
        x, y = _drawn(curve, scale)
        steps = curve.ink is None and len(y) == len(curve.y) and (curve.held or _quantised(y))
        marker = "o" if len(x) == 1 else ""
        order = 2.0 + sum(a > amount for a in ink) / len(ink)
        ax.plot(
            x,
            y,
            marker=marker,
            drawstyle="steps-post" if steps else "default",
            label=curve.label,
            **({"zorder": order} | style),
        )
    _open_limits(ax)


def is_logic(curves: Sequence[Curve]) -> bool:
    """Return whether the curves are switches or buttons: several, all of them 0 or 1."""
    return 1 < len(curves) <= look.MANY and all(logical(c.y) if c.ink is None else c.logic for c in curves)


def _drawn(curve: Curve, scale: float) -> tuple[Array, Array]:
    """Return the points of a curve over time."""
    x = curve.x * scale
    return envelope(x, curve.y) if curve.ink is None else (x, curve.y)


def draw_logic(ax: Axes, curves: Sequence[Curve], scale: float) -> None:
    """Draw switches one above the other, as a logic analyser does."""
    levels = [1.4 * i for i in range(len(curves))][::-1]
    for curve, level, style in zip(curves, levels, styles(curves), strict=True):
        x, y = _drawn(curve, scale)
        steps = curve.ink is None and len(y) == len(curve.y)
        ax.plot(x, y + level, drawstyle="steps-post" if steps else "default", **style)
    ax.set_yticks([level + 0.5 for level in levels], [curve.label for curve in curves])
    ax.tick_params(axis="y", length=0)
    ax.grid(visible=False, axis="y")


def draw_marks(ax: Axes, marks: Sequence[Mark], scale: float) -> list[tuple[Artist, str]]:
    """Draw the accepted range as a band and the published value as a line; return the entries of the legend.

    Marks far outside of the curves are left out, because they would flatten the curves.

    Parameters
    ----------
    ax : Axes
        With its curves.
    scale : float
        From seconds to the unit of the time axis.
    """
    (x0, x1), (y0, y1) = ax.get_xlim(), ax.get_ylim()
    drawn: dict[str, Artist] = {}
    wanted: list[float] = []
    for mark in marks:
        if mark.axis == "violated":
            if mark.end * scale < x0 or mark.start * scale > x1:
                continue
            thin = 0.001 * (x1 - x0)  # so wide that the mark of a single instant is visible
            drawn["violated"] = ax.axvspan(mark.start * scale - thin, mark.end * scale + thin, **_VIOLATED)
            continue
        if mark.axis == "time":
            _instant(ax, mark, scale, (x0, x1), drawn)
            continue
        start, end = max(mark.start * scale, x0), min(mark.end * scale, x1)
        if start > end:
            continue
        span = (start, end) if start < end else (start - 0.01 * (x1 - x0), end + 0.01 * (x1 - x0))
        visible = [v for v in (mark.low, mark.high, mark.published) if _near(v, y0, y1)]
        wanted += visible
        limits = [b for b in (mark.low, mark.high) if b in visible]
        if len(limits) == 2 and mark.low < mark.high:
            drawn["accepted"] = ax.fill_between(span, mark.low, mark.high, **_BAND)
        elif limits:
            (drawn["limit"],) = ax.plot(span, limits[:1] * 2, **_LIMIT)
        if mark.published in visible:
            (drawn["published"],) = ax.plot(span, [mark.published] * 2, **_PUBLISHED)
    ax.set_xlim(x0, x1)
    if wanted:
        pad = 0.04 * (y1 - y0)
        ax.set_ylim(min(y0, min(wanted) - pad), max(y1, max(wanted) + pad))
    _names(ax, [m for m in marks if m.axis == "time"], scale)
    return [(drawn[name], name) for name in ("accepted", "limit", "published", "violated") if name in drawn]


def _near(value: float, low: float, high: float) -> bool:
    """Return whether a level is at most half the height of the picture away from the curves."""
    return math.isfinite(value) and low - 0.5 * (high - low) <= value <= high + 0.5 * (high - low)


def _instant(ax: Axes, mark: Mark, scale: float, shown: tuple[float, float], drawn: dict[str, Artist]) -> None:
    visible = [scale * b for b in (mark.low, mark.high) if math.isfinite(b) and shown[0] <= scale * b <= shown[1]]
    if len(visible) == 2 and mark.low < mark.high:
        drawn["accepted"] = ax.axvspan(*visible, **_BAND)
    elif visible:
        drawn["limit"] = ax.axvline(visible[0], **_LIMIT)
    if math.isfinite(mark.published) and shown[0] <= scale * mark.published <= shown[1]:
        drawn["published"] = ax.axvline(scale * mark.published, **_PUBLISHED)


def _names(ax: Axes, marks: Sequence[Mark], scale: float) -> None:
    """Write the names of a few instants along their lines; those that nearly coincide share a line of text."""
    low, high = ax.get_xlim()
    labels: dict[float, str] = {}
    for mark in marks:
        passing = next((v for v in ((mark.low + mark.high) / 2, mark.high, mark.low) if math.isfinite(v)), math.nan)
        for x in (scale * mark.published, scale * passing):
            if low <= x <= high:
                same = next((position for position in labels if abs(position - x) < 0.02 * (high - low)), x)
                names = [*filter(None, labels.get(same, "").split(", ")), mark.name.replace("_", " ")]
                labels[same] = ", ".join(dict.fromkeys(names))
    if len(labels) > NAMED:
        return
    for x, name in labels.items():
        text = ax.annotate(
            name,
            (x, 0.04),
            (3, 0),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            rotation=90,
            va="bottom",
            ha="left",
            fontsize=8,
            color="#444444",
            zorder=4,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 0.5},
        )
        text.set_in_layout(False)  # a long name must not press the axes flat


def _quantised(y: Array) -> bool:
    """Return whether a signal jumps between few values, as an encoder's speed or a switch does."""
    y = np.sort(y)  # np.unique would import numpy.ma, which takes a tenth of the time of a picture
    return 8 * (1 + int(np.count_nonzero(y[1:] != y[:-1]))) < len(y)


def _open_limits(ax: Axes) -> None:
    """Widen the limits of a constant signal, so that its rounding noise does not fill the axes."""
    low, high = ax.get_ylim()
    least = 1e-6 * max(abs(low), abs(high), 1e-6)
    if high - low < least:
        ax.set_ylim((low + high) / 2 - 1e3 * least, (low + high) / 2 + 1e3 * least)


def styles(curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """Line style of each curve: references dark and dashed, the others by colour, then by dashes."""
    if len(curves) > look.MANY:
        return [{"color": shade, "linewidth": 0.8} for shade in shades("cividis", np.linspace(0.0, 0.95, len(curves)))]
    dashes = iter(look.DASHED * len(curves))
    lines = iter([{"color": c, "linestyle": line} for line in ("-", look.DASHED[0]) for c in look.COLOURS])
    if all(curve.reference for curve in curves):
        return [next(lines) | {"linestyle": next(dashes)} for _ in curves]
    dark = {"color": look.REFERENCE, "linewidth": 1.0, "zorder": 3.0}
    return [dark | {"linestyle": next(dashes)} if curve.reference else next(lines) for curve in curves]


def legend(
    ax: Axes,
    curves: Sequence[Curve],
    title: str,
    width: int,
    marks: Sequence[tuple[Artist, str]] = (),
    noun: str = "signals",
) -> None:
    """Place the legend above the axes, where it covers no data.

    Parameters
    ----------
    curves : sequence of Curve
        Those that were drawn first, in order.
    width : int
        Of the axes, in letters.
    marks : sequence of (Artist, str)
        From `draw_marks`.
    noun : str
        What the curves are, where there are too many to be named.
    """
    if len(curves) > look.MANY:
        text = f"{len(curves)} {noun}, dark to light from first to last"
        ax.set_title(f"{title}: {text}" if title else text, loc="left", fontsize=9)
        return
    lines = [(line, c.label) for line, c in zip(ax.lines, curves, strict=False) if np.isfinite(line.get_ydata()).any()]
    shown = [*lines, *marks]  # curves without a finite value are left out
    if not shown:
        return
    names = [textwrap.fill(name, width) for _, name in shown]
    longest = max(map(len, names)) + 6
    ax.legend(
        [artist for artist, _ in shown],
        names,
        title=title or None,
        alignment="left",
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=min(len(names), max(1, width // longest)),
        fontsize=9,
        title_fontsize=9,
    )


def fold_exponents(figure: Printed) -> None:
    """Move the scale factors of all axes of matplotlib's picture into their titles, where nothing can cover them."""
    from matplotlib.ticker import ScalarFormatter

    for ax in figure.axes:
        for axis in (ax.xaxis, ax.yaxis):
            numbers, title = axis.get_major_formatter(), axis.get_label()
            if not isinstance(numbers, ScalarFormatter):
                continue
            numbers.set_locs(axis.get_majorticklocs().tolist())
            axis.get_offset_text().set_visible(False)
            power = re.search(r"(?:e|\^\{)(-?\d+)", numbers.get_offset().replace("\N{MINUS SIGN}", "-"))
            if power is None:
                numbers.set_scientific(False)  # set again, because the layout may choose other ticks
                continue
            numbers.set_powerlimits((int(power[1]), int(power[1])))
            factor = f"$\\mathregular{{10^{{{power[1]}}}}}$"
            name, comma, unit = title.get_text().rpartition(", ")
            has_unit = comma or title.get_gid() == UNIT
            title.set_text(f"{name}{comma}{factor} {unit}" if has_unit else f"{unit}, {factor}".removeprefix(", "))
