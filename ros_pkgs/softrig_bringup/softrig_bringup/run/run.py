"""One run from scenario to results: run it, check that it is complete, write bag, figures, plots, report."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import math
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

from softrig_bags.health import with_health
from softrig_bags.scenery import LATCHED, with_scenery
from softrig_bags.write import write_bag
from softrig_core import (
    Block,
    Observer,
    Recording,
    Rig,
    Run,
    RunError,
    Scenario,
    Scene,
    figures_of,
    rig_of,
    run_inprocess,
)
from softrig_core.bits import kernels, math_digest
from softrig_core.block.params import declarations, flatten
from softrig_core.block.port import CLOCK
from softrig_core.block.scene import scene_of
from softrig_core.block.step import Step
from softrig_core.guard import naming, replace
from softrig_core.native.engine import WATCHES
from softrig_core.rig.code import fingerprints
from softrig_core.rig.members import other_names
from softrig_core.run.live_figures import Measured, is_recorded
from softrig_core.timebase import SECOND
from softrig_core.verdict.result import Result
from softrig_core.wire.parameter_event import recorded
from softrig_core.wire.recording import read_shards
from softrig_core.wire.shards import Shards
from softrig_nodes.processes.placement import NOBODY, Listener, Placement
from softrig_nodes.processes.stopping import signal_of, stoppable, unstopped

from ..folder import ResultsFolder
from ..options.identity import identity
from ..options.like import from_outside, lateness
from ..page.citations import cited
from ..page.wiring import wiring_of
from ..plots.curves import check_plots, shown
from ..plots.pictures import plot_run
from ..report.report import write_report

# The reasons why a run cannot be repeated from its scenario.
CHANGED, OUTSIDE = "parameters were changed while it ran", "there were messages from outside"


def execute(rig: Rig, placement: Placement, directory: Path, listener: Listener = NOBODY) -> Run:
    """Run a rig; if it failed or was stopped, `error` or `stopped` is set, and the result has what was recorded.

    Parameters
    ----------
    rig : Rig
        As returned by `checked`.
    directory : Path
        For the logs of node processes.
    """
    started, seed = time.perf_counter(), rig.scenario.seed
    run = Run(rig, seed, Recording((t, p.msgtype) for t, p in rig.topics.items()), mode=str(placement))
    if placement.mode == "inprocess":
        shards = Shards(directory, [(t, p.msgtype) for t, p in rig.topics.items()])

        def progress(t: int) -> None:
            # About a hundred times in a run: a node that is rarely due would keep its messages in a buffer.
            shards.flush()
            if listener.progress is not None:
                listener.progress(t)

        measured = {m.name: m for m in rig.members if is_recorded(m)}
        steps = dict[str, Step]()
        try:
            with stoppable():
                steps = run_inprocess(rig, seed, shards, progress, without=measured)
        except RunError as broken:
            run.error = str(broken)
        except KeyboardInterrupt as interrupt:
            run.stopped = signal_of(interrupt)
        except OSError as full:
            run.error = f"{directory}: {full.strerror or full}"
        try:
            shards.flush()  # for a run that failed or was stopped, too: its last messages are the most important
        except OSError as full:
            run.error = run.error or f"{directory}: {full.strerror or full}"
        run.recording = shards.recording()
        if steps:
            # As observers in a native run, these nodes watch what native code has recorded.
            natively = any(step.native[0] for step in steps.values())
            native = 0, WATCHES if natively else next(step.native[1] for step in steps.values())
            blocks: dict[str, Step | Measured] = {**steps}
            blocks |= {name: Measured(m, seed, lambda: run.signals, native) for name, m in measured.items()}
            run.blocks, run.status = blocks, {m.name: status_of(blocks[m.name]) for m in rig.members}
    else:
        from softrig_nodes import run_processes  # late import: runs in process do not need it

        outcome = run_processes(rig, seed, directory, placement, listener)
        run.recording, run.status, run.epoch = outcome.recording, outcome.status, outcome.epoch
        run.error, run.stopped = outcome.error, outcome.stopped
    run.wall_s = time.perf_counter() - started
    if not run.error and not run.stopped and placement.clock == "lockstep":
        run.error = gaps(rig, run.recording)
    return run


def status_of(step: Step | Measured) -> dict[str, Any]:
    """Return a block's status at the end of a run in process, as in a node's status file."""
    reports = {k: [int(level), text, n] for k, (level, text, n) in step.reports.items()}
    content: dict[str, Any] = {"reports": reports, "native": step.native}
    if isinstance(step.block, Observer):
        content["figures"] = {k: [v, unit] for k, (v, unit) in step.status().items() if math.isfinite(v)}
    return content


def tripped(rig: Rig, status: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the nodes whose protection tripped although the scenario does not expect it, with their reports."""
    return {
        m.name: text
        for m in rig.members
        if m.name not in rig.scenario.trips
        for key, (_, text, _) in status.get(m.name, {}).get("reports", {}).items()
        if key in m.block_class.TRIPS
    }


