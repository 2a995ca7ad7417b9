"""Repeat a run: its command line, the changes during the run, and the messages from external nodes."""

from __future__ import annotations

import argparse
import hashlib
import shlex
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from softrig_bags.errors import BagError
from softrig_bags.files.reader import BagReader
from softrig_bags.read import read_bag
from softrig_bags.tape import written
from softrig_core import Port, Recording, Rig, Run, Scenario, ScenarioError, load_scenario, rig_of
from softrig_core.block.codec import Decoder
from softrig_core.block.port import Refused
from softrig_core.errors import nearby
from softrig_core.kit.file_format import json_object, json_of
from softrig_core.rig.code import LETTERS, is_ours
from softrig_core.rig.members import Member
from softrig_core.timebase import SECOND
from softrig_core.wire.parameter_event import recorded
from softrig_core.wire.recording import Topic

from ..pack.cargo import check_scenario
from ..pack.packed import Digest, about, need_packages, opened
from ..pack.parts import METRICS, SCENARIO, STUDY, is_pack

#: Of the versions of a run, what decides its bits, the likeliest first.
DECIDE = ("math", "casadi", "pin", "daqp", "numpy", "scipy", "machine", "blas", "simd", "libc", "python")
MADE_WITH = ("versions", "code", "contents")
# The name of the node that publishes the external messages again.
TAPE = "recorded_inputs"
#: What a node in real time counts when a tick is not what it would be in lockstep, in words.
LATE = {
    "missed_deadlines": "deadlines missed",
    "incomplete_ticks": "ticks answered without all that was due",
    "dropped_ticks": "ticks dropped",
    "skipped_periods": "periods skipped",
    "overdue_messages": "messages after their tick",
    "late_messages": "messages out of order",
    "lost_arrays": "arrays lost",
}


@dataclass(frozen=True)
class Recalled:
    """Stored data of a run.

    Parameters
    ----------
    path : Path
        As it was named.
    options : argparse.Namespace
        Of its command.
    recording : Recording
        Empty where the bag was left out of a pack.
    epoch : int
        What its stamps count from, ns; 0 of a run in lockstep.
    late : mapping of str to mapping
        By node, of a run in real time: see `LATE`.
    made_with : mapping of str to mapping
        ``versions``, ``code`` and ``contents`` as ``metrics.json`` has them; a bag alone may know less.
    digests : mapping of str to Digest
        By topic, in place of the recording.
    bag_metadata : mapping of str to str
        What the bag's writer has left in it.
    """

    path: Path
    options: argparse.Namespace
    bag: Path
    recording: Recording
    epoch: int
    late: Mapping[str, Mapping[str, int]]
    made_with: Mapping[str, Mapping[str, Any]]
    digests: Mapping[str, Digest] = field(default_factory=dict)
    bag_metadata: Mapping[str, str] = field(default_factory=dict)


def _reached(recording: Recording, epoch: int) -> int:
    """Return the time of the newest tick in a recording, ns from t = 0."""
    return recording.newest(epoch) - epoch


def lateness(status: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, int]]:
    """Describe for each node of a real-time run what it has counted that does not occur in lockstep."""
    results = {name: {key: int(s[key]) for key in LATE if s.get(key)} for name, s in status.items()}
    return {name: counts for name, counts in results.items() if counts}


def recall(path: Path, parse: Callable[[list[str]], argparse.Namespace]) -> Recalled:
    """Find out how a run was made, from its bag alone or from a file of `softrig pack`.

    Parameters
    ----------
    path : Path
        Directory of the run, its bag, a single .mcap file of it, or a pack.
    parse : callable
        Returns the options in the words after ``softrig run``.

    Raises
    ------
    ScenarioError
        There is no such run, it has no bag (only the bag records the changes made during the run), or a package that it
        needs is not installed here.
    """
    if is_pack(path):
        return _unpacked(path, parse)
    bag = path / "bag" if (path / "bag").is_dir() else path
    if bag is path and (path / METRICS).is_file():
        raise ScenarioError(
            f"{path}: that run has no bag, so changes made during the run are unknown; rerun it without --no-record"
        )
    try:
        with BagReader(bag) as reader:
            data = reader.custom_data
        content = json_object(bag.absolute().parent / METRICS)
        # A run that continued another one was begun by the command of that one.
        begun = json_of(data.get("from", "{}")).get("command", "")
        command = shlex.split(begun or data.get("command", "") or str(content["command"]))
        late = json_of(data.get("late", "{}"))
        made_with = {key: json_of(data[key]) for key in MADE_WITH if key in data}
        made_with = {key: dict(content[key]) for key in MADE_WITH if key in content} | made_with
        epoch = int(data.get("epoch", "0"))
        options = parse(command[command.index("run") + 1 :])
        recording = read_bag(bag)
    except (BagError, OSError, ValueError, KeyError, TypeError, argparse.ArgumentError) as error:
        if bag is not path and isinstance(error, BagError):
            raise ScenarioError(str(error)) from None
        near = "" if path.exists() else nearby(path)
        raise ScenarioError(
            f"{path}: expected the directory of a run, the bag of a run, or a file of `softrig pack`{near}"
        ) from None
    need_packages(path, made_with.get("code", ()))
    return Recalled(path, options, bag.absolute(), recording, epoch, late, made_with, bag_metadata=data)


