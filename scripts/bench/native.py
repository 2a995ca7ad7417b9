"""Native code beside a loop written in C by hand, and beside Python: ns a tick."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table
from softrig_core import Recording, Rig, ScenarioError, rig_of
from softrig_core.block.runner import Runner
from softrig_core.native.compile import compiled, plain
from softrig_core.native.engine import Engine
from softrig_core.run.inprocess import record, wired

from .console import console
from .timing import least

SECONDS = 60.0  # simulated
RIGS = ("dc_motor_smc", "dc_motor_fsfb", "induction_dtc", "lsrm_fuzzy", "tcp_aqm_smc", "rehab_impedance",
        "manipulator_adsmc")  # fmt: skip
CODE = Path(__file__).with_name("dc_motor_smc.c")


def rates(seconds: float = SECONDS) -> dict[str, float]:
    """Measure ns of CPU a tick, the least of five; what C and native code record must be the same bits.

    Raises
    ------
    ScenarioError
        It is not.
    """
    rig = rig_of("dc_motor_smc", duration=seconds)
    members = [m for m in rig.members if m.outputs]

    def native(recorded: bool) -> Recording:
        recording = Recording((topic, port.msgtype) for topic, port in rig.topics.items())
        steps = wired(rig, {m.name: m.block(rig.scenario.seed) for m in members})
        if recorded:
            record(rig, steps, recording)
        for _ in Engine(list(steps.values())).run():
            pass
        if not steps["dc_motor_plant"].native[0]:
            raise ScenarioError(f"not native: {steps['dc_motor_plant'].native[1]}")
        return recording

    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "loop.so"
        subprocess.run(["gcc", "-O2", "-ffp-contract=off", "-shared", "-fPIC", str(CODE), "-o", str(library), "-lm"],
                       check=True)  # fmt: skip
        loop: Any = ctypes.CDLL(str(library)).loop
    loop.restype, loop.argtypes = ctypes.c_double, [ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    constants = np.array(_constants({m.name: m.block(0) for m in members}))

    def by_hand(recorded: bool) -> Any:
        rows = np.empty((rig.ticks, 6)) if recorded else None
        loop(rig.ticks, constants.ctypes.data, None if rows is None else rows.ctypes.data)
        return rows

    columns = [native(True).topics[t].columns() for t in ("motor/state", "motor/sensors", "motor/command")]
    found = np.hstack([c.values[: rig.ticks] for c in columns if c is not None])
    if found.tobytes() != by_hand(True).tobytes():
        raise ScenarioError("C by hand gives other bits")
    return {
        f"{name}{', recorded' if recorded else ''}": least(lambda f=f, r=recorded: f(r)) / rig.ticks * 1e9  # type: ignore[misc]
        for recorded in (False, True) for name, f in (("C by hand", by_hand), ("native", native))
    }  # fmt: skip


def _constants(blocks: dict[str, Any]) -> list[float]:
    plant, law = blocks["dc_motor_plant"], blocks["dc_motor_smc"]
    r = blocks["motor_reference"].p.velocities[0]
    gain = (law._k_per_ref * abs(r) if law._k is None else law._k) / law._gain
    return [plant.p.Kt, plant._counts_per_rad, law._wd_i, law._wd_w, law._c, gain, law._w_gain, law._wd_gain,
            law._delta, r, plant.p.load_torques[0], *plant._whole]  # fmt: skip


def print_table() -> None:
    """Native code of dc_motor_smc beside C by hand, then of rigs beside Python, ns of CPU a tick; needs gcc."""
    table = Table("loop", "ns a tick", box=None, pad_edge=False)
    for name, ns in rates().items():
        table.add_row(name, f"{ns:.1f}")
    console.print(table)
    table = Table("rig", "ticks", "one by one", "one text in Python", "native", "times", box=None, pad_edge=False)
    for name in RIGS:
        rig = rig_of(name)
        one, text, compiled_ = (ns_of(rig, make) for make in (None, plain, compiled))
        table.add_row(
            name, f"{rig.ticks:,}", f"{one:,.0f}", f"{text:,.0f}", f"{compiled_:,.0f}", f"{one / compiled_:.1f}"
        )
    console.print(table)


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
        for _ in Runner(members).run() if make is None else Engine(members, make).run():
            pass

    return least(run) / rig.ticks * 1e9
