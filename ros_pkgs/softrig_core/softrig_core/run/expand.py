"""Expand a scenario to the rig that runs: add the nodes of its faults, requirements and figures.

A fault is a node between a publisher and its subscribers, so it is added before the rig is wired. A node that watches
a requirement or measures figures only subscribes, so it is added to the wired rig.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..block.block import Block
from ..errors import ScenarioError
from ..kit.newest import once_for_objects
from ..rig.members import signal_units
from ..rig.rig import Rig, members_of
from ..scenario.faults import insert
from ..scenario.scenario import Draft, NodeEntry, Scenario, read_draft
from ..verdict.figures import figure_parameters
from ..verdict.requirements import watched

FIGURES = ("softrig_core", "figures")  # package and executable of what measures the figures of its rig
Classes = Mapping[str, type[Block]]


def rig_of(
    what: str | Path | Draft | Scenario | Rig,
    *,
    duration: float | None = None,
    overrides: Mapping[str, Any] | None = None,
    classes: Classes | None = None,
    live: bool = True,
) -> Rig:
    """Build the rig of a scenario's name, file or draft, of a scenario, or of a rig with changes.

    Parameters
    ----------
    duration : float, optional
        In s, instead of the scenario's.
    overrides : mapping, optional
        ``node.parameter``, or for a scenario by its name or draft also a shared value's name, to value.
    classes : mapping of node name to type of Block, optional
        Classes of nodes that no executable provides.
    live : bool
        Whether nodes that measure figures while it runs get the list of figures; not needed where none is read.

    Raises
    ------
    ScenarioError
        Bad input of any kind, in one line.
    """
    if not isinstance(what, str | Path | Draft | Scenario | Rig):
        kind = type(what).__name__
        raise ScenarioError(f"expected a scenario's name or file, a draft, a scenario or a rig, got {kind}")
    if overrides is not None and not (isinstance(overrides, Mapping) and all(isinstance(k, str) for k in overrides)):
        raise ScenarioError(f"overrides: expected a mapping of 'node.parameter' to value, got {overrides!r}")
    if isinstance(what, Rig):
        classes = what.classes | dict(classes or {})
        what = what.scenario
    if isinstance(what, str | Path):
        what = read_draft(str(what))
    if isinstance(what, Draft):
        what, overrides = what.filled(overrides), None
    if overrides or duration not in (None, what.duration):
        what = what.changed(duration=duration, overrides=overrides)
    return _expanded(what, classes or {}, live)


def _expanded(scenario: Scenario, classes: Classes, with_figures: bool) -> Rig:
    live = {
        n: e
        for n, e in scenario.nodes.items()
        if (e.package, e.executable) == FIGURES and not {"figures", "scenario"} & e.parameters.keys()
    }
    # The figures are resolved against the wired rig, so live nodes have none until it is wired.
    bare = _with_nodes(scenario, {n: _without_figures(e) for n, e in live.items()})
    rig = _watched(Rig.from_scenario(_faulty(bare, classes), classes))
    if not live:
        return rig
    # Live nodes read what the figures name from its source, even where a fault changes it for all other readers.
    if with_figures:
        values = {"period": rig.clock.params.period, **figure_parameters(rig)}
        full = _with_nodes(rig.scenario, {n: _with_parameters(e, values) for n, e in live.items()})
        rig = rig.listened(full, live)
    # The scenario keeps the live nodes as they were written, because what they receive may change with the rig.
    return replace(rig, scenario=_with_nodes(rig.scenario, live))


def _with_nodes(scenario: Scenario, nodes: Mapping[str, NodeEntry]) -> Scenario:
    return scenario.model_copy(update={"nodes": {**scenario.nodes, **nodes}}) if nodes else scenario


def _with_parameters(entry: NodeEntry, values: Mapping[str, Any]) -> NodeEntry:
    """Return the entry with parameters filled in that it does not set."""
    return entry.model_copy(update={"parameters": {**values, **entry.parameters}})


# Runs of a study share the result, and with it the node.
@once_for_objects
def _without_figures(entry: NodeEntry) -> NodeEntry:
    return _with_parameters(entry, {"figures": "[]", "ports": "[]"})


def _faulty(scenario: Scenario, classes: Classes) -> Scenario:
    """Return the scenario with its faults among its nodes."""
    if not scenario.faults:
        return scenario
    members = members_of(scenario, classes)
    nodes = insert(
        scenario.name,
        scenario.faults,
        {n: e.model_dump() for n, e in scenario.nodes.items()},
        {m.name: (m.inputs, m.outputs) for m in members},
        {m.name: m.params for m in members},
    )
    # The faults are nodes now; faults that stayed in the scenario would be inserted again by a rig that is made from
    # it.
    return scenario.having(nodes=nodes, faults={})


def _watched(rig: Rig) -> Rig:
    """Return the rig with the nodes that watch its requirements while it runs."""
    scenario = rig.scenario
    if not any(r.live or r.ends for r in scenario.requirements.values()):
        return rig
    new = watched(rig, signal_units(rig))
    for name in new.keys() & scenario.nodes.keys():
        raise ScenarioError(f"{scenario.name}: node {name}: that is the name of what watches a requirement")
    # The nodes that watch are in the scenario now; a rig that is made from it must not add them again.
    quiet = {n: r.model_copy(update={"live": False, "ends": False}) for n, r in scenario.requirements.items()}
    nodes = {n: e.model_dump() for n, e in scenario.nodes.items()}
    return rig.listened(scenario.having(nodes=nodes | new, requirements=quiet), new)
