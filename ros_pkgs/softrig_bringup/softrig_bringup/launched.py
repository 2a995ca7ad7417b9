"""A rig that a launch system starts: the nodes of `softrig run` with its options, and the actions at their end."""

from __future__ import annotations

import argparse
import atexit
import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from shutil import rmtree
from tempfile import mkdtemp
from typing import Any

from softrig_core import Recording, Run, RunError, ScenarioError
from softrig_core.errors import closest
from softrig_core.guard import stopped_by
from softrig_core.interrupt import PARENT
from softrig_core.rig.members import Member
from softrig_nodes.processes.children import read_status
from softrig_nodes.processes.domain import join_domain
from softrig_nodes.processes.executables import default_profile, patient
from softrig_nodes.processes.peers import starter
from softrig_nodes.processes.processes import gathered
from softrig_nodes.processes.shared_memory import remove_leftovers
from softrig_nodes.processes.spawning import container_arguments, groups, node_parameters, parameter_file
from softrig_nodes.processes.stopping import stoppable, undisturbed
from softrig_nodes.processes.supervision import left_early

from .options import run_options
from .run.run import checked, gaps, tripped
from .verbs import run_verb
from .view.rviz import ROOTED, Process, viewer

VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
UNASKED = "the run did not reach its end, and nothing of it was recorded or judged (record:=true, judge:=true)"
# name: (default, choices, description); an empty default means: as in the scenario
ARGUMENTS: dict[str, tuple[str | None, tuple[str, ...], str]] = {
    "scenario": (None, (), "name of a scenario or path of its YAML file"),
    "mode": ("realtime", ("realtime", "lockstep"), "against the wall clock, or tick by tick"),
    "place": ("processes", ("processes", "container"), "a process for each node, or one for all"),
    "namespace": ("", (), "of all nodes and topics of the rig, /clock as well"),
    "duration": ("", (), "s, instead of the scenario's"),
    "seed": ("", (), "instead of the scenario's"),
    "params_file": ("", (), "parameters in the form of ros2 param dump, instead of the scenario's"),
    "external": ("", (), "nodes that another process starts, names separated by spaces"),
    "wait_for": ("", (), "recorders that are to have all from t = 0 and do not ask for it, as rosbag2_recorder"),
    "frames": ("true", ("true", "false"), "/tf and /tf_static from the rig's nodes; false for publishers of your own"),
    "record": ("false", ("true", "false", "all"), "results at the end, as `softrig run` writes; all: with diagnostics"),
    "out": ("", (), "folder for them (default: runs/SCENARIO and what was changed, below the working folder)"),
    "judge": (
        "false",
        ("true", "false"),
        "table of the figures at the end; the launch ends with status 1 if one misses",
    ),
    "use_rviz": ("false", ("true", "false"), "RViz with a file for this rig; the launch ends when it is closed"),
}


def strange(words: Sequence[str]) -> str:
    """Describe which argument of a `ros2 launch` command our launch file does not have; launch accepts any.

    The text is empty if there is none, or if another launch file includes this one, because it may own the arguments.
    """
    if not any(Path(word).name == "rig.launch.py" for word in words):
        return ""
    names = [word.partition(":=")[0] for word in words if ":=" in word]
    unknown = next((name for name in names if name not in ARGUMENTS), None)
    if unknown is None:
        return ""
    return f"{unknown}: no argument of rig.launch.py{closest(unknown, ARGUMENTS)}; expected {', '.join(ARGUMENTS)}"


def begin(values: Mapping[str, str]) -> Launched:
    """Return the processes of a rig; see `Launched`.

    Raises
    ------
    RunError
        A signal was received; launch itself would continue without any process and end with status 0.
    """
    try:
        with stoppable():
            return Launched(values)
    except KeyboardInterrupt as interrupt:
        interrupt.add_note("nothing was run or written")
        raise RunError(stopped_by(interrupt)) from None


