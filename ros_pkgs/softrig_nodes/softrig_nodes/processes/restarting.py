"""Start killed nodes again, up to a limit; see `node.lockstep.comeback` for how they restore their state."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from softrig_core.errors import ScenarioError
from softrig_core.rig.members import Member
from softrig_core.rig.rig import Rig

from .children import Child, read_status
from .placement import Placement

Again = Callable[[int], object]


def check_restart(rig: Rig, placement: Placement) -> None:
    """Check that nodes of a run can be started again, if that is requested.

    Raises
    ------
    ScenarioError
        They cannot with this placement; the error contains the reason.
    """
    if not placement.restart:
        return
    outside = [m.name for m in rig.members if m.external]
    if placement.clock != "lockstep" or placement.mode != "processes" or placement.shared(rig) or placement.only:
        raise ScenarioError("--restart: expected a run in lockstep whose nodes have a process each, all on this host")
    if outside:
        raise ScenarioError(f"--restart: {', '.join(outside)} is an outside node, whose past messages are unknown")
    if not placement.record:
        raise ScenarioError(
            "--restart: a node restarts from the recordings of the others, expected --restart without --no-record"
        )


class _Progress(NamedTuple):
    """Observation of a node: time of its last status, ticks answered, and whether it has stopped answering."""

    written: int
    ticks: int
    stalled: bool


class Restarts:
    """Restarts killed nodes of a run, up to a limit.

    Parameters
    ----------
    again : callable
        Starts the node of a child again, by its number, and replaces the child.
    announce : callable, optional
        Gets a text at each restart.

    Attributes
    ----------
    counts : dict of str to int
        Number of restarts by node.
    """

    def __init__(self, most: int, again: Again, announce: Callable[[str], object] | None = None) -> None:
        self.most, self._again, self._announce = most, again, announce
        self.counts: dict[str, int] = {}
        self._progress: dict[str, dict[str, _Progress]] = {}  # for each dead node, the progress of each other node

    def check(self, children: list[Child]) -> list[Child]:
        """Start killed nodes again when all others wait; return those that cannot be started again.

        A node writes its recording to its file within a quarter of a second, and its status after that. Two statuses
        with the same tick mean that the node waits and that all its messages can be read.
        """
        lost = []
        for k, child in enumerate(children):
            code = child.process.poll()
            if code in (None, 0):
                continue
            # Only a node that was killed by a signal, which is a negative code, is started again.
            if code > 0 or self.counts.get(child.member.name, 0) >= self.most:
                lost.append(child)
            elif self._stand(child, children):
                self._restart(children, k, code)
        return lost

    def _stand(self, dead: Child, children: list[Child]) -> bool:
        """Return whether all other nodes wait or have ended; a node without a status is ignored."""
        waiting = self._progress.setdefault(dead.member.name, {})
        for child in children:
            with suppress(OSError):
                if child.process.poll() is None:
                    written, status = child.status.stat().st_mtime_ns, read_status(child.status)
                    ticks = status.get("ticks", 0)
                    old = waiting.setdefault(child.member.name, _Progress(written, ticks, False))
                    # Only two different status files show whether ticks were answered in between.
                    if old.written != written:
                        stalled = ticks == old.ticks and not status.get("busy")
                        waiting[child.member.name] = _Progress(written, ticks, stalled)
                else:
                    waiting.pop(child.member.name, None)
        return all(peer.stalled for peer in waiting.values())

    def _restart(self, children: list[Child], k: int, code: int) -> None:
        name = children[k].member.name
        t = read_status(children[k].status).get("t", 0) / 1e9
        self.counts[name] = self.counts.get(name, 0) + 1
        # If it dies again, the others must be seen waiting again.
        del self._progress[name]
        self._again(k)
        if self._announce is not None:
            self._announce(
                f"node {name} was killed by {signal.Signals(-code).name} after t = {t:.9g} s; it is started "
                f"again ({self.counts[name]} of {self.most})"
            )

    def why(self, member: Member) -> str:
        """Describe why a killed node is not restarted; empty if restarts are off."""
        if not self.most:
            return ""
        return f"; it was started again {self.counts.get(member.name, 0)} of {self.most} times"
