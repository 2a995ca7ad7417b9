"""A run once more as it went: its command line, and what was changed of its parameters while it ran."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError


def recall(
    path: Path, parse: Callable[[list[str]], argparse.Namespace]
) -> tuple[argparse.Namespace, list[dict[str, Any]]]:
    """Find out what a run was.

    Parameters
    ----------
    path : Path
        Directory of the run, or its bag.
    parse : callable
        Gives the options of what follows ``softrig run``.

    Returns
    -------
    argparse.Namespace
        The options of its command.
    list of dict
        What was changed while it ran, as ``changes`` of a scenario.

    Raises
    ------
    ScenarioError
        No such run, or it has no bag, which alone knows what was changed while it ran.
    """
    directory = path if (path / "metrics.json").is_file() else path.absolute().parent
    try:
        content = json.loads((directory / "metrics.json").read_text())
        command, changes = shlex.split(content["command"]), list(content["changes"])
    except (OSError, ValueError, KeyError, TypeError):
        raise ScenarioError(f"--like {path}: expected the directory of a run, with a metrics.json of this version, or "
                            "the bag in it") from None  # fmt: skip
    if not (directory / "bag").is_dir():
        raise ScenarioError(f"--like {path}: that run kept no bag: nobody knows what was changed while it ran")
    options = parse(command[command.index("run") + 1 :])
    by_time: dict[float, dict[str, Any]] = {}
    for change in changes:
        named = {f"{change['node']}.{name}": value for name, value in change["set"].items()}
        by_time.setdefault(change["at_s"], {}).update(named)
    return options, [{"at": at, "set": values} for at, values in by_time.items()]
