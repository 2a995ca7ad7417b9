"""The processes runner: every node of a rig in its own OS process, over DDS, watched until all have ended."""

from __future__ import annotations

import ctypes
import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from ..errors import ScenarioError
from ..model.params import flatten
from ..wire.recording import Recording
from .domain import free_domain
from .options import InputLink, Links
from .rig import Member, Rig

GRACE = 1.5  # s: after one node fails, how long the others may take to say what they saw
LIBC = ctypes.CDLL(None)  # loaded here: between fork and exec another thread may hold the loader's lock
STOP_STEPS = ((signal.SIGINT, 3.0), (signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0))
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
    """

    recording: Recording
    status: dict[str, dict[str, Any]]
    domain: int
    epoch: int = 0
    error: str = ""


@dataclass
class _Child:
    member: Member
    process: subprocess.Popen[bytes]
    end: int  # process file descriptor, readable when the process has ended
    log: Path
    status: Path
    shard: Path


def links(rig: Rig, member: Member) -> Links:
    """Work out what a node must know of its peers."""
    paired = {
        port: InputLink(period=_seconds(link.source), node=link.source.name, at_end=link.source.schedule.at_end,
                        port=link.port.name, sporadic=link.port.sporadic)
        for port, link in member.links.items()
    }  # fmt: skip
    tick_readers = _tick_readers(rig, member)
    acks = {m.name: _seconds(m) for m in _acknowledging(rig)} if member is rig.clock else {}
    return Links(
        base=_seconds(rig.clock),
        inputs=paired,
        records=_recorded_inputs(rig, member),
        readers={p.name: [m.name for m, _ in rig.readers(member, p) if not m.external] for p in member.outputs},
        outside=[p.topic for m in rig.members if m.external for p in m.outputs if rig.readers(m, p)],
        clock=InputLink(period=_seconds(rig.clock), node=rig.clock.name) if member in _clocked(rig) else None,
        owns_clock=member is rig.clock,
        acknowledges=bool(tick_readers),
        tick_readers=tick_readers,
        enders={m.name: _seconds(m) for m in rig.enders if not m.external},
        stride=rig.stride,
        acks=acks,
        clock_readers=[m.name for m in _clocked(rig)] if member is rig.clock else [],
        plants=sum(m.is_plant for m in rig.members),
    )


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
        found = [rig.clock] if member in _acknowledging(rig) else []
        found += [m for p in member.outputs if p.sporadic for m, _ in rig.readers(member, p)]
    return list(dict.fromkeys(m.name for m in found if not m.external))


def _clocked(rig: Rig) -> list[Member]:
    """Members that pace themselves by /clock: sources, and plants that do not own it."""
    return [m for m in rig.members if m is not rig.clock and (m.is_plant or not m.links)]


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
        Called with a text when an external node is waited for.

    Returns
    -------
    Outcome
        With `error` set when a node failed; what was recorded up to there is in it.

    Raises
    ------
    ScenarioError
        A node refused its parameters.
    KeyboardInterrupt
        After all nodes were stopped.
    """
    directory.mkdir(parents=True, exist_ok=True)
    children: list[_Child] = []
    with ExitStack() as stack:
        domain = stack.enter_context(free_domain()) if domain is None else domain
        epoch = 0
        if mode == "realtime":
            slowest = max((m.schedule for m in rig.members), key=lambda s: s.period)
            epoch = slowest.held(time.time_ns() + 3_000_000_000)
        variables = environment(domain, directory)
        external = [m for m in rig.members if m.external]
        if external and announce is not None:
            announce(_invitation(external, domain))
        try:
            for member in rig.members:
                if not member.external:
                    children.append(_start(rig, member, seed, directory, mode, epoch, record, variables))
            error = _watch(rig, children, progress, epoch)
        finally:
            _stop(children)
            for child in children:
                os.close(child.end)
    status = {c.member.name: _read_status(c.status) for c in children}
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    for child in children:
        if child.shard.exists():
            recording.read_shard(child.shard)
    refused = next((c for c in children if c.process.returncode == 2), None)
    if refused is not None:
        raise ScenarioError(_last_line(refused.log))
    return Outcome(recording, status, domain, epoch, error)


