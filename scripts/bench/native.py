"""Native code beside a hand-written loop in C, and beside Python: ns a tick."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from softrig_core import Recording, Rig, ScenarioError, jit, rig_of, simulate
from softrig_core.block.loop import Loop
from softrig_core.native.compile import compiled, plain
from softrig_core.native.engine import Engine
from softrig_core.run.inprocess import record, wired
from softrig_drives.induction_dtc.switching import VECTORS
from softrig_drives.lsrm.plant import step

from .page import Table, Tables
from .timing import least

RIGS = (
    "dc_motor_smc",
    "dc_motor_fsfb",
    "induction_dtc",
    "lsrm_fuzzy",
    "tcp_aqm_smc",
    "rehab_impedance",
    "manipulator_adsmc",
    "gupfc",
    "pv_mppt",
)
# Scenarios with hand-written C: simulated seconds, and topics of its tables, for each tick and for each 20th tick.
LOOPS: dict[str, tuple[float, list[tuple[str, ...]]]] = {
    "dc_motor_smc": (60.0, [("motor/state", "motor/sensors", "motor/command")]),
    "induction_dtc": (
        20.0,
        [
            (
                "joint_states",
                "currents_true",
                "currents_meas",
                "flux_true",
                "dc_link",
                "switches",
                "flux_estimate",
                "torque_estimate",
            ),
            ("speed_ref", "torque_ref", "load_torque"),
        ],
    ),
}


def rates(name: str, seconds: float = 0.0) -> dict[str, float]:
    """Measure ns of CPU a tick, the least of five; the recordings of C and native code must have the same bits.

    Each is measured without a recording, with one in fresh memory pages, and with one in memory that was used before.

    Parameters
    ----------
    name : str
        One of `LOOPS`.
    seconds : float
        Simulated; 0: those of `LOOPS`.

    Raises
    ------
    ScenarioError
        It is not.
    """
    usual, tables = LOOPS[name]
    rig = rig_of(name, duration=seconds or usual)
    members = [m for m in rig.members if m.outputs]
    blocks: dict[str, Any] = {m.name: m.block(rig.scenario.seed) for m in members}
    sizes = [sum(rig.topics[topic].size for topic in topics) for topics in tables]
    counts = [rig.ticks, -(-rig.ticks // 20)][: len(tables)]

    def native(recorded: bool) -> Recording:
        recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
        steps = wired(rig, {m.name: m.block(rig.scenario.seed) for m in members})
        if recorded:
            record(rig, steps, recording)
        for _ in Engine(list(steps.values())).run():
            pass
        for one in steps.values():
            # Otherwise the cycle through the link would keep the memory of the recording.
            one.link = None
        if not steps[members[0].name].native[0]:
            raise ScenarioError(f"not native: {steps[members[0].name].native[1]}")
        return recording

    loop = _built(name)
    loop.restype = ctypes.c_double
    constants = np.array(_motor(blocks) if name == "dc_motor_smc" else _drive(blocks))

    def by_hand(recorded: bool) -> Any:
        result = [np.empty((count, size)) for count, size in zip(counts, sizes, strict=True)]
        draws = [blocks["im_plant"].uniform.first(2 * rig.ticks + 8192)] if "im_plant" in blocks else []
        places = [ctypes.c_void_p(x.ctypes.data) for x in (constants, *draws)]
        places += [ctypes.c_void_p(x.ctypes.data if recorded else None) for x in result]
        loop(ctypes.c_long(rig.ticks), *places)
        return result

    recording = native(True)
    for topics, count, table in zip(tables, counts, by_hand(True), strict=True):
        columns = [recording.topics[topic].columns() for topic in topics]
        if np.hstack([c.values[:count] for c in columns if c is not None]).tobytes() != table.tobytes():
            raise ScenarioError(f"{name}: C by hand gives other bits")
    result = {}
    for recorded, fresh in ((False, False), (True, True), (True, False)):
        for how, f in (("C by hand", by_hand), ("native", native)):
            what = f"{how}{', recorded' if recorded else ''}{', fresh pages' if fresh else ''}"
            result[what] = least(lambda f=f, r=recorded: f(r), fresh=fresh) / rig.ticks * 1e9  # type: ignore[misc]
    return result


def _built(name: str, *flags: str) -> Any:
    """Build a hand-written loop in C."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "loop.so"
        code = Path(__file__).with_name(f"{name}.c")
        subprocess.run(
            ["gcc", "-O2", *flags, "-ffp-contract=off", "-shared", "-fPIC", str(code), "-o", str(library), "-lm"],
            check=True,
        )
        return ctypes.CDLL(str(library)).loop


