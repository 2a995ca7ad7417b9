"""Scenarios: one experiment as validated data, from a YAML file with inheritance and variants or from code."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from numbers import Integral
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PrivateAttr, ValidationError, model_validator

from .. import renamed
from ..board.clocked import ClockEntry
from ..board.entry import LinkEntry
from ..entry import Entry
from ..errors import ScenarioError, closest
from ..judge.claims import Claim
from ..judge.expectation import Expected
from ..judge.requirement_entry import Required, check_lengths
from .changes import ChangeEntry
from .faults import WORDS, FaultEntry
from .places import explain, place
from .plot_entry import PlotEntry
from .references import fill
from .scenario_file import list_scenarios, locate, merge, resolve

__all__ = [
    "Draft",
    "FigureEntry",
    "NodeEntry",
    "PlotEntry",
    "Scenario",
    "list_scenarios",
    "load_scenario",
    "merge",
    "read_draft",
]


# What ROS takes for names; they become names of files and of topics, so nothing else may be in them.
NodeName = Annotated[str, Field(pattern=r"^_?[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*_?$", max_length=200)]
TopicName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*$", max_length=200)]


class NodeEntry(Entry):
    """One node: which executable, with which parameters and remapped topics."""

    package: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$")
    executable: str = Field(pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.-]*$")
    parameters: dict[str, Any] = {}
    remap: dict[str, TopicName] = {}
    external: bool | ClockEntry = Field(
        False, description="started by another program; our executable only declares its ports"
    )
    link: LinkEntry | None = Field(None, description="a board with its exported firmware answers its ticks")

    @model_validator(mode="before")
    @classmethod
    def _by_its_new_name(cls, entry: Any) -> Any:
        if isinstance(entry, Mapping):
            package, executable = entry.get("package"), entry.get("executable")
            if isinstance(package, str) and isinstance(executable, str):
                return {**entry, "executable": renamed.report(package, executable)}
        return entry


class FigureEntry(Entry):
    """Entry of `figures`: a measurement of the run.

    Parameters
    ----------
    function : str
        Name of a registered figure function; the figure's own name when absent.
    arguments : dict
        Its arguments; ``$node.parameter`` is the value of a parameter of the rig and may be used in arithmetic:
        ``$load.times.1 + 0.5``.
    unit : str
        Unit of the figure; default: that of the function and its signal.
    since : str
        A signal; the figure is measured from its newest step on. `start` and `end` count from this step. Unless `final`
        is given, `final` is the signal's value after the step and `initial` is the measured value at the step. Several
        signals are separated by a comma and a blank: the figure is measured from the newest step of any of them, and
        `final` must be given. Empty: the whole run.
    """

    function: str = ""
    arguments: dict[str, Any] = {}
    unit: str | None = None
    since: str = ""


def _or_empty(value: Any) -> Any:
    return {} if value is None else value


class Scenario(Entry):
    """A rig and its experiment.

    Parameters
    ----------
    source : str
        Origin: paper, table, figure.
    cites : list of str
        Keys of entries in ``references.bib``, beside the scenario files.
    faults : dict of str to FaultEntry
        Faults on links, by the name of the node that implements the fault.
    changes : list of ChangeEntry
        Parameters that change while it runs.
    figures : dict of str to FigureEntry
        Figures to measure, by name.
    expect : dict of str to Expectation
        Expected values of figures.
    claims : dict of str to Claim
        Claims of the paper about figures.
    requirements : dict of str to Requirement
        Requirements on a run, as formulas of temporal logic over shared names.
    containers : list of lists of str
        Nodes that share a process when the rig runs in containers; if empty, all nodes share one.
    record : str
        ``signals``, or ``all``: the bag also has descriptions, diagnostics and figures of observers.
    trips : list of str
        Nodes whose protection is expected to trip permanently.
    shared : dict
        Values that other entries reference as ``$name``. They are already filled in and only stored as information.
    """

    name: str
    title: str
    system: str
    source: str = ""
    cites: tuple[str, ...] = ()
    duration: float = Field(gt=0, le=1e9)
    clock: float | str | None = Field(None, description="period in s of a clock that is no plant, also as 1/2880")
    seed: int = Field(0, ge=0, lt=2**63)
    timeout: float = Field(10.0, gt=0, le=1e6, description="wall-clock s without progress before a lockstep run fails")
    start_timeout: float = Field(120.0, gt=0, le=1e6, description="wall-clock s to wait for all nodes")
    shared: Annotated[dict[str, Any], BeforeValidator(_or_empty)] = {}
    nodes: dict[NodeName, NodeEntry] = Field(min_length=1)
    containers: tuple[tuple[str, ...], ...] = ()
    record: Literal["signals", "all"] = "signals"
    trips: tuple[str, ...] = ()
    faults: Annotated[dict[NodeName, FaultEntry], BeforeValidator(_or_empty)] = {}
    changes: tuple[ChangeEntry, ...] = ()
    figures: Annotated[dict[str, FigureEntry], BeforeValidator(_or_empty)] = {}
    expect: Annotated[dict[str, Expected], BeforeValidator(_or_empty)] = {}
    claims: Annotated[dict[str, Claim], BeforeValidator(_or_empty)] = {}
    requirements: Annotated[dict[str, Required], BeforeValidator(_or_empty)] = {}
    plots: tuple[PlotEntry, ...] = ()

    _file: Path | None = PrivateAttr(None)  # where all that is in it was written; for messages alone
    _changed_from: dict[str, Any] = PrivateAttr(default_factory=dict)

    @property
    def changed_from(self) -> Mapping[str, Any]:
        """Return the keys changed since the file was written, each with its original value; None if it was not set."""
        return self._changed_from

    def changing(self, before: Mapping[str, Any]) -> Scenario:
        """Record changes of it; the first original value of a key is kept."""
        self._changed_from = {**before, **self._changed_from}
        return self

    def written_in(self, file: Path | None) -> Scenario:
        """Store the place in the files at which each key is written."""
        self._file = file
        return self

    def seed_of(self, seed: int | None = None) -> int:
        """Return the seed of a run: its own when none is given; a ScenarioError refuses what is no seed."""
        if seed is None:
            return self.seed
        if isinstance(seed, bool) or not isinstance(seed, Integral) or not 0 <= seed < 2**63:
            raise ScenarioError(f"{self.name}: seed = {seed!r}: expected a whole number from 0 to 2^63 - 1")
        return int(seed)

    def written(self, *keys: str) -> str:
        """Describe where one of its keys is written, as the end of a message; empty if that is not known."""
        location = place(self.name, self._file, keys) if self._file else ""
        return f" ({location})" if "line" in location else ""

    @model_validator(mode="after")
    def _contained_once(self) -> Scenario:
        named = [name for group in self.containers for name in group]
        for name in named:
            if name not in self.nodes:
                raise ValueError(f"containers: no node {name!r}; the nodes are {', '.join(self.nodes)}")
            if named.count(name) > 1:
                raise ValueError(f"containers: node {name} is in more than one")
        return self

    @model_validator(mode="after")
    def _check_tripping_node(self) -> Scenario:
        if strange := [name for name in self.trips if name not in self.nodes]:
            raise ValueError(f"trips: no node {strange[0]!r}; the nodes are {', '.join(self.nodes)}")
        return self

    @model_validator(mode="after")
    def _figures_are_there(self) -> Scenario:
        for kind, names in (("expect", self.expect), ("claims", self.claimed())):
            for name in names:
                if name not in self.figures and name not in self.requirements:
                    known = ", ".join([*self.figures, *self.requirements]) or "none"
                    raise ValueError(f"{kind}: no figure {name!r}; the figures are {known}")
        if both := self.figures.keys() & self.requirements.keys():
            raise ValueError(f"requirements: {min(both)} is the name of a figure, too")
        return self

    def changed(self, *, duration: float | None = None, overrides: Mapping[str, Any] | None = None) -> Scenario:
        """Return the scenario with another length or parameters (``node.parameter`` to value).

        Raises
        ------
        ScenarioError
            A bad value, or no such node.
        """
        raw: dict[str, Any] = {k: {n: e.model_dump() for n, e in getattr(self, k).items()} for k in ("nodes", "faults")}
        before = _before(raw, overrides or {})
        if duration is not None and duration != self.duration:
            before["duration"] = self.duration
        for key, value in (overrides or {}).items():
            _override(raw, key, value)
        new = self.having(**({} if duration is None else {"duration": duration}), **(raw if overrides else {}))
        return new.written_in(None if overrides else self._file).changing(before)

    def having(self, **keys: Any) -> Scenario:
        """Return the scenario with other values of some keys; a ScenarioError names an invalid one."""
        known = {key: value for key, value in self if key in self.model_fields_set}
        try:
            return Scenario.model_validate(known | keys).changing(self._changed_from)
        except ValidationError as error:
            raise ScenarioError(f"{self.name}: {explain(error, Scenario)}") from None

    def claimed(self) -> list[str]:
        """Names of its own figures that its claims refer to."""
        published = [c.figure or key for key, c in self.claims.items() if c.verdict != "not_checkable" or c.figure]
        published += [r for c in self.claims.values() for r in c.references()]
        return [name for name in published if "." not in name]


def load_scenario(name: str, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Read a scenario by name or file.

    Parameters
    ----------
    name : str
        ``dc_motor_smc_b2``, a variant ``dc_motor_smc_b2_delta1``, or a path to a YAML file.
    overrides : mapping, optional
        ``node.parameter``, or the name of a shared value, to value.

    Raises
    ------
    ScenarioError
        Unknown scenario, YAML error, unknown key or bad value; names file, line and key.
    """
    return read_draft(name).filled(overrides)


