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
from softrig_core.guard import say

from ..folder import replace
from ..options.packed import ABOUT, is_pack, opened
from ..options.run_options import arguments, scenario_of
from ..plots.curves import Curve, Source, with_plots
from ..plots.pictures import UNDATED, plot_entry, plot_name, plot_run
from .bag_rig import rig_of_bag
from .looked import rig_of_pack
from .record import read_run

MM = 25.4  # in an inch


def rig_of_run(directory: Path) -> tuple[Rig, BagSignals]:
    """Give the rig of a run and its signals.

    Parameters
    ----------
    directory : Path
        Of a run, or any bag: a directory or a single file; or a pack.

    Returns
    -------
    (Rig, BagSignals)
        The rig that ran; of a bag that does not say of which scenario it is, or whose scenario is unknown here, one of
        its topics alone, without units.

    Raises
    ------
    ScenarioError
        No bag, or none in it, or what was run is unknown here.
    """
    if is_pack(directory):
        try:
            return rig_of_pack(opened(directory))
        except ScenarioError as error:
            raise ScenarioError(f"{directory}: {error}") from None
    if (directory / ABOUT).is_file():  # a pack that somebody has unpacked
        return rig_of_pack(directory)
    if not directory.exists():
        raise ScenarioError(f"{directory}: no such file or folder, hence no bag in it; expected a run, a bag or a pack")
    bag = directory / "bag" if (directory / "metrics.json").is_file() else directory
    if not bag.exists():
        raise ScenarioError(
            f"{directory}: no bag in it, expected the directory of a run or a bag; pictures are drawn from the bag"
        )
    found = signals(bag)
    if bag.is_dir() and (bag.parent / "metrics.json").is_file():
        return _as_it_ran(read_run(bag.parent).made_by), found
    with BagReader(bag) as reader:
        data = reader.custom_data
    scenario, command = data.get("scenario", ""), data.get("command", "")
    if not scenario:
        return rig_of_bag(bag, found), found
    try:
        return _as_it_ran(command) if command else rig_of(scenario), found
    except ScenarioError as error:
        say(f"{bag}: shown without its rig, scenario {scenario} cannot be made here: {error}")
        return rig_of_bag(bag, found), found


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
