"""Rigs beside other libraries: the same input, the distance of the end states, the CPU time of both."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table
from softrig_core import Recording, Rig, Signals, rig_of, run_inprocess
from softrig_power.pv.module import ModuleParams, cell
from softrig_robots.urdf import read_urdf

from . import induction, machines
from .console import console
from .induction import MANY
from .peers import asked
from .timing import least

SWITCHED = 0.5  # s of the induction motor, before its load comes


class Row(NamedTuple):
    """A system beside a peer; CPU in s of the same work, distance of the end states in a unit and its limit."""

    system: str
    peer: str
    work: str
    ours: float
    theirs: float
    apart: float
    allowed: float
    unit: str


def run(rig: Rig) -> tuple[Signals, float]:
    """Run a rig natively with everything recorded; return its signals and the least CPU time of several runs, s."""
    topics = [(t, p.msgtype) for t, p in rig.topics.items()]
    recording = Recording(topics)
    run_inprocess(rig, 1, recording, runs=MANY)
    return Signals(recording), least(lambda: run_inprocess(rig, 1, Recording(topics), runs=MANY), 3)


def peer(name: str, given: Any) -> Any:
    """Run a function of `beside_peers` with the Python of ``SOFTRIG_PEERS``, else with ours; None if both lack it."""
    pythons = dict.fromkeys((os.environ.get("SOFTRIG_PEERS", sys.executable), sys.executable))
    result = (asked("beside_peers", name, given, python, name) for python in pythons)
    return next((one for one in result if one is not None), None)


def farthest(end: Any, ours: Any) -> float:
    """Return the largest distance of two end states."""
    return float(np.abs(np.asarray(end) - np.asarray(ours)).max())


def dc_motor(library: str, allowed: float) -> Row | None:
    """The DC motor under the voltages of its sliding-mode controller."""
    rig = rig_of("dc_motor_smc")
    signals, ours = run(rig)
    plant = next(m.params for m in rig.members if m.is_plant)
    names = ("R", "L", "J", "b", "Kt", "Ke")
    given = {name: getattr(plant, name) for name in names} | {"period": plant.period}
    given["voltage"] = signals["motor/command/armature/effort"].x.tolist()
    if (result := peer(library, given)) is None:
        return None
    k = len(given["voltage"]) - 1
    state = [signals[f"motor/state/shaft/{field}"].x[k] for field in ("position", "velocity")]
    state.append(signals["motor/sensors/current_a/position"].x[k])
    work = f"{k} periods of held voltage"
    return Row(
        "dc_motor_smc", library, work, ours, result["cpu_s"], farthest(result["end"], state), allowed, "SI units"
    )


def arm(library: str, allowed: float) -> Row | None:
    """The two-link arm under the torques of its controller."""
    rig = rig_of("arm_computed_torque")
    signals, ours = run(rig)
    plant: Any = next(m.params for m in rig.members if m.is_plant)  # parameters of arm_plant
    joints = plant.joints
    torques = np.column_stack([signals[f"joint_torques/{joint}/effort"].x for joint in joints])[:-1]
    given = {
        "urdf": read_urdf(plant.urdf),
        "step": plant.period / plant.substeps,
        "substeps": plant.substeps,
        "torques": torques.tolist(),
        "q": plant.each("position"),
        "v": plant.each("velocity"),
    }
    if (result := peer(library, given)) is None:
        return None
    fields = [f"joint_states/{joint}/{field}" for field in ("position", "velocity") for joint in joints]
    state = [signals[name].x[len(torques)] for name in fields]
    work = f"{len(torques)} periods of held torque, Runge-Kutta of the same step"
    apart = farthest(result["end"], state)
    return Row("arm_computed_torque", library, work, ours, result["cpu_s"], apart, allowed, "rad, rad/s")


def pv_string(library: str, allowed: float) -> Row | None:
    """Currents of the PV string's modules at voltages of the whole curve, in four irradiances and two temperatures."""
    module = ModuleParams()
    cells = [cell(module, g, temperature) for g in (1000.0, 800.0, 600.0, 400.0) for temperature in (25.0, 60.0)]
    # Voltages that belong to even currents, because our solver goes along the current.
    currents = [np.linspace(0.0, 0.95 * one.I_ph, 2500) for one in cells]
    voltages: list[Any] = []

    def solve() -> None:
        result = zip(cells, currents, strict=True)
        voltages[:] = [one.junction(current)[0] - one.R_s * current for one, current in result]

    ours = least(solve, 3)
    given = {
        name: np.repeat([getattr(one, name) for one in cells], len(currents[0])).tolist()
        for name in ("I_ph", "I_0", "R_s", "R_p", "aV_t")
    } | {"V": np.concatenate(voltages).tolist()}
    if (result := peer(library, given)) is None:
        return None
    apart = farthest(result["end"], np.concatenate(currents))
    work = f"{len(given['V'])} points of the single-diode equation"
    return Row("pv_mppt", library, work, ours, result["cpu_s"], apart, allowed, "A")


