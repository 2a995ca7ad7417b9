"""Simulators of others, in a Python that has them, and what a comparison with one of them needs."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Recording, Rig, Signals, run_inprocess

from .timing import least

MANY = 10_000  # enough runs for compiling to pay off
# These belong to this Python and not to a peer's.
_OURS = ("PYTHONPATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV", "_ROS_WHEELS_BOOTSTRAP_COMPLETE")


class Row(NamedTuple):
    """A system beside a library; CPU in s of the same work, distance of the end states in a unit and its limit."""

    system: str
    work: str
    ours: float
    theirs: float
    apart: float
    allowed: float
    unit: str


def pythons() -> tuple[str, ...]:
    """Return the Pythons that may have a library: that of ``SOFTRIG_PEERS``, and this one."""
    return tuple(dict.fromkeys((os.environ.get("SOFTRIG_PEERS", sys.executable), sys.executable)))


def peer(name: str, given: Any) -> Any:
    """Run a function of `beside_peers`; None if no Python has its library."""
    result = (asked("beside_peers", name, given, python, name) for python in pythons())
    return next((one for one in result if one is not None), None)


def version(package: str) -> str:
    """Return the version of a package in the first Python that has it."""
    code = "import sys; from importlib.metadata import version; print(version(sys.argv[1]))"
    for python in pythons():
        done = subprocess.run([python, "-c", code, package], env=_environment(), capture_output=True, text=True)
        if not done.returncode:
            return done.stdout.strip()
    return ""


def run(rig: Rig) -> tuple[Signals, float]:
    """Run a rig natively with everything recorded; return its signals and the least CPU time of several runs, s."""
    topics = [(t, p.msgtype) for t, p in rig.topics.items()]
    recording = Recording(topics)
    run_inprocess(rig, 1, recording, runs=MANY)
    return Signals(recording), least(lambda: run_inprocess(rig, 1, Recording(topics), runs=MANY), 3)


def farthest(end: Any, ours: Any) -> float:
    """Return the largest distance of two end states."""
    return float(np.abs(np.asarray(end) - np.asarray(ours)).max())


def asked(script: str, name: str, given: Any, python: str, *arguments: str) -> Any:
    """Return the output of a module beside this one under another Python; None if that lacks the simulator.

    Parameters
    ----------
    script : str
        The module's name.
    name : str
        Of the simulator, for errors.
    given : any
        Plain data, handed over as JSON.

    Raises
    ------
    RuntimeError
        It fails; with the last line of what it says.
    """
    done = subprocess.run(
        [python, str(Path(__file__).with_name(f"{script}.py")), *arguments],
        input=json.dumps(given),
        text=True,
        capture_output=True,
        env=_environment(),
        check=False,
    )
    if done.returncode and "ModuleNotFoundError" in done.stderr:
        return None
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout)


def _environment() -> dict[str, str]:
    return {k: v for k, v in os.environ.items() if k not in _OURS}