def environment(domain: int, directory: Path) -> dict[str, str]:
    """Give the environment of a node process: its domain on this host only, its logs in a directory."""
    variables = dict(os.environ)
    variables |= {
        "ROS_DOMAIN_ID": str(domain),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
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


def _invitation(external: list[Member], domain: int) -> str:
    lines = [f"waiting for {', '.join(m.name for m in external)}; in another terminal:",
             f"  export ROS_DOMAIN_ID={domain} ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST"]  # fmt: skip
    for m in external:
        lines += [f"  {m.name} must publish {p.topic} ({p.msgtype}, {', '.join(p.labels)})" for p in m.outputs]
        lines += [f"  {m.name} can read {p.topic} ({p.msgtype})" for p in m.inputs]
    return "\n".join(lines)


def find_executable(package: str, executable: str) -> Path:
    """Find ``lib/<package>/<executable>`` of a sourced workspace.

    Raises
    ------
    ScenarioError
        It is not there; lists what the package has.
    """
    prefixes = [Path(p) for p in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if p]
    for prefix in prefixes:
        path = prefix / "lib" / package / executable
        if path.is_file() and os.access(path, os.X_OK):
            return path
    there = sorted({p.name for prefix in prefixes for p in (prefix / "lib" / package).glob("*") if p.is_file()})
    if not there:
        raise ScenarioError(f"package {package!r} has no executables in AMENT_PREFIX_PATH; is the workspace built "
                            "and sourced?")  # fmt: skip
    raise ScenarioError(f"package {package} has no executable {executable!r}; it has {', '.join(there)}")


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


def _start(rig: Rig, member: Member, seed: int, directory: Path, mode: str, epoch: int,
           record: bool, variables: dict[str, str]) -> _Child:  # fmt: skip
    stem = directory / member.name
    status, shard, log = stem.with_suffix(".status"), stem.with_suffix(".shard"), stem.with_suffix(".log")
    for stale in (status, shard):
        stale.unlink(missing_ok=True)
    parameters = node_parameters(rig, member, seed, mode) | {
        "run.shard": str(shard) if record else "",
        "run.status": str(status),
        "run.epoch": epoch,
    }
    file = stem.with_suffix(".params.yaml")
    lines = [f"    {name}: {json.dumps(value)}" for name, value in parameters.items()]
    file.write_text("/**:\n  ros__parameters:\n" + "\n".join(lines) + "\n")
    command = [str(find_executable(member.package, member.executable)), "--ros-args", "-r", f"__node:={member.name}",
               "--params-file", str(file)]  # fmt: skip
    for old, new in member.remap.items():
        command += ["-r", f"{old}:={new}"]
    # A process group of its own, so that Ctrl-C reaches the runner alone; not a session of its own, because Linux
    # schedules sessions against each other and a loop across them runs a fifth slower.
    with log.open("wb") as output:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=output, stderr=subprocess.STDOUT, env=variables,
            process_group=0, preexec_fn=_die_with_parent,
        )  # fmt: skip
    return _Child(member, process, os.pidfd_open(process.pid), log, status, shard)


def _die_with_parent() -> None:
    """Linux kills the node when the runner dies, whatever killed the runner."""
    pr_set_pdeathsig = 1
    LIBC.prctl(pr_set_pdeathsig, signal.SIGKILL)


def _watch(
    rig: Rig, children: list[_Child], progress: Callable[[int], object] | None, epoch: int
) -> str:  # fmt: skip
    """Wait until all have ended or one has failed; gives the reason of a failure.

    A node may wait for ever for a peer that has ended: it has the scenario's timeout, in realtime from the end of the
    run, in lockstep from the end of a node or the last progress.
    """
    realtime = epoch > 0
    late = epoch / 1e9 + rig.scenario.duration + rig.scenario.timeout
    plant = next((c for c in children if c.member is rig.clock), children[0])
    last = -1
    while True:
        running = [c for c in children if c.process.poll() is None]
        failed = [c for c in children if c.process.poll() not in (None, 0)]
        if failed:
            return _reason(children, failed)
        if not running:
            return ""
        t = _read_status(plant.status).get("t", 0)
        busy = any(_read_status(c.status).get("busy") for c in running)
        if not realtime and (t != last or busy or len(running) == len(children)):
            late = time.time() + rig.scenario.timeout
        if time.time() > late:
            names = ", ".join(c.member.name for c in running)
            return f"node {names} did not reach the end of the run within {rig.scenario.timeout:g} s after it"
        if t != last and progress is not None:
            progress(t)
        last = t
        # A child's end wakes the wait; otherwise look at the progress ten times a second. (Popen.wait with a limit
        # wakes up all the time, and each time takes a node's core.)
        select.select([c.end for c in running], [], [], 0.1)


def _reason(children: list[_Child], failed: list[_Child]) -> str:
    """Say which node failed and why; a node that only waited for one that was itself waiting is not the cause."""
    if not any((c.process.returncode or 0) < 0 for c in failed):
        deadline = time.monotonic() + GRACE
        while time.monotonic() < deadline and any(c.process.poll() is None for c in children):
            time.sleep(0.02)
        failed = [c for c in children if c.process.poll() not in (None, 0)]
    waits = {c.member.name: _read_status(c.status).get("waits_for", []) for c in failed}
    causes = [c for c in failed if not waits[c.member.name]] or [
        c for c in failed if not all(waits.get(sender) for sender in waits[c.member.name])
    ]
    texts = []
    for child in causes or failed[:1]:
        code = child.process.returncode or 0
        name = child.member.name
        if code < 0:
            t = _read_status(child.status).get("t", 0) / 1e9
            texts.append(f"node {name} was killed by {signal.Signals(-code).name} after t = {t:.9g} s")
        else:
            texts.append(f"node {_last_line(child.log) or f'{name} ended with status {code}'}")
    return "; ".join(texts)


def _stop(children: list[_Child]) -> None:
    """Stop what still runs: SIGINT, then SIGTERM, then SIGKILL."""
    for number, patience in STOP_STEPS:
        running = [c for c in children if c.process.poll() is None]
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
    """Replace this process by an executable: what ``ros2 run`` does, signals and exit status exact."""
    path = find_executable(package, executable)
    os.environ.setdefault("FASTRTPS_DEFAULT_PROFILES_FILE", str(PROFILE))
    sys.stdout.flush()
    os.execv(path, [str(path), *arguments])
