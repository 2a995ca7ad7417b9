"""The rig and the signals of a run that is over, from its bag."""

from __future__ import annotations

import shlex
from pathlib import Path

from softrig_bags.files.reader import BagReader
from softrig_bags.read import BagSignals, signals
from softrig_core import Rig, ScenarioError, rig_of
from softrig_core.command_line import Parser
from softrig_core.errors import nearby
from softrig_core.guard import print_line
from softrig_core.rig.members import other_names

from ..options.run_options import arguments, scenario_of
from ..pack.cargo import nodes_in_c
from ..pack.packed import opened
from ..pack.parts import ABOUT, is_pack
from ..plots.pictures import plot_run
from .bag_rig import rig_of_bag
from .looked import recorded_rig, rig_of_pack
from .record import read_run


def rig_of_run(directory: Path, namespace: str = "") -> tuple[Rig, BagSignals]:
    """Return the rig of a run and its signals.

    Parameters
    ----------
    directory : Path
        The directory of a run, any bag (a directory or a single file), or a pack.
    namespace : str
        For a bag: only topics in this namespace are read, and their names are given without it.

    Returns
    -------
    (Rig, BagSignals)
        The rig that ran. If the bag does not name its scenario, or the scenario is unknown here, the rig has only the
        bag's topics, without units.

    Raises
    ------
    ScenarioError
        There is no bag, or the scenario of the run is unknown here.
    """
    rig, result = _recalled(directory, namespace)
    return rig, result.known_as(other_names(rig))


def _recalled(directory: Path, namespace: str) -> tuple[Rig, BagSignals]:
    if namespace and (is_pack(directory) or (directory / ABOUT).is_file()):
        raise ScenarioError(f"{directory}: a pack has one rig, without a namespace; leave out --namespace")
    if is_pack(directory):
        folder = opened(directory)
        try:
            return rig_of_pack(folder)
        except ScenarioError as error:
            raise ScenarioError(f"{directory}: {error}") from None
    if (directory / ABOUT).is_file():  # an unpacked pack
        return rig_of_pack(directory)
    if not directory.exists():
        raise ScenarioError(f"{directory}: no such file or folder, expected a run, a bag or a pack{nearby(directory)}")
    bag = directory / "bag" if (directory / "metrics.json").is_file() else directory
    if not bag.exists():
        raise ScenarioError(
            f"{directory}: no bag in it, expected the directory of a run or a bag; pictures are drawn from the bag"
        )
    result = signals(bag, namespace, on_disk=True)
    if bag.is_dir() and (bag.parent / "metrics.json").is_file():
        return _as_it_ran(read_run(bag.parent).made_by, bag, result), result
    with BagReader(bag) as reader:
        data = reader.custom_data
    scenario, command = data.get("scenario", ""), data.get("command", "")
    if not scenario:
        return rig_of_bag(bag, result), result
    try:
        return _as_it_ran(command or f"run {shlex.quote(scenario)}", bag, result), result
    except ScenarioError as error:
        print_line(f"{bag}: shown without its rig, scenario {scenario} cannot be made here: {error}")
        return rig_of_bag(bag, result), result


def _parser() -> Parser:
    parser = Parser(prog="softrig run")
    arguments(parser)
    return parser


def _as_it_ran(command: str, bag: Path, recorded: BagSignals) -> Rig:
    """Build the rig that a run's command describes; nodes in C are shown as they were recorded.

    The flags of a compiler can start a program, and the scenario may have come with the run.
    """
    try:
        words = shlex.split(command)
        words = words[words.index("run") + 1 :]
    except ValueError:
        raise ScenarioError(f"metrics.json: command: expected that of a run, got {command!r}"[:200]) from None
    scenario = scenario_of(_parser().parse_args(words))
    return recorded_rig(scenario, bag, recorded, names) if (names := nodes_in_c(scenario)) else rig_of(scenario)


def draw_missing(directory: Path, into: Path) -> list[Path]:
    """Draw the pictures of a run that has none; returns their files."""
    rig, result = rig_of_run(directory)
    return plot_run(result, rig, into)
