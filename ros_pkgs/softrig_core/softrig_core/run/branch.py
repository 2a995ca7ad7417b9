"""A branch of a run: as the run before a time, then with other parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import ScenarioError
from ..rig.rig import Rig
from ..timebase import SECOND, to_ns
from ..wire.parameter_event import TOPIC as EVENTS, recorded
from ..wire.recording import Recording


def branched(
    rig: Rig, recording: Recording, at: float, values: Mapping[str, Any], epoch: int = 0
) -> list[dict[str, Any]]:
    """Return the parameter changes of a run that repeats a recorded one up to a time and then uses other parameters.

    Changes that were made before that time are repeated. Changes that people made later are left out. The changes of
    the scenario itself stay.

    Parameters
    ----------
    rig : Rig
        Of the recorded run.
    at : float
        s; the first tick of each node that is not earlier is the first that may differ.
    values : mapping
        ``node.parameter`` to value from then on; of parameters that may change while running.
    epoch : int
        What the stamps of the recording count from, ns.

    Returns
    -------
    list of dict
        For the key ``changes`` of its scenario.

    Raises
    ------
    ScenarioError
        The recorded run ended before that time.
    """
    reached = recording.newest(epoch) - epoch
    # NaN fails the comparison, too, and has no number of nanoseconds.
    start = to_ns(at) if at >= 0.0 else -1
    if not 0 <= start <= reached:
        raise ScenarioError(f"t = {at:.9g} s: expected a time that the run has reached, 0 to {reached / SECOND:.9g} s")
    results = [(t, node, new) for t, node, new in recorded(recording, epoch) if t < start]
    results += [
        (change.at, member.name, dict(change.values))
        for member in rig.members
        for change in member.changes
        # Changes of the scenario that took effect before `start` are among the recorded ones already.
        if member.schedule.next(change.at - 1) >= start
    ]
    changes = [{"at": t / SECOND, "set": {f"{node}.{k}": v for k, v in new.items()}} for t, node, new in results]
    return changes + ([{"at": start / SECOND, "set": dict(values)}] if values else [])


def parted(before: Recording, after: Recording, at: float) -> str:
    """Describe where two lockstep runs that should be equal before a time (s) differ; empty if they do not."""
    results: list[tuple[int, str]] = []
    for name in sorted(after.topics.keys() & before.topics.keys() - {EVENTS}):
        a, b = (recording.topics[name].before(to_ns(at)) for recording in (before, after))
        if a != b:
            pairs = zip(a.stream(), b.stream(), strict=False)
            k = next((k for k, (x, y) in enumerate(pairs) if x != y), min(len(a.times), len(b.times)))
            results.append((min(topic.times[k] for topic in (a, b) if k < len(topic.times)), name))
    return ", ".join(f"{name} at t = {t / SECOND:.9g} s" for t, name in sorted(results)[:3])
