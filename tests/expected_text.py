"""Pictures, drawings and pages as text, one line for each part, so that a test compares them with a readable file.

`SOFTRIG_EXPECTED=write scripts/softrig python -m pytest tests -k expected` writes the files in `tests/expected` again;
look at the pictures and at the difference before it is committed.
"""

import difflib
import os
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex
from matplotlib.ticker import FixedLocator
from softrig_bringup.plots.axes import fold_exponents
from softrig_bringup.plots.printed import printed

FEW = 6  # up to this many lines that differ are listed one by one
FOLDER = Path(__file__).parent / "expected"


def check_expected(name, lines):
    """Compare lines with a file."""
    results, file = list(lines), FOLDER / f"{name}.txt"
    if os.environ.get("SOFTRIG_EXPECTED") == "write":
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text("\n".join([*results, ""]))
    wanted = file.read_text().splitlines()
    assert results == wanted, "\n".join(difflib.unified_diff(wanted, results, f"expected/{name}.txt", "now", n=0))


def _number(value):
    return f"{value + 0.0:.4g}"


def _row(values):
    return " ".join(_number(v) for v in np.ravel(values))


def _curve(x, y):
    """First and last point of a curve and a checksum that each of its points changes."""
    x, y = (np.ma.filled(np.ma.asarray(v, float), np.nan) for v in (x, y))
    if len(x) <= 4:
        return f"({_row(x)}; {_row(y)})"
    weight = np.arange(1, len(x) + 1)
    ends = ", ".join(_row((v[0], v[-1], np.nansum(v), np.nansum(v * weight) / len(x))) for v in (x, y))
    return f"{len(x)} points {ends}" + (f", {np.isnan(y).sum()} gaps" if np.isnan(y).any() else "")


def _text(text):
    words = (
        f"{text.get_text()!r} size {text.get_fontsize():g} {to_hex(text.get_color())} {text.get_ha()} {text.get_va()}"
    )
    return words + (f" turned {text.get_rotation():g}" if text.get_rotation() else "")


def _line(line):
    text = f"{to_hex(line.get_color())} {line.get_linestyle()} {line.get_linewidth():g} {line.get_drawstyle()}"
    if line.get_marker() not in ("", "None", None):
        text += f" marker {line.get_marker()} {line.get_markersize():g}"
    if line.get_alpha() is not None:
        text += f" alpha {line.get_alpha():.3g}"
    text += "" if line.get_clip_on() else " unclipped"
    return f"line {line.get_label()!r} {text} z {line.get_zorder():.3g}: {_curve(line.get_xdata(), line.get_ydata())}"


def _together(lines):
    """The composition of many lines, and a checksum of their points."""
    styles = Counter(_line(line).partition(" ")[2].partition(":")[0].partition(" ")[2] for line in lines)
    x, y = (np.concatenate([np.asarray(c, float) for c in v]) for v in zip(*(i.get_data() for i in lines), strict=True))
    return f"{', '.join(f'{n} {style}' for style, n in styles.items())}: {_curve(x, y)}"


def _collection(part):
    face, alpha = part.get_facecolor(), part.get_alpha()
    colour = to_hex(face[0]) if len(face) else "none"
    kind = "area" if isinstance(part, PolyCollection) else type(part).__name__
    text = f"{kind} {colour} alpha {alpha} z {part.get_zorder():.3g}"
    values = part.get_array()
    if values is not None:
        text += f" {part.get_cmap().name} values {_curve(np.arange(values.size), np.ravel(values))}"
    points = np.vstack([p.vertices for p in part.get_paths()] or [np.empty((0, 2))])
    places = np.ma.filled(np.ma.asarray(part.get_offsets(), float), np.nan)
    return f"{text}: {_curve(*points.T)}" + (f" at {_curve(*places.T)}" if len(places) > 1 else "")


def on_paper(figure):
    """A picture as matplotlib draws it for print."""
    drawn = printed(figure)
    fold_exponents(drawn)
    return drawn


