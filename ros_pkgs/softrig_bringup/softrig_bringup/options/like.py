"""A run once more as it went: its command line, what was changed while it ran, and what came from outside."""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from softrig_core import Port, Recording, Rig, Run, Scenario, ScenarioError, rig_of
from softrig_core.block.codec import Decoder
from softrig_core.block.port import Refused
from softrig_core.timebase import SECOND
from softrig_core.wire.parameter_event import recorded
from softrig_core.wire.recording import Topic

TAPE = "recorded_inputs"  # node that says what came from outside
#: What a node in real time counts when a tick is not what it would be in lockstep, in words.
LATE = {
    "missed_deadlines": "deadlines missed", "incomplete_ticks": "ticks answered without all that was due",
    "dropped_ticks": "ticks dropped", "skipped_periods": "periods skipped",
    "overdue_messages": "messages after their tick", "late_messages": "messages out of order",
    "lost_arrays": "arrays lost",
}  # fmt: skip


@dataclass(frozen=True)
class Recalled:
    """What is known of a run.

    Parameters
    ----------
    path : Path
        As it was named.
    options : argparse.Namespace
        Of its command.
    bag : Path
    recording : Recording
    epoch : int
        What its stamps count from, ns; 0 of a run in lockstep.
    late : mapping of str to mapping
        By node, of a run in real time: see `LATE`.
    """

    path: Path
    options: argparse.Namespace
    bag: Path
    recording: Recording
    epoch: int
    late: Mapping[str, Mapping[str, int]]


def _reached(recording: Recording, epoch: int) -> int:
    """Give the newest tick in a recording, ns from t = 0."""
    return max((t.times[-1] for t in recording.topics.values() if t.times), default=epoch) - epoch


