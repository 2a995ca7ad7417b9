"""One run of a study in a worker, and the rows that runs leave behind."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from softrig_core import RunError, ScenarioError, load_scenario, simulate
from softrig_core.guard import naming

from .draw import Case


class Work(NamedTuple):
    """A case and what is to be kept of it; travels to the worker."""

    case: Case
    duration: float | None
    figures: tuple[str, ...]
    signals: tuple[str, ...]
    samples: int
    runs: int = 1  # so many of the kind are to come, in all workers


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
        done = simulate(case.scenario, seed=seed, duration=work.duration, overrides=case.overrides,
                        runs=work.runs)  # fmt: skip
    except RunError as error:
        return row | {"error": str(error), "wall_s": time.perf_counter() - started}
    wanted = [r for r in done.results if not work.figures or r.name in work.figures]
    missing = set(work.figures) - {r.name for r in wanted}
    if missing:
        raise ScenarioError(f"{case.scenario} has no figure {min(missing)!r}")
    row["figures"] = {r.name: r.number if np.isfinite(r.number) else None for r in wanted}
    row["never"] = [r.name for r in wanted if r.number == np.inf]
    row["passed"] = not done.missed
    if work.signals:
        row["signals"] = {name: _sampled(done.signals[name], work.samples) for name in work.signals}
    return row | {"wall_s": time.perf_counter() - started}


def value_of(row: Mapping[str, Any], figure: str) -> float:
    """Give a figure of a row: infinity for what never happens, NaN for what was not measured."""
    value = row["figures"].get(figure)
    return float(value) if value is not None else np.inf if figure in row.get("never", ()) else np.nan


def absent(values: Iterable[float]) -> str:
    """Say of how many runs there is no value: ``1 of 3 never``; empty when all have one."""
    found = np.array(list(values), float)
    never, lost = int(np.isposinf(found).sum()), int(np.isnan(found).sum())
    parts = [f"{never} of {found.size} never"] if never else []
    return ", ".join(parts + ([f"{lost} of {found.size} not measured"] if lost else []))


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

    What is in the file stays there: a line that was cut off or damaged, and one that tells of another run than the
    study has under that number, is passed over, and its run is done again.

    Parameters
    ----------
    path : Path
        Created when it is not there.
    total : int
        Runs of the study.
    cases : iterable of Case
        Those runs, where they are known before; a search asks `knows`.

    Attributes
    ----------
    passed_over : int
        Lines of the file that are no rows of this study, or repeat one.
    """

    def __init__(self, path: Path, total: int, cases: Iterable[Case] | None = None) -> None:
        self.path = path
        self._known: dict[int, bytes] = {}
        self.passed_over = 0
        if path.is_symlink():
            raise ScenarioError(f"{path} is a link, expected a file of its own for the rows")
        lines, whole = 0, True
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    lines += 1
                    whole = line.endswith(b"\n")
                    if (row := _row(line)) is not None and 0 <= row["number"] < total:
                        self._known.setdefault(row["number"], _content(row))
            if cases is not None and self._known:
                expected = {c.number: _content(c._asdict()) for c in cases if c.number in self._known}
                self._known = {k: v for k, v in self._known.items() if expected.get(k) == v}
            self.passed_over = lines - len(self._known)
        self._file = path.open("ab")
        if not whole:
            self._file.write(b"\n")  # the next row is a line of its own

    def __len__(self) -> int:
        return len(self._known)

    def knows(self, case: Case) -> bool:
        """Whether the row of a case is there.

        Raises
        ------
        ScenarioError
            The row of that number is of another run.
        """
        known = self._known.get(case.number)
        if known is not None and known != _content(case._asdict()):
            raise ScenarioError(f"{self.path}: run {case.number} has other parameters than this search asks for (is it "
                                "by another version of optuna?); choose another --out, or remove it")  # fmt: skip
        return known is not None

    def add(self, row: dict[str, Any]) -> None:
        """Write one row to the disk."""
        with naming(self.path):
            self._file.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
            self._file.flush()
        self._known[row["number"]] = _content(row)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Read all rows, one at a time, in the order in which they were written."""
        told = set()
        with self.path.open("rb") as file:
            for line in file:
                row = _row(line)
                if row and row["number"] not in told and self._known.get(row["number"]) == _content(row):
                    told.add(row["number"])
                    yield row

    def close(self) -> None:
        """Close the file."""
        with naming(self.path):
            self._file.close()


_KINDS: dict[str, type | tuple[type, ...]] = {
    "number": int, "scenario": str, "case": str, "seed": int, "overrides": dict, "figures": dict, "never": list,
    "passed": bool, "error": str, "wall_s": (int, float), "signals": dict,
}  # fmt: skip


def _row(line: bytes) -> dict[str, Any] | None:
    """Read a row; nothing when the line is none."""
    try:
        row = json.loads(line)
    except ValueError:
        return None
    if not isinstance(row, dict) or not _KINDS.keys() - {"signals", "never"} <= row.keys() <= _KINDS.keys():
        return None
    right = all(isinstance(v, _KINDS[k]) for k, v in row.items())
    return row if right and all(v is None or isinstance(v, float | int) for v in row["figures"].values()) else None


def _content(run: Mapping[str, Any]) -> bytes:
    """Give a digest of what a run is; a case without a seed of its own has that of its scenario."""
    seed = _seed(run["scenario"]) if run["seed"] is None else run["seed"]
    what = json.dumps([run["scenario"], run["case"], seed, run["overrides"]])
    return hashlib.blake2b(what.encode(), digest_size=16).digest()
