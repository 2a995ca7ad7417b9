"""CPU time of one simulated second of the drive, beside the same second in other simulators."""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Callable, Mapping

import numpy as np
from softrig_core import Recording, Rig, Signals, load_scenario, rig_of, run_inprocess

from .induction_peers import LEGS
from .page import Table, Tables
from .peers import MANY, asked
from .timing import cpu

ROUNDS = 3
PEERS = {
    "motulator": "motulator, fed our switching, rtol 1e-3",
    "motulator-tight": "motulator, fed our switching, rtol 1e-8",
    "gym-electric-motor": "gym-electric-motor, fed our switching, Euler",
}


def drive(seconds: float) -> Rig:
    """Return the headline scenario, its duration changed."""
    return rig_of(load_scenario("induction_dtc").model_copy(update={"duration": seconds}))


def switching(seconds: float) -> tuple[list[int], Signals]:
    """Run the headline scenario; return the number of the voltage vector of every period, and the signals."""
    rig = drive(seconds)
    recording = Recording((t, p.msgtype) for t, p in rig.topics.items())
    run_inprocess(rig, 1, recording)
    signals = Signals(recording)
    legs = np.column_stack([signals[f"switches/{leg}/effort"].x for leg in ("Sa", "Sb", "Sc")]).astype(int)
    return [LEGS.index(tuple(row)) for row in legs.tolist()], signals


def peer(name: str, vectors: list[int], python: str = sys.executable) -> Mapping[str, float] | None:
    """Run one case of `induction_peers` with the given Python.

    Returns
    -------
    mapping or None
        What it printed; None when that Python does not have the simulator.
    """
    result: dict[str, float] | None = asked("induction_peers", name, vectors, python, name)
    return result


def agreement(python: str = sys.executable, seconds: float = 0.75, name: str = "motulator-tight") -> float | None:
    """Return how far a peer ends from ours under the same switching: stator flux in Wb or speed in rad/s.

    The larger of the two; None where the peer is not installed.
    """
    vectors, signals = switching(seconds)
    result = peer(name, vectors, python)
    if result is None:
        return None
    k = round(result["periods"])
    psi = [signals[f"flux_true/{axis}"].x[k] for axis in "xy"]
    speed = signals["joint_states/shaft/velocity"].x[k]
    flux = np.hypot(psi[0] - result["psi_alpha"], psi[1] - result["psi_beta"])
    return max(float(flux), abs(float(speed) - result["speed"]))


def simulated_second(python: str = sys.executable) -> dict[str, float | None]:
    """Measure the CPU time (s) of one simulated second, start-up left out.

    Parameters
    ----------
    python : str
        Interpreter that may have motulator and gym-electric-motor; they are optional.

    Returns
    -------
    dict of str to float or None
        By case, ours first; None where a simulator is not installed.
    """
    rig = drive(1.0)
    topics = [(t, p.msgtype) for t, p in rig.topics.items()]
    results: dict[str, float | None] = {
        "softrig in process": _median(lambda: run_inprocess(rig, 1)),
        "softrig in process, everything recorded": _median(lambda: run_inprocess(rig, 1, Recording(topics))),
        "softrig natively, everything recorded": natively(1.0),
    }
    vectors, _ = switching(1.0)
    for name, title in PEERS.items():
        result = peer(name, vectors, python)
        results[title] = None if result is None else result["cpu_s"]
    return results


def natively(seconds: float) -> float:
    """Return the CPU time (s) of a run of many, by native code that is there, with its wiring."""
    rig = drive(seconds)
    topics = [(t, p.msgtype) for t, p in rig.topics.items()]
    run_inprocess(rig, 1, Recording(topics), runs=MANY)
    return _median(lambda: run_inprocess(rig, 1, Recording(topics), runs=MANY))


def _median(call: Callable[[], object]) -> float:
    return statistics.median(cpu(call) for _ in range(ROUNDS))


def table() -> Tables:
    """One simulated second of the induction motor drive beside motulator and gym-electric-motor, where installed.

    ``SOFTRIG_PEERS`` in the environment: an interpreter that has them.
    """
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    results = simulated_second(python)
    ours = results["softrig natively, everything recorded"] or 0.0
    rows: Table = [("one simulated second of the drive", "CPU s", "times", "difference after 0.5 s, Wb or rad/s")]
    for name, seconds in results.items():
        tight = {"motulator-tight": PEERS["motulator-tight"], "gym-electric-motor": PEERS["gym-electric-motor"]}
        apart = next((agreement(python, 0.5, peer) for peer, title in tight.items() if title == name), None)
        figures = ("not installed", "") if seconds is None else (f"{seconds:.4f}", f"{seconds / ours:,.1f}")
        rows.append((name, *figures, "" if apart is None else f"{apart:.1e}"))
    return {"induction": rows}