class Launched:
    """The processes of a rig, for a caller that starts them and reports when they have ended.

    Parameters
    ----------
    values : mapping of str to str
        Values of `ARGUMENTS`.

    Raises
    ------
    ScenarioError
        The scenario, or a change of it, is invalid.
    RunError
        The domain is the private domain of a run.

    Attributes
    ----------
    sent : signal.Signals
        The signal that shut the launch down.
    """

    sent = signal.SIGINT

    def __init__(self, values: Mapping[str, str]) -> None:
        arguments = {name: values.get(name) or default or "" for name, (default, _, _) in ARGUMENTS.items()}
        self._options = options = _options(arguments)
        self._record, self._judge = arguments["record"] != "false", arguments["judge"] == "true"
        self._frames = arguments["frames"] == "true"
        self._rig = rig = checked(run_options.scenario_of(options))
        self._seed, self._placement = rig.scenario.seed, run_options.placement_of(options)
        self._realtime = self._placement.clock == "realtime"
        os.environ[PARENT] = str(os.getpid())
        remove_leftovers()
        join_domain(int(os.environ.get("ROS_DOMAIN_ID") or 0))  # reserved, so that no run chooses it
        self._folder = run_verb.results_folder(options, rig) if self._record else None
        if self._folder is not None:
            self._log = self._folder.path / "log"
            self._log.mkdir(exist_ok=True)
        else:
            self._log = Path(mkdtemp(prefix="softrig-launch-"))
            atexit.register(rmtree, self._log, ignore_errors=True)
        self._begun = time.monotonic()
        self._error, self._stopped = "", False
        self._namespace = arguments["namespace"].strip("/")
        self._variables: dict[str, str] = {}
        if not os.environ.get(VARIABLE):  # nodes wait for a silent peer as long as the timeout of the scenario
            self._variables[VARIABLE] = str(patient(default_profile(), self._log, rig.scenario.timeout))
        self.processes = [
            self._process(group, self._namespace, arguments["wait_for"].split())
            for group in groups(rig, self._placement.shared(rig))
        ]
        self._running = len(self.processes)
        if arguments["use_rviz"] == "true":
            self.processes.append(viewer(rig, self._log, self._namespace, not self._realtime))

    def _process(self, group: list[Member], namespace: str, recorders: list[str]) -> Process:
        rig, log = self._rig, self._log
        keep = self._record or self._judge
        extra: dict[str, object] = {"run.start_timeout": 0.0} if any(m.external for m in rig.members) else {}
        extra |= {} if self._frames else {"run.frames": False}
        parameters = {
            m.name: node_parameters(
                rig, m, self._seed, "realtime" if self._realtime else "lockstep", recorders=recorders
            )
            | extra
            | {"run.status": str(log / f"{m.name}.status"), "run.shard": str(log / f"{m.name}.shard") if keep else ""}
            for m in group
        }
        # topics that are nowhere below a namespace: two rigs would drive each other
        moved = {f"/{name}": f"/{namespace}/{name}" for name in ROOTED} if namespace else {}
        if len(group) > 1:
            shared = moved | ({"__ns": f"/{namespace}"} if namespace else {})
            words = container_arguments(group, parameters, log, shared)
            return Process("softrig_nodes", "container", arguments=words, variables=self._variables)
        m = group[0]
        return Process(
            m.package,
            m.executable,
            m.name,
            namespace,
            parameters=[str(parameter_file(m, parameters[m.name], log))],
            remappings=[*(m.remap | moved).items()],
            variables=self._variables,
        )

    def ended(self, name: str, status: int, interrupted: bool) -> str:
        """Note that a process has ended; after the last one, do the same as `softrig run` at the end of a run.

        Parameters
        ----------
        name : str
            Of the process.
        status : int
            Its exit status.
        interrupted : bool
            Whether the launch was being shut down already.

        Returns
        -------
        str
            Why the launch is to end with a failure; empty when it is not.
        """
        self._running -= 1
        self._stopped = self._stopped or interrupted
        wrong = f"{name} ended with status {status}" if status and not interrupted else ""
        self._error = self._error or wrong
        if self._running:
            return wrong
        try:
            return self._over() or wrong
        except KeyboardInterrupt as interrupt:
            return stopped_by(interrupt)

    def _over(self) -> str:
        """Finish when all processes have ended; return why the launch ends with a failure."""
        rig, options = self._rig, self._options
        names = [m.name for m in rig.members if not m.external]
        with undisturbed() as arrived:  # a signal must not interrupt the gathering of the recording
            recording, nodes = gathered(rig, self._log, names, f"{self._namespace}/" if self._namespace else "")
        if arrived and not self._stopped:
            self._stopped, self.sent = True, signal.Signals(arrived[0])
        late = "" if self._error or self._stopped else left_early(nodes)
        self._error = self._error or late
        if self._record or self._judge:
            result, reached = self._conclude(recording, nodes)
        else:
            result, reached = 0, f"stopped by {self.sent.name}: {UNASKED}" if self._stopped and not self._error else ""
        if self._error or self._stopped:
            return late or reached
        if trips := tripped(rig, nodes):
            slow = run_verb.too_slow(options, rig, nodes, container="place:=container") if self._realtime else ""
            return slow or "; ".join(f"{name}: {text}" for name, text in trips.items())
        return f"judged: status {result}" if result and (self._judge or result > 1) else ""

    def _conclude(self, recording: Recording, status: dict[str, dict[str, Any]]) -> tuple[int, str]:
        """Write, print and judge; return the exit status of `softrig run` and the time that a stopped run reached."""
        rig, options = self._rig, self._options
        epoch = int(read_status(self._log / f"{starter(rig).name}.status").get("epoch", 0))
        messages = [f"{name}: {s['error']}" for name, s in status.items() if s.get("error")]
        run = Run(rig, self._seed, recording, time.monotonic() - self._begun, str(self._placement), epoch, status)
        if self._error:
            run.error = "; ".join([self._error, *messages])
        elif self._stopped:
            run.stopped = self.sent
        elif not self._realtime:
            run.error = gaps(rig, recording)
        return run_verb.conclude(options, run, self._folder), run.stopped_at


def _options(args: Mapping[str, str]) -> argparse.Namespace:
    """Return the equivalent options of `softrig run`."""
    words = [args["scenario"], "--mode", args["place"], *(["--realtime"] if args["mode"] == "realtime" else [])]
    for name, option in (("duration", "duration"), ("seed", "seed"), ("params_file", "params-file"), ("out", "out")):
        words += [f"--{option}={args[name]}"] if args[name] else []
    if args["params_file"] and args["namespace"]:
        words += [f"--namespace={args['namespace']}"]
    words += ["--record-all"] if args["record"] == "all" else []
    for node in args["external"].split():
        words += ["--external", node]
    try:
        return run_options.Again().parse_args(words)
    except argparse.ArgumentError as error:
        raise ScenarioError(str(error)) from None
