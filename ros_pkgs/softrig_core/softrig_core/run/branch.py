"""A run that went another way from a time on: as it was before, then with other parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import ScenarioError
from ..rig.rig import Rig
from ..scenario.scenario import Scenario
from ..timebase import SECOND, to_ns
from ..wire.parameter_event import TOPIC as EVENTS, recorded
from ..wire.recording import Recording


def branched(
    rig: Rig, recording: Recording, at: float, values: Mapping[str, Any], *, epoch: int = 0,
    duration: float | None = None,
) -> Scenario:  # fmt: skip
    """Give the scenario of a run that is a recorded one up to a time, and goes on from there with other parameters.

    Who changed what before that time has done it here, too; what people did from there on has not happened. The changes
    that the scenario itself makes stay.

    Parameters
    ----------
    rig : Rig
        Of the recorded run.
    recording : Recording
    at : float
        s; the first tick of each node that is not earlier is the first that may differ.
    values : mapping
        ``node.parameter`` to value from then on; of parameters that may change while running.
    epoch : int
        What the stamps of the recording count from, ns.
    duration : float, optional
        In s, in place of the recorded run's.

    Raises
    ------
    ScenarioError
        The run did not come so far, or `values` cannot be.
    """
    reached = max((topic.times[-1] for topic in recording.topics.values() if topic.times), default=epoch) - epoch
    start = to_ns(at) if at >= 0.0 else -1
    if not 0 <= start <= reached:
        raise ScenarioError(f"t = {at:.9g} s: expected a time that the run has come to, 0 to {reached / SECOND:.9g} s")
    changes: list[dict[str, Any]] = [
        {"at": t / SECOND, "set": {f"{node}.{name}": value for name, value in own.items()}}
        for t, node, own in recorded(recording, epoch) if t < start
    ]  # fmt: skip
    for member in rig.members:
        changes += [
            {"at": change.at / SECOND, "set": {f"{member.name}.{name}": v for name, v in change.values.items()}}
            for change in member.changes if member.schedule.next(change.at - 1) >= start
        ]  # fmt: skip
    changes += [{"at": start / SECOND, "set": dict(values)}] if values else []
    scenario = rig.scenario.having(changes=changes)
    return scenario if duration is None else scenario.changed(duration=duration)


def parted(before: Recording, after: Recording, at: float) -> str:
    """Say where two runs in lockstep, which are to be the same before a time (s), are not; empty when they are."""
    found: list[tuple[int, str]] = []
    for name in sorted(after.topics.keys() & before.topics.keys() - {EVENTS}):
        a, b = (recording.topics[name].before(to_ns(at)) for recording in (before, after))
        if a != b:
            pairs = zip(a.stream(), b.stream(), strict=False)
            k = next((k for k, (x, y) in enumerate(pairs) if x != y), min(len(a.times), len(b.times)))
            found.append((min(topic.times[k] for topic in (a, b) if k < len(topic.times)), name))
    return ", ".join(f"{name} at t = {t / SECOND:.9g} s" for t, name in sorted(found)[:3])
