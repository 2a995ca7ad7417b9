"""One machine's part of a rig: `softrig run SCENARIO --only NODE ... --domain N` on each of them."""

from __future__ import annotations

import argparse
import os
from dataclasses import replace
from pathlib import Path

from softrig_core import Rig, ScenarioError
from softrig_core.errors import closest
from softrig_core.guard import print_line
from softrig_nodes.processes.placement import Listener

from ..options.run_options import folder_name, placement_of


def run_part(rig: Rig, options: argparse.Namespace) -> int:
    """Run the nodes that `options` name until the rig has ended; their recordings stay in shards.

    Figures need what all parts have recorded: `softrig bag repair` makes one bag of all shards in a folder.

    Parameters
    ----------
    rig : Rig
        The whole.
    options : argparse.Namespace
        Of the verb `run`.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    ScenarioError
        No such node, no domain, or a placement without processes.
    """
    names = [m.name for m in rig.members if not m.external]
    for name in options.only:
        if name not in names:
            raise ScenarioError(
                f"--only {name}: no such node{closest(name, names)}; those to be started are {', '.join(names)}"
            )
    if options.domain is None:
        raise ScenarioError("--only: expected --domain N, the same on all machines of the rig")
    if options.mode == "inprocess":
        raise ScenarioError("--only: in process all blocks run on one machine; expected --mode processes or container")
    out = (options.out or Path("runs") / folder_name(rig.scenario.name, options, options.only)).absolute()
    absent = [name for name in names if name not in options.only]
    print_line(f"{', '.join(options.only)} here, domain {options.domain}; elsewhere: {', '.join(absent) or 'nobody'}")
    placement = replace(placement_of(options), wait=options.wait or 0.0)
    from softrig_nodes import run_processes

    outcome = run_processes(rig, rig.scenario.seed, out / "log", placement, Listener(announce=print_line))
    if outcome.error:
        print_line(f"the run broke: {outcome.error}")
        return 3
    log = os.path.relpath(out / "log")
    print_line(
        f"recorded in {log}; for a bag of the whole rig, copy the .shard files of all parts into one folder "
        "and run softrig bag repair FOLDER"
    )
    return 128 + outcome.stopped if outcome.stopped else 0
