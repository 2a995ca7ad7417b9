"""Data source of a page: the files that the nodes of a running run write, or a bag."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import Recording, Rig
from softrig_core.rig.members import other_names
from softrig_core.timebase import SECOND
from softrig_core.wire.parameter_event import recorded
from softrig_core.wire.recording import ShardTail
from softrig_core.wire.signals import Signals, Table
from softrig_nodes.processes.children import read_status
from softrig_nodes.processes.peers import starter

from .tracks import Pane, Track

LATELY = 12  # reads of the data over which the speed is measured
Turned = tuple[float, str, Mapping[str, Any]]  # s, node, new values


class Growing:
    """A run in progress.

    Parameters
    ----------
    held : bool
        Whether each message represents a period. In lockstep a node lags behind the others only by the time it needs to
        pass on its records.

    Attributes
    ----------
    live : bool
        Whether more messages may arrive.
    end : float
        Time up to which all nodes have passed on their records, s; in real time, and after the end, that of the newest
        message.
    version : int
        Changes whenever there is something new.
    status : dict
        Status reported by each node.
    changes : list
        Parameter changes: the tick in s from which they are effective, the node, its new values.
    results : list
        Figures as in metrics.json; empty before the end.
    outcome : str
        How the run ended; empty while it is under way.
    length : float
        Initial length of the pictures' time axis, s: that of the whole run.
    speed : float
        Recent ratio of simulated to wall-clock time.
    awaited : list of str
        Nodes that the run waits for before it begins or continues.
    waited : float
        How long the run has waited for them, s of wall-clock time.
    """

    def __init__(self, rig: Rig, held: bool = True) -> None:
        self.rig, self.live, self.outcome = rig, True, ""
        self._also = other_names(rig)
        self._names = [m.name for m in rig.members if not m.external]
        self._tracks = {topic: Track() for topic in rig.topics}
        self.status: dict[str, dict[str, Any]] = {name: {} for name in self._names}
        self.changes: list[Turned] = []
        self.results: list[Mapping[str, Any]] = []
        self.end, self.version = 0.0, 0
        self.length = rig.scenario.duration
        self._newest: dict[str, float] = {}
        self._holds = {  # s
            p.topic: m.params.period
            for m in rig.members
            if held and not m.external
            for p in m.outputs
            if not p.sporadic
        }
        self._marks: deque[tuple[float, float]] = deque(maxlen=LATELY)
        self._complete = time.monotonic()  # time (s) at which all nodes were last present

    @property
    def speed(self) -> float:
        """Return the simulated time over wall-clock time, over the last updates."""
        (first, start), (last, end) = self._marks[0], self._marks[-1]
        return (end - start) / (last - first) if last > first else 0.0

    @property
    def awaited(self) -> list[str]:
        """Return the nodes that have not reported yet or, if all have, those that are still starting."""
        mute = [name for name, entry in self.status.items() if not entry]
        return mute or [name for name, entry in self.status.items() if entry.get("state") == "starting"]

    @property
    def waited(self) -> float:
        """Time since all nodes have reported, s."""
        return time.monotonic() - self._complete

    @property
    def thinned(self) -> bool:
        """Return whether only extremes remain of old data."""
        return any(track.thinned for track in self._tracks.values())

    def append(self, recording: Recording, epoch: int = 0) -> None:
        """Add what is new."""
        result = Signals(recording, epoch).known_as(self._also)
        for name, topic in recording.topics.items():
            if name in self._tracks and topic.times:
                table = result.table(name)
                if table.columns:
                    self._tracks[name].append(table.t, table.columns)
                    self.version += 1
                self._newest[name] = float(table.t[-1])
        if self._newest:
            reached = [t + self._holds[name] for name, t in self._newest.items() if name in self._holds]
            self.end = min([max(self._newest.values()), *reached])
        self._marks.append((time.monotonic(), self.end))

    def finish(self, outcome: str, folder: Path | None) -> None:
        """Note that the run is over, and its outcome."""
        self.end = max(self._newest.values(), default=0.0)
        if folder is not None:
            content = json.loads((folder / "metrics.json").read_text())
            self.results, self.status = content["metrics"], content["nodes"]
        self.outcome = outcome
        self.version += 1

    def pane(self, first: float, last: float) -> Pane:
        """Return the signals within a window of time, s."""
        return Pane({topic: track.table(first, last) for topic, track in self._tracks.items() if len(track)})


class Live(Growing):
    """A run in progress, as its nodes record it.

    It does not affect the loop: it subscribes to no topic, and no node waits for it.

    Parameters
    ----------
    directory : Path
        Where the nodes write their files.
    """

    def __init__(self, rig: Rig, directory: Path, realtime: bool) -> None:
        super().__init__(rig, not realtime)
        self._directory, self._realtime = directory, realtime
        self._tails = [ShardTail(directory / f"{name}.shard") for name in self._names]

    def read_new(self) -> None:
        """Read the data that was written since the last call."""
        if self.outcome:
            return
        self.read()
        for name in self._names:
            # The file is half written, or being replaced: its previous content stays valid.
            self.status[name] = read_status(self._directory / f"{name}.status") or self.status[name]
        if not self.awaited:
            self._complete = time.monotonic()

    def read(self) -> bool:
        """Read a part of the nodes' recordings; return whether there is more."""
        epoch = int(self.status.get(starter(self.rig).name, {}).get("epoch", 0))
        if self._realtime and not epoch:
            return False
        recording = Recording((t, p.msgtype) for t, p in self.rig.topics.items())
        more = [tail.read(recording) for tail in self._tails]
        self.append(recording, epoch)
        for t, node, values in recorded(recording, epoch):
            self.changes.append((t / SECOND, node, values))
            self.version += 1
        return any(more)

    def finish(self, outcome: str, folder: Path | None) -> None:
        """Note that the run is over, and its outcome."""
        while self.read():
            pass
        self.read_new()
        super().finish(outcome, folder)


class Recorded:
    """A run that is over; attributes as those of `Live`.

    Parameters
    ----------
    signals : Signals
        Of its bag.
    content : mapping
        Of its metrics.json; empty where there is none.
    """

    live = thinned = False
    speed = waited = 0.0
    awaited: Sequence[str] = ()

    def __init__(self, rig: Rig, signals: Signals, content: Mapping[str, Any]) -> None:
        self.rig = rig
        topics = [t for t in rig.topics if t in signals.recording.topics and signals.recording.topics[t].number]
        self._tables = {t: signals.table(t) for t in topics}
        self.end = max((float(t.t[-1]) for t in self._tables.values()), default=0.0)
        self.status, self.results = content.get("nodes", {}), content.get("metrics", [])
        self.changes = [(c["at_s"], c["node"], c["set"]) for c in content.get("changes", [])]
        self.length = max(self.end, 1e-9)
        self.outcome = content.get("error", "") or content.get("stopped", "") or "recorded"
        self.version = 1

    def pane(self, first: float, last: float) -> Pane:
        """Return the signals within a window of time, s."""
        return Pane({topic: _cut(table, first, last) for topic, table in self._tables.items()})


def _cut(table: Table, first: float, last: float) -> Table:
    if first <= 0.0 and last == math.inf:
        return table
    i = max(0, int(np.searchsorted(table.t, first, "right")) - 1)
    j = int(np.searchsorted(table.t, last, "right"))
    return Table(table.t[i:j], table.stamp[i:j], {label: x[i:j] for label, x in table.columns.items()})


Source = Growing | Recorded
