"""Every controller and plant of the systems, with every switch and choice: properties of its first answers."""

import math
import sys
from pathlib import Path
from random import Random
from typing import Literal, get_args, get_origin

import pytest
from softrig_core import ByHand, ParameterError, Plant, RunError, Sample
from softrig_core.block.params import Params, build
from softrig_core.block.schedule import Schedule, rational
from softrig_core.solver.solver import Solver

sys.path.insert(0, str(Path(__file__).parents[1] / "campaign"))
from parameters import executables

PACKAGES = ("softrig_drives", "softrig_power", "softrig_robots", "softrig_systems")
TICKS = 3
FINE = ("raw1m", "raw100k", "m100k", "pulse")  # a tick of these takes tenths of a second, and other tests cover them
SCALES = {"rad/s": 20.0, "V": 10.0, "A": 3.0, "N": 5.0, "W": 50.0, "W/m^2": 900.0, "degC": 40.0, "rpm": 500.0}
OTHER = 0.3  # scale for all other units
LATER = {  # options that act only later: at an end, on a fault, or after a delay
    "aqm_controller": "anti_windup",
    "dc_axis_controller": "compensation aw",
    "delay_line": "profile",
    "dtc_controller": "table",
    "fault_locator": "algorithm mode equations",
    "foc_controller": "mode",
    "induction_foc_controller": "mode",
    "induction_plant": "one_way",
    "line_plant": "fault.type record",
    "lsrm_fuzzy": "conjunction",
    "lsrm_plant": "locked",
    "lyapunov_monitor": "system cell_terms",
    "manipulator_controller": "use_printed_mu1",
    "ocp_player": "sampling form",
    "pendulum_plant": "profile",
    "pmsm_plant": "one_way",
    "rectifier_gpc": "solver model",
    "rectifier_plant": "feedforward structure",
    "rehab_controller": "loop_delay reference_lost",
    "rehab_plant": "start_outside",
    "shaft_sensor": "index",
    "speed_controller": "anti_windup",
    "switched_delay_plant": "profile",
    "tank_plant": "profile",
    "tcp_fluid": "disturbance",
    "tcp_packets": "disturbance",
}


def choices(model, prefix=""):
    """Each switch changed and each other choice made, one at a time."""
    for name, field in model.model_fields.items():
        kind = field.annotation
        if isinstance(kind, type) and issubclass(kind, Params):
            yield from choices(kind, f"{prefix}{name}.")
        elif kind is bool:
            yield {prefix + name: not field.default}
        elif get_origin(kind) is Literal:
            yield from ({prefix + name: v} for v in get_args(kind) if v != field.default and v not in FINE)


def _drawn(unit, k, draw):
    """A number of the size of its unit: positive first, then of either sign, at last a switch if it may be one."""
    x = draw.uniform(0.05 if k == 0 else -1.0, 1.0)
    return float(x > 0.0) if k == 2 and unit in ("", "1") else x * SCALES.get(unit, OTHER)


def answered(block, values, draw):
    """Return the rows of the first ticks, fed with numbers of the size of their units, and the keys of its reports."""
    params = build(block.Params, values)
    inputs, outputs = block.ports(params)
    one, time_of = ByHand(block(params)), Schedule(rational(params.period)).time
    rows = []
    for k in range(TICKS):
        t = time_of(k)
        messages = {}
        for port in inputs:
            row = tuple(_drawn(unit, k, draw) for unit in port.units)
            messages[port.name] = Sample(t, row) if port.delayed else row
        if issubclass(block, Plant):
            answer = one.outputs(t)
            one.advance(t, **messages)
        else:
            answer = one.update(t, **messages)
        for port in outputs:
            if (row := answer.get(port.name)) is not None:
                stamp, row = row if isinstance(row, Sample) else (t, row)
                assert len(row) == port.size, port.name
                assert stamp <= t, port.name
                assert all(map(math.isfinite, row)) or port.unchecked, (port.name, row)
                rows.append((port.name, stamp, *row))
    return rows, sorted(one.reports)


def blocks():
    for of, name, block in executables():
        # simavr is not installed everywhere.
        if of in PACKAGES and not issubclass(block, Solver) and name != "dc_motor_uno":
            yield pytest.param(name, block, id=name)


@pytest.mark.parametrize(("name", "block"), blocks())
def test_each_choice_has_an_effect_and_answers_are_finite_and_repeatable(name, block):
    """A choice without a visible effect is listed in `LATER`; one that is impossible alone is refused."""
    usual = answered(block, {}, Random(name))
    assert answered(block, {}, Random(name)) == usual
    idle = set()
    for values in choices(block.Params):
        try:
            result = answered(block, values, Random(name))
        except (ParameterError, RunError):
            continue
        idle |= set(values) if result == usual else set()
    assert idle == set(LATER.get(name, "").split())
