"""A film as one SVG file that moves by itself: SMIL, which every browser plays, inside an ``img`` as well.

A library such as drawsvg writes these elements, too; but this module would still have to decide which shapes stay, move
as a whole, bend or jump, and therefore which elements a film needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from xml.etree.ElementTree import Element, tostring

from softrig_core.drawing.shapes import Circle, Line, Point, Polygon, Shape, Text

from ..page.html import e
from .film import FRAMES, Film
from .svg import element, number, points, root

JUMP = 40.0  # units in one frame: a longer way is drawn as a jump, not as a motion
SPOKEN = 4  # frames for which a text stays: a reader can follow five texts a second


def animated(film: Film) -> str:
    """Write a film as SVG; a constant shape is written once, a rigidly moved shape once with its translations."""
    clips: list[Element] = []
    parts = [_moving(series, film, clips) for series in zip(*film.frames, strict=True)]
    content = [e("defs", *clips), *parts] if clips else parts
    return tostring(root(film.bounds, film.drawing.title, *content), "unicode")


def _moving(series: Sequence[Shape], film: Film, clips: list[Element]) -> Element:
    first = series[0]
    if isinstance(first, Text):
        return _text([s for s in series if isinstance(s, Text)], film, clips)
    result = element(first)
    if isinstance(first, Circle):
        circles = [s for s in series if isinstance(s, Circle)]
        numbers = {
            "cx": [c.centre[0] for c in circles],
            "cy": [c.centre[1] for c in circles],
            "r": [c.radius for c in circles],
        }
        jump = _jumps([(c.centre,) for c in circles])
        for name, values in numbers.items():
            if len(set(values)) > 1:
                result.append(_animate(name, [number(v) for v in values], film, jump))
        return result
    positions = [s.points for s in series if isinstance(s, Line | Polygon)]
    if len(set(positions)) == 1:
        return result
    shifts = [(p[0][0] - positions[0][0][0], p[0][1] - positions[0][0][1]) for p in positions]
    if all(_shifted(positions[0], p, s) for p, s in zip(positions, shifts, strict=True)):
        result.append(_shift(shifts, film))
    else:
        result.append(_animate("points", [points(p) for p in positions], film, _jumps(positions)))
    return result


def _shifted(first: Sequence[Point], now: Sequence[Point], shift: Point) -> bool:
    return all(abs(b[0] - a[0] - shift[0]) < 0.15 and abs(b[1] - a[1] - shift[1]) < 0.15 for a, b in zip(first, now))


def _jumps(positions: Sequence[Sequence[Point]]) -> bool:
    """Return whether a shape jumps; a jumping shape is not moved smoothly between frames."""
    return any(
        abs(a[0] - b[0]) > JUMP or abs(a[1] - b[1]) > JUMP
        for before, now in pairwise(positions)
        for a, b in zip(before, now)
    )


def _animate(name: str, values: Sequence[str], film: Film, jump: bool) -> Element:
    discrete = {"calcMode": "discrete"} if jump else {}
    return e(
        "animate", attributeName=name, values=";".join(values), dur=_seconds(film), repeatCount="indefinite", **discrete
    )


def _shift(shifts: Sequence[Point], film: Film, discrete: bool = False) -> Element:
    stepped = {"calcMode": "discrete"} if discrete or _jumps([(s,) for s in shifts]) else {}
    values = ";".join(f"{number(x)} {number(y)}".removesuffix(" 0") for x, y in shifts)
    return e(
        "animateTransform",
        attributeName="transform",
        type="translate",
        values=values,
        dur=_seconds(film),
        repeatCount="indefinite",
        **stepped,
    )


def _text(series: Sequence[Text], film: Film, clips: list[Element]) -> Element:
    """Draw a changing text as a strip of all its texts behind a window of one line; the strip is shifted."""
    first = series[0]
    positions = [s.at for s in series]
    texts = [s.text for s in series[::SPOKEN]]
    result = element(first)
    if len(set(texts)) > 1:
        strip = list(dict.fromkeys(texts))
        pitch = 2.0 * first.size
        result.text = None
        x, y = first.at
        for k, text in enumerate(strip):
            result.append(e("tspan", text, x=number(x), y=number(y + k * pitch)))
        rows = [strip.index(text) for text in texts for _ in range(SPOKEN)][: len(series)]
        result.append(_shift([(0.0, -pitch * row) for row in rows], film, discrete=True))
        left, _, width, _ = film.bounds
        name = f"c{len(clips)}"
        window = e(
            "rect",
            x=number(left - width),
            y=number(y - first.size),
            width=number(3 * width),
            height=number(1.4 * first.size),
        )
        clips.append(e("clipPath", window, id=name))
        result = e("g", result, **{"clip-path": f"url(#{name})"})
    if len(set(positions)) > 1:
        result = e("g", result)
        result.append(_shift([(x - positions[0][0], y - positions[0][1]) for x, y in positions], film))
    return result


def _seconds(film: Film) -> str:
    return f"{len(film.frames) / FRAMES:g}s"
