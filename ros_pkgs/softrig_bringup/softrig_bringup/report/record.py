"""The contents of a run's ``metrics.json``, for the pages about the run."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from softrig_core import ScenarioError
from softrig_core.data import NAME, Data, MisfitError
from softrig_core.errors import nearby
from softrig_core.kit.file_format import json_of
from softrig_core.verdict.result import Result

from ..page.citations import Citation
from ..page.wiring import Wiring
from ..plots.named import Shown


@dataclass(frozen=True)
class _Status(Data):
    """The entries of a node's status that the pages read by name; the status may also contain figures."""

    error: str = ""
    reports: dict[str, tuple[int, str, int]] = field(default_factory=dict)
    refused: dict[str, tuple[int, str]] = field(default_factory=dict)
    native: tuple[int, str] = (0, "")


@dataclass(frozen=True)
class Plot(Data):
    """A picture of the scenario; see `softrig_core.scenario.plot_entry.PlotEntry`."""

    title: str
    signals: dict[str, str]
    unit: str = ""
    quantity: str = ""
    x: str = ""
    window: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        if not self.signals:
            raise ValueError(f"the plot {self.title!r} has no signals")
        if self.window is not None and not -math.inf < self.window[0] < self.window[1] < math.inf:
            raise ValueError(f"window {self.window[0]:g} to {self.window[1]:g} s: expected its begin before its end")


@dataclass(frozen=True)
class _Changed(Data):
    """A change during the run: the node, and the first tick with the change."""

    at_s: float
    node: str
    set: dict[str, Any]


@dataclass(frozen=True)
class Origin(Data):
    """The run from which this one continues: its command, and the time from which the two differ."""

    run: str
    at_s: float
    command: str


@dataclass(frozen=True, kw_only=True)
class RunRecord(Data):
    """The entries of ``metrics.json`` that the pages use."""

    scenario: str
    title: str
    system: str
    source: str
    mode: str
    label: str = ""
    seed: int
    duration_s: float
    reached_s: float | None = None
    ticks: int
    wall_s: float
    error: str = ""
    stopped: str = ""
    changed: tuple[str, ...] = ()
    command: str
    metrics: tuple[Result, ...]
    plots: tuple[Plot, ...] = ()
    parameters: dict[str, dict[str, Any]]
    changes: tuple[_Changed, ...] = ()
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    versions: dict[str, str]
    code: dict[str, str] = field(default_factory=dict)
    nodes: dict[str, dict[str, Any]] = field(default_factory=dict)
    citations: tuple[Citation, ...] = ()
    wiring: Wiring = field(default_factory=Wiring)
    signals: dict[str, Shown] = field(default_factory=dict)
    also: dict[str, dict[str, str]] = field(default_factory=dict)  # `other_names` of the rig
    origin: Origin | None = field(default=None, metadata={NAME: "from"})
    contradictions: tuple[str, ...] = ()

    @property
    def made_by(self) -> str:
        """Return the command that identifies the rig; for a run continued from another one, that of the first."""
        return self.command if self.origin is None else self.origin.command

    @property
    def simulated_s(self) -> float:
        """Return the simulated time that the run reached, s."""
        return self.duration_s if self.reached_s is None else self.reached_s

    @property
    def compared(self) -> bool:
        """Return whether the run was changed or stopped early: published values are then shown for comparison only."""
        return bool(self.changed or self.stopped)

    @property
    def judged(self) -> list[Result]:
        """The metrics that can pass or miss."""
        return [m for m in self.metrics if m.judged]

    @property
    def missed(self) -> list[Result]:
        """The metrics that missed."""
        return [] if self.stopped else [m for m in self.metrics if not m.passed]


def read_run(directory: Path) -> RunRecord:
    """Read ``metrics.json`` of a run directory.

    Raises
    ------
    ScenarioError
        No such file, not JSON, or a key is missing or of the wrong type; names file and key.
    """
    path = directory / "metrics.json"
    try:
        return record_of(json_of(path.read_text()), str(path))
    except OSError:
        if not directory.exists():
            raise ScenarioError(f"{directory}: no such folder, expected that of a run{nearby(directory)}") from None
        raise ScenarioError(f"{directory}: no metrics.json in it, expected the directory of a run") from None
    except ValueError as error:
        raise ScenarioError(f"{path}: not valid JSON: {error}") from None


def record_of(content: Any, source: str) -> RunRecord:
    """Check the content of a metrics.json.

    Raises
    ------
    ScenarioError
        A key is missing or of the wrong type; names `source` and key.
    """
    try:
        record = RunRecord.read(content)
        for status in record.nodes.values():
            _checked_status(status)
        return record
    except MisfitError as error:
        raise ScenarioError(f"{source}: {'.'.join(map(str, error.place))}: {error.reason.lower()}") from None


def _checked_status(status: dict[str, Any]) -> None:
    try:
        _Status.read(status)
    except MisfitError as error:
        raise error.below("nodes") from None
