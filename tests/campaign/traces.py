"""What a run must not leave behind: processes, shared memory, files outside its directory."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

from softrig_core import RunError
from softrig_nodes.processes.domain import free_domain
from softrig_nodes.processes.shared_memory import AGE, FAST, _is_abandoned, remove_leftovers

SHARED = Path("/dev/shm")


def of_run(directory: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Return number and environment of every process whose logs are below a directory: nodes and what they start."""
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            pairs = (entry / "environ").read_text(errors="replace").split("\0")
        except OSError:  # another user's process, or one that has ended
            continue
        results = dict(p.split("=", 1) for p in pairs if "=" in p)
        if results.get("ROS_LOG_DIR", "").startswith(str(directory)):
            yield int(entry.name), results


def orphans(directory: Path, seconds: float = 15.0) -> list[int]:
    """Return the processes of a run that still exist after a time, and kill them."""
    deadline = time.monotonic() + seconds
    while (left := [number for number, _ in of_run(directory)]) and time.monotonic() < deadline:
        time.sleep(0.05)
    for number in left:
        try:
            os.kill(number, signal.SIGKILL)
        except ProcessLookupError:
            continue
    return left


def segments() -> set[str]:
    """Return the names of the middleware's files in shared memory."""
    return {p.name for fast in FAST for p in SHARED.glob(f"*{fast}*")}


def left_in_memory(before: set[str], domain: int | None) -> list[str]:
    """Return new files without a living owner that the next runs would not remove either.

    Other runs of this machine start and end meanwhile. So a file counts only if it remains after three removals, and a
    file of the domain only if no process uses that domain again.
    """
    left = segments() - before
    with ExitStack() as stack:
        try:
            stack.enter_context(free_domain(domain))
        except RunError:
            domain = None
        first = 7400 + 250 * (-1000 if domain is None else domain)
        own_ports = {f"{fast}port{n}" for fast in FAST for n in range(first, first + 250)}
        for _ in range(3):
            time.sleep(AGE + 0.1)  # the clearing skips files younger than AGE
            remove_leftovers(domain)
            with ExitStack() as locks:
                left &= {n for n in segments() if _judged(n, own_ports) and _is_abandoned(SHARED / n, locks)}
            if not left:
                break
    return sorted(left)


def _judged(name: str, own_ports: set[str]) -> bool:
    """Return whether the next run removes a file; it leaves ports of another domain until a run uses that domain."""
    stem = name.removesuffix("_el")
    return stem in own_ports if "_port" in name else stem != name
