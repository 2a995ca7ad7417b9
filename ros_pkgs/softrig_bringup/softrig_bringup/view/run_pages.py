"""A page beside a run: its process, the data sent to it, and the wait for the last browser."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from softrig_core import Run, Scenario, rig_of
from softrig_core.guard import print_line
from softrig_nodes.processes.placement import Placement

from .remote import Remote, let_go

RESTARTS = 3  # restarts of a page that has failed


class RunPages:
    """The process of the pages of one run (`view.serve`); it only reads what the nodes write.

    A page process that crashes is restarted at its address; after the last attempt the run continues without a page.

    Parameters
    ----------
    directory : Path
        Where the nodes write their files.
    address : str
        ``host:port``.
    """

    def __init__(self, scenario: Scenario, directory: Path, placement: Placement, address: str) -> None:
        self._directory, self._address = directory, address
        self._watched: dict[str, Any] = {
            "scenario": scenario.model_dump(mode="json", exclude_unset=True),
            "directory": str(directory),
            "realtime": placement.clock == "realtime",
            "paused": placement.paused,
            "pace": placement.pace,
            "how": str(placement),
        }
        self._process: subprocess.Popen[str] | None = None
        self._ends = False  # whether the end of the process is intended
        self.keeper = threading.Thread(target=self._keep, daemon=True)
        self.stream: Any = None  # where the page's address is printed; None: the error stream of this process

    def open(self, domain: int) -> None:
        """Serve the page of a rig in this domain."""
        from .serve import free_address, new_token

        host, port = free_address(self._address)
        self._watched |= {"domain": domain, "address": f"{host}:{port}", "token": new_token()}
        (self._directory / "view.json").write_text(json.dumps(self._watched))
        self._process = self._start()
        self.keeper.start()

    def _start(self) -> subprocess.Popen[str]:
        command = [sys.executable, "-P", "-m", "softrig_bringup.view.serve", str(self._directory / "view.json")]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stderr=self.stream, text=True, process_group=0)

    def _keep(self) -> None:
        """Restart the page process when it ends with an error, a limited number of times."""
        for left in range(RESTARTS, -1, -1):
            assert self._process is not None
            status = self._process.wait()
            if self._ends:
                return
            outcome = "it is started again" if left else "the run continues without it"
            print_line(f"the page has broken (status {status}): {outcome}")
            if left:
                self._process = self._start()
        if self._watched["paused"]:  # without a page nobody could continue a paused run
            rig = rig_of(Scenario.model_validate(self._watched["scenario"]))
            remote = Remote(self._watched["domain"], self._directory, lambda call: call())
            remote.ask({"node": rig.clock.name, "call": "resume"}, lambda done, reason: remote.close())

    def over(self, run: Run, folder: Path) -> None:
        """Notify the pages that the run is over, and wait until no browser is connected; Ctrl-C ends the wait."""
        self._ends = True
        if self._process is None or self._process.poll() is not None or self._process.stdin is None:
            return
        how = f"broke: {run.error}" if run.error else run.stopped_at or "ended"
        with suppress(OSError):
            line = {"over": how, "folder": str(folder), "wrong": bool(run.error)}
            self._process.stdin.write(json.dumps(line) + "\n")
            self._process.stdin.flush()
        if run.stopped:
            return
        with suppress(KeyboardInterrupt):
            print_line("the page stays until it is closed, or Ctrl-C")
            if status := self._process.wait():
                print_line(f"the page has broken (status {status}); the results are there")

    def close(self) -> None:
        """End the process."""
        self._ends = True
        if self._process is not None:
            let_go(self._process, 5.0)


@contextmanager
def page(scenario: Scenario, directory: Path, placement: Placement, address: str) -> Iterator[RunPages]:
    """Yield a page that can be opened beside a run; see `RunPages`."""
    result = RunPages(scenario, directory, placement, address)
    try:
        yield result
    finally:
        result.close()
