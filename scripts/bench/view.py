"""The cost of a page beside a run: in lockstep in ticks/s, in real time at 5 kHz in missed deadlines."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

from rich.table import Table
from softrig_bringup.view.run_pages import RunPages, page
from softrig_core import ScenarioError, rig_of
from softrig_nodes import run_processes
from softrig_nodes.processes.placement import Listener, Placement

from .console import console

ROUNDS = 3
Mode = Literal["lockstep", "realtime"]
LENGTH: dict[Mode, float] = {"lockstep": 6.0, "realtime": 10.0}  # s of the induction drive
PERIOD = 0.0002  # s, for plant, law and monitor in real time
# A browser that shows each state immediately.
READER = """
import re, sys
from bokeh.client import pull_session
url = next(m[1] for line in sys.stdin if (m := re.search(r"the page is (http\\S+)", line)))
base, _, token = url.partition("?token=")
session = pull_session(url=base + "view", arguments={"token": token})
find = lambda name: session.document.select_one({"name": name})
def shown():
    new = find("echo").text != find("beat").text
    if new:
        find("echo").text = find("beat").text
    return new
while session._connection.connected:  # its loop waits for each message inside of the wait for the one before
    session._connection._loop_until(shown)
"""


def view() -> None:
    """Ticks/s in lockstep and missed deadlines at 5 kHz, with and without a page that a browser shows."""
    table = Table("run", "page", "ticks/s, or missed", box=None, pad_edge=False)
    results: dict[tuple[Mode, bool], list[float]] = {}
    for _ in range(ROUNDS):
        for mode in LENGTH:
            for shown in (False, True):
                results.setdefault((mode, shown), []).append(_measure(mode, shown))
    for (mode, shown), values in results.items():
        middle = sorted(values)[ROUNDS // 2]
        text = f"{middle:,.0f} ticks/s" if mode == "lockstep" else f"{middle:.2%}"
        table.add_row(mode, "shown" if shown else "none", text)
    ratio = sorted(b / a for a, b in zip(results["lockstep", False], results["lockstep", True], strict=True))[
        ROUNDS // 2
    ]
    console.print(table)
    console.print(f"lockstep with a page: {ratio:.2f} of the speed without")


def _measure(mode: Mode, shown: bool) -> float:
    rig = rig_of("induction_dtc", duration=LENGTH[mode])
    if mode == "realtime":
        rig = rig_of(rig, overrides={f"{n}.period": PERIOD for n in ("im_plant", "dtc_controller", "flux_monitor")})
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, placement = Path(name), Placement("container", mode)
        beside: RunPages | None = None
        if shown:
            beside = stack.enter_context(page(rig.scenario, folder, placement, "127.0.0.1:0"))
            reader: Any = subprocess.Popen([sys.executable, "-c", READER], stdin=subprocess.PIPE)
            stack.callback(reader.kill)
            beside.stream = reader.stdin
        listener = Listener(opened=beside.open if beside else None)
        outcome = run_processes(rig, rig.scenario.seed, folder, placement, listener)
    if outcome.error:
        raise ScenarioError(outcome.error)
    status = outcome.status["im_plant"]
    if mode == "lockstep":
        return float(status["ticks"] / status["running_s"])
    return float(status["missed_deadlines"] / (status["ticks"] + status["missed_deadlines"]))
