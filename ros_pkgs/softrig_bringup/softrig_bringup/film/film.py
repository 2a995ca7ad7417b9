"""The frames of a run's drawing, evenly spaced in simulated time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from softrig_core import ScenarioError
from softrig_core.drawing.base import Drawing
from softrig_core.drawing.shapes import Pen, Shape
from softrig_core.wire.signals import Signal

FRAMES = 20  # a second of the film
LONGEST = 600  # frames
COMFORTABLE = 8.0  # s of film: a loop of this length is still short enough to watch twice
PAST = 60  # rows of a trail
STRIP = 30.0  # units below the drawing, for the time and the speed of the film


@dataclass(frozen=True)
class Film:
    """A drawing over a window of time.

    Parameters
    ----------
    times : float array of shape (n,)
        Simulated time of each frame, s.
    frames : list of lists of Shape
        One a time.
    speed : float
        Simulated seconds in one second of film.
    """

    drawing: Drawing
    times: NDArray[np.float64]
    frames: list[list[Shape]]
    speed: float

    @property
    def duration(self) -> float:
        """Return the length of the film, s."""
        return len(self.frames) / FRAMES

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Left, top, width, height with the strip of the time."""
        x, y, width, height = self.drawing.bounds
        return x, y, width, height + STRIP


def comfortable(span: float) -> float:
    """Return a speed (1, 2 or 5 times a power of ten) that makes a loop of convenient length.

    Examples
    --------
    >>> comfortable(0.1), comfortable(2.0), comfortable(60.0)
    (0.02, 0.5, 10.0)
    """
    least = span / COMFORTABLE
    decade = 10.0 ** math.floor(math.log10(least))
    return float(f"{decade * next(s for s in (1, 2, 5, 10) if s * decade >= least * (1 - 1e-9)):.6g}")


def film(drawing: Drawing, signals: Mapping[str, Signal], start: float, end: float, speed: float | None = None) -> Film:
    """Draw a run's frames.

    Parameters
    ----------
    signals : mapping of str to (t, x)
        `Signals` of the run; one that the run has not is drawn at rest.
    start, end : float
        s, of the simulated time.
    speed : float, optional
        Simulated seconds in one of film; a `comfortable` one without it.

    Raises
    ------
    ScenarioError
        Nothing to draw from, or more than `LONGEST` frames.
    """
    speed = speed or comfortable(end - start)
    count = 1 + round((end - start) / speed * FRAMES)
    if count > LONGEST:
        raise ScenarioError(
            f"{count} frames at {FRAMES} a second: expected at most {LONGEST}; use a speed of "
            f"{comfortable(end - start):g} or a shorter window"
        )
    if count < 2:
        raise ScenarioError(f"{end - start:g} s at a speed of {speed:g} are less than two frames of 1/{FRAMES} s")
    known = {name: signals[name] for name in drawing.signals if name in signals and signals[name].t.size}
    if not known:
        raise ScenarioError(f"no drawn signal was recorded: {', '.join(drawing.signals)}")
    times = start + (end - start) * np.arange(count) / (count - 1)
    result = rows(known, times)
    if not drawing.trail:
        return Film(drawing, times, [_with_time(drawing, r, (), t, speed) for r, t in zip(result, times)], speed)
    # a grid that frames share: the trail of each is the stretch of it before the frame
    step = max(drawing.trail / PAST, 1e-9)
    first = max(start - drawing.trail, 0.0)
    grid = np.asarray(first + step * np.arange(math.floor((end - first) / step) + 1), dtype=np.float64)
    track = rows(known, grid)
    frames = []
    for row, t in zip(result, times):
        a, b = np.searchsorted(grid, [t - drawing.trail, t])
        frames.append(_with_time(drawing, row, track[a:b], t, speed))
    return Film(drawing, times, frames, speed)


def rows(known: Mapping[str, Signal], times: NDArray[np.float64]) -> list[dict[str, float]]:
    """Return the newest value of each signal at each time; None before its first."""
    columns = {}
    for name, (t, x) in known.items():
        newest = np.searchsorted(t, times + 1e-9, side="right") - 1
        columns[name] = np.where(newest >= 0, x[np.maximum(newest, 0)], math.nan).tolist()
    return [dict(zip(columns, values, strict=True)) for values in zip(*columns.values(), strict=True)]


def _with_time(
    drawing: Drawing, row: Mapping[str, float], past: Sequence[Mapping[str, float]], t: float, speed: float
) -> list[Shape]:
    x, y, width, height = drawing.bounds
    pen = Pen()
    digits = max(0, min(6, 1 - math.floor(math.log10(speed)))) if speed < 10 else 0
    pen.text((x + 20, y + height + 14), f"t = {t:.{digits}f} s", "muted")
    pen.text((x + width - 20, y + height + 14), speed_text(speed), "muted", 13.0, "end")
    return [*drawing.frame(row, past), *pen.shapes]


def speed_text(speed: float) -> str:
    """Describe the speed of a film relative to the run.

    Examples
    --------
    >>> speed_text(0.02), speed_text(1.0), speed_text(5.0)
    ('slowed down 50 times', 'as fast as it is', '5 times as fast as it is')
    """
    if speed == 1.0:
        return "as fast as it is"
    return f"slowed down {1 / speed:g} times" if speed < 1.0 else f"{speed:g} times as fast as it is"
