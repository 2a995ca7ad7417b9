"""Exported C beside C by hand and native code; FMUs without Python beside those with it."""

from __future__ import annotations

import ctypes
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.table import Table
from softrig_control.fmu.export import export
from softrig_core import rig_of
from softrig_core.export.command import export_c, export_rig

from . import native
from .console import console
from .timing import least

TICKS = 100_000
STEPS = 20_000
RIG = """
#include "{n}.h"
static {n} rig;
void run(long ticks);
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
void run(long ticks);
void run(long ticks)
{
    lsrm_plant_init(&node, NULL);
    in.voltage[0] = 10;
    for (long k = 0; k < ticks; k++) {
        (void)lsrm_plant_advance(&node, &in, k * 50000);
    }
}
"""
# in a process of its own: PythonFMU's library can be loaded into a Python process once only
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


def _rate(place: Path, driver: str, sources: list[str]) -> float:
    (place / "driver.c").write_text("#include <stddef.h>\n" + driver)
    command = ["gcc", "-O2", "-flto", "-ffp-contract=off", "-shared", "-fPIC", "-o", "driver.so", "driver.c", *sources]
    subprocess.run([*command, "-lm"], cwd=place, check=True)
    run = ctypes.CDLL(str(place / "driver.so")).run
    return least(lambda: run(ctypes.c_long(TICKS))) / TICKS * 1e9


def fmu_rates(node: str) -> tuple[float, float]:
    """Measure ns of CPU a step of `doStep`, of an FMU with Python and of one without, called from C's interface."""
    found = []
    for kind in (0, 2):
        with tempfile.TemporaryDirectory() as folder:
            path = export(rig_of("dc_motor_smc"), node, Path(folder), kind)
            (Path(folder) / "loop.c").write_text(LOOP)
            library = str(Path(folder) / "loop.so")
            build = ["gcc", "-O2", "-shared", "-fPIC", "-o", library, "loop.c"]
            subprocess.run(build, cwd=folder, check=True)
            command = [sys.executable, "-c", STEP, str(path), str(STEPS), library]
            done = subprocess.run(command, check=True, capture_output=True, text=True)
            found.append(float(done.stdout.split()[-1]))
    return found[0], found[1]


def print_table() -> None:
    """Exported C beside C by hand and native code, ns of CPU a tick; FMUs with and without Python, ns a step."""
    table = Table("loop", "C by hand", "native", "exported C", "exported / by hand", box=None, pad_edge=False)
    for name in native.LOOPS:
        known, own = native.rates(name), rig_rate(name)
        by_hand = known["C by hand"]
        table.add_row(name, f"{by_hand:.1f}", f"{known['native']:.1f}", f"{own:.1f}", f"{own / by_hand:.2f}")
    core, own = native.core_rates(), plant_rate()
    by_hand = core["C by hand, 1 a loop"]
    table.add_row("lsrm_plant", f"{by_hand:.1f}", f"{core['native']:.1f}", f"{own:.1f}", f"{own / by_hand:.2f}")
    console.print(table)
    table = Table("FMU, a step", "with Python", "without", "times", box=None, pad_edge=False)
    for node in ("dc_motor_plant", "dc_motor_smc"):
        python, plain = fmu_rates(node)
        table.add_row(node, f"{python:,.0f}", f"{plain:,.0f}", f"{python / plain:,.0f}")
    console.print(table)