@dataclass(frozen=True)
class Draft:
    """The content of a scenario's files with inheritance and variant applied, but without its shared values.

    Parameters
    ----------
    path : Path
        For messages; nothing is read any more.
    """

    name: str
    path: Path
    raw: dict[str, Any]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle so that a process gets one object of equal drafts; what it keeps of runs is found by identity."""
        return _draft, (self.name, self.path, pickle.dumps(self.raw))

    def filled(self, overrides: Mapping[str, Any] | None = None) -> Scenario:
        """Create the scenario; see `load_scenario`."""
        if not overrides:
            return self._published
        raw = dict(self.raw)
        before = _before(raw, overrides)
        for key, value in overrides.items():
            _override(raw, key, value)
        return (self._quickly(raw) or self._validated(raw, None)).changing(before)

    @cached_property
    def _published(self) -> Scenario:
        return self._validated(self.raw, self.path)

    def _quickly(self, raw: Mapping[str, Any]) -> Scenario | None:
        """Return the scenario of changed values by checking the changed nodes alone; None where that is not enough."""
        if any(raw[key] is not value for key, value in self.raw.items() if key != "nodes"):
            return None
        before, shared = self.raw["nodes"], self.raw.get("shared")
        changed = {n: e for n, e in raw["nodes"].items() if e is not before[n]}
        try:
            known = self._published.nodes
            new = {n: _revised(known.get(n), before[n], e, shared or {}) for n, e in changed.items()}
        except (ScenarioError, ValidationError):  # a message names the place in the whole scenario
            return None
        if not new.keys() <= known.keys():  # the name itself is a reference
            return None
        return self._published.model_copy(update={"nodes": {**known, **new}}).written_in(None)

    def _validated(self, raw: Mapping[str, Any], written_in: Path | None) -> Scenario:
        try:
            shared = raw.get("shared") or {}
            filled = fill(raw, shared if isinstance(shared, dict) else {})
            scenario = Scenario.model_validate({**filled, "name": self.name})
            check_lengths(scenario.duration, scenario.shared, scenario.requirements, scenario.figures)
            return scenario.written_in(written_in)
        except ValidationError as error:
            location = place(self.name, self.path, error.errors()[0]["loc"])
            raise ScenarioError(f"{location}: {explain(error, Scenario)}") from None
        except ScenarioError as error:
            raise ScenarioError(f"{self.path.name}: {error}") from None


@lru_cache(maxsize=8)
def _draft(name: str, path: Path, raw: bytes) -> Draft:
    return Draft(name, path, pickle.loads(raw))


def _revised(known: NodeEntry | None, before: Any, entry: Any, shared: Mapping[str, Any]) -> NodeEntry:
    """Return a node's entry for changed content; where its parameters alone differ, nothing else is validated again."""
    # An entry that refers to a shared value (`Over`) is no mapping before it is filled.
    if known is not None and isinstance(entry, dict) and isinstance(before, dict):
        changed = {key for key, value in entry.items() if before.get(key) is not value}
        if changed == {"parameters"} and isinstance(values := fill(entry["parameters"], shared), dict):
            return known.model_copy(update={"parameters": values})
    return NodeEntry.model_validate(fill(entry, shared))