def figure_lines(figure):
    """A figure of matplotlib: everything that is drawn into it, in order."""
    yield f"figure {_row(figure.get_size_inches())} in, {figure.dpi:g} dpi"
    yield from (f"  text {_text(t)} at {_row(t.get_position())}" for t in figure.texts)
    yield from (f"  title {_text(t)} at {_row(t.get_position())}" for t in [figure._suptitle] if t is not None)
    for ax in figure.axes:
        spot = ax.get_subplotspec()
        rows = "" if spot is None else f" {' '.join(map(str, spot.get_geometry()))}"
        yield f"  axes{rows} {ax.get_xlabel()!r} {ax.get_ylabel()!r} x {_row(ax.get_xlim())} y {_row(ax.get_ylim())}"
        scales = ax.get_xscale(), ax.get_yscale(), ax.get_aspect()
        grid = [bool(a.get_gridlines() and a.get_gridlines()[0].get_visible()) for a in (ax.xaxis, ax.yaxis)]
        yield f"    {' '.join(map(str, scales))} grid {grid[0]:d}{grid[1]:d}"
        for where in ("left", "center", "right"):
            if title := ax.get_title(where):
                size = {"left": ax._left_title, "center": ax.title, "right": ax._right_title}[where]
                yield f"    title {where} {title!r} size {size.get_fontsize():g} {to_hex(size.get_color())}"
        for axis in (ax.xaxis, ax.yaxis):
            if isinstance(axis.get_major_locator(), FixedLocator):
                names = [t.get_text() for t in axis.get_ticklabels()]
                yield f"    ticks {_row(axis.get_majorticklocs())} {names}"
        unnamed = [line for line in ax.lines if line.get_label().startswith("_")]
        if len(unnamed) > FEW:
            yield f"    {len(unnamed)} lines without a name: {_together(unnamed)}"
        yield from (f"    {_line(line)}" for line in ax.lines if line not in unnamed or len(unnamed) <= FEW)
        yield from (f"    {_collection(part)}" for part in ax.collections)
        boxes = [p.get_path().transformed(p.get_patch_transform()).get_extents().extents for p in ax.patches]
        if len(boxes) > 4:
            yield f"    {len(boxes)} patches {to_hex(ax.patches[0].get_facecolor())}: {_row(np.sum(boxes, axis=0))}"
        else:
            for patch, box in zip(ax.patches, boxes, strict=True):
                text = f"{to_hex(patch.get_facecolor(), keep_alpha=True)} {patch.get_linewidth():g}"
                yield f"    {type(patch).__name__} {text} z {patch.get_zorder():.3g}: {_row(box)}"
        yield from (f"    text {_text(t)} at {_row(getattr(t, 'xy', t.get_position()))}" for t in ax.texts)
        if (legend := ax.get_legend()) is not None:
            words = [t.get_text() for t in legend.get_texts()]
            size = f"size {legend.get_texts()[0].get_fontsize():g}" if words else ""
            title = legend.get_title().get_text()
            yield f"    legend {title!r} {words} {legend._ncols} columns {size} at {legend._loc}"


class _Tree(HTMLParser):
    """A page as nested lists: tag, attributes, content."""

    def __init__(self, text):
        super().__init__()
        self.root = ("page", {}, [])
        self._open = [self.root]
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        element = (tag, dict(attrs), [])
        self._open[-1][2].append(element)
        if tag not in VOID:
            self._open.append(element)

    def handle_startendtag(self, tag, attrs):
        self._open[-1][2].append((tag, dict(attrs), []))

    def handle_endtag(self, tag):
        while self._open[-1][0] != tag:
            self._open.pop()
        self._open.pop()

    def handle_data(self, data):
        if data.strip():
            self._open[-1][2].append(" ".join(data.split()))


VOID = ("meta", "img", "br", "link")
INLINE = ("td", "th", "code", "b", "a", "span", "dt", "dd", "title")


def page_lines(text, without=()):
    """A page of HTML: one line for each element and each row of a table; nothing below the headings of `without`."""
    yield from _below(_Tree(text).root[2], 0, without)


def _below(content, depth, without):
    skipped = ""
    for part in content:
        if isinstance(part, str):
            yield "  " * depth + repr(part)
            continue
        tag, attributes, inside = part
        if tag in ("h1", "h2", "h3", "h4"):
            skipped = tag if inside and inside[0] in without else ""
        if skipped or tag == "style":
            continue
        if tag in ("tr", "dl") or all(isinstance(i, str) or i[0] in INLINE for i in inside):
            yield "  " * depth + _inline(part)
        else:
            yield "  " * depth + _head(tag, attributes)
            yield from _below(inside, depth + 1, without)


def _head(tag, attributes):
    entries = {k: v for k, v in attributes.items() if k not in ("class", "data-label") and v}
    entries = {k: "data" if str(v).startswith("data:") else v for k, v in entries.items()}
    name = ".".join([tag, *(attributes.get("class") or "").split()])
    return " ".join([name, *(f"{k}={v}" for k, v in entries.items())])


def _inline(part):
    if isinstance(part, str):
        return part
    tag, attributes, inside = part
    words = " | ".join(_inline(i) for i in inside)
    return f"{_head(tag, attributes)}: {words}" if tag not in ("td", "th") or attributes.get("class") else words
