"""How a node is: its status file and the figures in it."""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..model.block import Observer

if TYPE_CHECKING:
    from .adapter import Adapter


def write_status(adapter: Adapter) -> None:
    """Write the status file of a node, if one is wanted."""
    if not adapter.options.status:
        return
    block = adapter.block
    status: dict[str, Any] = {
        "state": adapter.state, "t": adapter.t, "ticks": adapter.ticks,
        "error": str(adapter.error) if adapter.error else "", "waits_for": adapter.waits_for,
        "lacking": adapter.lacking, "epoch": adapter.epoch,
        "refused": {i.port.topic: [i.refused, i.last_refusal] for i in adapter.inputs + adapter.paces if i.refused},
        "reports": {key: [int(level), text, n] for key, (level, text, n) in block.reports.items()},
        "busy": adapter.busy(),
        "cpu_s": round(time.process_time(), 3),
    }  # fmt: skip
    if adapter.state != "running":  # what takes longer than a tick
        status |= {"peak_memory_mb": _peak_memory()} | adapter.statistics()
    if isinstance(block, Observer) and adapter.state == "done":
        status["figures"] = {k: v for k, v in block.status().items() if math.isfinite(v[0])}
    path = Path(adapter.options.status)
    if adapter.open_ended and adapter.state == "running" and path.exists():
        _overwrite(path, json.dumps(status).encode())
        return
    new = path.with_suffix(".new")
    new.write_text(json.dumps(status))
    new.replace(path)


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


def _peak_memory() -> float | None:
    """Largest resident size in MB; getrusage would count that of the parent before exec too."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:  # not Linux
        return None
    return round(int(status.split("VmHWM:")[1].split()[0]) / 1024, 1)
