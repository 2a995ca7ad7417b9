"""The processes runner: every node of a rig in its own OS process, over DDS, watched until all have ended."""

from __future__ import annotations

import ctypes
import json
import math
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from os.path import isfile
from pathlib import Path
from typing import Any, Literal

from ..errors import ScenarioError
from ..model.params import flatten
from ..model.port import Port
from ..model.resource import prefixes
from ..model.solver import Solver
from ..wire.recording import Recording
from .domain import free_domain
from .options import InputLink, Links
from .rig import Member, Rig, load_main
from .scenario_file import closest
from .shared_memory import remove_leftovers
from .stopping import Stopping, signal_of, stoppable, unstopped

GRACE = 1.5  # s: after one node fails, how long the others may take to say what they saw
LIBC = ctypes.CDLL(None)  # loaded here: between fork and exec another thread may hold the loader's lock
STOP_STEPS = ((signal.SIGINT, 3.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))
FILES = ("status", "shard")  # that a node writes
PROFILE = Path(__file__).parent.with_name("fastdds_profile.xml")


@dataclass
class Outcome:
    """What a run through processes left behind.

    Parameters
    ----------
    recording : Recording
    status : dict
        Status file of each node (`adapter.Adapter.write_status`).
    domain : int
        ROS_DOMAIN_ID of the run.
    epoch : int
        Wall-clock ns of t = 0 (realtime), 0 in lockstep.
    error : str
        Why the run broke, naming the node; empty when it did not.
    stopped : int
        Number of the signal that ended it before its time; 0 when none did.
    """

    recording: Recording
    status: dict[str, dict[str, Any]]
    domain: int
    epoch: int = 0
    error: str = ""
    stopped: int = 0


@dataclass
class _Child:
    """One node; those of a container share the process and the log."""

    member: Member
    process: subprocess.Popen[bytes]
    end: int  # process file descriptor, readable when the process has ended
    log: Path
    status: Path
    shard: Path
    interrupted: bool = False  # by this runner: how it ends then says nothing


def links(rig: Rig, member: Member) -> Links:
    """Work out what a node must know of its peers."""
    paired = {
        port: InputLink(period=_seconds(link.source), node=link.source.name, at_end=link.source.schedule.at_end,
                        port=link.port.name, sporadic=link.port.sporadic)
        for port, link in member.links.items() if not (link.source.external and link.port.sporadic)
    }  # fmt: skip
    tick_readers = _tick_readers(rig, member)
    pacers = _pacers(rig, member)
    acknowledging = [m for m in _acknowledging(rig) if m is not member] if member is _gatherer(rig) else []
    by_readers = rig.clock.external and bool(pacers or member.links)
    # an outside plant that nobody commands has nothing else to pace itself by
    unheard = rig.clock.external and _gatherer(rig) is None and member in _acknowledging(rig)
    clocked = member in _clocked(rig)
    return Links(
        base=_seconds(rig.clock),
        inputs=paired,
        records=_recorded_inputs(rig, member),
        readers={p.name: [m.name for m, _ in rig.readers(member, p) if not m.external] for p in member.outputs},
        free=[name for name, k in member.links.items() if k.source.external and k.port.sporadic],
        guests=any(m.external for m in rig.members),
        outside=[p.topic for m in rig.members if m.external for p in m.outputs if _ours(rig.readers(m, p))],
        clock=InputLink(period=_seconds(rig.clock), node=rig.clock.name) if clocked and not by_readers else None,
        hears_clock=clocked and by_readers,
        owns_clock=member is rig.clock,
        acknowledges=bool(tick_readers) or unheard,
        tick_readers=tick_readers,
        enders={m.name: _seconds(m) for m in rig.enders if not m.external},
        stride=rig.stride,
        acks={m.name: _seconds(m) for m in [*acknowledging, *pacers]},
        clock_readers=[m.name for m in _clocked(rig) if not m.external] if member is rig.clock else [],
        solvers=[m.name for m in rig.members if issubclass(m.block_class, Solver) and not m.external],
        starter=starter(rig).name,
        starts=[m.name for m in rig.members if not m.external],
        grid=str(max(m.schedule.period for m in rig.members)),
    )


