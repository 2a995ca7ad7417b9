"""A film as pixels, for programs that do not support SVG: GIF, WebP or animated PNG."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import to_rgb
from matplotlib.font_manager import FontProperties, findfont
from matplotlib.path import Path
from matplotlib.transforms import Affine2D
from PIL import Image
from softrig_core import ScenarioError
from softrig_core.drawing.shapes import PALETTE, Circle, Line, Polygon, Shape, Text

from .film import FRAMES, Film

LARGEST = 2_000_000  # bytes: a longer GIF is shown late or not at all by many programs
# Number of colours, and n: one of n frames remains; tried in order until the file is small enough.
REDUCED = ((64, 1), (32, 1), (32, 2), (16, 3))
FONT = findfont("DejaVu Sans")
SHARES = {"start": 0.0, "middle": 0.5, "end": 1.0}  # share of a text's width that lies before its point


def pixels(film: Film, form: str) -> tuple[bytes, str]:
    """Write a film as an animated picture.

    Parameters
    ----------
    form : {"gif", "webp", "png"}

    Returns
    -------
    str
        What a GIF was reduced to so that it is no larger than `LARGEST`; empty where it was not.

    Raises
    ------
    ScenarioError
        A GIF remains larger than that.
    """
    images = [picture(frame, film.bounds) for frame in film.frames]
    if form != "gif":
        return _written(images, form, 1), ""
    for colours, every in REDUCED:
        data = _written([i.quantize(colours, dither=Image.Dither.NONE) for i in images[::every]], form, every)
        if len(data) <= LARGEST:
            text = f"reduced to {colours} colours and {len(images[::every])} frames"
            return data, text if (colours, every) != REDUCED[0] else ""
    raise ScenarioError(
        f"a GIF of {len(data) / 1e6:.2f} MB with {colours} colours and {len(images[::every])} frames, "
        f"expected at most {LARGEST / 1e6:g} MB: choose a shorter window (--from, --to), a greater "
        "--speed, or SVG"
    )


def _written(images: Sequence[Image.Image], form: str, every: int) -> bytes:
    """Write a film with every n-th frame."""
    file = BytesIO()
    more = {"gif": {"disposal": 1, "optimize": True}, "webp": {"lossless": True, "method": 4}, "png": {}}[form]
    images[0].save(file, form, save_all=True, append_images=images[1:], duration=1000 * every // FRAMES, loop=0, **more)
    return file.getvalue()


def picture(shapes: Sequence[Shape], bounds: tuple[float, float, float, float]) -> Image.Image:
    """Draw one frame on light ground, by matplotlib's renderer: it has round corners, dashes and smooth edges."""
    left, top, width, height = bounds
    # At 72 dpi a point of type is a unit of the drawing.
    renderer: Any = RendererAgg(round(width), round(height), 72)  # type: ignore[no-untyped-call]
    transform = Affine2D().translate(-left, -top - height).scale(1.0, -1.0)
    gc = renderer.new_gc()
    gc.set_joinstyle("round")
    gc.set_linewidth(0.0)
    renderer.draw_path(gc, Path.unit_rectangle(), Affine2D().scale(width, height), to_rgb(PALETTE["paper"][0]))
    for shape in shapes:
        if isinstance(shape, Circle) and not shape.radius:
            continue  # an SVG does not show the edge of such a circle either
        gc.set_foreground(to_rgb(PALETTE[shape.role][0]))
        if isinstance(shape, Text):
            font = FontProperties(size=shape.size, fname=FONT)
            wide = renderer.get_text_width_height_descent(shape.text, font, False)[0]
            x, y = transform.transform(shape.at)
            renderer.draw_text(gc, x - SHARES[shape.anchor] * wide, height - y, shape.text, font, 0.0)
            continue
        dashed = isinstance(shape, Line) and shape.dashed
        gc.set_linewidth(max(1.0, shape.width) if shape.width else 0.0)
        gc.set_dashes(0.0, (5.0, 4.0) if dashed else None)
        gc.set_capstyle("butt" if dashed else "round")
        fill = "" if isinstance(shape, Line) else shape.fill
        if isinstance(shape, Circle):
            path = Path.circle(shape.centre, shape.radius)
        elif isinstance(shape, Polygon):
            path = Path([*shape.points, shape.points[0]], closed=True)
        else:
            path = Path(shape.points)
        renderer.draw_path(gc, path, transform, to_rgb(PALETTE[fill][0]) if fill else None)
    return Image.fromarray(np.asarray(renderer.buffer_rgba())).convert("RGB")