def checked(scenario: Scenario) -> Rig:
    """Build the rig of a scenario; names and values are checked before the run."""
    rig = rig_of(scenario)
    figures_of(rig)
    check_plots(rig)
    cited(scenario.cites)
    return rig


def gaps(rig: Rig, recording: Recording) -> str:
    """Describe which topics of a lockstep run lack a tick or have one twice; empty if none does."""
    results = []
    expected = {} if rig.clock.external else {CLOCK.topic: rig.clock.schedule}
    for member in rig.members:
        readers = {p.name: [m for m, _ in rig.readers(member, p)] for p in member.outputs}
        read = [p for p in member.outputs if not member.external or any(not m.external for m in readers[p.name])]
        expected |= {p.topic: member.schedule for p in read}
    sporadic = {p.topic for m in rig.members for p in m.outputs if p.sporadic}
    for topic, schedule in expected.items():
        times = recording.topics[topic].ticks()
        if topic in sporadic:
            wrong = next((t for a, t in pairwise([-1, *times.tolist()]) if t <= a or not schedule.due(t)), None)
            if wrong is not None:
                results.append(
                    f"{topic}: a message at t = {wrong / 1e9:.9g} s, which is not a tick, or not after the last message"
                )
            continue
        wanted = schedule.count()
        if len(times) == wanted and times[0] == 0 and times[-1] == schedule.last:
            continue
        k = next((i for i, t in enumerate(times.tolist()) if t != schedule.time(i)), len(times))
        results.append(f"{topic}: {len(times)} messages of {wanted}, first gap at t = {schedule.time(k) / 1e9:.9g} s")
    return "; ".join(results)


def summary(run: Run, figures: Sequence[Result], command: str, label: str = "") -> dict[str, Any]:
    """Create the content of metrics.json; `label` is the name of the run."""
    scenario = run.rig.scenario
    # Code and parameters of external nodes are not known here.
    members = [m for m in run.rig.members if not m.external]
    return {
        "scenario": scenario.name,
        "title": scenario.title,
        "system": scenario.system,
        "source": scenario.source,
        "mode": run.mode,
        "label": label,
        "seed": run.seed,
        "duration_s": scenario.duration,
        "reached_s": run.reached_s,
        "ticks": max(0, run.recording.topics[CLOCK.topic].number - 1) or _plant_ticks(run),
        "wall_s": round(run.wall_s, 3),
        "error": run.error,
        "stopped": run.stopped_at,
        "command": command,
        "versions": versions() | checkout(),
        "code": fingerprints(m.block_class for m in members),
        "contents": {m.name: dict(m.files) for m in members if m.files},
        "parameters": {m.name: flatten(m.params) for m in members},
        "changes": _changes(run),
        "branched": run.branched,
        "once": _once(run),
        "units": {m.name: {d.name: d.unit for d in declarations(type(m.params)) if d.unit} for m in members},
        "metrics": [f.plain() for f in figures],
        "claims": [f.plain() for f in run.claims],
        "nodes": run.status,
        "plots": [p.model_dump() for p in scenario.plots],
        "signals": {name: s.plain() for name, s in shown(run.rig).items()},
        **({"also": other_names(run.rig)} if len(members) < len(run.rig.members) else {}),
        "wiring": wiring_of(run.rig).plain(),
        "citations": [c.plain() for c in cited(scenario.cites)],
    }


def _changes(run: Run) -> list[dict[str, Any]]:
    """The changes of parameters that took effect and were recorded: the tick in s, the node, its new values."""
    return [{"at_s": t / SECOND, "node": node, "set": values} for t, node, values in recorded(run.recording, run.epoch)]


def _once(run: Run) -> list[str]:
    """Describe why a run cannot be repeated from its scenario; empty if it can."""
    outside = [m.name for m in run.rig.members if m.external]
    results = [f"{', '.join(outside)} from outside"] if outside else []
    results += [CHANGED] if turned(run) or any(b["left"] for b in run.branched) else []
    results += [OUTSIDE] if not outside and from_outside(run.rig, run.recording) else []
    return results + (["in real time"] if run.epoch else [])


def once_broken_off(rig: Rig, shards: Iterable[Path]) -> list[str]:
    """Describe why a killed lockstep run cannot be repeated, from its shards; empty if it can.

    Parameters
    ----------
    rig : Rig
        The run that is about to replace it; the two are compared.
    """
    try:
        recording = read_shards(shards)
        results = [CHANGED] if turned(Run(rig, rig.scenario.seed, recording)) else []
    # The shards are damaged on the disk, so it is unknown whether there was a change.
    except (ValueError, KeyError):
        return ["parameters may have been changed while it ran"]
    return results + ([OUTSIDE] if from_outside(rig, recording) else [])


def turned(run: Run) -> list[str]:
    """Describe the changes that a user made during the run, without those of the scenario."""
    scripted = {
        (m.schedule.next(c.at - 1), m.name, name): value
        for m in run.rig.members
        for c in m.changes
        for name, value in c.values.items()
    }
    return [
        f"{node}.{name}={json.dumps(value)} from {t / SECOND:.9g} s"
        for t, node, values in recorded(run.recording, run.epoch)
        for name, value in values.items()
        # A person may have set another value at the tick of a change of the scenario.
        if scripted.get((t, node, name)) != value
    ]


