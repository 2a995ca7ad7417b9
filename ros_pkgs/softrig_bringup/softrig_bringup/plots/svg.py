"""A picture as SVG: no library, some milliseconds, text as text, for the screen, for paper and for screen readers."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array

from .canvas import Area, Artist, Axes, Axis, Cells, Dashes, Figure, Line, Rule, Words
from .curves import envelope
from .ticks import minus, power_of, round_ticks, texts, with_power

INK, FRAME, GRID, NUMBERS, SOFT = "#222222", "#666666", "#dddddd", "#444444", "#777777"
FONT = "system-ui, 'Segoe UI', 'DejaVu Sans', sans-serif"
FINE = 10  # parts of a pixel to which coordinates of curves are rounded
LONG = 20_000  # points from which on a curve in a plane is drawn without repeated pieces
# advance of DejaVu Sans, hundredths of the size: the widest of the usual letters, so that nothing lies over another
_WIDTHS = {
    30: "'IJijl", 36: " ,-./:;\\f|", 41: "!()[]rt", 46: '"', 54: "*?_`sz", 60: "FLPckvxy",
    64: "$0123456789ESTYabdeghnopqu{}", 70: "ABCKRVXZ", 78: "&DGHNOQU", 84: "#+<=>^w~", 88: "M", 100: "%@Wm",
}  # fmt: skip
_NO_XML = re.compile(r"[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
Whole = NDArray[np.int64]
_WIDTH = {letter: width / 100 for width, letters in _WIDTHS.items() for letter in letters}
# Lengths of dashes and gaps, in widths of the line.
_DASHES = {"--": (3.7, 1.6), "-.": (6.4, 1.6, 1.0, 1.6), ":": (1.0, 1.65)}
# a dark page inverts lightness and keeps hues, as pages of softrig do with their pictures; paper stays white
_STYLE = "@media screen and (prefers-color-scheme:dark){svg.plot{filter:invert(.9) hue-rotate(180deg)}}"


def escape(text: str) -> str:
    """Return a text for an SVG; what XML cannot have, such as control characters of a recorded name, is shown as �."""
    return html.escape(_NO_XML.sub("\ufffd", text), quote=False)


class Box(NamedTuple):
    """Pixels of a part of the picture."""

    left: float
    top: float
    width: float
    height: float


class Scale(NamedTuple):
    """Ticks of an axis: their positions, their labels, and the power of ten in the title."""

    at: Sequence[float]
    names: Sequence[str]
    power: int


def svg(figure: Figure) -> str:
    """Return a picture as the text of an SVG file.

    Curves are drawn with all of their extremes, but no more points than can be seen. Equal pictures give equal texts.
    """
    writer = _Writer(figure)
    body = "".join(writer.parts())
    key = f"p{crc32((figure.title + figure.run + body).encode()):08x}"
    wide, high = writer.wide, writer.high
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="plot" role="img" aria-labelledby="{key}t {key}d" '
        f'width="{wide:g}" height="{high:g}" viewBox="0 0 {wide:g} {high:g}" font-family="{FONT}">'
        f'<title id="{key}t">{escape(figure.title or "Picture")}</title>'
        f'<desc id="{key}d">{escape(" ".join(described(figure)))}</desc>'
        f'<style>{_STYLE}</style><rect width="100%" height="100%" fill="#ffffff"/>{body}</svg>\n'
    )


def described(figure: Figure) -> Iterator[str]:
    """Describe a picture for blind readers: the titles of each axes, the range and the final value of each curve."""
    for axes in figure.axes:
        if not axes.on:
            continue
        over = axes.titles["x"] or next((a.titles["x"] for a in figure.axes if a.x is axes.x and a.titles["x"]), "")
        head = axes.heads.get("left", ("",))[0] or (axes.named[1] if axes.named else "")
        low, high = axes.x.extent()
        title = ": ".join(text for text in (head, axes.titles["y"]) if text) or "Values"
        parts = []
        # Lines without a label are then marks, which the legend explains.
        labelled = any(line.label for line in axes.lines)
        for line in axes.lines:
            known = line.y[np.isfinite(line.y)]
            if known.size and not line.up and bool(line.label) == labelled:
                label = line.label + " " if line.label else ""
                low_y, high_y = float(np.amin(known)), float(np.amax(known))
                parts.append(f"{label}{low_y:.4g} to {high_y:.4g}, last {known[-1]:.4g}")
        many = [f"{len(parts)} curves"] if len(parts) > 8 else parts
        marks = [name for artist, name in (axes.named or ([], "", 0, 0.0))[0] if not artist.label]
        yield minus(f"{title}, over {over or 'x'} {low:.4g} to {high:.4g}: {'; '.join([*many, *marks])}.")


def width_of(text: str, size: float) -> float:
    """Estimate the width of a text in units of its size, never less than in DejaVu Sans."""
    return size * max((sum(_WIDTH.get(letter, 0.66) for letter in line) for line in text.split("\n")), default=0.0)


class _Writer:
    """Writer of an SVG plot: it measures titles, numbers and legends first, then places and draws everything."""

    def __init__(self, figure: Figure) -> None:
        self.figure = figure
        self.point = figure.dpi / 72.0  # pixels per point of the type size
        self.wide, self.high = (round(length * figure.dpi) for length in figure.size)
        self._before: list[float] = []  # pixels before the axes of each column; the titles of a column are aligned

    def parts(self) -> Iterator[str]:
        figure, point = self.figure, self.point
        top = 20.0 * point if figure.title else 8.0 * point
        bottom = 13.0 * point if figure.below else 2.0 * point
        if figure.title:
            yield self._text(figure.title, 0.008 * self.wide, 13.0 * point, 12.0, INK, bold=True)
        if figure.run:
            yield self._text(figure.run, 0.992 * self.wide, 9.0 * point, 8.0, SOFT, "end")
        if figure.below:
            yield self._text(figure.below, 0.008 * self.wide, self.high - 4.0 * point, 9.0, SOFT)
        right = 0.0
        if figure.bar:
            right = 78.0 * point
            yield from self._bar(Box(self.wide - 66.0 * point, top + 4.0 * point, 12.0 * point,
                                     self.high - top - bottom - 40.0 * point))  # fmt: skip
        for axes, box, scales in self._layout(Box(0.0, top, self.wide - right, self.high - top - bottom)):
            if axes.on:
                yield from self._axes(axes, box, scales)

    # room -------------------------------------------------------------------------------------------------------

    def _layout(self, area: Box) -> list[tuple[Axes, Box, tuple[Scale, Scale]]]:
        """Place axes so that all of a row have their edges in line, and all of a column."""
        axes = self.figure.axes
        if not axes:
            return []
        grid = axes[0].place.grid
        rows, columns = grid.rows, grid.columns
        boxes = {id(a): Box(0.0, 0.0, area.width / columns - 70.0, area.height / rows - 60.0) for a in axes}
        limits = {id(a): (a.x.limits(), a.y.limits()) for a in axes if a.equal}
        for _ in range(3):  # the room for the numbers depends on the number of ticks, and this number on the room
            for a in axes:
                if a.equal:
                    _equalise(a, boxes[id(a)], *limits[id(a)])
            scales = {id(a): (self._scale(a, "x", boxes[id(a)].width), self._scale(a, "y", boxes[id(a)].height))
                      for a in axes}  # fmt: skip
            above, below, before, behind = [0.0] * rows, [0.0] * rows, [0.0] * columns, [0.0] * columns
            for a in axes:
                need = self._room(a, *scales[id(a)])
                row, first, last = a.place.rowspan.start, a.place.colspan.start, a.place.colspan.stop - 1
                above[row], below[row] = max(above[row], need[0]), max(below[row], need[1])
                before[first], behind[last] = max(before[first], need[2]), max(behind[last], need[3])
            self._before = before
            high = (area.height - sum(above) - sum(below)) / rows
            wide = (area.width - sum(before) - sum(behind)) / columns
            lefts = [area.left + sum(before[: k + 1]) + sum(behind[:k]) + k * wide for k in range(columns)]
            tops = [area.top + sum(above[: k + 1]) + sum(below[:k]) + k * high for k in range(rows)]
            for a in axes:
                first, last = a.place.colspan.start, a.place.colspan.stop - 1
                boxes[id(a)] = Box(lefts[first], tops[a.place.rowspan.start], lefts[last] + wide - lefts[first],
                                   max(8.0, high))  # fmt: skip
        return [(a, boxes[id(a)], scales[id(a)]) for a in axes]

    def _room(self, axes: Axes, x: Scale, y: Scale) -> tuple[float, float, float, float]:
        """Return the space that an axes needs above, below, left and right, pixels."""
        point = self.point
        above = 6.0 + self._legend_rows(axes) * 12.5 + (13.0 if "left" in axes.heads or "right" in axes.heads else 0.0)
        below = 5.0
        if axes.numbered and axes.on:
            lines = max((name.count("\n") + 1 for name in x.names), default=1)
            below += 4.0 + axes.tick_sizes["x"] * 1.25 * lines
        if axes.titles["x"]:
            below += axes.sizes["x"] * 1.5
        before = 8.0 + max((width_of(name, axes.tick_sizes["y"]) for name in y.names), default=0.0) + 5.0
        if axes.titles["y"]:
            before += axes.sizes["y"] * 1.5
        behind = 8.0
        if axes.numbered and x.names and x.at:
            low, high = axes.x.limits()
            reach = width_of(x.names[-1], axes.tick_sizes["x"]) / 2
            behind = max(behind, reach * max(0.0, 1.0 - 8.0 * (high - x.at[-1]) / ((high - low) or 1.0)) + 2.0)
        return above * point, below * point, before * point, behind * point

    def _legend_rows(self, axes: Axes) -> int:
        if not axes.named:
            return 0
        entries, title, ncols, _ = axes.named
        return _rows_of(entries, ncols)[1] + bool(title)

    def _scale(self, axes: Axes, name: str, length: float) -> Scale:
        """Choose ticks for a length in pixels, or format the given ticks."""
        axis: Axis = axes.x if name == "x" else axes.y
        low, high = axis.limits()
        fixed = axes.ticks[name]
        if fixed is not None:
            visible = [k for k, t in enumerate(fixed[0]) if low <= t <= high]
            ticks = [fixed[0][k] for k in visible]
            if fixed[1] is not None:
                return Scale(ticks, [fixed[1][k] for k in visible], 0)
        else:
            size = axes.tick_sizes[name] * self.point * (3.0 if name == "x" else 2.0)
            ticks = round_ticks(low, high, min(9, max(1, int(length / size))), integers=axes.whole and name == "x")
        power = power_of(ticks)
        return Scale(ticks, texts(ticks, power, (low, high)), power)

    # drawing ----------------------------------------------------------------------------------------------------

    def _axes(self, axes: Axes, box: Box, scales: tuple[Scale, Scale]) -> Iterator[str]:
        x, y = scales
        to_x, to_y = (
            _to_pixels(axes.x.limits(), box.left, box.width),
            _to_pixels(axes.y.limits(), box.top + box.height, -box.height),
        )
        right, bottom = box.left + box.width, box.top + box.height
        lines = [f"M{_n(to_x(t))} {_n(box.top)}V{_n(bottom)}" for t in x.at if axes.gridded["x"]]
        lines += [f"M{_n(box.left)} {_n(to_y(t))}H{_n(right)}" for t in y.at if axes.gridded["y"]]
        if lines:
            yield f'<path d="{"".join(lines)}" fill="none" stroke="{GRID}" stroke-width="{_n(0.6 * self.point)}"/>'
        yield from self._inside(axes, box)
        tick = 3.5 * self.point
        frame = f"M{_n(box.left)} {_n(box.top)}V{_n(bottom)}H{_n(right)}"
        frame += "".join(f"M{_n(to_x(t))} {_n(bottom)}v{_n(tick)}" for t in x.at)
        if axes.dashes:
            frame += "".join(f"M{_n(box.left)} {_n(to_y(t))}h{_n(-tick)}" for t in y.at)
        yield f'<path d="{frame}" fill="none" stroke="{FRAME}" stroke-width="{_n(0.8 * self.point)}"/>'
        yield from self._over(axes, box, to_x, to_y)
        size = axes.tick_sizes["y"]
        for value, name in zip(y.at, y.names, strict=True):
            yield self._text(
                name, box.left - 6.0 * self.point, to_y(value) + 0.36 * size * self.point, size, NUMBERS, "end"
            )
        below = bottom
        if axes.numbered:
            size = axes.tick_sizes["x"]
            for value, name in zip(x.at, x.names, strict=True):
                yield self._text(name, to_x(value), bottom + (5.0 + 0.95 * size) * self.point, size, NUMBERS, "middle")
            below += (5.0 + 1.25 * size * max((n.count("\n") + 1 for n in x.names), default=1)) * self.point
        if title := with_power(axes.titles["x"], x.power, False):
            y_title = below + axes.sizes["x"] * self.point
            yield self._text(title, box.left + box.width / 2, y_title, axes.sizes["x"], INK, "middle")
        if title := with_power(axes.titles["y"], y.power, axes.unit_alone):
            left = box.left - self._before[axes.place.colspan.start] + 1.2 * axes.sizes["y"] * self.point
            yield self._text(title, left, box.top + box.height / 2, axes.sizes["y"], INK, "middle", turned=True)
        yield from self._heads(axes, box)

    def _heads(self, axes: Axes, box: Box) -> Iterator[str]:
        """Write the parts above an axes: the legend, and the texts at its upper left and upper right."""
        point, base = self.point, box.top - 5.0 * self.point
        if axes.named:
            entries, title, ncols, size = axes.named
            columns, rows = _rows_of(entries, ncols)
            left = box.left + 2.0 * point
            for column in columns:
                y = base - (rows - 1) * 12.5 * point
                for artist, name in column:
                    yield self._sample(artist, left, y - 3.2 * point)
                    for line in name.split("\n"):
                        yield self._text(line, left + 20.0 * point, y, size, INK)
                        y += 12.5 * point
                widest = max(width_of(name, size) for _, name in column)
                left += (20.0 + widest + 14.0) * point
            base -= rows * 12.5 * point
            if title:
                yield self._text(title, box.left + 2.0 * point, base, size, INK)
                base -= 12.5 * point
        for side, (text, size, colour) in axes.heads.items():
            if side == "left":
                yield self._text(text, box.left, base, size, colour)
            else:
                yield self._text(text, box.left + box.width, base, size, colour, "end")

    def _sample(self, artist: Artist, left: float, y: float) -> str:
        """Draw the sample of an artist in the legend."""
        right = left + 15.0 * self.point
        if isinstance(artist, Area | Cells):
            top, high = y - 3.0 * self.point, 6.0 * self.point
            return (f'<rect x="{_n(left)}" y="{_n(top)}" width="{_n(right - left)}" height="{_n(high)}" '
                    f'fill="{artist.color}" fill-opacity="{artist.alpha:g}"/>')  # fmt: skip
        if isinstance(artist, Line) and artist.marker and not artist.linestyle:
            return self._marks(artist, [((left + right) / 2, y)])
        return self._stroke(artist, f"M{_n(left)} {_n(y)}H{_n(right)}", self.point)

    def _inside(self, axes: Axes, box: Box) -> Iterator[str]:
        """Draw curves, bands and maps, cut at the edges of the axes, in tenths of a pixel."""
        wide, high = box.width * FINE, box.height * FINE
        to_x, to_y = _to_pixels(axes.x.limits(), 0.0, wide), _to_pixels(axes.y.limits(), high, -high)
        drawn = []
        for item in sorted(axes.items, key=lambda item: item.zorder):
            if isinstance(item, Line) and item.clip_on:
                x, y = to_x(item.x), to_y(item.y)
                if item.linestyle:
                    drawn.append(self._stroke(item, path(x, y, item.steps, box.width), FINE * self.point))
                if item.marker:
                    drawn.append(self._marks(item, _finite(x, y), FINE))
            elif isinstance(item, Area):
                drawn.append(self._area(item, to_x, to_y, high))
            elif isinstance(item, Rule):
                position = to_x(item.at) if item.axis == "x" else to_y(item.at)
                form = f"M{_n(position)} 0V{_n(high)}" if item.axis == "x" else f"M0 {_n(position)}H{_n(wide)}"
                drawn.append(self._stroke(item, form, FINE * self.point))
            elif isinstance(item, Cells):
                drawn += self._cells(item, to_x, to_y)
        if drawn:
            box_attributes = " ".join(f'{k}="{_n(v)}"' for k, v in zip(("x", "y", "width", "height"), box, strict=True))
            yield (f'<svg {box_attributes} viewBox="0 0 {_n(wide)} {_n(high)}" preserveAspectRatio="none">'
                   f'{"".join(drawn)}</svg>')  # fmt: skip

    def _over(self, axes: Axes, box: Box, to_x: Any, to_y: Any) -> Iterator[str]:
        """Draw elements that may cross the edges: texts, and marks for values beyond the edges."""
        for item in axes.items:
            if isinstance(item, Line) and not item.clip_on:
                y = box.top + (1.0 - item.y) * box.height if item.up else to_y(item.y)
                yield self._marks(item, _finite(to_x(item.x), y))
            elif isinstance(item, Words):
                x = box.left + item.x * box.width if item.across else to_x(item.x)
                y = box.top + (1.0 - item.y) * box.height if item.up else to_y(item.y)
                yield self._words(item, x + item.offset[0] * self.point, y - item.offset[1] * self.point)

    def _stroke(self, item: Artist, form: str, unit: float) -> str:
        width = getattr(item, "linewidth", 1.4)
        dashes = _dashes(getattr(item, "linestyle", "-"))
        dash = f' stroke-dasharray="{" ".join(_n(d * width * unit) for d in dashes)}"' if dashes else ""
        faint = f' stroke-opacity="{item.alpha:.3g}"' if item.alpha < 1.0 else ""
        return (f'<path d="{form}" fill="none" stroke="{item.color}" stroke-width="{_n(width * unit)}" '
                f'stroke-linejoin="round"{dash}{faint}/>')  # fmt: skip

    def _area(self, item: Area, to_x: Any, to_y: Any, high: float) -> str:
        x = to_x(item.x)
        low, up = (np.array([high, high]), np.zeros(2)) if item.tall else (to_y(item.low), to_y(item.high))
        if item.steps:
            x, low, up = np.repeat(x, 2)[1:], np.repeat(low, 2)[:-1], np.repeat(up, 2)[:-1]
        known = np.isfinite(low) & np.isfinite(up)
        x, low, up = x[known], low[known], up[known]
        form = path(np.concatenate([x, x[::-1]]), np.concatenate([up, low[::-1]]), False, math.inf)
        edge = (f' stroke="{item.color}" stroke-opacity="{item.alpha:g}" stroke-width="{_n(item.linewidth * FINE)}"'
                if item.linewidth else "")  # fmt: skip
        return f'<path d="{form}z" fill="{item.color}" fill-opacity="{item.alpha:g}"{edge}/>' if form else ""

    def _cells(self, item: Cells, to_x: Any, to_y: Any) -> Iterator[str]:
        x0, x1 = to_x(item.boxes[:, 0]), to_x(item.boxes[:, 2])
        y0, y1 = to_y(item.boxes[:, 3]), to_y(item.boxes[:, 1])
        faint = f' fill-opacity="{item.alpha:g}"' if item.alpha < 1.0 else ""
        for a, b, c, d, colour in zip(x0, y0, x1, y1, item.colours, strict=True):
            if not colour or not math.isfinite(a + b + c + d):
                continue
            if item.size:
                radius = math.sqrt(item.size) / 2 * self.point * FINE
                yield f'<circle cx="{_n(a)}" cy="{_n(b)}" r="{_n(radius)}" fill="{colour}"/>'
            elif d > b:
                yield (f'<rect x="{_n(a)}" y="{_n(b)}" width="{_n(c - a)}" height="{_n(d - b)}" '
                       f'fill="{colour}"{faint}/>')  # fmt: skip

    def _marks(self, item: Line, points: Sequence[tuple[float, float]], fine: float = 1.0) -> str:
        """Draw dots or crosses at points."""
        # A point has an edge, except for the mark x.
        size = item.markersize * (0.5 if item.marker == "." else 1.0) + (item.marker != "x")
        size *= self.point * fine
        faint = f' opacity="{item.alpha:.3g}"' if item.alpha < 1.0 else ""
        half = _n(size / 2)
        if item.marker == "x":
            full = _n(size)
            d = "".join(f"M{_n(x - size / 2)} {_n(y - size / 2)}l{full} {full}m0 -{full}l-{full} {full}"
                        for x, y in points)  # fmt: skip
            return f'<path d="{d}" fill="none" stroke="{item.color}" stroke-width="{_n(self.point * fine)}"{faint}/>'
        dots = "".join(f"M{_n(x - size / 2)} {_n(y)}a{half} {half} 0 1 0 {_n(size)} 0a{half} {half} 0 1 0 {_n(-size)} 0"
                       for x, y in points)  # fmt: skip
        return f'<path d="{dots}" fill="{item.color}"{faint}/>'

    def _words(self, item: Words, x: float, y: float) -> str:
        size = item.fontsize
        anchor = {"left": "start", "center": "middle", "right": "end"}[item.ha]
        if item.rotation:  # a text along a rising line: its left side becomes its lower side
            box = ""
            if item.boxed:
                wide, high = width_of(item.text, size) * self.point, 1.25 * size * self.point
                box = (f'<rect x="{_n(x - 1)}" y="{_n(y - wide)}" width="{_n(high)}" height="{_n(wide)}" '
                       f'fill="#ffffff" fill-opacity="0.75"/>')  # fmt: skip
            return box + self._text(item.text, x + 0.95 * size * self.point, y, size, item.color, anchor, turned=True)
        down = 0.95 * size * self.point if item.va == "top" else 0.0
        return self._text(item.text, x, y + down, size, item.color, anchor)

    def _text(
        self,
        text: str,
        x: float,
        y: float,
        size: float,
        colour: str,
        anchor: str = "start",
        *,
        bold: bool = False,
        turned: bool = False,
    ) -> str:
        style = f' font-size="{_n(size * self.point)}" fill="{colour}"'
        style += f' text-anchor="{anchor}"' if anchor != "start" else ""
        style += ' font-weight="bold"' if bold else ""
        style += f' transform="rotate(-90 {_n(x)} {_n(y)})"' if turned else ""
        lines = text.split("\n")
        if len(lines) == 1:
            return f'<text x="{_n(x)}" y="{_n(y)}"{style}>{escape(text)}</text>'
        spans = "".join(
            f'<tspan x="{_n(x)}" y="{_n(y + k * 1.25 * size * self.point)}">{escape(line)}</tspan>'
            for k, line in enumerate(lines)
        )
        return f"<text{style}>{spans}</text>"

    def _bar(self, box: Box) -> Iterator[str]:
        """Draw the bar of colours of a map, with its numbers and title."""
        from .shades import shades

        assert self.figure.bar is not None
        cells, label = self.figure.bar
        low, high, name = cells.scale
        if high <= low:
            low, high = low - 0.05 * (abs(low) or 1.0), high + 0.05 * (abs(high) or 1.0)
        step = box.height / 64
        for k, colour in enumerate(shades(name, np.linspace(1.0, 0.0, 64))):
            yield (f'<rect x="{_n(box.left)}" y="{_n(box.top + k * step)}" width="{_n(box.width)}" '
                   f'height="{_n(step + 0.5)}" fill="{colour}"/>')  # fmt: skip
        ticks = round_ticks(low, high, min(9, max(1, int(box.height / (20.0 * self.point)))))
        power = power_of(ticks)
        to_y, right = _to_pixels((low, high), box.top + box.height, -box.height), box.left + box.width
        names = texts(ticks, power, (low, high))
        for t, text in zip(ticks, names, strict=True):
            y = to_y(t)
            yield f'<path d="M{_n(right)} {_n(y)}h{_n(3.5 * self.point)}" stroke="{FRAME}" fill="none"/>'
            yield self._text(text, right + 6.0 * self.point, y + 3.6 * self.point, 10.0, NUMBERS)
        reach = max((width_of(text, 10.0) for text in names), default=0.0)
        x = min(right + (18.0 + reach) * self.point, self.wide - 3.0 * self.point)
        yield self._text(with_power(label, power, False), x, box.top + box.height / 2, 10.0, INK, "middle", turned=True)


def path(x: Array, y: Array, steps: bool, columns: float) -> str:
    """Return the data of an SVG path through points, without invisible detail.

    Parameters
    ----------
    x, y : float arrays of shape (n,)
        Tenths of a pixel; where one is not finite the path is broken.
    steps : bool
        Each value is held until the next x.
    columns : float
        Width in pixels: of more than four points a column the first, lowest, highest and last remain.
    """
    known = np.isfinite(x) & np.isfinite(y)
    if not known.all():
        parts = np.split(np.arange(len(x)), np.flatnonzero(np.diff(known)) + 1)
        return "".join(path(x[p], y[p], steps, columns) for p in parts if p.size and known[p[0]])
    if not len(x):
        return ""
    along = bool((np.diff(x) >= 0.0).all())
    if along and math.isfinite(columns) and x[-1] > x[0]:
        x, y = envelope(x, y, max(8, int(columns)))
    if steps:
        x, y = np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    points = np.clip(np.stack([x, y], axis=1), -1e6, 1e6).round().astype(np.int64)
    points = points[_corners(points, along)]
    if len(points) > LONG:
        return _once(points)
    moves = np.diff(points, axis=0).ravel().tolist()
    text = " ".join(map(str, moves)).replace(" -", "-")
    return f"M{points[0, 0]} {points[0, 1]}" + (f"l{text}" if moves else "h0")


def _corners(points: Whole, along: bool) -> NDArray[np.bool_]:
    """Return the points that a path needs: no repeated point, and no point on a level between two others."""
    keep = np.ones(len(points), bool)
    keep[1:] = (np.diff(points, axis=0) != 0).any(axis=1)
    if along and keep.sum() > 2:
        left = np.flatnonzero(keep)
        y = points[left, 1]
        level = (y[1:-1] == y[:-2]) & (y[1:-1] == y[2:])
        keep[left[1:-1][level]] = False
    return keep


def _once(points: Whole) -> str:
    """Return a path in which each piece is drawn once, however often a trajectory passes there."""
    segments = np.concatenate([points[:-1], points[1:]], axis=1)
    first = np.sort(np.unique(segments, axis=0, return_index=True)[1])
    commands, last = [], -2
    for k in first.tolist():
        x0, y0, x1, y1 = segments[k].tolist()
        commands.append(f"l{x1 - x0} {y1 - y0}" if k == last + 1 else f"M{x0} {y0}l{x1 - x0} {y1 - y0}")
        last = k
    return "".join(commands)


def _n(value: float) -> str:
    """Return a number with as many digits as a picture shows."""
    return f"{round(float(value), 1):g}" if abs(value) < 1e5 else f"{value:.0f}"


def _to_pixels(limits: tuple[float, float], begin: float, length: float) -> Any:
    """Return functions that turn data into pixels."""
    low, high = limits
    factor = length / ((high - low) or 1.0)
    return lambda value: begin + (value - low) * factor


def _finite(x: Array, y: Array) -> list[tuple[float, float]]:
    known = np.isfinite(x) & np.isfinite(y)
    return list(zip(x[known].tolist(), y[known].tolist(), strict=True))


def _dashes(line: Dashes) -> Sequence[float]:
    return _DASHES.get(line, ()) if isinstance(line, str) else line[1]


def _rows_of(entries: Sequence[tuple[Artist, str]], ncols: int) -> tuple[list[Sequence[tuple[Artist, str]]], int]:
    """Arrange the entries of a legend in columns; return them and the number of lines of the longest."""
    each = -(-len(entries) // max(1, min(ncols, len(entries)))) if entries else 0
    columns = [entries[k : k + each] for k in range(0, len(entries), each)] if each else []
    lines = max((sum(name.count("\n") + 1 for _, name in column) for column in columns), default=0)
    return columns, lines


def _equalise(axes: Axes, box: Box, seen_x: tuple[float, float], seen_y: tuple[float, float]) -> None:
    """Widen the limits of one axis until both have the same scale."""
    (x0, x1), (y0, y1) = seen_x, seen_y
    scale = max((x1 - x0) / box.width, (y1 - y0) / box.height)
    for axis, low, high, length in ((axes.x, x0, x1, box.width), (axes.y, y0, y1, box.height)):
        wide = (scale * length - (high - low)) / 2
        axis.fixed = low - wide, high + wide