def _unpacked(path: Path, parse: Callable[[list[str]], argparse.Namespace]) -> Recalled:
    """Recall a run from a pack."""
    folder = opened(path)
    if (folder / STUDY).is_dir():
        raise ScenarioError(f"{path}: holds a study, expected a run; `softrig study --like {path}` repeats it")
    stated = about(folder)
    need_packages(path, [*stated.packages, *stated.code])
    try:
        check_scenario(folder, load_scenario(str(folder / SCENARIO / f"{stated.scenario}.yaml")), stated)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    options = parse([str(folder / SCENARIO / f"{stated.scenario}.yaml")])
    made_with = stated.model_dump(include=set(MADE_WITH))
    bag = folder / "bag"
    if not bag.is_dir():
        return Recalled(path, options, bag, Recording(()), 0, {}, made_with, stated.digests)
    with BagReader(bag) as reader:
        data = reader.custom_data
    late, epoch = json_of(data.get("late", "{}")), int(data.get("epoch", "0"))
    return Recalled(path, options, bag, read_bag(bag), epoch, late, made_with, bag_metadata=data)


def repeated(scenario: Scenario, run: Recalled) -> Scenario:
    """Return a run's scenario with the changes made while it ran, and a node that replays its external inputs.

    Raises
    ------
    ScenarioError
        The plant was an external node, whose behaviour is unknown.
    """
    if run.digests:
        # The file of a pack without its bag has the changes already.
        return scenario
    by_time: dict[float, dict[str, Any]] = {}
    for t, node, values in recorded(run.recording, run.epoch):
        by_time.setdefault(t / SECOND, {}).update({f"{node}.{name}": value for name, value in values.items()})
    rig = rig_of(scenario.having(changes=[]))
    if rig.clock.external:
        raise ScenarioError(f"{run.path}: {rig.clock.name} was outside and set the ticks, so only it can repeat them")
    nodes: dict[str, Any] = {name: entry for name, entry in scenario.nodes.items() if not entry.external}
    nodes |= tape(rig, run)
    return scenario.having(nodes=nodes, changes=[{"at": when, "set": values} for when, values in by_time.items()])


def tape(rig: Rig, run: Recalled, until: float = 0.0) -> dict[str, Any]:
    """Return the node that replays external inputs up to a time (s; 0: all); empty if the run had no such inputs."""
    inputs = from_outside(rig, run.recording)
    parameters = {
        "period": str(rig.clock.schedule.period),
        "bag": str(run.bag),
        "until": until,
        "inputs": [written(port) for port in inputs],
    }
    return {TAPE: {"package": "softrig_bags", "executable": "tape", "parameters": parameters}} if inputs else {}


def from_outside(rig: Rig, recording: Recording) -> list[Port]:
    """Return, for each topic that external nodes published, the first port that reads it."""
    results: dict[str, Port] = {}
    for member in rig.members:
        for port in member.inputs:
            link = member.links.get(port.name)
            topic = recording.topics.get(port.topic)
            if not member.external and (link is None or link.source.external) and topic is not None and topic.number:
                results.setdefault(port.topic, replace(port, name=f"input_{len(results) + 1}"))
    return list(results.values())


# the results of a repetition -------------------------------------------------------------------------------------


def compared(before: Recalled, run: Run, made_with: Mapping[str, Any]) -> tuple[bool, list[str]]:
    """Compare a repetition with the run: whether all nodes published the same numbers at the same ticks.

    The runs are compared up to the time that both have reached: in real time a run may end before all nodes have
    answered the last tick.

    Parameters
    ----------
    made_with : mapping
        Versions and settings that produced the repetition, as in ``metrics.json``.

    Returns
    -------
    told : list of str
        Description of the comparison; the last line states whether the numbers repeat, and if not, which version
        differs first.
    """
    lines, messages, topics = _differences(before, run)
    same = not lines and messages > 0
    late = [f"that run was late: {words(before.late)}"] if before.late else []
    if not messages:
        return same, [*late, f"nothing of {before.path} could be compared: no message of any node that runs here"]
    if same:
        return same, [*late, f"repeats {before.path} number for number: {messages} messages on {topics} topics"]
    return same, [
        *late,
        f"differs from {before.path}: {', '.join(lines)}; {first_version(before.made_with, made_with)}",
    ]


