"""The contents of a run's ``metrics.json``, for the pages about the run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator
from softrig_core import ScenarioError
from softrig_core.errors import nearby
from softrig_core.kit.file_format import json_of
from softrig_core.scenario.plot_entry import PlotEntry
from softrig_core.verdict.result import Result

from ..page.citations import Citation
from ..page.wiring import Wiring
from ..plots.named import Shown


class _Status(BaseModel):
    """The entries of a node's status that the pages read by name; the status may also contain figures."""

    error: str = ""
    reports: dict[str, tuple[int, str, int]] = {}
    refused: dict[str, tuple[int, str]] = {}
    native: tuple[int, str] = (0, "")


class _Changed(BaseModel):
    """A change during the run: the node, and the first tick with the change."""

    at_s: float
    node: str
    set: dict[str, Any]


class Origin(BaseModel):
    """The run from which this one continues: its command, and the time from which the two differ."""

    run: str
    at_s: float
    command: str


class RunRecord(BaseModel):
    """The entries of ``metrics.json`` that the pages use."""

    model_config = ConfigDict(frozen=True)

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
    plots: tuple[PlotEntry, ...] = ()
    parameters: dict[str, dict[str, Any]]
    changes: tuple[_Changed, ...] = ()
    units: dict[str, dict[str, str]] = {}
    versions: dict[str, str]
    code: dict[str, str] = {}
    nodes: dict[str, dict[str, Any]] = {}
    citations: tuple[Citation, ...] = ()
    wiring: Wiring = Wiring()
    signals: dict[str, Shown] = {}
    also: dict[str, dict[str, str]] = {}  # `other_names` of the rig
    origin: Origin | None = Field(default=None, alias="from")
    contradictions: tuple[str, ...] = ()

    @property
    def made_by(self) -> str:
        """Return the command that identifies the rig; for a run continued from another one, that of the first."""
        return self.command if self.origin is None else self.origin.command

    @field_validator("nodes")
    @classmethod
    def _readable(cls, nodes: dict[str, dict[str, Any]]) -> dict[str, dict[str, Any]]:
        for status in nodes.values():
            _Status.model_validate(status)
        return nodes

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
        return RunRecord.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        raise ScenarioError(f"{source}: {'.'.join(map(str, first['loc']))}: {first['msg'].lower()}") from None
