"""A page beside a run: its process, what it is told, and the wait for the last browser."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from softrig_core import Run, Scenario
from softrig_core.guard import say
from softrig_core.processes.placement import Placement

from .remote import let_go


class Beside:
    """The process of the pages of one run (`view.serve`); it only reads what the nodes write.

    Parameters
    ----------
    scenario : Scenario
    directory : Path
        Where the nodes write their files.
    placement : Placement
    address : str
        ``host:port``.
    """

    def __init__(self, scenario: Scenario, directory: Path, placement: Placement, address: str) -> None:
        self._directory = directory
        self._told = {
            "scenario": scenario.model_dump(mode="json", exclude_unset=True), "directory": str(directory),
            "realtime": placement.clock == "realtime", "paused": placement.paused, "how": str(placement),
            "address": address,
        }  # fmt: skip
        self._process: subprocess.Popen[str] | None = None
        self.said: Any = None  # where it says its address; this process's own error stream if that is nowhere

    def open(self, domain: int) -> None:
        """Serve the page of a rig in this domain."""
        file = self._directory / "view.json"
        file.write_text(json.dumps(self._told | {"domain": domain}))
        command = [sys.executable, "-P", "-m", "softrig_bringup.view.serve", str(file)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stderr=self.said, text=True, process_group=0)

    def over(self, run: Run, folder: Path) -> None:
        """Tell the pages that the run is over, and wait until nobody looks any more; Ctrl-C ends the wait."""
        if self._process is None or self._process.poll() is not None or self._process.stdin is None:
            return
        how = f"broke: {run.error}" if run.error else run.stopped_at or "ended"
        with suppress(OSError):
            line = {"over": how, "folder": str(folder), "wrong": bool(run.error)}
            self._process.stdin.write(json.dumps(line) + "\n")
            self._process.stdin.flush()
        if run.stopped:
            return
        say("the page stays until it is closed, or Ctrl-C")
        with suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            let_go(self._process, 5.0)


@contextmanager
def page(scenario: Scenario, directory: Path, placement: Placement, address: str) -> Iterator[Beside]:
    """Give a page that can be opened beside a run; see `Beside`."""
    found = Beside(scenario, directory, placement, address)
    try:
        yield found
    finally:
        found.close()
