"""Placement of a run, and the callbacks that report on it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from softrig_core.rig.rig import Rig


@dataclass(frozen=True)
class Placement:
    """Placement of a run: the processes of its nodes, and how they run.

    Parameters
    ----------
    mode : {"processes", "container", "inprocess"}
        Each node in a process of its own; together in the containers of the scenario, or all in one; only the blocks,
        without nodes.
    domain : int, optional
        ROS_DOMAIN_ID; a free one when absent.
    containers : sequence of sequences of str, optional
        Names of nodes that share a process; overrides `mode`.
    only : sequence of str
        Names of the nodes that are started here, when the others run on another machine; all when empty.
    wait : float, optional
        Limit in s of the wait for all nodes, 0 for none; by default the scenario's, and none for external nodes.
    paused : bool
        In lockstep: the run is paused at t = 0 until ``~/resume`` of its clock is called.
    pace : float
        In lockstep: ratio of simulated to wall-clock time, 0 for as fast as possible.
    record : bool
        Whether nodes record what they publish; otherwise the recording is empty.
    restart : int
        In lockstep, with a process for each node: how often a killed node is started again.
    """

    mode: Literal["processes", "container", "inprocess"] = "processes"
    clock: Literal["lockstep", "realtime"] = "lockstep"
    domain: int | None = None
    containers: Sequence[Sequence[str]] | None = None
    only: Sequence[str] = ()
    wait: float | None = None
    paused: bool = False
    pace: float = 0.0
    record: bool = True
    restart: int = 0

    def __str__(self) -> str:
        """Describe in one word or two the placement and the kind of time."""
        if self.clock == "lockstep":
            return self.mode
        return f"{self.mode}, realtime" if self.mode == "container" else "realtime"

    def shared(self, rig: Rig) -> Sequence[Sequence[str]]:
        """Return the containers of a rig: all nodes together where neither this nor the scenario names any."""
        if self.containers is not None:
            return self.containers
        return (rig.scenario.containers or [[m.name for m in rig.members]]) if self.mode == "container" else ()


@dataclass(frozen=True)
class Listener:
    """Callbacks that report on a run while it lasts.

    Parameters
    ----------
    progress : callable, optional
        Gets the plant's time in ns.
    announce : callable, optional
        Gets a text when the run waits for an external node, and when that has joined.
    opened : callable, optional
        Gets the domain before the first node is started.
    """

    progress: Callable[[int], object] | None = None
    announce: Callable[[str], object] | None = None
    opened: Callable[[int], object] | None = None


PROCESSES, NOBODY = Placement(), Listener()
