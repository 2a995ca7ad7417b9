"""The verb `view`: a run or a bag to browse, or a scenario that starts paused."""

from __future__ import annotations

import argparse
from pathlib import Path

from softrig_bags.files.compressed import SUFFIXES, plain
from softrig_core.extras import need
from softrig_core.kit.file_format import json_object
from softrig_nodes.processes.stopping import stoppable

from ..pack.parts import is_pack
from ..report.run_rig import rig_of_run
from . import run_verb


def view(options: argparse.Namespace) -> int:
    """Show the named run or scenario; return the exit status."""
    path = Path(options.scenario)
    if options.scenario and (path.is_dir() or plain(path).suffix in SUFFIXES or is_pack(path)):
        return _recorded(path, options.address, options.namespace)
    options.view, options.paused = True, not options.running
    return run_verb.run(options)


def _recorded(path: Path, address: str, namespace: str) -> int:
    need("bokeh", "view")
    from ..view.serve import serve
    from ..view.sources import Recorded

    rig, signals = rig_of_run(path, namespace)
    directory = path if (path / "metrics.json").is_file() else path.absolute().parent
    content = json_object(directory / "metrics.json")  # empty for a bag without the folder of a run
    how = str(content.get("mode", "bag"))
    with stoppable():
        try:
            serve(Recorded(rig, signals, content), how, address)
        except KeyboardInterrupt:
            return 0
    return 0
