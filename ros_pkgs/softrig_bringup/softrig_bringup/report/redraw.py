"""Pictures of a run that is over, drawn from its bag: for a paper, or where the run drew none."""

from __future__ import annotations

import argparse
import csv
import os
import shlex
from collections.abc import Sequence
from io import StringIO
from pathlib import Path

from softrig_bags.read import BagSignals, signals
from softrig_bags.reader import BagReader
from softrig_core import Rig, ScenarioError, rig_of
from softrig_core.command_line import Parser

from ..folder import replace
from ..options.packed import ABOUT, is_pack, opened
from ..options.run_options import arguments, scenario_of
from ..plots.curves import Curve, Source, with_plots
from ..plots.pictures import UNDATED, plot_entry, plot_name, plot_run
from .looked import rig_of_pack
from .record import read_run

MM = 25.4  # in an inch


def rig_of_run(directory: Path) -> tuple[Rig, BagSignals]:
    """Give the rig of a run and its signals.

    Parameters
    ----------
    directory : Path
        Of a run, or a bag that a run has written; a single .mcap file of it, or a pack.

    Raises
    ------
    ScenarioError
        Neither, or no bag in it, or its scenario is unknown here.
    """
    if directory.is_file():
        return _of_file(directory)
    if (directory / ABOUT).is_file():  # a pack that somebody has unpacked
        return rig_of_pack(directory)
    bag = directory / "bag" if (directory / "metrics.json").is_file() else directory
    if not bag.is_dir():
        raise ScenarioError(
            f"{directory}: no bag in it, expected the directory of a run or a bag; pictures are drawn from the bag"
        )
    found = signals(bag)
    if (bag.parent / "metrics.json").is_file():
        return _as_it_ran(read_run(bag.parent).made_by), found
    scenario = BagReader(bag).custom_data.get("scenario", "")
    if not scenario:
        raise ScenarioError(f"{bag}: does not say of which scenario it is")
    return rig_of(scenario), found


def _of_file(path: Path) -> tuple[Rig, BagSignals]:
    from ..options.like import recall

    if is_pack(path):
        try:
            return rig_of_pack(opened(path))
        except ScenarioError as error:
            raise ScenarioError(f"{path}: {error}") from None
    run = recall(path, _parser().parse_args)
    return rig_of(scenario_of(run.options)), signals(run.bag)


def _parser() -> Parser:
    parser = Parser(prog="softrig run")
    arguments(parser)
    return parser


def _as_it_ran(command: str) -> Rig:
    """Build the rig that a run's command stands for."""
    try:
        words = shlex.split(command)
        words = words[words.index("run") + 1 :]
    except ValueError:
        raise ScenarioError(f"metrics.json: command: expected that of a run, got {command!r}"[:200]) from None
    return rig_of(scenario_of(_parser().parse_args(words)))


def draw_missing(directory: Path, into: Path) -> list[Path]:
    """Draw the pictures of a run that has none; gives their files."""
    rig, found = rig_of_run(directory)
    return plot_run(found, rig, into)


def main(options: argparse.Namespace) -> int:
    """Draw pictures of a run anew: of some signals, or the plots of its scenario; print their files."""
    names, out, form = options.signals, options.out, options.format
    rig, found = rig_of_run(options.run)
    rig = with_plots(rig, "_".join(n.replace("/", " ") for n in names), names, options.window)
    out.mkdir(parents=True, exist_ok=True)
    source = Source(found, rig)
    for number, entry in enumerate(rig.scenario.plots, 1):
        figure = plot_entry(
            found,
            rig,
            entry,
            title=not (options.no_title or names),
            font=options.font,
            inches=options.width and options.width / MM,
        )
        path = out / Path(plot_name(number, entry.title)).with_suffix(f".{form}")
        try:
            figure.savefig(path, dpi=300, metadata=UNDATED.get(form))
        except RuntimeError as error:  # of the PGF backend
            raise ScenarioError(
                f"{form}: {str(error).splitlines()[0]}; it needs LaTeX (xelatex), pdf does not"
            ) from None
        print(path)
        if options.csv:
            replace(path.with_suffix(".csv"), _table([source.shown(entry, n) for n in entry.signals], source))
            print(path.with_suffix(".csv"))
    return 0


def _table(curves: Sequence[Curve], source: Source) -> str:
    """Write curves as CSV: a row a time, a cell empty where a signal has no sample."""
    rows: dict[float, list[str]] = {}
    for k, curve in enumerate(curves):
        for t, x in zip(curve.x.tolist(), curve.y.tolist(), strict=True):
            rows.setdefault(t, [""] * len(curves))[k] = repr(x)
    text = StringIO()
    writer = csv.writer(text, lineterminator=os.linesep)
    writer.writerow(["t (s)", *(f"{source.short(c.signal) or c.label} ({c.unit or '1'})" for c in curves)])
    writer.writerows([repr(t), *rows[t]] for t in sorted(rows))
    return text.getvalue()
