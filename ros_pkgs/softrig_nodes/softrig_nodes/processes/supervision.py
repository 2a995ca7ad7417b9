"""Watching the node processes of a run: until all have ended or one has failed, and which one is the cause."""

from __future__ import annotations

import math
import select
import signal
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from softrig_core.board.clocked import WAITS
from softrig_core.rig.rig import Rig
from softrig_core.run.stuck import STUCK

from .children import Child, is_held, last_line, read_status
from .dead_locks import DeadLocks
from .guests import Guests
from .peers import starter
from .restarting import Restarts
from .stopping import Stopping

STANDS = 2.0  # s without a tick after which the logs are read for the reason
GRACE = 1.5  # s: time for the other nodes to report what they saw, after one has failed


def supervise(
    rig: Rig,
    children: list[Child],
    progress: Callable[[int], object] | None,
    guests: Guests,
    realtime: bool,
    stopping: Stopping,
    restarts: Restarts,
    clock: SystemClock,
    domain: int,
    announce: Callable[[str], object] | None = None,
) -> str:
    """Wait until all nodes have ended or one has failed; return the reason of a failure.

    A node could wait forever for a peer that has ended, so the scenario's timeout applies to it. In realtime it counts
    from the end of the run, in lockstep from the end of a node or the last progress. It also applies to a node whose
    process is stopped (SIGSTOP). A node that never reports a status has the scenario's start timeout, because its
    peers may wait for an outside node. If killed nodes are started again, the run fails when it makes no progress for
    longer than a start may take.
    """
    comes_up = time.monotonic() + rig.scenario.start_timeout
    late = math.inf if realtime else time.monotonic() + rig.scenario.timeout
    first, locks = starter(rig), DeadLocks()
    last, before, moved, logged = -1, dict[str, Any](), time.monotonic(), set[str]()
    while True:
        stopping.check()
        clock.update()
        locks.release(domain)
        running = [c for c in children if c.process.poll() is None]
        started = dict(restarts.counts)
        if failed := restarts.check(children):
            return _reason(children, failed, restarts)
        if restarts.counts != started:
            comes_up = time.monotonic() + rig.scenario.start_timeout
        if ended := _ended(children):
            return ended
        if all(c.process.poll() == 0 for c in children):
            return ""
        states = {c.member.name: read_status(c.status) for c in children}
        guests.check(states)
        if time.monotonic() > comes_up and (mute := _mute(states, rig.scenario.start_timeout)):
            return mute
        # The starter may run on another machine.
        plant = next((c for c in children if c.member is first), children[0])
        state = states[plant.member.name]
        t = state.get("t", 0)
        # The newest status of a process that is stopped may still say busy, for example in a paced run.
        busy = any(states[c.member.name].get("busy") and not is_held(c) for c in running)
        if realtime:
            if late == math.inf and state.get("epoch"):
                to_start = _to_start(state["epoch"], rig.scenario.start_timeout)
                late = time.monotonic() + to_start + rig.scenario.duration + rig.scenario.timeout
            # A person has stopped the clock of the rig, so the whole run may still lie ahead.
            if state.get("held"):
                late = max(late, time.monotonic() + rig.scenario.duration + rig.scenario.timeout)
        elif restarts.most:
            # A restarted node repeats its ticks while the others wait, so progress of any node counts.
            if (now := {name: (s.get("t"), s.get("state")) for name, s in states.items()}) != before or busy:
                before, late = now, time.monotonic() + max(rig.scenario.timeout, rig.scenario.start_timeout)
        # While all nodes run, they detect a stall themselves and name its cause. Only a node that waits for one that
        # has ended or is stopped needs this limit.
        elif t != last or busy or (len(running) == len(children) and not any(is_held(c) for c in running)):
            late = time.monotonic() + rig.scenario.timeout
        if time.monotonic() > late:
            names = ", ".join(c.member.name for c in running)
            lost = f"node {names} did not reach the end of the run within {rig.scenario.timeout:g} s after it"
            return _asleep(running) or lost
        if t != last and progress is not None:
            progress(t)
        if t != last:
            moved = time.monotonic()
        elif announce is not None and time.monotonic() > moved + STANDS:
            for line in _stuck(running) - logged:
                announce(line)
                logged.add(line)
        last = t
        # A child's end wakes the wait; otherwise the progress is checked ten times a second. (Popen.wait with a limit
        # wakes up all the time, each time on a node's core.)
        select.select([c.end for c in running], [], [], 0.1)


def _stuck(children: Sequence[Child]) -> set[str]:
    """Return the last log of processes if it shows what the run waits for: a block's call, a third-party node."""
    return {line for line in (last_line(c.log) for c in children) if STUCK in line or WAITS in line}


