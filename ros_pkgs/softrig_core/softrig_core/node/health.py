"""How a node is: its status file and the figures in it."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from ..model.block import Block, Observer


class StatusFile:
    """The file in which a node says how it is, as JSON.

    Parameters
    ----------
    path : str
        Empty: none is wanted.
    """

    def __init__(self, path: str) -> None:
        self._path = Path(path)

    def write(self, status: Mapping[str, Any], in_place: bool) -> None:
        """Replace what it says; `in_place` when that must not take longer than a tick."""
        content = json.dumps(status).encode()
        if in_place and self._path.exists():
            _overwrite(self._path, content)
            return
        new = self._path.with_suffix(".new")
        new.write_bytes(content)
        new.replace(self._path)


def figures(block: Block) -> dict[str, Any]:
    """Give what an observer has measured, as far as it is a number."""
    if not isinstance(block, Observer):
        return {}
    return {"figures": {k: v for k, v in block.status().items() if math.isfinite(v[0])}}


def _overwrite(path: Path, content: bytes) -> None:
    """Change a file in its place, padded to its length: 10 us between two ticks, while to replace it takes 0.4 to 4 ms.

    Who reads it at that moment may find it half written: no JSON, and he looks again.
    """
    file = os.open(path, os.O_WRONLY)
    try:
        os.pwrite(file, content.ljust(os.fstat(file).st_size), 0)
    finally:
        os.close(file)


def percentiles(name: str, samples: Iterable[int]) -> dict[str, float]:
    """Give p50, p99 and maximum of times in ns as ``<name>_p50_ms`` and so on; nothing without samples.

    Parameters
    ----------
    name : str
        Beginning of the names of the figures.
    samples : iterable of int
        Times in ns.
    """
    ordered = sorted(samples)
    if not ordered:
        return {}
    n = len(ordered)
    picked = {"p50": ordered[n // 2], "p99": ordered[n * 99 // 100], "max": ordered[-1]}
    return {f"{name}_{key}_ms": value / 1e6 for key, value in picked.items()}


def peak_memory() -> float | None:
    """Largest resident size in MB; getrusage would count that of the parent before exec too."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:  # not Linux
        return None
    return round(int(status.split("VmHWM:")[1].split()[0]) / 1024, 1)
