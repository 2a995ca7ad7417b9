"""Nodes that were killed and are started again, so many times; see `node.lockstep.comeback` for how they come back."""

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
    """Ensure that nodes of a run could be started again, if that is wanted.

    Raises
    ------
    ScenarioError
        Of this placement they could not; says why.
    """
    if not placement.restart:
        return
    outside = [m.name for m in rig.members if m.external]
    if placement.clock != "lockstep" or placement.mode != "processes" or placement.shared(rig) or placement.only:
        raise ScenarioError("--restart: expected a run in lockstep whose nodes have a process each, all on this host")
    if outside:
        raise ScenarioError(f"--restart: {', '.join(outside)} is an outside node, whose past messages are unknown")
    if not placement.record:
        raise ScenarioError("--restart: a node comes back from what the others have recorded, expected a record")


class _Look(NamedTuple):
    """When a node had written of itself, how many ticks it had answered, and whether as many as the time before."""

    written: int
    ticks: int
    stood: bool


class Restarts:
    """How often a node of a run may be started again.

    Parameters
    ----------
    again : callable
        Starts the node of a child anew, by its number, and puts it in its place.
    announce : callable, optional
        Gets a text when that is done.

    Attributes
    ----------
    counts : dict of str to int
        By node: how often it was.
    """

    def __init__(self, most: int, again: Again, announce: Callable[[str], object] | None = None) -> None:
        self.most, self._again, self._announce = most, again, announce
        self.counts: dict[str, int] = {}
        self._looks: dict[str, dict[str, _Look]] = {}  # by node that has died, at each of the others

    def look(self, children: list[Child]) -> list[Child]:
        """Start those again that were killed, when all others stand; return those that nobody can start again.

        What a node has recorded is in its file a quarter of a second later, and its status after that: two of them that
        tell of the same tick mean that it stands, and that all it has said can be read.
        """
        lost = []
        for k, child in enumerate(children):
            code = child.process.poll()
            if code in (None, 0):
                continue
            if code > 0 or self.counts.get(child.member.name, 0) >= self.most:
                lost.append(child)
            elif self._stand(child, children):
                self._restart(children, k, code)
        return lost

    def _stand(self, dead: Child, children: list[Child]) -> bool:
        """Return whether all others stand, or have ended; of one that has said nothing yet nothing is known."""
        looks = self._looks.setdefault(dead.member.name, {})
        for child in children:
            with suppress(OSError):
                if child.process.poll() is None:
                    written, status = child.status.stat().st_mtime_ns, read_status(child.status)
                    ticks = status.get("ticks", 0)
                    old = looks.setdefault(child.member.name, _Look(written, ticks, False))
                    if old.written != written:
                        stood = ticks == old.ticks and not status.get("busy")
                        looks[child.member.name] = _Look(written, ticks, stood)
                else:
                    looks.pop(child.member.name, None)
        return all(look.stood for look in looks.values())

    def _restart(self, children: list[Child], k: int, code: int) -> None:
        name = children[k].member.name
        t = read_status(children[k].status).get("t", 0) / 1e9
        self.counts[name] = self.counts.get(name, 0) + 1
        del self._looks[name]
        self._again(k)
        if self._announce is not None:
            self._announce(
                f"node {name} was killed by {signal.Signals(-code).name} after t = {t:.9g} s; it is started "
                f"again ({self.counts[name]} of {self.most})"
            )

    def why(self, member: Member) -> str:
        """Describe why a node that was killed is not started again; empty where none is."""
        if not self.most:
            return ""
        return f"; it was started again {self.counts.get(member.name, 0)} of {self.most} times"
