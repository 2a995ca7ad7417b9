"""Shapes as SVG, in the colours of light and dark ground."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree.ElementTree import Element, tostring

from softrig_core.drawing.base import Drawing
from softrig_core.drawing.shapes import PALETTE, Circle, Line, Point, Shape, Text

from ..page.html import e

FONT = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', 'DejaVu Sans', sans-serif"


def sheet(dark: bool | None = None) -> str:
    """Return the style sheet: a class a role for strokes, one for fills.

    Parameters
    ----------
    dark : bool, optional
        Whether to use the colours for a dark background; by default those that the reader's system prefers.
    """

    def rules(column: int) -> str:
        return "".join(
            f".s-{role}{{stroke:{pair[column]}}}.f-{role}{{fill:{pair[column]}}}" for role, pair in PALETTE.items()
        )

    text = f"text{{font-family:{FONT};font-variant-numeric:tabular-nums}}"
    shapes = "polyline,polygon,circle{stroke-linejoin:round;stroke-linecap:round}.d{stroke-dasharray:5 4}"
    if dark is not None:
        return text + shapes + rules(int(dark))
    return f"{text}{shapes}{rules(0)}@media (prefers-color-scheme:dark){{{rules(1)}}}"


def element(shape: Shape) -> Element:
    """Return a shape as an element of SVG."""
    if isinstance(shape, Text):
        x, y = shape.at
        anchor = {} if shape.anchor == "start" else {"text-anchor": shape.anchor}
        attributes = {"font-size": number(shape.size)} | anchor
        return e("text", shape.text, x=number(x), y=number(y), class_=f"f-{shape.role}", **attributes)
    style = [f"s-{shape.role}"] if shape.width else []
    width = {"stroke-width": number(shape.width)} if shape.width else {}
    if isinstance(shape, Line):
        style += ["d"] if shape.dashed else []
        return e("polyline", points=points(shape.points), fill="none", class_=" ".join(style), **width)
    style += [f"f-{shape.fill}"] if shape.fill else []
    filled = {} if shape.fill else {"fill": "none"}
    attributes = {"class_": " ".join(style)} | filled | width
    if isinstance(shape, Circle):
        (x, y), r = shape.centre, shape.radius
        return e("circle", cx=number(x), cy=number(y), r=number(r), **attributes)
    return e("polygon", points=points(shape.points), **attributes)


def root(bounds: tuple[float, float, float, float], title: str, *content: Element, dark: bool | None = None) -> Element:
    """Return an SVG document with its own ground."""
    x, y, width, height = bounds
    ground = e("rect", x=number(x), y=number(y), width=number(width), height=number(height), class_="f-paper")
    return e(
        "svg",
        e("title", title),
        e("style", sheet(dark)),
        ground,
        *content,
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"{x:g} {y:g} {width:g} {height:g}",
        width=number(width),
        height=number(height),
        role="img",
    )


def points(corners: tuple[Point, ...]) -> str:
    """Write points as SVG has them."""
    return " ".join(f"{number(x)},{number(y)}" for x, y in corners)


def number(value: float) -> str:
    """Write a coordinate as briefly as its tenth of a unit allows."""
    text = f"{value:.1f}".removesuffix(".0")
    return "0" if text == "-0" else text


def still(drawing: Drawing, shapes: Sequence[Shape], dark: bool | None = None) -> str:
    """Write one frame as a file by itself.

    Parameters
    ----------
    shapes : sequence of Shape
        From `Drawing.frame`.
    dark : bool, optional
        See `sheet`.
    """
    return tostring(root(drawing.bounds, drawing.title, *map(element, shapes), dark=dark), "unicode")
