"""Rigs beside other libraries: the same input, the distance of the end states, the CPU time of both."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from softrig_control.fmu.export import export
from softrig_core import Signals, rig_of
from softrig_power.pv.module import ModuleParams, cell
from softrig_robots.urdf import read_urdf

from . import induction, machines
from .beside_grid import gupfc, rectifier
from .page import Table, Tables, show
from .peers import Row, farthest, peer, run, version
from .timing import least

STATE = ("motor/state/shaft/position", "motor/state/shaft/velocity", "motor/sensors/current_a/position")
SWITCHED = 0.5  # s of the induction motor, before the load step
FMU_RIG = """
title: The DC motor as an FMU under its sliding-mode controller
system: dc_motor
source: bench peers
duration: 3.0
nodes:
  motor_plant:
    package: softrig_control
    executable: fmu_plant
    parameters:
      period: {period}
      fmu: {path}
      isolated: false
      inputs: [motor/command/armature/effort = motor.command.armature.effort]
      outputs: [{outputs}]
  motor_reference:
    package: softrig_control
    executable: reference_source
    parameters: {{period: 0.1, velocities: [1.0]}}
    remap: {{reference: motor/reference}}
  dc_motor_smc:
    package: softrig_drives
    executable: dc_motor_smc
    parameters: {{period: {period}}}
figures: {{}}
"""


def dc_motor(library: str, allowed: float) -> Row | None:
    """The DC motor under the voltages of its sliding-mode controller."""
    rig = rig_of("dc_motor_smc")
    signals, ours = run(rig)
    plant = next(m.params for m in rig.members if m.is_plant)
    names = ("R", "L", "J", "b", "Kt", "Ke")
    with tempfile.TemporaryDirectory() as folder:
        given = {name: getattr(plant, name) for name in names}
        given |= {"fmu": str(export(rig, "dc_motor_plant", Path(folder), 2))} if library == "fmpy" else {}
        return _motor("dc_motor_smc", library, allowed, ours, given | {"period": plant.period}, signals)


def _motor(
    system: str, library: str, allowed: float, ours: float, given: dict[str, Any], signals: Signals
) -> Row | None:
    """Run the motor in a library under the recorded voltages."""
    given = given | {"voltage": signals["motor/command/armature/effort"].x.tolist(), "state": list(map(_fmi, STATE))}
    if (result := peer(library, given)) is None:
        return None
    k = len(given["voltage"]) - 1
    apart = farthest(result["end"], [signals[name].x[k] for name in STATE])
    return Row(system, f"{k} periods of held voltage", ours, result["cpu_s"], apart, allowed, "SI units")


def fmu(library: str, allowed: float) -> Row | None:
    """The DC motor as an FMU of C: as the plant of a rig, and in the library under the voltages of that rig."""
    known = rig_of("dc_motor_smc")
    period = next(m.params for m in known.members if m.is_plant).period
    with tempfile.TemporaryDirectory() as folder:
        path = str(export(known, "dc_motor_plant", Path(folder), 2))
        outputs = [*STATE, "motor/state/shaft/effort", "motor/sensors/encoder_count/position"]
        scenario = Path(folder, "motor_fmu.yaml")
        listed = ", ".join(f"{name} = {_fmi(name)}" for name in outputs)
        scenario.write_text(FMU_RIG.format(period=period, path=path, outputs=listed))
        signals, ours = run(rig_of(str(scenario)))
        return _motor("dc_motor_plant as an FMU", library, allowed, ours, {"period": period, "fmu": path}, signals)


def _fmi(signal: str) -> str:
    """Return the name of a signal in an exported FMU."""
    return signal.replace("/", ".")


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
    return Row("arm_computed_torque", work, ours, result["cpu_s"], apart, allowed, "rad, rad/s")


def pv_string(library: str, allowed: float) -> Row | None:
    """Currents of the PV string's modules at voltages of the whole curve, in four irradiances and two temperatures."""
    module = ModuleParams()
    cells = [cell(module, g, temperature) for g in (1000.0, 800.0, 600.0, 400.0) for temperature in (25.0, 60.0)]
    # Voltages for evenly spaced currents, as softrig's solver steps along the current.
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
    return Row("pv_mppt", work, ours, result["cpu_s"], apart, allowed, "A")