def starter(rig: Rig) -> Member:
    """Give the node that says when a run in real time starts: the clock, or the first that is ours."""
    return next((m for m in (rig.clock, *rig.members) if not m.external), rig.clock)


def _seconds(member: Member) -> str:
    return str(member.schedule.period)


def _recorded_inputs(rig: Rig, member: Member) -> list[str]:
    """Inputs from outside the rig whose first reader this member is."""
    first: dict[str, Member] = {}
    for m in rig.members:
        for port in m.inputs:
            link = m.links.get(port.name)
            if link is None or link.source.external:
                first.setdefault(port.topic, m)
    return [p.name for p in member.inputs if first.get(p.topic) is member]


def _tick_readers(rig: Rig, member: Member) -> list[str]:
    """Name the nodes that read what a member says of its ticks."""
    if member in rig.enders:
        found = [m for m in rig.members if m is not member]
    else:
        gatherer = _gatherer(rig)
        found = [gatherer] if gatherer not in (None, member) and member in _acknowledging(rig) else []
        found += [m for m in rig.members if member in _pacers(rig, m)]
        found += [m for p in member.outputs if p.sporadic for m, _ in rig.readers(member, p)]
    return list(dict.fromkeys(m.name for m in found if not m.external))


def _clocked(rig: Rig) -> list[Member]:
    """Members that pace themselves by /clock: sources, and plants that do not own it."""
    return [m for m in rig.members if m is not rig.clock and (m.is_plant or not m.links)]


def _gatherer(rig: Rig) -> Member | None:
    """Give the member that waits for the acknowledgements: the clock, or who commands an external one."""
    if not rig.clock.external:
        return rig.clock
    senders = [k.source for k in rig.clock.links.values()]
    return next((m for m in senders if not m.external and not m.is_plant), None)


def _pacers(rig: Rig, member: Member) -> list[Member]:
    """Give those by whose ticks a source paces itself when the clock is outside and may publish no /clock: its readers,
    or who commands the clock.
    """
    if not rig.clock.external or member.external or member.is_plant or member.links:
        return []
    readers = [m for p in member.outputs for m, _ in rig.readers(member, p) if not m.external]
    gatherer = _gatherer(rig)
    return list(dict.fromkeys(readers)) or ([gatherer] if gatherer is not None else [])


def _acknowledging(rig: Rig) -> list[Member]:
    """Members that would otherwise be left behind: those nobody waits for, and further plants."""
    leaves = rig.leaves()
    return [m for m in rig.members if m is not rig.clock and not m.external and (m.is_plant or m in leaves)]


