"""Every law and plant of the systems, and every one of its switches and choices: its first answers, told as numbers."""

import itertools
import re
import sys
from pathlib import Path
from random import Random
from typing import Literal, get_args, get_origin

import pytest
from softrig_core import ByHand, ParameterError, Plant, RunError, Sample
from softrig_core.block.params import Params, build
from softrig_core.block.schedule import Schedule, rational
from softrig_core.solver.solver import Solver
from told import check_told

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
from parameters import executables

PACKAGES = ("softrig_drives", "softrig_power", "softrig_robots", "softrig_systems")
TICKS = 3
FINE = ("raw1m", "raw100k", "m100k", "pulse")  # of these a tick is tenths of a second; other tests have them
SCALES = {"rad/s": 20.0, "V": 10.0, "A": 3.0, "N": 5.0, "W": 50.0, "W/m^2": 900.0, "degC": 40.0, "rpm": 500.0}
OTHER = 0.3  # of other units


def choices(model, prefix=""):
    """Each switch turned and each other choice made, one at a time."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Params):
            yield from choices(kind, f"{prefix}{name}.")
        elif kind is bool:
            yield {prefix + name: not field.default}
        elif get_origin(kind) is Literal:
            yield from ({prefix + name: v} for v in get_args(kind) if v != field.default and v not in FINE)


def _drawn(unit, k, draw):
    """A number of the size of its unit: above zero at first, of either sign then, at last a switch where it may be."""
    x = draw.uniform(0.05 if k == 0 else -1.0, 1.0)
    return float(x > 0.0) if k == 2 and unit in ("", "1") else x * SCALES.get(unit, OTHER)


def answered(block, values, draw):
    """What a block says in its first ticks, fed with numbers of the size of its units."""
    params = build(block.Params, values)
    inputs, outputs = block.ports(params)
    one, time_of = ByHand(block(params)), Schedule(rational(params.period)).time
    for k in range(TICKS):
        t = time_of(k)
        given = {}
        for port in inputs:
            row = tuple(_drawn(unit, k, draw) for unit in port.units)
            given[port.name] = Sample(t, row) if port.delayed else row
        if issubclass(block, Plant):
            said = one.outputs(t)
            one.advance(t, **given)
        else:
            said = one.update(t, **given)
        for port in outputs:
            if (row := said.get(port.name)) is not None:
                row = row.values if isinstance(row, Sample) else row
                noise = 1e-9 * max(map(abs, row), default=0.0)  # of a number that is none but for rounding
                shown = [f"{x if abs(x) > noise else 0.0:.6g}" for x in itertools.islice(row, 12)]
                yield f"  {k} {port.name}: {' '.join(shown)}" + (f" ... {sum(row):.6g}" if len(row) > 12 else "")
    for key, (_, text, *_) in one.reports.items():
        yield f"  says {key}: " + re.sub(r"-?\d+\.\d{7,}", lambda number: f"{float(number[0]):.6g}", text)


def told(package):
    for of, name, block in executables():
        if of != package or issubclass(block, Solver) or name == "dc_motor_uno":  # simavr is not everywhere
            continue
        for values in ({}, *choices(block.Params)):
            head = f"{name} {' '.join(f'{k}={v}' for k, v in values.items())}".rstrip()
            yield head
            try:
                yield from answered(block, values, Random(name))
            except (ParameterError, RunError) as error:
                yield f"  refused: {str(error)[:150]}"


@pytest.mark.parametrize("package", PACKAGES)
def test_first_answers_are_as_told(package):
    check_told(f"blocks/{package}", told(package))