def core_rates() -> dict[str, float]:
    """Measure ns of CPU a tick of the linear motor's plant under the voltages of a run, compiled and in hand-written C.

    C has several such runs in one loop, too, each a lane; of two ways to compile it the faster one counts.

    Raises
    ------
    ScenarioError
        The two give other bits.
    """
    run = simulate("lsrm_fuzzy")
    columns = run.recording.topics["phase_voltage"].columns()
    assert columns is not None
    u = np.ascontiguousarray(columns.values[: run.rig.ticks])
    plant: Any = run.blocks["lsrm_plant"].block
    limit, *constants, _ = plant._constants.tolist()
    result, c = np.empty((len(u), 6)), np.array([limit, *constants])
    rates = {"native": least(lambda: _driven(u, plant._geometry, plant._constants, result)) / len(u) * 1e9}
    for lanes in (1, 2, 4):
        wanted = np.empty((len(u), lanes, 6))
        places = [ctypes.c_void_p(x.ctypes.data) for x in (plant._geometry, c, u, wanted)]
        loops = [_built("lsrm_plant", f"-DLANES={lanes}", *flags) for flags in ((), ("-O3", "-march=native"))]
        times = [least(lambda loop=loop, to=places: loop(ctypes.c_long(len(u)), *to)) for loop in loops]  # type: ignore[misc]
        rates[f"C by hand, {lanes} a loop"] = min(times) / len(u) / lanes * 1e9
        if any(wanted[:, k].tobytes() != result.tobytes() for k in range(lanes)):
            raise ScenarioError("lsrm_plant: C by hand gives other bits")
    return rates


@jit
def _driven(u: Any, geometry: Any, constants: Any, rows: Any) -> None:
    state = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for n in range(len(u)):
        state = step(state, (u[n, 0], u[n, 1], u[n, 2], u[n, 3]), (0.0, 0.0), False, geometry, constants)
        for k in range(6):
            rows[n, k] = state[k]


def _motor(blocks: dict[str, Any]) -> list[float]:
    plant, law = blocks["dc_motor_plant"], blocks["dc_motor_smc"]
    r = blocks["motor_reference"].p.velocities[0]
    gain = (law._k_per_ref * abs(r) if law._k is None else law._k) / law._gain
    return [plant.p.Kt, plant._counts_per_rad, law._wd_i, law._wd_w, law._c, gain, law._w_gain, law._wd_gain,
            law._delta, r, plant.p.load_torques[0], *plant._whole]  # fmt: skip


def _drive(blocks: dict[str, Any]) -> list[float]:
    plant, law, pid = blocks["im_plant"], blocks["dtc_controller"], blocks["speed_controller"]._pid
    convert, p = plant._convert, law.p
    speed, load = blocks["speed_source"].p, blocks["load_source"].p
    return [*plant._constants, convert._q, convert._shift, convert._p_d, plant.p.U_dc,
            blocks["speed_controller"]._rise, pid._kp, pid._ki_ts, pid._limit, blocks["speed_controller"].p.u_max,
            law._estimator._half_R_s, p.flux_ramp, p.flux_ref, p.flux_band, p.torque_band, speed.velocities[1],
            speed.times[1], load.values[1], load.times[1], p.magnetising_time, plant.p.trip_current,
            *(leg for vector in VECTORS for leg in vector),
            *(x for u in law._unit for x in (u.real, u.imag))]  # fmt: skip


def tables() -> Tables:
    """Native code beside hand-written C, then rigs beside Python, ns of CPU a tick; needs gcc."""
    results = {name: rates(name) for name in LOOPS}
    loops: Table = [("ns a tick", *(cell for name in LOOPS for cell in (name, "of C")))]
    for how in results["dc_motor_smc"]:
        ours = [(results[name][how], results[name][how.replace("native", "C by hand")]) for name in LOOPS]
        loops.append((how, *(cell for ns, c in ours for cell in (f"{ns:.1f}", f"{ns / c:.2f}"))))
    core: Table = [("plant of lsrm_fuzzy", "ns a tick"), *((how, f"{ns:.0f}") for how, ns in core_rates().items())]
    ticks: Table = [("rig", "ticks", "Python, tick by tick", "Python, generated text of the rig", "native", "times")]
    for name in RIGS:
        rig = rig_of(name)
        one, text, compiled_ = (ns_of(rig, make) for make in (None, plain, compiled))
        ticks.append(
            (name, f"{rig.ticks:,}", f"{one:,.0f}", f"{text:,.0f}", f"{compiled_:,.0f}", f"{one / compiled_:.1f}")
        )
    return {"native loops": loops, "native core": core, "native rigs": ticks}


def ns_of(rig: Rig, make: Any) -> float:
    """Measure ns of CPU a tick of a whole run, everything recorded, observers in the rig; the least of five.

    Parameters
    ----------
    rig : Rig
    make : callable or None
        As for `Engine`; None: members answer one by one.
    """

    def run() -> None:
        recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
        steps = wired(rig, {m.name: m.block(rig.scenario.seed) for m in rig.members})
        record(rig, steps, recording)
        members = list(steps.values())
        for _ in Loop(members).run() if make is None else Engine(members, make).run():
            pass

    return least(run) / rig.ticks * 1e9
