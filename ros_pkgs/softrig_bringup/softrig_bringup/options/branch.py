"""Continuation of a recorded run with changes from a time on: ``--from RUN@T --set ...``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from softrig_core import Run, Scenario, ScenarioError, rig_of, to_ns
from softrig_core.run.branch import branched

from .like import Recalled, compared, tape


def continued(scenario: Scenario, run: Recalled, start: float, values: Mapping[str, Any]) -> Scenario:
    """Return the scenario of a run up to a time (s), with other parameters from there on.

    Raises
    ------
    ScenarioError
        The run ended before that time, or it had an external node.
    """
    rig = rig_of(scenario)
    if outside := [m.name for m in rig.members if m.external]:
        raise ScenarioError(f"--from {run.path}: {', '.join(outside)} was an outside node, and its state is unknown")
    try:
        changes = branched(rig, run.recording, start, values, run.epoch)
    except ScenarioError as error:
        raise ScenarioError(f"--from {run.path}: {error}") from None
    return scenario.having(nodes={**scenario.nodes, **(tape(rig, run, start) if start else {})}, changes=changes)


def began_as(before: Recalled, run: Run, start: float, made_with: Mapping[str, Any]) -> tuple[bool, list[str]]:
    """Describe whether a run equals the recorded one up to the time (s) of its branch; see `compared`."""
    if not start:
        return True, []
    old = replace(before, recording=before.recording.before(before.epoch + to_ns(start)))
    same, differences = compared(old, replace(run, recording=run.recording.before(run.epoch + to_ns(start))), made_with)
    return same, [f"up to t = {start:.9g} s: {line}" for line in differences]