def run_processes(
    rig: Rig,
    seed: int,
    directory: Path,
    *,
    mode: Literal["lockstep", "realtime"] = "lockstep",
    domain: int | None = None,
    record: bool = True,
    progress: Callable[[int], object] | None = None,
    announce: Callable[[str], object] | None = None,
    wait: float | None = None,
    containers: Iterable[Sequence[str]] = (),
    only: Sequence[str] = (),
) -> Outcome:
    """Start all nodes of a rig, wait for them, gather what they recorded.

    Parameters
    ----------
    rig : Rig
    seed : int
    directory : Path
        For logs, parameter files, shards and status files.
    mode : {"lockstep", "realtime"}
    domain : int, optional
        ROS_DOMAIN_ID; a free one when absent.
    record : bool
        Whether nodes record what they publish; without, the recording is empty.
    progress : callable, optional
        Called with the plant's time in ns.
    announce : callable, optional
        Called with a text when an external node is waited for, and when it has come.
    wait : float, optional
        Limit in s of the wait for all nodes, 0 for none; by default the scenario's, and none for external nodes.
    containers : iterable of sequences of str
        Names of nodes that share a process; every other node has one of its own.
    only : sequence of str
        Names of the nodes that are started here, when the others run on another machine; all when empty.

    Returns
    -------
    Outcome
        With `error` set when a node failed and `stopped` when a signal or an interrupt ended the run; what was
        recorded up to there is in it.

    Raises
    ------
    ScenarioError
        A node refused its parameters.
    """
    directory.mkdir(parents=True, exist_ok=True)
    children: list[_Child] = []
    external = [m for m in rig.members if m.external]
    if wait is None:
        wait = 0.0 if external else rig.scenario.start_timeout
    error, stopped = "", 0
    with ExitStack() as stack:
        own_domain = domain is None
        domain = stack.enter_context(free_domain()) if domain is None else domain
        remove_leftovers()
        variables = environment(domain, directory, discovery="SUBNET" if only else "LOCALHOST")
        guests = _Guests(rig, announce)
        try:
            with stoppable() as stopping:
                try:
                    guests.invite(domain)
                    options = {"run.mode": mode, "run.start_timeout": wait}
                    for group in groups(rig, containers, only):
                        # A signal waits until it is known who has been started; what Python does at a fork would
                        # swallow it with a traceback, besides.
                        with unstopped():
                            children += _start(rig, group, seed, directory, options, record, variables)
                    error = _watch(rig, children, progress, guests, mode == "realtime", stopping)
                except KeyboardInterrupt as interrupt:
                    stopped = signal_of(interrupt)
                finally:
                    _stop(children)
        finally:
            for child in children:
                os.close(child.end)
        remove_leftovers(domain if own_domain and not external else None)
    status = {c.member.name: _read_status(c.status) for c in children}
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    for child in children:
        if child.shard.exists():
            recording.read_shard(child.shard)
    refused = next((c for c in children if c.process.returncode == 2 and not c.interrupted), None)
    if refused is not None:
        raise ScenarioError(_last_line(refused.log))
    epoch = int(status.get(starter(rig).name, {}).get("epoch", 0))
    return Outcome(recording, status, domain, epoch, error, stopped)


