"""Starting the nodes of a rig: their parameters, their command lines, their processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from softrig_core.block.change import dumps
from softrig_core.block.params import flatten
from softrig_core.board.elsewhere import Elsewhere
from softrig_core.guard import replace
from softrig_core.rig.members import Member
from softrig_core.rig.rig import Rig

from .children import Child
from .executables import find_executable
from .fork_server import LIBC, PR_SET_PDEATHSIG, start_node
from .peers import links

FILES = ("status", "shard")  # files that a node writes
DIED = ".shard.died"  # suffix of the record of a node that has died and is started again


def groups(rig: Rig, containers: Iterable[Sequence[str]], only: Sequence[str] = ()) -> list[list[Member]]:
    """Return our nodes by process, only those that are named if some are."""
    members = {m.name: m for m in rig.members if not m.external and (not only or m.name in only)}
    shared = [[members.pop(name) for name in names if name in members] for names in containers]
    return [g for g in shared if g] + [[m] for m in members.values()]


def node_parameters(
    rig: Rig, member: Member, seed: int, mode: str, *, recorders: Sequence[str] | None = None, returns: bool = False
) -> dict[str, Any]:
    """Return the ROS parameters that start a member of a rig: those of its block that differ, and how it runs.

    Parameters
    ----------
    mode : {"lockstep", "realtime"}
    recorders : sequence of str, optional
        Nodes outside the rig that read everything and are awaited, besides those that ask for it. None means that the
        domain is the rig's own, with no other nodes in it.
    returns : bool
        Whether a node that died is started again.
    """
    default = flatten(member.block_class.Params())
    params = {k: v for k, v in flatten(member.params).items() if v != default.get(k)}
    updates: dict[str, Any] = {"returns": returns}
    # The clock runs ahead of followers; a restarted node must find all others at the tick at which it died.
    updates |= {"followers": []} if returns else {}
    entry = getattr(member.block_class, "ENTRY", None) if issubclass(member.block_class, Elsewhere) else None
    link = {} if entry is None else {"run.link": entry.model_dump_json()}
    updates |= {} if recorders is None else {"public": True, "recorders": list(recorders)}
    return (
        params
        | link
        | {
            "run.mode": mode,
            "run.seed": seed,
            "run.duration": rig.scenario.duration,
            "run.timeout": rig.scenario.timeout,
            "run.start_timeout": rig.scenario.start_timeout,
            "run.links": links(rig, member).model_copy(update=updates).model_dump_json(),
            "run.changes": dumps(member.changes),
        }
    )


class Started(NamedTuple):
    """Start options of all processes of a run; for `recorders` and `returns` see `node_parameters`."""

    rig: Rig
    seed: int
    directory: Path
    options: dict[str, Any]
    record: bool
    variables: dict[str, str]
    recorders: Sequence[str] | None
    returns: bool


def start(run: Started, group: list[Member], *, again: bool = False) -> list[Child]:
    """Start a node, or several in a container.

    Parameters
    ----------
    again : bool
        Whether it died and is started again.
    """
    rig, seed, directory, options, record, variables, recorders, returns = run
    log = directory / f"{'+'.join(m.name for m in group)[:200]}.log"
    parameters = {}
    for member in group:
        stem = directory / member.name
        if again:
            _keep_record(stem)
        for kind in FILES:
            # A status of an earlier run would be taken for that of the new node.
            stem.with_suffix(f".{kind}").unlink(missing_ok=True)
        parameters[member.name] = (
            node_parameters(rig, member, seed, options["run.mode"], recorders=recorders, returns=returns)
            | options
            | {
                "run.shard": str(stem.with_suffix(".shard")) if record else "",
                "run.status": str(stem.with_suffix(".status")),
            }
            | ({"run.again": str(directory), "run.paused": False} if again else {})
        )
    if len(group) == 1:
        executable = find_executable(group[0].package, group[0].executable)
        arguments = _ros_arguments(group[0], parameters[group[0].name], directory)
    else:
        executable = find_executable("softrig_nodes", "container")
        arguments = container_arguments(group, parameters, directory)
    # A process group of its own, so that Ctrl-C reaches the runner alone; not a session of its own, because Linux
    # schedules sessions against each other and a loop across them runs a fifth slower.
    command = [str(executable), *arguments]
    with log.open("ab" if again else "wb") as output:
        process = start_node(
            executable.parent.name, executable.name, command, variables, output.fileno()
        ) or subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=variables,
            process_group=0,
            preexec_fn=_die_with_parent,
        )
    return [
        Child(
            m, process, os.pidfd_open(process.pid), log, directory / f"{m.name}.status", directory / f"{m.name}.shard"
        )
        for m in group
    ]


def _keep_record(stem: Path) -> None:
    """Keep the record of a node that died; if it died during a restart, keep the longer record of before."""
    shard, before = stem.with_suffix(".shard"), stem.with_suffix(DIED)
    if shard.exists() and (not before.exists() or before.stat().st_size < shard.stat().st_size):
        shard.replace(before)


def container_arguments(
    group: Sequence[Member],
    parameters: Mapping[str, dict[str, Any]],
    directory: Path,
    shared: Mapping[str, str] | None = None,
) -> list[str]:
    """Write the parameter files of nodes that share a process, and return the command line of their container.

    Parameters
    ----------
    parameters : mapping
        Parameters by node, as returned by `node_parameters`.
    shared : mapping of str to str, optional
        Remaps of all of them.
    """
    arguments: list[str] = []
    for member in group:
        arguments += ["--"] if arguments else []
        arguments += [member.package, member.executable, *_ros_arguments(member, parameters[member.name], directory)]
        for old, new in (shared or {}).items():
            arguments += ["-r", f"{old}:={new}"]
    return arguments


def _ros_arguments(member: Member, parameters: dict[str, Any], directory: Path) -> list[str]:
    """Write a node's parameter file, and return the arguments that name it, the node and its remaps."""
    file = parameter_file(member, parameters, directory)
    arguments = ["--ros-args", "-r", f"__node:={member.name}", "--params-file", str(file)]
    for old, new in member.remap.items():
        arguments += ["-r", f"{old}:={new}"]
    return arguments


def parameter_file(member: Member, parameters: Mapping[str, Any], directory: Path) -> Path:
    """Write the parameters of a node to a file for `--params-file`.

    Parameters
    ----------
    parameters : mapping
        Parameters, as returned by `node_parameters`.
    """
    file = directory / f"{member.name}.params.yaml"
    # JSON is YAML, and `json.dumps` quotes each text, so that a text such as `no` stays a text.
    lines = [f"    {name}: {json.dumps(value)}" for name, value in parameters.items()]
    replace(file, "/**:\n  ros__parameters:\n" + "\n".join(lines) + "\n")
    return file


def _die_with_parent() -> None:
    """Let Linux kill the node when the runner dies, whatever killed the runner."""
    LIBC.prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