def _plant_ticks(run: Run) -> int:
    return int(run.status.get(run.rig.clock.name, {}).get("ticks", 0))


def versions() -> dict[str, str]:
    """Return the dependencies of a run: versions, the C library's functions by their results, the kernels in use."""
    result = {"python": platform.python_version(), "machine": platform.machine()}
    machine = {
        "libc": " ".join(platform.libc_ver()).strip(),
        "math": math_digest(),
        **kernels(),
    }
    result |= {name: value for name, value in machine.items() if value}
    for name in ("softrig_core", "numpy", "scipy", "casadi", "pin", "daqp", "rosbags", "ros-jazzy-rclpy"):
        try:
            result[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return result


@cache
def checkout() -> dict[str, str]:
    """Return the commit of the running checkout (with ``+`` if files were changed) and its lock file's hash."""
    script = Path(os.environ.get("SOFTRIG_COMMAND", ""))
    lock = script.parent / "locks" / "run.lock"
    if not lock.is_file():
        return {}
    result = {"run.lock": f"sha256:{hashlib.sha256(lock.read_bytes()).hexdigest()}"}
    git = ["git", "-C", str(script.parent), "-c", "core.fsmonitor=", "--no-optional-locks"]
    try:
        messages = [
            subprocess.run([*git, *command], capture_output=True, text=True, timeout=10, check=True).stdout.strip()
            for command in (["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"])
        ]
    # There is no git here, or the checkout is an archive without its history.
    except (OSError, subprocess.SubprocessError):
        return result
    return {"commit": messages[0] + ("+" if messages[1] else "")} | result


def save(
    run: Run, content: Mapping[str, Any], folder: ResultsFolder, record: bool = True, health: bool = False
) -> None:
    """Write metrics.json and bag/ into a folder, with a list of the files written.

    Parameters
    ----------
    content : mapping
        From `summary`.
    record : bool
        Whether the bag is written.
    health : bool
        Whether the bag also has what the nodes report beside their signals.
    """
    with _writing(folder) as directory, unstopped():
        texts = _texts(run.rig) if health else {}
        if record:
            recording = with_scenery(run.recording, _scenes(run.rig))
            recording = with_health(recording, texts, run.status) if health else recording
            content = {**content, "run": identity(run.rig, run.seed, recording)}
        # This is written first, because it tells the reason when the disk is full.
        replace(directory / "metrics.json", json.dumps(content, indent=1) + "\n")
        if record:
            write_bag(directory / "bag", recording, custom_data=_provenance(run, content), latched=[*LATCHED, *texts])
        run.recording.release()


def illustrate(run: Run, folder: ResultsFolder, also: str = "") -> None:
    """Add the plots and report.html to the files of `save`.

    Parameters
    ----------
    also : str
        See `softrig_bringup.plots.pictures.plot_run`.
    """
    with _writing(folder) as directory:
        if any(topic.number for topic in run.recording.topics.values()):
            plot_run(run.signals, run.rig, directory, also, results=run.results)
        write_report([directory], directory / "report.html")


@contextmanager
def _writing(folder: ResultsFolder) -> Iterator[Path]:
    folder.path.mkdir(parents=True, exist_ok=True)
    try:
        with naming(folder.path):
            yield folder.path
    except BaseException:
        # On a full disk the list cannot be written either, and its error would hide the name of the first file.
        with suppress(OSError):
            folder.close()
        raise
    folder.close()


def _texts(rig: Rig) -> dict[str, str]:
    """Return topic to text of the latched topics of the rig."""
    members = [m for m in rig.members if not m.external and m.block_class.latched is not Block.latched]
    return {topic: text for m in members for topic, text in m.block(rig.scenario.seed).latched().items()}


def _scenes(rig: Rig) -> dict[str, Scene]:
    """Return the scenes of the rig for viewers, by the topic that moves them."""
    result = {}
    for member in rig.members:
        scene = scene_of(member.block_class, member.params)
        if scene is not None:
            result[next(p.topic for p in member.outputs if p.name == scene.port)] = scene
    return result


def _provenance(run: Run, content: Mapping[str, Any]) -> dict[str, str]:
    keys = ("scenario", "mode", "seed", "versions", "code", "command", "run")

    epoch = {"epoch": str(run.epoch)} if run.epoch else {}  # time of t = 0, if the run was in real time
    late = lateness(run.status) if run.epoch else {}
    epoch |= {"late": json.dumps(late)} if late else {}
    epoch |= {"from": json.dumps(content["from"])} if "from" in content else {}  # the run from which it continues
    epoch |= {"contents": json.dumps(content["contents"])} if content["contents"] else {}
    # Figures that observers measured at the end.
    last = {name: s["figures"] for name, s in run.status.items() if s.get("figures")}
    observed = {"observed": json.dumps(last)} if last else {}
    epoch |= {"branched": json.dumps(run.branched)} if run.branched else {}
    return epoch | observed | {k: v if isinstance(v := content[k], str) else json.dumps(v) for k in keys}
