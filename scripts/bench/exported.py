"""Exported C beside hand-written C and native code; FMUs without Python beside those with it."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from softrig_control.fmu.export import export
from softrig_core import ScenarioError, rig_of
from softrig_core.export.check import FLAGS
from softrig_core.export.command import export_c, export_rig
from softrig_core.export.golden import member_of

from . import native
from .console import console
from .timing import least

ROUNDS = 50  # many rounds of some ms, because on a busy machine the least of a few is too large
TICKS = 100_000
STEPS = 20_000
RIG = """
#include "{n}.h"
static {n} rig;
SHOWN void run(long ticks);
void run(long ticks)
{{
    {n}_init(&rig);
    while (ticks-- > 0) {{
        (void){n}_step(&rig);
    }}
}}
"""
PLANT = """
#include "lsrm_plant.h"
static lsrm_plant node;
static lsrm_plant_in in;
SHOWN void run(long ticks);
void run(long ticks)
{
    lsrm_plant_init(&node, NULL);
    in.voltage[0] = 10;
    for (long k = 0; k < ticks; k++) {
        (void)lsrm_plant_advance(&node, &in, k * 50000);
    }
}
"""
LAW = """
#include "dc_motor_smc.h"
#define ROWS 4096
static dc_motor_smc node;
static double r[ROWS], w[ROWS], i[ROWS], u[ROWS];
static const double c[8] = { WD_I, WD_W, C, K_PER_REF, GAIN, W_GAIN, WD_GAIN, DELTA };
SHOWN void run(long ticks);
SHOWN void by_hand(long ticks);
SHOWN double last(void);
static void fill(void)
{
    for (int k = 0; k < ROWS; k++) {
        r[k] = REFERENCE;
        w[k] = 0.005 * k;
        i[k] = 0.1 + 0.001 * (k % 100);
    }
}
double last(void) { return u[7]; }
void run(long ticks)
{
    dc_motor_smc_in in = { .has_reference = true };
    dc_motor_smc_out out;
    fill();
    dc_motor_smc_init(&node, NULL);
    for (long k = 0; k < ticks; k++) {
        in.reference[0] = r[k % ROWS];
        in.state[0] = w[k % ROWS];
        in.sensors[1] = i[k % ROWS];
        (void)dc_motor_smc_step(&node, &in, &out, k * 10000000);
        u[k % ROWS] = out.command[0];
    }
}
void by_hand(long ticks)
{
    double size = REFERENCE;
    fill();
    for (long k = 0; k < ticks; k++) {
        const double v = w[k % ROWS], wd = c[0] * i[k % ROWS] - c[1] * v, s = c[2] * (r[k % ROWS] - v) - wd;
        size = r[k % ROWS] != 0.0 ? fabs(r[k % ROWS]) : size; /* a set point of 0 keeps the gain of the last one */
        u[k % ROWS] = c[5] * v + c[6] * wd + c[3] * size / c[4] * (s != 0.0 ? s / (fabs(s) + c[7]) : 0.0);
    }
}
"""
# A separate process, because a Python process can load PythonFMU's library only once.
STEP = """
import ctypes, json, sys, time, fmpy
from fmpy.fmi2 import FMU2Slave
path, steps = sys.argv[1], int(sys.argv[2])
about = fmpy.read_model_description(path)
h = float(about.defaultExperiment.stepSize)
fmu = FMU2Slave(guid=about.guid, unzipDirectory=fmpy.extract(path), instanceName="x",
                modelIdentifier=about.coSimulation.modelIdentifier)
fmu.instantiate(); fmu.setupExperiment(startTime=0.0)
fmu.enterInitializationMode(); fmu.exitInitializationMode()
run = ctypes.CDLL(sys.argv[3]).run
begin = time.process_time()
failed = run(fmu.dll.fmi2DoStep, ctypes.c_void_p(fmu.component), ctypes.c_long(steps), ctypes.c_double(h))
print((time.process_time() - begin) / steps * 1e9 if not failed else "a step failed")
"""
LOOP = """
int run(int (*step)(void *, double, double, int), void *c, long steps, double h);
int run(int (*step)(void *, double, double, int), void *c, long steps, double h)
{
    int failed = 0;
    for (long k = 0; k < steps; k++) {
        failed |= step(c, (double)k * h, h, 1);
    }
    return failed;
}
"""


def rig_rate(name: str) -> float:
    """Measure ns of CPU a tick of an exported rig."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        done, _ = export_rig(rig_of(name), place, rows=2000)
        sources = [f"{done.name}.c", *json.loads((place / f"{done.name}.json").read_text())["sources"]]
        return _rate(place, RIG.format(n=done.name), sources)