def _differences(before: Recalled, run: Run) -> tuple[list[str], int, int]:
    """Describe where topics begin to differ; how many messages on how many topics were compared."""
    lines, messages, topics = [], 0, 0
    for topic, digest in digests(run).items() if before.digests else ():
        if (old := before.digests.get(topic)) is not None:
            topics, messages = topics + 1, messages + old.messages
            lines += [topic] if old != digest else []
    for member, port in _outputs(run):
        old_topic = before.recording.topics.get(port.topic)
        if old_topic is None:
            continue
        topics += 1
        a = list(_values(port, old_topic, before.epoch))
        b = list(_values(port, run.recording.topics[port.topic], run.epoch))
        common = min(a[-1][0], b[-1][0]) if a and b else -1
        # Its last message may be long ago, so it does not show how far the node came.
        if port.sporadic:
            common = min(
                _reached(before.recording, before.epoch), _reached(run.recording, run.epoch)
            ) - member.schedule.time(2)
        a, b = ([row for row in rows if row[0] <= common] for rows in (a, b))
        messages += len(a)
        k = next((k for k, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))
        if a != b:
            first = min(rows[k][0] for rows in (a, b) if k < len(rows))
            lines.append(f"{port.topic} from t = {first / SECOND:.9g} s")
    return lines, messages, topics


def _outputs(run: Run) -> Iterable[tuple[Member, Port]]:
    """Yield the outputs of all nodes except the one that replays the external inputs."""
    return ((m, port) for m in run.rig.members if m.name != TAPE for port in m.outputs)


def digests(run: Run) -> dict[str, Digest]:
    """Return the digest of each topic that a node of a run has published."""
    result = {}
    for _, port in _outputs(run):
        rows = list(_values(port, run.recording.topics[port.topic], run.epoch))
        hashed = hashlib.sha256()
        for t, stamp, values in rows:
            # Adding 0.0 turns -0.0 into 0.0, as the two compare equal.
            hashed.update(struct.pack(f"<qq{len(values)}d", t, stamp, *(v + 0.0 for v in values)))
        result[port.topic] = Digest(messages=len(rows), sha256=hashed.hexdigest()[:32])
    return result


def first_version(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Describe the first difference between two runs: the user's code, softrig's code, files, libraries."""

    def pairs(key: str, names: Iterable[str]) -> Iterable[tuple[str, Any, Any]]:
        a, b = before.get(key, {}), after.get(key, {})
        return ((name, a[name], b.get(name, "none")) for name in names if name in a and a[name] != b.get(name, "none"))

    code_names = sorted(before.get("code", ()), key=lambda name: (is_ours(name), name))
    remaining = [name for name in before.get("versions", ()) if name not in (*DECIDE, "commit", "run.lock")]
    for kind, result in (
        ("the code of ", pairs("code", code_names)),
        ("the files of ", pairs("contents", before.get("contents", ()))),
        ("", pairs("versions", [*DECIDE, *remaining])),
    ):
        for name, a, b in result:
            commits = [str(w.get("versions", {}).get("commit", ""))[:LETTERS] for w in (before, after)]
            note = f" (commit {commits[0]} there, {commits[1]} here)" if kind == "the code of " and all(commits) else ""
            shown = f"{a} there, {b} here" if kind != "the files of " else "other hashes"
            return f"the first version that differs is {kind}{name}: {shown}{note}"
    return "no version differs" if before.get("versions") else "its versions are not known"


def words(late: Mapping[str, Mapping[str, int]]) -> str:
    """Describe the numbers of nodes and messages."""
    return "; ".join(
        f"{node} {', '.join(f'{n} {LATE.get(key, key)}' for key, n in counts.items())}" for node, counts in late.items()
    )


def _values(port: Port, topic: Topic, epoch: int) -> Iterable[tuple[int, int, tuple[float, ...]]]:
    """Return tick, stamp (ns) and values of each message; bytes that a port would refuse as no values."""
    decode = Decoder(port)
    for t, data in zip(topic.times, topic.data, strict=True):
        try:
            stamp, values = decode(data)
        except Refused:
            stamp, values = 0, ()
        yield t - epoch, stamp - epoch if port.stamped and stamp else stamp, values
