"""A run in a notebook: its figures and pictures in a cell."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING
from xml.etree.ElementTree import tostring

from softrig_core import Run

from ..page.html import e, picture
from ..plots.curves import with_plots
from ..plots.pictures import plot_entry, plot_run
from ..report.record import RunRecord
from ..report.run_page import metrics
from .run import summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST = 4  # pictures in a cell


def html(run: Run) -> str:
    """Return the title, the table of figures and the first pictures of a run, which need no style sheet."""
    record = RunRecord.read(summary(run, run.results, ""))
    with TemporaryDirectory() as folder:
        result = plot_run(run.signals, run.rig, Path(folder), most=MOST, results=run.results)
        pictures = [picture(path.read_bytes(), path.stem) for path in result[:MOST]]
    about = e("p", e("b", record.title), f" · {run!r}".replace("<", "").replace(">", ""))
    return tostring(e("div", about, metrics(record), *pictures), "unicode", "html")


def plot(run: Run, names: Sequence[str], window: tuple[float, float] | None = None) -> Figure:
    """Draw signals of a run over time; see `softrig_core.Run.plot`."""
    rig = with_plots(run.rig, run.rig.scenario.title, names, window)
    figure = plot_entry(run.signals, rig, rig.scenario.plots[0])
    figure._repr_png_ = partial(_png, figure)  # type: ignore[attr-defined]  # for a cell, without pyplot too
    return figure


def _png(figure: Figure) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()
