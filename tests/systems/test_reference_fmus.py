"""The Reference FMUs of the Modelica Association, or any others, against FMPy's own simulation of them.

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
FLOATS = ("Real", "Float64", "Float32")
CVODE = {"fmi_type": "ModelExchange", "solver": "CVode", "relative_tolerance": 1e-9}
UNITS = sorted(FOLDER.rglob("*.fmu"))

pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not UNITS, reason=f"no Reference FMUs in {FOLDER}; SOFTRIG_REFERENCE_FMUS names their folder"),
]


def of(unit, causality):
    """Variables that channels can carry, one for each element of an array."""
    return [
        v for v in unit.variables.values() if v.causality == causality and v.kind not in ("", "String") and v.count > 0
    ]


def cells(variables):
    """Names of scalars, and of all elements of arrays, as in a scenario."""
    indices = {v.name: [",".join(str(i + 1) for i in at) for at in np.ndindex(*v.dims)] for v in variables}
    return [f"{v.name}[{at}]" if v.dims else v.name for v in variables for at in indices[v.name]]


def stepped(path, names, period, ticks, driven=None, **options):
    """Return the output of our plant at each tick; `driven` has input cells and their values at each tick, held in
    between.
    """
    inputs, values = driven or ([], np.empty((ticks + 1, 0)))
    topics = {
        "outputs": tuple(f"y{k}/x/position = {name}" for k, name in enumerate(names)),
        "inputs": tuple(f"u{k}/x/position = {name}" for k, name in enumerate(inputs)),
    }
    plant = ByHand(FmuPlant(name="unit", fmu=str(path), period=period, **topics, **options))
    rows = []
    for now in values:
        rows.append([plant.outputs(0)[f"to_y{k}"][0] for k in range(len(names))])
        try:
            plant.advance(0, **{f"u{k}": (float(u),) for k, u in enumerate(now)})
        except RunError as error:  # the FMU Stair ends the simulation itself, as in FMPy
            if "asks to end the simulation" not in str(error):
                raise
            break
    return np.array(rows)


def timed(path, unit):
    """Period and number of ticks of an FMU's own experiment, 200 at most."""
    model = fmpy.read_model_description(str(path), validate=False)
    experiment, inner = model.defaultExperiment, getattr(model.coSimulation, "fixedInternalStepSize", None)
    step = float((experiment and experiment.stepSize) or inner or 0.01)
    stop = float((experiment and experiment.stopTime) or 1.0)
    return step, max(3, math.floor(min(stop, 200 * step) / step + 1e-9))


@pytest.mark.parametrize("path", UNITS, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_its_values_equal_those_of_fmpy(path):
    unit = describe(str(path))
    outputs = of(unit, "output")
    if not outputs or not {"co_simulation", "model_exchange"} & set(unit.interfaces):
        pytest.skip(f"{path.name} has {', '.join(unit.interfaces)} and {len(outputs)} outputs that a channel carries")
    period, ticks = timed(path, unit)
    about = {"stop_time": ticks * period, "output_interval": period, "validate": False}
    names, about["output"] = cells(outputs), [v.name for v in outputs]
    compared = 0
    if "co_simulation" in unit.interfaces:
        reference = fmpy.simulate_fmu(str(path), fmi_type="CoSimulation", **about)
        # The FMU's own step may fall on either side of a rounded time.
        close = 1e-5 if path.stem == "Roberts" else 1e-12
        _same(stepped(path, names, period, ticks), reference, outputs, close)
        compared += 1
    if "model_exchange" in unit.interfaces and (path.stem in SMOOTH or "co_simulation" not in unit.interfaces):
        reference = fmpy.simulate_fmu(str(path), **CVODE, **about)
        _same(stepped(path, names, period, ticks, method="model_exchange", steps=10), reference, outputs, 1e-5)
        compared += 1
    assert compared


INTERFACES = {"co_simulation": "CoSimulation", "model_exchange": "ModelExchange"}
DRIVEN = [p for p in UNITS if of(describe(str(p)), "input") and set(INTERFACES) & set(describe(str(p)).interfaces)]


def drawn(variables, ticks):
    """Values for each cell at each tick, and the same as FMPy's table; eighths, which a Float32 represents."""
    rng = np.random.default_rng(7)
    kinds = {"Boolean": np.bool_} | dict.fromkeys(FLOATS, np.float64)
    columns = {}
    for v in variables:
        shape = (ticks + 1, *v.dims)
        whole = rng.integers(1, 3, shape) if v.kind not in kinds else rng.integers(0, 2, shape)
        columns[v.name] = (rng.integers(-8, 9, shape) / 8.0 if v.kind in FLOATS else whole).astype(
            kinds.get(v.kind, np.int64)
        )
    table = np.empty(ticks + 1, [("time", float), *((n, c.dtype, c.shape[1:]) for n, c in columns.items())])
    for name, column in columns.items():
        table[name] = column
    return np.concatenate([c.reshape(ticks + 1, -1) for c in columns.values()], axis=1).astype(float), table


@pytest.mark.parametrize("path", DRIVEN, ids=lambda p: f"{p.parent.name}/{p.stem}")
def test_its_answers_to_inputs_equal_those_of_fmpy(path):
    """Inputs change at each tick, every element of an array and every kind of number; held from tick to tick."""
    unit = describe(str(path))
    inputs, outputs = of(unit, "input"), of(unit, "output")
    period, ticks = timed(path, unit)
    ticks = min(ticks, 40)
    values, table = drawn(inputs, ticks)
    table["time"] = period * np.arange(ticks + 1)
    about = {"stop_time": ticks * period, "output_interval": period, "validate": False}
    about |= {"input": table, "output": [v.name for v in outputs]}
    compared = 0
    for method, kind in INTERFACES.items():
        if method in unit.interfaces:
            options, steps = {"fmi_type": kind}, 1
            if method == "model_exchange":  # FMPy interpolates between rows, so two rows at each tick hold the value
                options = CVODE | {"input": np.repeat(table, 2)[:-1]}
                options["input"]["time"], steps = np.repeat(table["time"], 2)[1:], 100
            reference = fmpy.simulate_fmu(str(path), **(about | options))
            reference = reference[
                np.unique(np.round(reference["time"], 9), return_index=True)[1]
            ]  # keep the row before each event
            result = stepped(path, cells(outputs), period, ticks, (cells(inputs), values), method=method, steps=steps)
            _same(
                result[1:], reference[1:], outputs, 1e-12 if method == "co_simulation" else 1e-5
            )  # at t = 0 FMPy has already set the inputs
            compared += 1
            assert np.ptp(result, axis=0).min() > 0.0  # each output changes, so the comparison means something
    assert compared


def _same(result, reference, variables, tolerance):
    expected = np.concatenate([np.reshape(reference[v.name], (len(reference), -1)) for v in variables], axis=1)[
        : len(result)
    ]
    np.testing.assert_allclose(result, expected.astype(float), rtol=tolerance, atol=tolerance)