def plant_rate() -> float:
    """Measure ns of CPU a period of the linear motor's exported plant."""
    with tempfile.TemporaryDirectory() as folder:
        export_c(rig_of("lsrm_fuzzy"), "lsrm_plant", Path(folder), rows=1000, drawn=200)
        port = next(p for p in rig_of("lsrm_fuzzy").members[0].inputs).name
        return _rate(Path(folder), PLANT.replace("in.voltage", f"in.{port}"), ["lsrm_plant.c"])


def law_rates() -> tuple[float, float]:
    """Measure ns of CPU a tick of the sliding mode controller: in hand-written C, and exported.

    Raises
    ------
    ScenarioError
        The two give other bits.
    """
    rig = rig_of("dc_motor_smc")
    law: Any = member_of(rig, "dc_motor_smc").block(rig.scenario.seed)
    values = (law._wd_i, law._wd_w, law._c, law._k_per_ref, law._gain, law._w_gain, law._wd_gain, law._delta, 10.0)
    names = ("WD_I", "WD_W", "C", "K_PER_REF", "GAIN", "W_GAIN", "WD_GAIN", "DELTA", "REFERENCE")
    head = "".join(f"#define {name} {value!r}\n" for name, value in zip(names, values, strict=True))
    with tempfile.TemporaryDirectory() as folder:
        export_c(rig, "dc_motor_smc", Path(folder), rows=500, drawn=100)
        library = _built(Path(folder), head + LAW, ["dc_motor_smc.c"])
    library.last.restype = ctypes.c_double
    results, answers = [], []
    for run in (library.by_hand, library.run):
        results.append(least(lambda run=run: run(ctypes.c_long(TICKS)), ROUNDS) / TICKS * 1e9)  # type: ignore[misc]
        answers.append(library.last())
    if answers[0] != answers[1]:
        raise ScenarioError(f"the sliding mode law: C by hand gives {answers[0]!r}, exported {answers[1]!r}")
    return results[0], results[1]


def _rate(place: Path, driver: str, sources: list[str]) -> float:
    run = _built(place, driver, sources).run
    return least(lambda: run(ctypes.c_long(TICKS)), ROUNDS) / TICKS * 1e9


def _built(place: Path, driver: str, sources: list[str]) -> Any:
    shown = '#define SHOWN __attribute__((visibility("default")))\n#include <stddef.h>\n'
    (place / "driver.c").write_text(shown + driver)
    command = [
        "gcc",
        *FLAGS,
        "-flto",
        "-fvisibility=hidden",
        "-shared",
        "-fPIC",
        "-o",
        "driver.so",
        "driver.c",
        *sources,
        "-lm",
    ]
    subprocess.run(command, cwd=place, check=True)
    return ctypes.CDLL(str(place / "driver.so"))


def fmu_rates(node: str) -> tuple[float, float]:
    """Measure ns of CPU a step of `doStep`, of an FMU with Python and of one without, called from C's interface."""
    results = []
    for kind in (0, 2):
        with tempfile.TemporaryDirectory() as folder:
            path = export(rig_of("dc_motor_smc"), node, Path(folder), kind)
            (Path(folder) / "loop.c").write_text(LOOP)
            library = str(Path(folder) / "loop.so")
            build = ["gcc", "-O2", "-shared", "-fPIC", "-o", library, "loop.c"]
            subprocess.run(build, cwd=folder, check=True)
            command = [sys.executable, "-c", STEP, str(path), str(STEPS), library]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            results.append(float(done.stdout.split()[-1]))
    return results[0], results[1]


def print_law() -> None:
    """Exported controller beside hand-written C, ns of CPU a tick."""
    _row("law of dc_motor_smc", *law_rates())


def print_rigs() -> None:
    """Exported rigs beside hand-written C and native code, ns of CPU a tick."""
    for name in native.LOOPS:
        known = native.rates(name)
        _row(f"rig {name}", known["C by hand"], rig_rate(name), known["native"])


def print_plant() -> None:
    """Exported plant of the linear motor beside hand-written C and native code, ns of CPU a period."""
    core = native.core_rates()
    _row("plant of lsrm_fuzzy", core["C by hand, 1 a loop"], plant_rate(), core["native"])


def print_fmus() -> None:
    """FMUs with and without Python, ns of CPU a step."""
    for node in ("dc_motor_plant", "dc_motor_smc"):
        python, plain = fmu_rates(node)
        console.print(f"FMU of {node}: with Python {python:,.0f}, without {plain:,.0f} ({python / plain:,.0f} times)")


def _row(name: str, by_hand: float, own: float, native: float | None = None) -> None:
    known = "" if native is None else f", native {native:.1f}"
    console.print(f"{name}: C by hand {by_hand:.1f}, exported {own:.1f} ({own / by_hand:.2f} of it){known}")
