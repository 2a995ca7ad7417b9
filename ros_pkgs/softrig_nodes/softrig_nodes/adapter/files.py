"""The files that the nodes of a run have written, read by a node that is restarted."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from softrig_core.wire.recording import Recording, read_shards

from ..processes.children import read_status
from ..processes.spawning import DIED


@dataclass
class Files:
    """Messages that a rig published before one of its nodes was restarted.

    Parameters
    ----------
    recording : Recording
        Of its senders. Messages from outside and changes of its parameters are in its own recording.
    answered : mapping of str to float
        By node: the time before which it has answered all its ticks, ns.
    ended : set of str
        Nodes that have answered their last tick and left.
    """

    recording: Recording
    local: Recording
    answered: Mapping[str, float] = field(default_factory=dict)
    ended: frozenset[str] = frozenset()


def read_files(folder: Path, name: str, peers: Iterable[str]) -> Files:
    """Read the files that the nodes of a run are writing.

    Parameters
    ----------
    name : str
        Name of the restarted node; its record is ``NAME.shard.died``.
    peers : iterable of str
        Nodes that it reads, or that read it.
    """
    status = {peer: read_status(folder / f"{peer}.status") for peer in peers}
    ended = frozenset(peer for peer, entry in status.items() if entry.get("state") == "done")
    # A node that has left has answered all its ticks, whatever time its last status has.
    answered = {peer: math.inf if peer in ended else float(entry.get("t", 0)) for peer, entry in status.items()}
    shards = read_shards(folder / f"{peer}.shard" for peer in status)
    return Files(shards, read_shards([folder / f"{name}{DIED}"]), answered, ended)
