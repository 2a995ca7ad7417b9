"""One run of a study in a worker, and the rows that runs leave behind."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from softrig_core import RunError, ScenarioError, load_scenario, simulate

from .draw import Case


class Work(NamedTuple):
    """A case and what is to be kept of it; travels to the worker."""

    case: Case
    duration: float | None
    figures: tuple[str, ...]
    signals: tuple[str, ...]
    samples: int


@lru_cache(maxsize=64)
def _seed(scenario: str) -> int:
    return load_scenario(scenario).seed


def run(work: Work) -> dict[str, Any]:
    """Run one case in this process and give its row; a run that broke gives a row with its error.

    Raises
    ------
    ScenarioError
        Bad input: no run of such a study can work.
    """
    case = work.case
    seed = _seed(case.scenario) if case.seed is None else case.seed
    row: dict[str, Any] = {"number": case.number, "scenario": case.scenario, "case": case.case, "seed": seed,
                           "overrides": case.overrides, "figures": {}, "passed": False, "error": ""}  # fmt: skip
    started = time.perf_counter()
    try:
        done = simulate(case.scenario, seed=seed, duration=work.duration, overrides=case.overrides)
    except RunError as error:
        return row | {"error": str(error), "wall_s": time.perf_counter() - started}
    wanted = [r for r in done.results if not work.figures or r.name in work.figures]
    missing = set(work.figures) - {r.name for r in wanted}
    if missing:
        raise ScenarioError(f"{case.scenario} has no figure {min(missing)!r}")
    row["figures"] = {r.name: r.number if np.isfinite(r.number) else None for r in wanted}
    row["passed"] = not done.missed
    if work.signals:
        row["signals"] = {name: _sampled(done.signals[name], work.samples) for name in work.signals}
    return row | {"wall_s": time.perf_counter() - started}


def _sampled(signal: Any, samples: int) -> dict[str, Any]:
    """Hold a signal between its samples and look at it at equal distances."""
    t, x = signal
    if t.size == 0:
        return {"end": 0.0, "x": []}
    times = np.linspace(t[0], t[-1], samples)
    held = np.clip(np.searchsorted(t, times, side="right") - 1, 0, t.size - 1)
    return {"end": float(t[-1]), "x": x[held].tolist()}


class Log:
    """Rows as they come, a line each, in a file that survives an interruption.

    Parameters
    ----------
    path : Path
        Created when it is not there; a last line that was cut off is dropped.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: set[int] = set()
        whole = 0
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    try:
                        self.known.add(int(json.loads(line)["number"]))
                    except (ValueError, KeyError, TypeError):
                        break
                    whole += len(line)
            os.truncate(path, whole)
        self._file = path.open("ab")

    def add(self, row: dict[str, Any]) -> None:
        """Write one row to the disk."""
        self._file.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
        self._file.flush()
        self.known.add(row["number"])

    def rows(self) -> Iterator[dict[str, Any]]:
        """Read all rows, one at a time, in the order in which they were written."""
        with self.path.open("rb") as file:
            for line in file:
                yield json.loads(line)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
