"""Lookup of the package that runs blocks as nodes, by its entry points, because this package works without ROS."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, distribution, entry_points
from pathlib import Path
from typing import Any, NoReturn

from .errors import ScenarioError
from .guard import print_for
from .interrupt import interrupt
from .renamed import former, notice

GROUP = "softrig_runner"


def find_runner(name: str) -> Any:
    """Return the function that an installed package registers under a name in the group `softrig_runner`.

    Parameters
    ----------
    name : {"node", "processes", "container"}

    Raises
    ------
    ScenarioError
        No installed package registers it; names the package of softrig that does.
    """
    try:  # by its name first, because reading the entry points of all packages takes 30 ms of a node's start
        points = distribution("softrig_nodes").entry_points.select(group=GROUP, name=name)
    except PackageNotFoundError:
        points = entry_points(group=GROUP, name=name)
    for point in points:
        return point.load()
    raise ScenarioError(
        "nodes need the package softrig_nodes and ROS 2, and softrig_nodes is not installed here; "
        "`simulate` and runs in process need neither"
    )


def run_node(block_class: type[Any], args: Sequence[str] | None = None) -> NoReturn:
    """Run a block as the node of this process until the process ends.

    Parameters
    ----------
    args : sequence of str, optional
        Command line, the name of the executable first; that of the process when absent.
    """
    interrupt.install()
    argv = sys.argv if args is None else list(args)
    package, name = block_class.__module__.partition(".")[0], Path(argv[0]).name
    if name in former(package):
        print_for(name, notice(package, name))
    try:
        run = find_runner("node")
    except ScenarioError as error:
        print_for(name, error)
        sys.exit(2)
    run(block_class, argv)
    raise AssertionError("a node ends its process")