def read_draft(name: str) -> Draft:
    """Read the files of a scenario once, as `load_scenario` does, to create many scenarios from them.

    Raises
    ------
    ScenarioError
        Unknown scenario, YAML error or a wrong `extends`.
    """
    name, path = locate(name)
    raw = resolve(name, path)
    if "name" in raw:
        raise ScenarioError(f"{path.name}: key name: a scenario is named by its file")
    return Draft(name, path, raw)


def _before(raw: Mapping[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Return the written value of each key before its change; None if the key is not set."""
    result = {}
    for key, value in overrides.items():
        node, _, parameter = key.partition(".")
        entry: Any = (raw.get("shared") or {}).get(node)
        for part, below in (("nodes", ("parameters",)), ("faults", ())):
            if isinstance(section := (raw.get(part) or {}).get(node), Mapping):
                entry = section
                for name in below:
                    entry = entry.get(name) or {}
        written = _at(entry, parameter) if parameter else entry
        if written is None or written != value:
            result[key] = written
    return result


def _at(entry: Any, name: str) -> Any:
    """Return the entry under a dotted name, whose parts may be keys of nested mappings."""
    if not isinstance(entry, Mapping):
        return None
    if name in entry:
        return entry[name]
    head, _, remaining = name.partition(".")
    return _at(entry.get(head), remaining) if remaining else None


def _override(raw: dict[str, Any], key: str, value: Any) -> None:
    """Apply one changed parameter or shared value to a resolved scenario."""
    node, _, parameter = key.partition(".")
    nodes, shared = raw.get("nodes"), raw.get("shared") or {}
    nodes = nodes if isinstance(nodes, Mapping) else {}
    if not parameter and key in shared:
        raw["shared"] = shared | {key: value}
        return
    if node not in nodes and isinstance(shared.get(node), Mapping):  # one value of a group
        raw["shared"] = merge(dict(shared), {node: {parameter: value}})
        return
    faults = raw.get("faults") or {}
    if parameter and node in faults:
        raw["faults"] = merge(faults, {node: {WORDS.get(parameter, parameter): value}})
        return
    nodes_and_faults = (*nodes, *faults)
    if node not in nodes or not parameter:
        also = f", or a shared value ({', '.join(shared)})" if shared else ""
        near = closest(node, nodes_and_faults) if parameter else closest(key, shared)
        raise ScenarioError(
            f"override {key!r}{near}: expected node.parameter with node one of {', '.join(nodes_and_faults)}{also}"
        )
    raw["nodes"] = merge({**nodes, node: nodes[node] or {}}, {node: {"parameters": {parameter: value}}})
