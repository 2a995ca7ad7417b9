"""One digest that bag, figures and scenario of a run share, so that parts of different runs are recognised."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softrig_bags.content.block import distinct
from softrig_bags.errors import BagError
from softrig_bags.files.reader import BagReader
from softrig_core.kit.file_format import json_of
from softrig_core.wire.long import stretches

from ..pack.parts import BAG, METRICS

if TYPE_CHECKING:
    from softrig_core import Rig
    from softrig_core.wire.recording import Recording

HALF = 16  # letters of the digest of the recorded part; the digest of the request has as many
# This node repeats external messages. It belongs to a repetition, so it must not change the identity of the run.
NOT_NODES = ("recorded_inputs",)


def identity(rig: Rig, seed: int, recording: Recording) -> str:
    """Compute the digest of a run.

    Parameters
    ----------
    rig : Rig
        As it began.
    seed : int
        Of the run.
    recording : Recording
        As the bag has it.
    """
    return recorded_half(recording) + asked_half(rig, seed)


def recorded_half(recording: Recording) -> str:
    """Compute the half of the identity that covers the recording: topics, times and bytes."""
    digest = hashlib.sha256()
    for name in sorted(name for name, topic in recording.topics.items() if topic.number):
        topic = recording.topics[name]
        content = hashlib.sha256()
        for times in stretches(topic.ticks()):
            content.update(times.astype("<i8").tobytes())
        for text in topic.texts():
            content.update(text)
        digest.update(_line(name, topic.msgtype, topic.number) + content.digest())
    return digest.hexdigest()[:HALF]


def bagged_half(bag: Path) -> str:
    """Compute the same half from a bag, block by block, so that no more than a block is in memory."""
    contents, counts = defaultdict[int, Any](hashlib.sha256), Counter[int]()
    with BagReader(bag) as reader:
        # The digest of a topic has all its times first, so the bag is read twice.
        for data in (False, True):
            for block in reader.blocks():
                for topic in distinct(block.topic):
                    rows = block.select(block.topic == topic)
                    counts[topic] += 0 if data else len(rows)
                    for content in rows.texts() if data else (rows.t.astype("<i8").tobytes(),):
                        contents[topic].update(content)
        digest = hashlib.sha256()
        for name, topic in sorted((reader.labels[topic], topic) for topic in contents):
            digest.update(_line(name, reader.topics[topic].msgtype, counts[topic]) + contents[topic].digest())
    return digest.hexdigest()[:HALF]


def _line(name: str, msgtype: str, number: int) -> bytes:
    return f"{name}\0{msgtype}\0{number}\0".encode()


def asked_half(rig: Rig, seed: int) -> str:
    """Compute the half of the identity that covers the inputs: length, seed and all nodes' initial parameters.

    A file enters with its name only, because a pack has it in another folder.
    """
    from softrig_core.block.params import flatten  # reading a bag needs no rig, so this import is late

    nodes = {m.name: _plain(flatten(m.params)) for m in rig.members if not m.external and m.name not in NOT_NODES}
    asked = {"duration": rig.scenario.duration, "seed": seed, "nodes": nodes}
    return hashlib.sha256(json.dumps(asked, sort_keys=True, default=str).encode()).hexdigest()[:HALF]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return Path(value).name if isinstance(value, str) and "/" in value and Path(value).suffix else value


def strangers(content: Mapping[str, Any], bag: Mapping[str, str], recorded: str = "") -> list[str]:
    """Describe which parts belong to different runs; empty if none does or if an older version wrote the run.

    Parameters
    ----------
    content : mapping
        Of metrics.json.
    bag : mapping
        The bag's own metadata.
    recorded : str
        The half of the identity that the messages of the bag have, if it is known.
    """
    figures, bagged = str(content.get("run", "")), str(bag.get("run", ""))
    if figures and bagged and figures != bagged:
        return [f"metrics.json is of run {figures[:HALF]}, the bag of run {bagged[:HALF]}: they do not belong together"]
    stated = figures or bagged
    if stated and recorded and recorded != stated[:HALF]:
        return [f"the bag is not as it was written: its messages are {recorded}, of the run {stated[:HALF]}"]
    return []


def contradictions(directory: Path) -> tuple[str, ...]:
    """Describe which files in the folder of a run contradict each other."""
    try:
        content = json_of((directory / METRICS).read_text())
        with BagReader(directory / BAG) as reader:
            custom = reader.custom_data
        return tuple(strangers(content, custom, bagged_half(directory / BAG))) if "run" in {*content, *custom} else ()
    except (OSError, ValueError, BagError):  # the function that reads the file itself reports the error
        return ()
