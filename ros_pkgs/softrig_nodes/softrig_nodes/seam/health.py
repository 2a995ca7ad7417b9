"""The health of a node: its status file and the figures in it."""

from __future__ import annotations

import ctypes
import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from softrig_core.block.block import Observer
from softrig_core.block.held import RunningBlock

AT_FDCWD, RENAME_EXCHANGE = -100, 2
_renameat2 = getattr(ctypes.CDLL(None), "renameat2", None)  # glibc 2.28


class StatusFile:
    """The file in which a node reports its status, as JSON.

    Parameters
    ----------
    path : str
        Path of the file; if empty, none is written.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path)

    def write(self, status: Mapping[str, Any]) -> None:
        """Replace the content of the file atomically; a reader never sees half of it."""
        new = self._path.with_suffix(".new")
        new.write_bytes(json.dumps(status).encode())
        _exchange(new, self._path)


def figures(running: RunningBlock) -> dict[str, Any]:
    """Return the measurements of an observer that are numbers."""
    if not isinstance(running.block, Observer):
        return {}
    return {"figures": {k: v for k, v in running.status().items() if math.isfinite(v[0])}}


def _exchange(new: Path, path: Path) -> None:
    """Replace a file by another atomically: readers that have it open continue to read the old one.

    On ext4 a plain rename over an existing file takes 0.2 to 8 ms, because ext4 then starts to write to the disk. An
    exchange of the two names takes 70 us in total. Not every system and file system supports it.
    """
    if _renameat2 is None or _renameat2(AT_FDCWD, os.fsencode(new), AT_FDCWD, os.fsencode(path), RENAME_EXCHANGE):
        # The first time there is no old file that it could be exchanged with.
        new.replace(path)
    else:
        new.unlink()


def percentiles(name: str, samples: Iterable[int], most: int) -> dict[str, float]:
    """Return p50, p99 and maximum of times in ns as ``<name>_p50_ms`` and so on; empty without samples.

    Parameters
    ----------
    name : str
        Beginning of the names of the figures.
    samples : iterable of int
        Times in ns: all, or the newest.
    most : int
        The longest of all.
    """
    ordered = sorted(samples)
    if not ordered:
        return {}
    n = len(ordered)
    picked = {"p50": ordered[n // 2], "p99": ordered[n * 99 // 100], "max": most}
    return {f"{name}_{key}_ms": value / 1e6 for key, value in picked.items()}


def peak_memory() -> float | None:
    """Largest resident size in MB; getrusage would count that of the parent before exec too."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:  # not Linux
        return None
    return round(int(status.split("VmHWM:")[1].split()[0]) / 1024, 1)
