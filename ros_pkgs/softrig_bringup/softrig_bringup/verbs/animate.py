"""The verb `animate`: a run's drawing as a short film."""

from __future__ import annotations

import argparse
from pathlib import Path

from softrig_bags.files.compressed import SUFFIXES, plain
from softrig_core import Rig, ScenarioError, rig_of, simulate
from softrig_core.drawing import Drawing, drawing_for
from softrig_core.guard import replace

from ..film.film import Film, film
from ..film.smil import animated
from ..report.run_rig import rig_of_run

FORMS = ("svg", "gif", "webp", "png")


def animate(options: argparse.Namespace) -> int:
    """Write the film; returns the exit status."""
    out: Path | None = options.out
    if out is not None and out.suffix[1:] not in FORMS:
        raise ScenarioError(f"{out}: expected a file that ends with .{', .'.join(FORMS)}")
    movie = film_of(options.what, options.start, options.end, options.speed)
    out = out or Path(f"{movie.drawing.rig.scenario.name}.svg")
    reduced = write(movie, out)
    about = [f"{movie.duration:.3g} s", f"{len(movie.frames)} frames", f"{out.stat().st_size / 1e6:.2f} MB", reduced]
    print(f"{out}: {', '.join(filter(None, about))}")
    return 0


def film_of(source: str, start: float = 0.0, end: float | None = None, speed: float | None = None) -> Film:
    """Create the film of a run or of a scenario.

    Parameters
    ----------
    source : str
        Folder of a run, or name or file of a scenario.
    start, end : float
        s; to the end of the run without `end`.
    speed : float, optional
        See `softrig_bringup.film.film.film`.

    Raises
    ------
    ScenarioError
        Nothing to draw, or nothing in that window.
    """
    if not Path(source).is_dir() and plain(Path(source)).suffix not in SUFFIXES:
        rig = rig_of(source)
        drawing = _drawing(rig)
        length = rig.scenario.duration
        first, last = _window(start, end, length)
        run = simulate(rig_of(rig, duration=last) if last < length else rig, progress=True)
        return film(drawing, run.signals, first, last, speed)
    rig, signals = rig_of_run(Path(source))
    drawing = _drawing(rig)
    ends = [float(signals[name].t[-1]) for name in drawing.signals if name in signals and signals[name].t.size]
    return film(drawing, signals, *_window(start, end, max(ends, default=0.0)), speed)


def _drawing(rig: Rig) -> Drawing:
    result = drawing_for(rig)
    if result is None:
        plants = ", ".join(f"{m.name} ({m.package}/{m.executable})" for m in rig.members if m.is_plant)
        raise ScenarioError(f"{rig.scenario.name}: no drawing of {plants or 'a rig without a plant'}")
    return result


def _window(start: float, end: float | None, length: float) -> tuple[float, float]:
    last = length if end is None else min(end, length)
    if last - start < 1e-9:  # too short for the unit s
        raise ScenarioError(f"--from {start:g} s to {last:g} s: expected a part of the run, which is {length:g} s long")
    return start, last


def write(movie: Film, out: Path) -> str:
    """Write a film in the format of the file's extension, complete or not at all; return its reductions."""
    if out.suffix == ".svg":
        replace(out, animated(movie))
        return ""
    from ..film.raster import pixels  # late import: it needs Pillow

    content, reduced = pixels(movie, out.suffix[1:])
    replace(out, content)
    return reduced
