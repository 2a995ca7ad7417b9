"""The verb `draw plot`: pictures of runs that are over, drawn from their bags for a paper."""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING

from softrig_core import ScenarioError, Signals
from softrig_core.guard import replace
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.wire.signals import short_name

from ..options.naming import folder_of
from ..pack.packed import opened
from ..pack.parts import is_pack
from ..plots.curves import Curve, Source, inside, shown, with_plots
from ..plots.named import plot_name
from ..plots.overlay import Overlay, overlay_figures
from ..plots.pictures import plot_entry, write_figure
from ..plots.style import PAPERS, Style
from ..report.apart import names as run_names
from ..report.looked import record_of_pack
from ..report.record import read_run
from ..report.run_rig import rig_of_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MM = 25.4  # in an inch


def main(options: argparse.Namespace) -> int:
    """Draw pictures of runs again, of some signals or of the plots of their scenario; print their files."""
    runs = [Path(word) for word in options.what if _is_run(word)] or [Path(options.what[0])]
    names = [word for word in options.what if Path(word) not in runs]
    style = _style(options, bool(names))
    out = options.out or _folder(runs, names, options.window)
    drawn = _of_one(runs[0], names, options, style) if len(runs) == 1 else _of_several(runs, names, options, style)
    number = 0
    for number, (entry, figure, table) in enumerate(drawn, 1):
        path = out / Path(plot_name(number, entry.title)).with_suffix(f".{options.format}")
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            write_figure(figure, path, dpi=300)
        except RuntimeError as error:  # the PGF backend raises it
            raise ScenarioError(
                f"{options.format}: {str(error).splitlines()[0]}; it needs LaTeX (xelatex), pdf does not"
            ) from None
        print(path)
        if options.csv:
            replace(path.with_suffix(".csv"), table)
            print(path.with_suffix(".csv"))
    if not number:
        raise ScenarioError(f"{', '.join(map(str, runs))}: they share no signal that can be drawn over time")
    return 0


def _is_run(word: str) -> bool:
    path = Path(word)
    return path.exists() and (path.is_file() or (path / "metrics.json").is_file() or (path / "metadata.yaml").is_file())


def _style(options: argparse.Namespace, named: bool) -> Style:
    """Return the style that the options select; an explicit option overrides the publisher's style."""
    paper = PAPERS.get(options.style)
    width = options.width or (paper.widths[int(options.columns) - 1] if paper else None)
    title = not (options.no_title or named or paper)
    return Style(
        title, options.font or (paper.font if paper else None), width and width / MM, bool(paper and paper.serif)
    )


def _folder(runs: Sequence[Path], names: Sequence[str], window: Sequence[float] | None) -> Path:
    """Name the folder of pictures by their content, below that of the run if there is one."""
    parts = [name.replace("/", " ") for name in names] + ([f"{a:g}_to_{b:g}_s" for a, b in [window]] if window else [])
    if len(runs) > 1:
        return Path("pictures") / folder_of(
            [*(run.resolve().name for run in runs), *parts], [str(r.resolve()) for r in runs]
        )
    home = next((p for p in (runs[0], runs[0].parent) if (p / "metrics.json").is_file()), None)
    below = (
        home / "pictures" if home else Path("pictures") / folder_of([runs[0].resolve().name], [str(runs[0].resolve())])
    )
    return below / folder_of(parts) if parts else below


Drawing = Iterator[tuple[PlotEntry, "Figure", str]]


def _of_one(run: Path, names: Sequence[str], options: argparse.Namespace, style: Style) -> Drawing:
    rig, result = rig_of_run(run, options.namespace)
    rig = with_plots(rig, "_".join(n.replace("/", " ") for n in names), names, options.window)
    _check_window(options.window, [result])
    source = Source(result, rig)
    for entry in rig.scenario.plots:
        figure = plot_entry(result, rig, entry, style)
        yield entry, figure, _table([source.shown(entry, n) for n in entry.signals], source)


def _of_several(runs: Sequence[Path], names: Sequence[str], options: argparse.Namespace, style: Style) -> Drawing:
    """Draw the common signals of several runs over one another."""
    records = [(run, record_of_pack(opened(run)) if is_pack(run) else read_run(run)) for run in runs]
    called = run_names(records, options.label)
    overlays = []
    for path, label in zip(runs, called, strict=True):
        rig, result = rig_of_run(path, options.namespace)
        rig = with_plots(rig, "_".join(n.replace("/", " ") for n in names), names, options.window)
        overlays.append(Overlay(label, label, rig.scenario.plots, shown(rig), result))
    _check_window(options.window, [over.signals for over in overlays])
    for entry, figure in overlay_figures(overlays, style):
        yield entry, figure, _side_by_side(entry, overlays)


def _check_window(window: Sequence[float] | None, runs: Sequence[Signals]) -> None:
    """Refuse a window that ends before it begins, or in which no run has a sample: its picture would be empty."""
    if window and not window[0] < window[1]:
        raise ScenarioError(f"--window {window[0]:g} {window[1]:g}: expected FROM before TO")
    times = [t for result in runs for t, _ in result.values() if t.size] if window else []
    if window and times and not any(t[0] <= window[1] and window[0] <= t[-1] for t in times):
        first, last = min(t[0] for t in times), max(t[-1] for t in times)
        raise ScenarioError(
            f"--window {window[0]:g} {window[1]:g}: nothing was recorded then, only from {first:g} to {last:g} s"
        )


def _side_by_side(entry: PlotEntry, overlays: Sequence[Overlay]) -> str:
    """Write the curves of several runs as CSV: a column a run and signal."""
    curves = [
        (
            f"{short_name(name, over.shown)} of {over.label} ({over.shown[name].unit or '1'})",
            inside(Curve("", "", *over.signals[name]), entry.window),
        )
        for name in entry.signals
        for over in overlays
        if name in over.shown
    ]
    return _columns([head for head, _ in curves], [curve for _, curve in curves])


def _table(curves: Sequence[Curve], source: Source) -> str:
    return _columns([f"{source.short(c.signal) or c.label} ({c.unit or '1'})" for c in curves], curves)


def _columns(heads: Sequence[str], curves: Sequence[Curve]) -> str:
    """Write curves as CSV: a row a time, a cell empty where a signal has no sample."""
    rows: dict[float, list[str]] = {}
    for k, curve in enumerate(curves):
        for t, x in zip(curve.x.tolist(), curve.y.tolist(), strict=True):
            rows.setdefault(t, [""] * len(curves))[k] = repr(x)
    text = StringIO()
    writer = csv.writer(text, lineterminator=os.linesep)
    writer.writerow(["t (s)", *heads])
    writer.writerows([repr(t), *rows[t]] for t in sorted(rows))
    return text.getvalue()