def _to_start(epoch: int, most: float) -> float:
    """Return the seconds to a start at wall-clock time `epoch`, ns; limited, since the clock may have been set."""
    return min(max(0.0, epoch / 1e9 - time.time()), most)


class SystemClock:
    """Detects that the system's clock was set back.

    Fast DDS measures its waits with that clock. Until the clock reaches its old time again, no participant is
    discovered and no lost message is sent again.
    """

    def __init__(self) -> None:
        self._most = self._ahead()
        self._back = 0.0

    def update(self) -> None:
        """Update the lead over the monotonic clock, and the largest amount by which the clock was set back, s."""
        now = self._ahead()
        self._most = max(self._most, now)
        self._back = max(self._back, self._most - now)

    def set_back(self) -> str:
        """Describe that it was set back; empty if it was not."""
        self.update()
        text = f"; the system's clock was set back by {self._back:.0f} s meanwhile, and Fast DDS waits by it"
        return text if self._back > 1.0 else ""

    @staticmethod
    def _ahead() -> float:
        return time.time() - time.monotonic()


def idle(states: Mapping[str, Mapping[str, Any]]) -> str:
    """Report that a run has ended regularly without a tick: in real time its end may have passed at the start."""
    if any(state.get("ticks") for state in states.values()):
        return ""
    return "all nodes have ended, and none of them has answered a tick"


def left_early(states: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the nodes that a foreign signal ended before their last tick; empty if there are none."""
    results = [
        f"{name} at t = {state.get('t', 0) / 1e9:.9g} s" for name, state in states.items() if state.get("left_early")
    ]
    return f"somebody has stopped node {', '.join(results)}" if results else ""


def _ended(children: Sequence[Child]) -> str:
    """Name the nodes whose code has ended their process with status 0, as `os._exit(0)` does; empty if none has."""
    results = []
    for child in children:
        if child.process.poll() == 0:
            # A node of ours writes a final state before it ends, so one without it was ended by other code.
            state = read_status(child.status)
            if state.get("state") not in ("done", "failed") and not state.get("left_early"):
                results.append(f"{child.member.name} after t = {state.get('t', 0) / 1e9:.9g} s")
    return f"code of node {', '.join(results)} has ended its process with status 0" if results else ""


def _mute(states: Mapping[str, Mapping[str, Any]], patience: float) -> str:
    """Name the nodes that have not reported a status; empty if none."""
    names = ", ".join(name for name, state in states.items() if not state)
    return f"node {names} has reported nothing within {patience:g} s of its start" if names else ""


def _asleep(children: list[Child]) -> str:
    """Name the nodes whose processes are stopped; empty if there are none."""
    names = ", ".join(c.member.name for c in children if is_held(c))
    return f"node {names}: its process is stopped (SIGSTOP); it was waited for until the timeout" if names else ""


def _reason(children: list[Child], failed: list[Child], restarts: Restarts) -> str:
    """Describe which node failed and why; a node that only waited for one that was itself waiting is not the cause."""
    if not any((c.process.returncode or 0) < 0 for c in failed):
        deadline = time.monotonic() + GRACE
        while time.monotonic() < deadline and any(c.process.poll() is None for c in children):
            time.sleep(0.02)
        # On a busy host a process that has reported its error may end late, but it can still be the cause.
        failed = [
            c for c in children if c.process.poll() not in (None, 0) or read_status(c.status).get("state") == "failed"
        ]
    # a container fails as a whole, but some of its nodes may have finished before
    failed = [c for c in failed if read_status(c.status).get("state") != "done"] or failed
    waits = {c.member.name: read_status(c.status).get("waits_for", []) for c in failed}
    asleep = _asleep([c for c in children if any(c.member.name in names for names in waits.values())])
    if asleep and all(waits.values()):
        return asleep
    causes = blamed(waits)
    texts = []
    for child in (c for c in failed if c.member.name in causes):
        code = child.process.returncode or 0
        name = child.member.name
        if code < 0:
            t = read_status(child.status).get("t", 0) / 1e9
            killed = f"node {name} was killed by {signal.Signals(-code).name} after t = {t:.9g} s"
            texts.append(killed + restarts.why(child.member))
        else:
            text = read_status(child.status).get("error")
            reported = f"{name}: {text}" if text else last_line(child.log)
            texts.append(f"node {reported or f'{name} ended with status {code}'}")
    return "; ".join(texts)


def blamed(waits: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the nodes whose errors show the cause: those that waited for no node, or for one that has not failed.

    Parameters
    ----------
    waits : by node name
        The nodes that each failed node waited for.
    """
    causes = [n for n, senders in waits.items() if not all(sender in waits for sender in senders) or not senders]
    return causes or list(waits)[:1]