def drive(name: str, allowed: float) -> Row | None:
    """A field-oriented drive on its duty ratios."""
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    if (result := machines.beside(name, python, 0.5)) is None:
        return None
    work = "1 s of held duty ratios (difference: at a tolerance of 1e-11)"
    apart = max(result.current, result.speed)
    return Row(name, work, result.ours, result.theirs, apart, allowed, "A, rad/s")


def switched(library: str, allowed: float) -> Row | None:
    """The direct torque control's motor on its switching states."""
    python = os.environ.get("SOFTRIG_PEERS", sys.executable)
    tight = "motulator-tight" if library == "motulator" else library
    if (apart := induction.agreement(python, SWITCHED, tight)) is None:
        return None
    theirs = induction.peer(library, induction.switching(SWITCHED)[0], python) or {"cpu_s": np.nan}
    work = f"{SWITCHED} s of switching states"
    work += " (difference: at a tolerance of 1e-8)" if tight != library else ""
    return Row("induction_dtc", work, induction.natively(SWITCHED), theirs["cpu_s"], apart, allowed, "Wb, rad/s")


class Peer(NamedTuple):
    """A comparison: its function and what it is to run, the peer as a table names it, its package, the limit."""

    compare: Callable[[str, float], Row | None]
    name: str
    title: str
    package: str
    allowed: float


# : What is compared, and the largest difference of the end states: both solve the same equations, so only the :
# integration differs. The table has the same order.
ROWS = (
    Peer(dc_motor, "python_control", "python-control {}, `forced_response`", "control", 1e-9),
    Peer(dc_motor, "scipy_ivp", "scipy {}, `solve_ivp` at 1e-9", "scipy", 1e-7),
    Peer(dc_motor, "fmpy", "FMPy {}, softrig's plant as an FMU", "fmpy", 1e-12),
    Peer(fmu, "fmpy", "FMPy {}, without a controller", "fmpy", 1e-12),
    Peer(drive, "pmsm_foc", "motulator {}", "motulator", 1e-9),
    Peer(drive, "im_foc", "motulator {}", "motulator", 1e-9),
    Peer(drive, "im_vhz", "motulator {}", "motulator", 1e-9),
    Peer(drive, "pmsm_foc_synrm_gem", "motulator {}", "motulator", 1e-9),
    Peer(switched, "motulator", "motulator {}", "motulator", 1e-6),
    # It only has Euler's method at 50 us, which is first order.
    Peer(switched, "gym-electric-motor", "gym-electric-motor {}, Euler at 50 us", "gym_electric_motor", 5e-2),
    Peer(rectifier, "motulator_grid", "motulator {}, its grid converter", "motulator", 1e-6),
    Peer(gupfc, "pandapower", "pandapower {}, `run_timeseries`", "pandapower", 1e-8),
    Peer(pv_string, "pvlib", "pvlib {}, `i_from_v`", "pvlib", 1e-9),
    Peer(arm, "mujoco", "MuJoCo {}", "mujoco", 1e-9),
    Peer(arm, "pinocchio", "pinocchio {}, `aba`", "pin", 1e-9),
)
HEADS = ("system", "library", "the same work", "softrig, CPU s", "library, CPU s", "ratio", "difference", "allowed")


def peers() -> Tables:
    """Rigs beside peers of the same work (motulator, MuJoCo, pandapower ...): distance of the end states, CPU time.

    ``SOFTRIG_PEERS`` in the environment: an interpreter that has them.

    Raises
    ------
    RuntimeError
        A peer ended farther away than its row allows: one of the two got another input or solves other equations.
    """
    table: Table = [HEADS]
    wrong = []
    for compare, name, title, package, allowed in ROWS:
        row = compare(name, allowed)
        if row is None:
            table.append((compare.__name__, name, "not installed", *[""] * 5))
            continue
        figures = (
            f"{row.ours:.3g}",
            f"{row.theirs:.3g}",
            f"{row.theirs / row.ours:,.{1 if row.theirs < 10.0 * row.ours else 0}f}",
            f"{row.apart:.1e} {row.unit}",
        )
        table.append((f"`{row.system}`", title.format(version(package)), row.work, *figures, f"{row.allowed:.0e}"))
        if not row.apart <= row.allowed:
            wrong.append(f"{name} ends {row.apart:.3g} {row.unit} from {row.system}, expected at most {row.allowed:g}")
    if wrong:
        show(table)
        raise RuntimeError("; ".join(wrong))
    return {"peers": table}
