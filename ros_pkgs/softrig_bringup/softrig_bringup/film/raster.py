"""A film as pixels, for programs that do not support SVG: GIF, WebP or animated PNG."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from itertools import pairwise
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont
from softrig_core import ScenarioError
from softrig_core.drawing.shapes import PALETTE, Circle, Line, Point, Polygon, Shape, Text

from .film import FRAMES, Film

FINER = 2  # times as many pixels as are kept: smooth edges
LARGEST = 2_000_000  # bytes of a GIF: larger ones are not shown, or not at once, where GIFs are used
REDUCED = ((64, 1), (32, 1), (32, 2), (16, 3))  # colours, and one of so many frames, until it is small enough
_ANCHORS = {"start": "ls", "middle": "ms", "end": "rs"}


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
        A GIF that is larger all the same.
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


def picture(shapes: list[Shape], bounds: tuple[float, float, float, float]) -> Image.Image:
    """Draw one frame on light ground."""
    left, top, width, height = bounds
    image = Image.new("RGB", (round(width) * FINER, round(height) * FINER), _colour("paper"))
    draw = ImageDraw.Draw(image)

    def at(point: Point) -> Point:
        return (point[0] - left) * FINER, (point[1] - top) * FINER

    for shape in shapes:
        colour = _colour(shape.role)
        if isinstance(shape, Text):
            draw.text(at(shape.at), shape.text, colour, _font(shape.size * FINER), _ANCHORS[shape.anchor])
            continue
        width_px = max(1, round(shape.width * FINER)) if shape.width else 0
        if isinstance(shape, Circle):
            x, y = at(shape.centre)
            r = shape.radius * FINER
            if r > 0:
                fill = _colour(shape.fill) if shape.fill else None
                draw.ellipse((x - r, y - r, x + r, y + r), fill, colour if width_px else None, width_px)
            continue
        corners = [at(p) for p in shape.points]
        if isinstance(shape, Polygon):
            if shape.fill:
                draw.polygon(corners, _colour(shape.fill))
            corners.append(corners[0])
        if not width_px:
            continue
        for a, b in _dashes(corners) if isinstance(shape, Line) and shape.dashed else pairwise(corners):
            draw.line((a, b), colour, width_px)
        r = width_px / 2
        if width_px > 2 and not (isinstance(shape, Line) and shape.dashed):  # round corners and ends
            for x, y in corners:
                draw.ellipse((x - r, y - r, x + r, y + r), colour)
    return image.resize((round(width), round(height)), Image.Resampling.LANCZOS)


def _dashes(corners: list[Point]) -> list[tuple[Point, Point]]:
    """Cut a line into dashes of 5 units with gaps of 4."""
    result, walked = [], 0.0
    for a, b in pairwise(corners):
        length = ((b[0] - a[0]) ** 2 + (b[1] - a[1]) ** 2) ** 0.5
        d = 0.0
        while d < length:
            phase = walked % (9.0 * FINER)
            step = min((5.0 if phase < 5.0 * FINER else 9.0) * FINER - phase, length - d)
            if phase < 5.0 * FINER:
                ends = [(a[0] + (b[0] - a[0]) * s / length, a[1] + (b[1] - a[1]) * s / length) for s in (d, d + step)]
                result.append((ends[0], ends[1]))
            d, walked = d + max(step, 1e-6), walked + max(step, 1e-6)
    return result


def _colour(role: str) -> str:
    return PALETTE[role][0]


def _font(size: float) -> ImageFont.FreeTypeFont:
    import matplotlib

    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)
