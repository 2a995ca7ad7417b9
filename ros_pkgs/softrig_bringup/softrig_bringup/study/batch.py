"""Many runs: on workers that stay from one batch to the next, their rows in a file that survives an interruption."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from functools import cached_property
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.guard import naming, print_line
from softrig_core.kit.file_format import json_of
from softrig_optim.sweep import Workers, progress

from .draw import Case
from .work import Work, run


class Batch:
    """The runs of a study or search; runs in the log of an earlier call are not repeated.

    Parameters
    ----------
    title : str
        Beside the progress bar.
    log : Log
        Closed at the end.
    workers, scheduler
        See `softrig_optim.sweep.Workers`.
    """

    def __init__(self, title: str, log: Log, workers: int | None = None, scheduler: str = "") -> None:
        self.log = log
        self._open = ExitStack()
        self._pool = Workers(workers, scheduler)
        self._progress = progress(title, log.total)

    def __enter__(self) -> Batch:
        if self.log.passed_over:
            print_line(
                f"{self.log.path}: {self.log.passed_over} of its lines are no rows of this study (cut off, damaged, "
                "doubled); they are ignored, and missing runs are repeated"
            )
        self._open.callback(self.log.close)
        self._open.enter_context(self._pool)
        self._advance = self._open.enter_context(self._progress)
        return self

    def __exit__(self, *error: Any) -> None:
        self._open.__exit__(*error)

    def run(self, works: Iterable[Work]) -> Iterator[dict[str, Any]]:
        """Yield the missing rows in the order in which their runs end."""

        def left() -> Iterator[Work]:
            for work in works:
                if not self.log.knows(work.case):
                    yield work
                else:
                    self._advance()

        for _, row in self._pool.stream(run, left()):
            self.log.add(row)
            self._advance()
            yield row

    def rows(self, works: Sequence[Work]) -> list[dict[str, Any]]:
        """Return the rows of all runs in their order, including those of earlier calls."""
        known = self._known
        known |= {row["number"]: row for row in self.run(works)}
        return [known[work.case.number] for work in works]

    @cached_property
    def _known(self) -> dict[int, dict[str, Any]]:
        return {row["number"]: row for row in self.log.rows()}


class Log:
    """A file of rows, appended one line each as runs end, that survives an interruption.

    Lines in the file are never removed. A line is skipped, and its run is repeated, if it is truncated or damaged, or
    if it belongs to another run than the study has under that number.

    Parameters
    ----------
    path : Path
        Created when it is not there.
    total : int
        Runs of the study.
    cases : iterable of Case
        The runs of the study, if they are known in advance; a search calls `knows` instead.

    Attributes
    ----------
    passed_over : int
        Number of lines that are not rows of this study or repeat a row.
    """

    def __init__(self, path: Path, total: int, cases: Iterable[Case] | None = None) -> None:
        self.path, self.total = path, total
        self._known: dict[int, bytes] = {}
        self.passed_over = 0
        if path.is_symlink():
            raise ScenarioError(f"{path} is a link, expected a file of its own for the rows")
        lines, complete = 0, True
        if path.exists():
            with path.open("rb") as file:
                for line in file:
                    lines += 1
                    complete = line.endswith(b"\n")
                    if (row := row_of(line)) is not None and 0 <= row["number"] < total:
                        self._known.setdefault(row["number"], _content(row))
            if cases is not None and self._known:
                expected = {c.number: _content(c._asdict()) for c in cases if c.number in self._known}
                self._known = {k: v for k, v in self._known.items() if expected.get(k) == v}
            self.passed_over = lines - len(self._known)
        self._file = path.open("ab")
        if not complete:
            # The last line was cut off, and the next row must be a line of its own.
            self._file.write(b"\n")

    def __len__(self) -> int:
        return len(self._known)

    def knows(self, case: Case) -> bool:
        """Return whether the row of a case exists.

        Raises
        ------
        ScenarioError
            The row of that number is of another run.
        """
        known = self._known.get(case.number)
        if known is not None and known != _content(case._asdict()):
            raise ScenarioError(
                f"{self.path}: run {case.number} has other parameters than this search asks for (another "
                "version of optuna?); choose another --out, or remove it"
            )
        return known is not None

    def add(self, row: dict[str, Any]) -> None:
        """Write one row to the disk."""
        with naming(self.path):
            self._file.write(json.dumps(row, separators=(",", ":")).encode() + b"\n")
            # Each row is passed to the operating system at once, so that an interruption loses no finished run.
            self._file.flush()
        self._known[row["number"]] = _content(row)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Read all rows, one at a time, in the order in which they were written."""
        messages = set()
        with self.path.open("rb") as file:
            for line in file:
                row = row_of(line)
                if row and row["number"] not in messages and self._known.get(row["number"]) == _content(row):
                    messages.add(row["number"])
                    yield row

    def close(self) -> None:
        """Close the file."""
        with naming(self.path):
            self._file.close()


_KINDS: dict[str, type | tuple[type, ...]] = {
    "number": int,
    "scenario": str,
    "case": str,
    "seed": int,
    "overrides": dict,
    "figures": dict,
    "never": list,
    "missed": list,
    "not_judged": list,
    "published_for": str,
    "passed": (bool, type(None)),
    "error": str,
    "wall_s": (int, float),
    "signals": dict,
}
_OPTIONAL = {"signals", "never", "missed", "not_judged", "published_for"}


def row_of(line: bytes) -> dict[str, Any] | None:
    """Read a row; None if the line is not a row."""
    try:
        row = json_of(line)
    except ValueError:
        return None
    if not isinstance(row, dict) or not _KINDS.keys() - _OPTIONAL <= row.keys() <= _KINDS.keys():
        return None
    right = all(isinstance(v, _KINDS[k]) for k, v in row.items())
    return row if right and all(v is None or isinstance(v, float | int) for v in row["figures"].values()) else None


def _content(run: Mapping[str, Any]) -> bytes:
    """Return a digest of the definition of a run."""
    text = json.dumps([run["scenario"], run["case"], run["seed"], run["overrides"]])
    return hashlib.blake2b(text.encode(), digest_size=16).digest()