def environment(domain: int, directory: Path, *, discovery: str = "LOCALHOST") -> dict[str, str]:
    """Give the environment of a node process: its domain, as far as `discovery` reaches, its logs in a directory."""
    variables = dict(os.environ)
    variables |= {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": discovery,
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "ROS_LOG_DIR": str(directory / "log"),
        "PYTHONUNBUFFERED": "1",
        # one thread each: a BLAS that splits sums by the number of cores would change last bits
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    variables.pop("ROS_LOCALHOST_ONLY", None)  # deprecated, would override the discovery range
    variables.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    return variables


class _Guests:
    """The external nodes of a run: says what they are to do, and when they have come."""

    def __init__(self, rig: Rig, announce: Callable[[str], object] | None) -> None:
        self._announce = announce
        self._needed = {
            m.name: {p.topic for p in m.outputs if _ours(rig.readers(m, p))} for m in rig.members if m.external
        }  # fmt: skip
        self._rig = rig
        self._warned: set[str] = set()
        self._awaited = [name for name, topics in self._needed.items() if topics]

    def invite(self, domain: int) -> None:
        """Say who is expected, where, and with what."""
        if self._announce is None or not self._needed:
            return
        who = ", ".join(self._awaited or self._needed)
        lines = [f"waiting for {who} (as long as it takes or --wait says; Ctrl-C ends); in another terminal:",
                 f"  export ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"]  # fmt: skip
        for m in self._rig.members:
            for p in m.outputs if m.external else ():
                verb = "must publish" if p.topic in self._needed[m.name] else "may publish"
                lines.append(f"  {m.name} {verb} {p.topic} ({p.msgtype}, {', '.join(p.labels)})")
            lines += [f"  {m.name} can read {p.topic} ({p.msgtype})" for p in m.inputs if m.external]
        self._announce("\n".join(lines))

    def look(self, children: list[_Child]) -> None:
        """Say who has come since the last look."""
        if not self._awaited:
            return
        states = [_read_status(c.status) for c in children]
        if any("lacking" not in s for s in states):
            return  # not all of ours are there themselves
        self._warn(states)
        lacking = {topic for s in states for topic in s["lacking"]}
        for name in [n for n in self._awaited if not self._needed[n] & lacking]:
            self._awaited.remove(name)
            if self._announce is not None:
                self._announce(f"{name} is there")

    def _warn(self, states: list[dict[str, Any]]) -> None:
        """Say, once, who cannot be heard because of its type."""
        for state in states:
            for key, (_, text, _) in state.get("reports", {}).items():
                if key.startswith("type of ") and text not in self._warned:
                    self._warned.add(text)
                    if self._announce is not None:
                        self._announce(text)


def _ours(readers: list[tuple[Member, Port]]) -> bool:
    return any(not m.external for m, _ in readers)


def find_executable(package: str, executable: str) -> Path:
    """Find ``lib/<package>/<executable>`` of a sourced workspace.

    Raises
    ------
    ScenarioError
        It is not there; lists what the package has.
    """
    installed = prefixes()
    for prefix in installed:
        path = prefix / "lib" / package / executable
        if isfile(path) and os.access(path, os.X_OK):
            return path
    there = sorted({p.name for prefix in installed for p in (prefix / "lib" / package).glob("*") if p.is_file()})
    if not there:
        packages = [folder.name for prefix in installed for folder in (prefix / "lib").glob("*") if folder.is_dir()]
        raise ScenarioError(f"package {package!r} has no executables here{closest(package, packages)}; one of your own "
                            "is built by colcon and named by --workspace DIR before the verb")  # fmt: skip
    raise ScenarioError(f"package {package} has no executable {executable!r}{closest(executable, there)}; it has "
                        f"{', '.join(there)}")  # fmt: skip


def node_parameters(rig: Rig, member: Member, seed: int, mode: str) -> dict[str, Any]:
    """Give the ROS parameters that start a member of a rig: those of its block that differ, and how it runs."""
    default = flatten(member.block_class.Params())
    own = {k: v for k, v in flatten(member.params).items() if v != default.get(k)}
    return own | {
        "run.mode": mode,
        "run.seed": seed,
        "run.duration": rig.scenario.duration,
        "run.timeout": rig.scenario.timeout,
        "run.start_timeout": rig.scenario.start_timeout,
        "run.links": links(rig, member).model_dump_json(),
    }


def placed(rig: Rig, place: str) -> Iterable[Sequence[str]]:
    """Give the containers of a rig: none through processes, all nodes together when the scenario names none."""
    return (rig.scenario.containers or [[m.name for m in rig.members]]) if place == "container" else ()


def groups(rig: Rig, containers: Iterable[Sequence[str]], only: Sequence[str] = ()) -> list[list[Member]]:
    """Give our nodes by process, only those that are named if some are."""
    own = {m.name: m for m in rig.members if not m.external and (not only or m.name in only)}
    shared = [[own.pop(name) for name in names if name in own] for names in containers]
    return [g for g in shared if g] + [[m] for m in own.values()]


def _start(rig: Rig, group: list[Member], seed: int, directory: Path, options: dict[str, Any],
           record: bool, variables: dict[str, str]) -> list[_Child]:  # fmt: skip
    """Start a node, or several in a container."""
    log = directory / f"{'+'.join(m.name for m in group)[:200]}.log"
    given = {}
    for member in group:
        stem = directory / member.name
        for kind in FILES:
            stem.with_suffix(f".{kind}").unlink(missing_ok=True)
        given[member.name] = node_parameters(rig, member, seed, options["run.mode"]) | options | {
            "run.shard": str(stem.with_suffix(".shard")) if record else "",
            "run.status": str(stem.with_suffix(".status")),
        }  # fmt: skip
    if len(group) == 1:
        executable = find_executable(group[0].package, group[0].executable)
        arguments = _ros_arguments(group[0], given[group[0].name], directory)
    else:
        executable = find_executable("softrig_core", "container")
        arguments = container_arguments(group, given, directory)
    # A process group of its own, so that Ctrl-C reaches the runner alone; not a session of its own, because Linux
    # schedules sessions against each other and a loop across them runs a fifth slower.
    with log.open("wb") as output:
        process = subprocess.Popen(
            [str(executable), *arguments], stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT,
            env=variables, process_group=0, preexec_fn=_die_with_parent,
        )  # fmt: skip
    return [
        _Child(
            m, process, os.pidfd_open(process.pid), log, directory / f"{m.name}.status", directory / f"{m.name}.shard"
        )
        for m in group
    ]


def container_arguments(group: Sequence[Member], given: Mapping[str, dict[str, Any]], directory: Path) -> list[str]:
    """Write the parameter files of nodes that share a process and give the command line of their container."""
    arguments: list[str] = []
    for member in group:
        arguments += ["--"] if arguments else []
        arguments += [member.package, member.executable, *_ros_arguments(member, given[member.name], directory)]
    return arguments


def _ros_arguments(member: Member, parameters: dict[str, Any], directory: Path) -> list[str]:
    """Write a node's parameter file and give the arguments that name it, the node and its remaps."""
    file = parameter_file(member, parameters, directory)
    arguments = ["--ros-args", "-r", f"__node:={member.name}", "--params-file", str(file)]
    for old, new in member.remap.items():
        arguments += ["-r", f"{old}:={new}"]
    return arguments


def parameter_file(member: Member, parameters: Mapping[str, Any], directory: Path) -> Path:
    """Write the parameters of a node as `--params-file` takes them.

    Parameters
    ----------
    member : Member
    parameters : mapping
        As `node_parameters` gives them.
    directory : Path
    """
    file = directory / f"{member.name}.params.yaml"
    lines = [f"    {name}: {json.dumps(value)}" for name, value in parameters.items()]
    file.write_text("/**:\n  ros__parameters:\n" + "\n".join(lines) + "\n")
    return file


def _die_with_parent() -> None:
    """Linux kills the node when the runner dies, whatever killed the runner."""
    pr_set_pdeathsig = 1
    LIBC.prctl(pr_set_pdeathsig, signal.SIGKILL)


def _watch(
    rig: Rig, children: list[_Child], progress: Callable[[int], object] | None, guests: _Guests, realtime: bool,
    stopping: Stopping,
) -> str:  # fmt: skip
    """Wait until all have ended or one has failed; gives the reason of a failure.

    A node may wait for ever for a peer that has ended: it has the scenario's timeout, in realtime from the end of the
    run, in lockstep from the end of a node or the last progress. So has one whose process is stopped (SIGSTOP).
    """
    late = math.inf if realtime else time.monotonic() + rig.scenario.timeout
    first = starter(rig)
    plant = next((c for c in children if c.member is first), children[0])  # the first may run on another machine
    last = -1
    while True:
        stopping.check()
        running = [c for c in children if c.process.poll() is None]
        failed = [c for c in children if c.process.poll() not in (None, 0)]
        if failed:
            return _reason(children, failed)
        if not running:
            return ""
        guests.look(children)
        state = _read_status(plant.status)
        t = state.get("t", 0)
        busy = any(_read_status(c.status).get("busy") for c in running)
        if realtime:
            if late == math.inf and state.get("epoch"):
                to_start = state["epoch"] / 1e9 - time.time()
                late = time.monotonic() + to_start + rig.scenario.duration + rig.scenario.timeout
        elif t != last or busy or (len(running) == len(children) and not any(_is_stopped(c) for c in running)):
            late = time.monotonic() + rig.scenario.timeout
        if time.monotonic() > late:
            if asleep := _asleep(running):
                return asleep
            names = ", ".join(c.member.name for c in running)
            return f"node {names} did not reach the end of the run within {rig.scenario.timeout:g} s after it"
        if t != last and progress is not None:
            progress(t)
        last = t
        # A child's end wakes the wait; otherwise look at the progress ten times a second. (Popen.wait with a limit
        # wakes up all the time, and each time takes a node's core.)
        select.select([c.end for c in running], [], [], 0.1)


def _asleep(children: list[_Child]) -> str:
    """Name the nodes whose processes are held; empty without any."""
    names = ", ".join(c.member.name for c in children if _is_stopped(c))
    return f"node {names}: its process is stopped (SIGSTOP); it was waited for until the timeout" if names else ""


def _is_stopped(child: _Child) -> bool:
    """Whether a process is held by SIGSTOP or a terminal (Linux)."""
    with suppress(OSError):
        return Path(f"/proc/{child.process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T"
    return False


def _reason(children: list[_Child], failed: list[_Child]) -> str:
    """Say which node failed and why; a node that only waited for one that was itself waiting is not the cause."""
    if not any((c.process.returncode or 0) < 0 for c in failed):
        deadline = time.monotonic() + GRACE
        while time.monotonic() < deadline and any(c.process.poll() is None for c in children):
            time.sleep(0.02)
        failed = [c for c in children if c.process.poll() not in (None, 0)]
    # a container fails as one, but some of its nodes may have finished before
    failed = [c for c in failed if _read_status(c.status).get("state") != "done"] or failed
    waits = {c.member.name: _read_status(c.status).get("waits_for", []) for c in failed}
    held = _asleep([c for c in children if any(c.member.name in names for names in waits.values())])
    if held and all(waits.values()):
        return held
    causes = blamed(waits)
    texts = []
    for child in (c for c in failed if c.member.name in causes):
        code = child.process.returncode or 0
        name = child.member.name
        if code < 0:
            t = _read_status(child.status).get("t", 0) / 1e9
            texts.append(f"node {name} was killed by {signal.Signals(-code).name} after t = {t:.9g} s")
        else:
            said = _read_status(child.status).get("error")
            told = f"{name}: {said}" if said else _last_line(child.log)
            texts.append(f"node {told or f'{name} ended with status {code}'}")
    return "; ".join(texts)


def blamed(waits: Mapping[str, Sequence[str]]) -> list[str]:
    """Give the nodes whose errors tell the cause: those that waited for none, or for one that did not wait itself.

    Parameters
    ----------
    waits : by node name
        For whom each node that failed waited.
    """
    causes = [n for n, senders in waits.items() if not senders]
    causes = causes or [n for n, senders in waits.items() if not all(waits.get(sender) for sender in senders)]
    return causes or list(waits)[:1]


def _stop(children: list[_Child]) -> None:
    """Stop what still runs: SIGINT, then SIGTERM, then SIGKILL."""
    for child in children:
        child.interrupted = child.process.poll() is None
    for number, patience in STOP_STEPS:
        running = {c.process.pid: c for c in children if c.process.poll() is None}.values()
        if not running:
            return
        for child in running:
            child.process.send_signal(signal.SIGCONT)  # a stopped process could not end otherwise
            child.process.send_signal(number)
        deadline = time.monotonic() + patience
        for child in running:
            with suppress(subprocess.TimeoutExpired):
                child.process.wait(max(0.0, deadline - time.monotonic()))


def _read_status(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return {}


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else ""


def node_main(package: str, executable: str, arguments: list[str]) -> int:
    """Become an executable: what ``ros2 run`` does. One of Python runs in this process, so that what stops its module
    from being imported is told with its place; any other replaces it.

    Raises
    ------
    ScenarioError
        No such executable, or its module cannot be imported.
    """
    path = find_executable(package, executable)
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    main = load_main(package, executable)
    sys.stdout.flush()
    if main is None:
        os.execv(path, [str(path), *arguments])
    sys.argv = [str(path), *arguments]
    return int(main() or 0)