def drive(name: str, allowed: float) -> Row | None:
    """A field-oriented drive on its duty ratios."""
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    if (result := machines.beside(name, python, 0.5)) is None:
        return None
    work = "a second of held duty ratios (distance: at a tolerance of 1e-11)"
    apart = max(result.current, result.speed)
    return Row(name, "motulator", work, result.ours, result.theirs, apart, allowed, "A, rad/s")


def switched(library: str, allowed: float) -> Row | None:
    """The direct torque control's motor on its switching states."""
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    tight = "motulator-tight" if library == "motulator" else library
    if (apart := induction.agreement(python, SWITCHED, tight)) is None:
        return None
    theirs = induction.peer(library, induction.switching(SWITCHED)[0], python) or {"cpu_s": np.nan}
    work = f"{SWITCHED} s of switching states (motulator's distance: at a tolerance of 1e-8)"
    return Row(
        "induction_dtc", library, work, induction.natively(SWITCHED), theirs["cpu_s"], apart, allowed, "Wb, rad/s"
    )


#: What is compared, and how far apart the end states may be: both solve the same equations, so only the integration
#: differs. Its order is that of the table.
ROWS: tuple[tuple[Callable[[str, float], Row | None], str, float], ...] = (
    (dc_motor, "python_control", 1e-9),
    (dc_motor, "scipy_ivp", 1e-7),
    (drive, "pmsm_foc", 1e-9),
    (drive, "im_foc", 1e-9),
    (drive, "im_vhz", 1e-9),
    (drive, "pmsm_foc_synrm_gem", 1e-9),
    (switched, "motulator", 1e-6),
    # It has Euler's method at 50 us only, which is first order.
    (switched, "gym-electric-motor", 5e-2),
    (pv_string, "pvlib", 1e-9),
    (arm, "mujoco", 1e-9),
    (arm, "pinocchio", 1e-9),
)


def print_table() -> None:
    """Rigs beside peers of the same work (motulator, MuJoCo, pvlib ...): distance of the end states, CPU time.

    ``SOFTRIG_PEERS`` in the environment: an interpreter that has them.

    Raises
    ------
    RuntimeError
        A peer ended farther away than its row allows: one of the two got another input or solves other equations.
    """
    table = Table("system", "peer", "the same work", "ours, CPU s", "theirs", "times", "apart by", "allowed")
    wrong = []
    for compare, name, allowed in ROWS:
        row = compare(name, allowed)
        if row is None:
            table.add_row(compare.__name__, name, "not installed", *[""] * 5)
            continue
        figures = (
            f"{row.ours:.3g}",
            f"{row.theirs:.3g}",
            f"{row.theirs / row.ours:.3g}",
            f"{row.apart:.1e} {row.unit}",
        )
        table.add_row(row.system, row.peer, row.work, *figures, f"{row.allowed:.0e}")
        if not row.apart <= row.allowed:
            wrong.append(
                f"{row.peer} ends {row.apart:.3g} {row.unit} from {row.system}, expected at most {row.allowed:g}"
            )
    console.print(table)
    if wrong:
        raise RuntimeError("; ".join(wrong))
