"""One digest that bag, figures and scenario of a run share, so that parts of different runs are recognised."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import Any

from softrig_core import Rig
from softrig_core.block.params import flatten
from softrig_core.wire.recording import CHUNK, Recording

HALF = 16  # letters for what was recorded; as many for what was asked follow
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
    whole = hashlib.sha256()
    for name in sorted(name for name, topic in recording.topics.items() if topic.number):
        topic = recording.topics[name]
        times, data = topic.ticks(), (data for _, data in topic.stream())
        content = hashlib.sha256(times.astype("<i8").tobytes())
        while block := b"".join(islice(data, CHUNK)):
            content.update(block)
        whole.update(f"{name}\0{topic.msgtype}\0{len(times)}\0".encode() + content.digest())
    return whole.hexdigest()[:HALF]


def asked_half(rig: Rig, seed: int) -> str:
    """Compute the half of the identity that covers the inputs: length, seed and all nodes' initial parameters.

    A file enters with its name only, because a pack has it in another folder.
    """
    nodes = {m.name: _plain(flatten(m.params)) for m in rig.members if not m.external and m.name not in NOT_NODES}
    asked = {"duration": rig.scenario.duration, "seed": seed, "nodes": nodes}
    return hashlib.sha256(json.dumps(asked, sort_keys=True, default=str).encode()).hexdigest()[:HALF]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return Path(value).name if isinstance(value, str) and "/" in value and Path(value).suffix else value


def strangers(content: Mapping[str, Any], bag: Mapping[str, str], recording: Recording | None) -> list[str]:
    """Describe which parts of a run do not belong together; empty if all do, or if an older version wrote the run.

    Parameters
    ----------
    content : mapping
        Of metrics.json.
    bag : mapping
        The bag's own metadata.
    recording : Recording, optional
        The contents of the bag.
    """
    figures, bagged = str(content.get("run", "")), str(bag.get("run", ""))
    if figures and bagged and figures != bagged:
        return [f"metrics.json is of run {figures[:HALF]}, the bag of run {bagged[:HALF]}: they do not belong together"]
    stated = figures or bagged
    if stated and recording is not None and (result := recorded_half(recording)) != stated[:HALF]:
        return [f"the bag is not as it was written: its messages are {result}, of the run {stated[:HALF]}"]
    return []
