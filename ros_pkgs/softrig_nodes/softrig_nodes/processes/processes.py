"""The processes runner: every node of a rig in its own OS process, over DDS, watched until all have ended."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from softrig_core.errors import ScenarioError
from softrig_core.guard import need_ros
from softrig_core.rig.rig import Rig
from softrig_core.wire.recording import Recording

from .children import Child, end_left, last_line, read_status, stop
from .domain import DOMAINS, free_domain, holders, require_loopback
from .executables import NO_MEMORY, environment
from .guests import Guests
from .peers import starter
from .placement import NOBODY, PROCESSES, Listener, Placement
from .restarting import Restarts, check_restart
from .shared_memory import lacking, remove_leftovers
from .spawning import Started, groups, start
from .stopping import signal_of, stoppable, undisturbed, unstopped
from .supervision import SystemClock, idle, left_early, supervise


@dataclass
class Outcome:
    """The outcome of a run in processes.

    Parameters
    ----------
    status : dict
        Status file of each node (`adapter.Adapter.write_status`).
    domain : int
        ROS_DOMAIN_ID of the run.
    epoch : int
        Wall-clock ns of t = 0 (realtime), 0 in lockstep.
    error : str
        Why the run failed, with the name of the node; empty when it did not.
    stopped : int
        Number of the signal that ended it before its time; 0 when none did.
    """

    recording: Recording
    status: dict[str, dict[str, Any]]
    domain: int
    epoch: int = 0
    error: str = ""
    stopped: int = 0


def run_processes(
    rig: Rig, seed: int, directory: Path, placement: Placement = PROCESSES, listener: Listener = NOBODY
) -> Outcome:
    """Start all nodes of a rig, wait for them, gather their recordings.

    Parameters
    ----------
    directory : Path
        For logs, parameter files, shards and status files.

    Returns
    -------
    Outcome
        With `error` set when a node failed and `stopped` when a signal or an interrupt ended the run; it has everything
        that was recorded up to then.

    Raises
    ------
    ScenarioError
        A node refused its parameters, nodes of this placement could not be started again, or there is no ROS 2.
    """
    need_ros()
    check_restart(rig, placement)
    directory.mkdir(parents=True, exist_ok=True)
    domain, only, wait = placement.domain, placement.only, placement.wait
    # Parts of a rig on several hosts find each other over their network instead.
    if not only:
        require_loopback()
    children: list[Child] = []
    external = [m for m in rig.members if m.external]
    if wait is None:
        wait = 0.0 if external else rig.scenario.start_timeout
    error, stopped, clock = "", 0, SystemClock()
    with ExitStack() as stack:
        own_domain = domain is None
        if domain is None:
            domain = stack.enter_context(free_domain())
        else:
            remove_leftovers()
        if own_domain and domain not in DOMAINS and listener.announce is not None:
            listener.announce(f"domain {domain}: {DOMAINS[0]} to {DOMAINS[-1]} are taken{holders(DOMAINS)}")
        members = groups(rig, placement.shared(rig), only)
        variables = environment(
            domain, directory, discovery="SUBNET" if only else "LOCALHOST", silence=rig.scenario.timeout
        )
        if why := lacking(len(members)):
            variables |= NO_MEMORY
            if listener.announce is not None:
                listener.announce(f"{why}: messages use UDP, which is slower")
        options = {
            "run.mode": placement.clock,
            "run.start_timeout": wait,
            "run.paused": placement.paused,
            "run.pace": placement.pace,
        }

        # A domain that this run has reserved contains no recorders of other people, so the start need not search for
        # any.
        recorders = None if own_domain else ()
        run = Started(
            rig, seed, directory, options, placement.record, variables, recorders, returns=placement.restart > 0
        )

        def restart(k: int) -> None:
            with unstopped():
                old, (children[k],) = children[k], start(run, [children[k].member], again=True)
                os.close(old.end)

        restarts = Restarts(placement.restart, restart, listener.announce)
        guests = Guests(rig, listener.announce)
        if listener.opened is not None:
            listener.opened(domain)
        try:
            with stoppable() as stopping:
                try:
                    guests.invite(domain)
                    for group in members:
                        # A signal waits until it is known which processes have been started; besides, Python's fork
                        # code would swallow it with a traceback.
                        with unstopped():
                            children += start(run, group)
                    error = supervise(
                        rig,
                        children,
                        listener.progress,
                        guests,
                        placement.clock == "realtime",
                        stopping,
                        restarts,
                        clock,
                        domain,
                        listener.announce,
                    )
                except KeyboardInterrupt as interrupt:
                    stopped = signal_of(interrupt)
                finally:
                    with undisturbed() as late:
                        stop(children)
                        end_left(children)
        finally:
            for child in children:
                os.close(child.end)
        # A signal must not end the run here, or its recording would be lost.
        with undisturbed() as later:
            remove_leftovers(domain if own_domain and not external else None)
            recording, status = gathered(rig, directory, [c.member.name for c in children])
        for name, count in restarts.counts.items():
            status[name]["restarts"] = count
        stopped = next((number for number in (stopped, *late, *later) if number), 0)
    if not (error or stopped):
        error = idle(status) or left_early(status)
    error += clock.set_back() if error else ""
    refused = next((c for c in children if c.process.returncode == 2 and not c.interrupted), None)
    if refused is not None:
        # On a full disk the reason is lost, too.
        no_reason = f"{refused.log} is empty, so the reason why this process ended is unknown; is the disk full?"
        raise ScenarioError(last_line(refused.log) or no_reason)
    epoch = int(status.get(starter(rig).name, {}).get("epoch", 0))
    return Outcome(recording, status, domain, epoch, error, stopped)


def gathered(
    rig: Rig, directory: Path, names: Iterable[str], namespace: str = ""
) -> tuple[Recording, dict[str, dict[str, Any]]]:
    """Return the recording of the nodes of a run, and the status of each.

    Parameters
    ----------
    directory : Path
        Folder of the `FILES` that the nodes wrote.
    names : iterable of str
        Names of the nodes.
    namespace : str
        See `Recording.read_shard`.
    """
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    status = {}
    for name in names:
        status[name] = read_status(directory / f"{name}.status")
        if (shard := directory / f"{name}.shard").exists():
            recording.read_shard(shard, namespace)
    return recording, status