def lateness(status: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Say of each node of a run in real time what it has counted that lockstep does not know."""
    found = {name: {key: int(s[key]) for key in LATE if s.get(key)} for name, s in status.items()}
    return {name: counts for name, counts in found.items() if counts}


def recall(path: Path, parse: Callable[[list[str]], argparse.Namespace]) -> Recalled:
    """Find out what a run was, from its bag alone.

    Parameters
    ----------
    path : Path
        Directory of the run, or its bag.
    parse : callable
        Gives the options of what follows ``softrig run``.

    Raises
    ------
    ScenarioError
        No such run, or it has no bag, which alone knows what was changed while it ran.
    """
    from softrig_bags.errors import BagError
    from softrig_bags.read import read_bag
    from softrig_bags.reader import BagReader

    bag = path / "bag" if (path / "bag").is_dir() else path
    if bag is path and (path / "metrics.json").is_file():
        raise ScenarioError(f"--like {path}: that run kept no bag: nobody knows what was changed while it ran")
    try:
        with BagReader(bag) as reader:
            about = reader.custom_data
        begun = json.loads(about.get("from", "{}")).get("command", "")  # of one that went on from another
        command = shlex.split(begun or about.get("command", "") or _command(bag.absolute().parent / "metrics.json"))
        late = json.loads(about.get("late", "{}"))
        epoch = int(about.get("epoch", "0"))
        options = parse(command[command.index("run") + 1 :])
        return Recalled(path, options, bag.absolute(), read_bag(bag), epoch, late)
    except (BagError, OSError, ValueError, KeyError, TypeError):
        raise ScenarioError(f"--like {path}: expected the directory of a run, or the bag of one that says how it was "
                            "made") from None  # fmt: skip


def _command(metrics: Path) -> str:
    """Of a bag that does not say it."""
    return str(json.loads(metrics.read_text())["command"])


def repeated(scenario: Scenario, run: Recalled) -> Scenario:
    """Give the scenario of a run with what was changed while it ran, and a node that says what came from outside.

    Raises
    ------
    ScenarioError
        Somebody else's plant: it alone knows what it does.
    """
    by_time: dict[float, dict[str, Any]] = {}
    for t, node, values in recorded(run.recording, run.epoch):
        by_time.setdefault(t / SECOND, {}).update({f"{node}.{name}": value for name, value in values.items()})
    rig = rig_of(scenario.having(changes=[]))
    if rig.clock.external:
        raise ScenarioError(f"--like {run.path}: {rig.clock.name} was outside, and gave the ticks: it alone can repeat "
                            "them")  # fmt: skip
    nodes: dict[str, Any] = {name: entry for name, entry in scenario.nodes.items() if not entry.external}
    nodes |= tape(rig, run)
    return scenario.having(nodes=nodes, changes=[{"at": at, "set": values} for at, values in by_time.items()])


def tape(rig: Rig, run: Recalled, until: float = 0.0) -> dict[str, Any]:
    """Give the node that says what came from outside, up to a time (s; 0: all), if anything has."""
    inputs = from_outside(rig, run.recording)
    parameters = {"period": str(rig.clock.schedule.period), "bag": str(run.bag), "until": until,
                  "inputs": [_text(port) for port in inputs]}  # fmt: skip
    return {TAPE: {"package": "softrig_bags", "executable": "tape", "parameters": parameters}} if inputs else {}


def from_outside(rig: Rig, recording: Recording) -> list[Port]:
    """Give the first port that reads each topic that came from outside, if something has come."""
    found: dict[str, Port] = {}
    for member in rig.members:
        for port in member.inputs:
            link = member.links.get(port.name)
            topic = recording.topics.get(port.topic)
            if not member.external and (link is None or link.source.external) and topic is not None and topic.times:
                found.setdefault(port.topic, replace(port, name=f"input_{len(found) + 1}"))
    return list(found.values())


def _text(port: Port) -> str:
    from softrig_bags.tape import written

    return written(port)


# what a repetition has brought -----------------------------------------------------------------------------------


def compared(before: Recalled, run: Run) -> tuple[bool, list[str]]:
    """Hold a repetition against the run: whether all nodes said the same numbers at the same ticks; in words.

    The end counts as far as both have come: in real time the last tick may be over before all have answered it.
    """
    lines, messages, topics = [], 0, 0
    for member in run.rig.members:
        for port in member.outputs:
            old = before.recording.topics.get(port.topic)
            if old is None or member.name == TAPE:
                continue
            topics += 1
            new = run.recording.topics[port.topic]
            a, b = list(_values(port, old, before.epoch)), list(_values(port, new, run.epoch))
            common = min(a[-1][0], b[-1][0]) if a and b else -1
            if port.sporadic:  # its last message may be long ago
                common = min(
                    _reached(before.recording, before.epoch), _reached(run.recording, run.epoch)
                ) - member.schedule.time(2)
            a, b = ([row for row in rows if row[0] <= common] for rows in (a, b))
            messages += len(a)
            k = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
            if a != b:
                at = min([rows[k][0] for rows in (a, b) if k < len(rows)], default=0)
                lines.append(f"{port.topic} from t = {at / SECOND:.9g} s")
    same = not lines and messages > 0
    told = [f"repeats {before.path} number for number: {messages} messages on {topics} topics"]
    if not messages:
        told = [f"nothing of {before.path} could be compared: no message of any node that runs here"]
    if lines:
        told = [f"differs from {before.path}: {', '.join(lines)}"]
    if before.late:
        told.append(f"that run was late: {words(before.late)}")
    return same, told


def words(late: Mapping[str, Mapping[str, int]]) -> str:
    """Say what nodes have counted."""
    return "; ".join(f"{node} {', '.join(f'{n} {LATE.get(key, key)}' for key, n in counts.items())}"
                     for node, counts in late.items())  # fmt: skip


def _values(port: Port, topic: Topic, epoch: int) -> Iterable[tuple[int, int, tuple[float, ...]]]:
    """Give tick, stamp (ns) and values of each message; bytes that a port would refuse as no values."""
    decode = Decoder(port)
    for t, data in zip(topic.times, topic.data, strict=True):
        try:
            stamp, values = decode(data)
        except Refused:
            stamp, values = 0, ()
        yield t - epoch, stamp - epoch if port.stamped and stamp else stamp, values
