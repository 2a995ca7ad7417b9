"""The node processes of a run: the files that they write, whether they are stopped, their end."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softrig_core.rig.members import Member

from .fork_server import Forked

STOP_STEPS = ((signal.SIGINT, 3.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))


@dataclass
class Child:
    """One node; those of a container share the process and the log."""

    member: Member
    process: subprocess.Popen[bytes] | Forked
    end: int  # process file descriptor, readable when the process has ended
    log: Path
    status: Path
    shard: Path
    interrupted: bool = False  # whether this runner stopped it; its exit status is then no sign of an error


def is_held(child: Child) -> bool:
    """Return whether a process is stopped by SIGSTOP or a terminal (Linux)."""
    with suppress(OSError):
        return Path(f"/proc/{child.process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    return False


def stop(children: list[Child]) -> None:
    """Stop the remaining processes: SIGINT, then SIGTERM, then SIGKILL."""
    for child in children:
        child.interrupted = child.process.poll() is None
    for number, patience in STOP_STEPS:
        # The nodes of a container share one process, which must get each signal only once.
        running = {c.process.pid: c for c in children if c.process.poll() is None}.values()
        if not running:
            return
        for child in running:
            # A process that is stopped (SIGSTOP) handles no other signal until it continues.
            child.process.send_signal(signal.SIGCONT)
            child.process.send_signal(number)
        deadline = time.monotonic() + patience
        for child in running:
            with suppress(subprocess.TimeoutExpired):
                child.process.wait(max(0.0, deadline - time.monotonic()))


def end_left(children: list[Child]) -> None:
    """End processes that a node's code has started and left; they would keep the node's files open.

    Each node leads a process group of its own. Its members are killed one by one: a signal to a group whose number were
    wrong would reach other programs.
    """
    left = {child.process.pid for child in children if child.process.poll() is not None and _has_members(child)}
    for entry in Path("/proc").iterdir() if left else ():
        # A process may end while it is looked at.
        with suppress(OSError, IndexError):
            if entry.name.isdigit() and int((entry / "stat").read_text().rpartition(")")[2].split()[2]) in left:
                os.kill(int(entry.name), signal.SIGKILL)


def _has_members(child: Child) -> bool:
    try:
        os.killpg(child.process.pid, 0)
    except ProcessLookupError:
        return False
    # Group 0 would be that of this runner, group 1 that of the first process of the system.
    return child.process.pid > 1


def read_status(path: Path) -> dict[str, Any]:
    """Read the status that a node reported; empty before its first report."""
    with suppress(FileNotFoundError):
        return json.loads(path.read_text())
    return {}


def last_line(log: Path) -> str:
    """Return the last line of a log that is not empty."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else ""
