"""The Reference FMUs of the Modelica Association, or any others, beside FMPy's own simulation of them.

None is committed: SOFTRIG_REFERENCE_FMUS names the folder where a build has unpacked them, with folders of versions.
"""

import math
import os
from pathlib import Path

import numpy as np
import pytest

fmpy = pytest.importorskip("fmpy")
# ruff: noqa: E402
from softrig_control.fmu.description import describe
from softrig_control.fmu.nodes import FmuPlant
from softrig_core import ByHand, RunError

FOLDER = Path(os.environ.get("SOFTRIG_REFERENCE_FMUS", "/usr/share/reference-fmus"))
SMOOTH = ("Dahlquist", "VanDerPol")
UNITS = sorted(FOLDER.rglob("*.fmu"))

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not UNITS, reason=f"no Reference FMUs in {FOLDER}; SOFTRIG_REFERENCE_FMUS names their folder"),
]


def outputs_of(unit):
    """Scalars that a channel can carry."""
    found = [v for v in unit.variables.values() if v.causality == "output" and v.kind not in ("", "String")]
    return [v.name for v in found if not v.dims]


def stepped(path, names, period, ticks, **given):
    outputs = tuple(f"y{k}/x/position = {name}" for k, name in enumerate(names))
    plant = ByHand(FmuPlant(name="unit", fmu=str(path), period=period, outputs=outputs, **given))
    rows = []
    for _ in range(ticks + 1):
        rows.append([plant.outputs(0)[f"to_y{k}"][0] for k in range(len(names))])
        try:
            plant.advance(0)
        except RunError as error:  # Stair does, where FMPy stops, too
            if "asks to end the simulation" not in str(error):
                raise
            break
    return np.array(rows)


@pytest.mark.parametrize("path", UNITS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_its_values_are_those_of_fmpy(path):
    unit, model = describe(str(path)), fmpy.read_model_description(str(path), validate=False)
    names, experiment = outputs_of(unit), model.defaultExperiment
    if not names or not {"co_simulation", "model_exchange"} & set(unit.interfaces):
        pytest.skip(f"{path.name} has {', '.join(unit.interfaces)} and {len(names)} outputs that a channel carries")
    period = float(experiment.stepSize or 0.01) if experiment else 0.01
    stop = min(float(experiment.stopTime or 1.0), 200 * period) if experiment else 200 * period
    ticks = math.floor(stop / period + 1e-9)
    about = {"stop_time": ticks * period, "output_interval": period, "output": names, "validate": False}
    compared = 0
    if "co_simulation" in unit.interfaces:
        theirs = fmpy.simulate_fmu(str(path), fmi_type="CoSimulation", **about)
        close = 1e-5 if path.stem == "Roberts" else 1e-12  # a rounding of the time is one of its own steps more or less
        _same(stepped(path, names, period, ticks), theirs, names, close)
        compared += 1
    if "model_exchange" in unit.interfaces and (path.stem in SMOOTH or "co_simulation" not in unit.interfaces):
        solver = {"fmi_type": "ModelExchange", "solver": "CVode", "relative_tolerance": 1e-9}
        theirs = fmpy.simulate_fmu(str(path), **solver, **about)
        _same(stepped(path, names, period, ticks, method="model_exchange", steps=10), theirs, names, 1e-5)
        compared += 1
    assert compared


def _same(ours, theirs, names, tolerance):
    expected = [[row[n] for n in names] for row in theirs][: len(ours)]
    np.testing.assert_allclose(ours, expected, rtol=tolerance, atol=tolerance)
