"""Compiled functions of the power systems give the bits of plain Python, each from the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
from softrig_power.dispatch import branch
from softrig_power.dispatch.conditions import Losses
from softrig_power.dispatch.units import NARROW, Units
from softrig_power.fault_location.line import simulation
from softrig_power.fault_location.line.parameters import RigParams
from softrig_power.fault_location.method import equations
from softrig_power.fault_location.records import resample
from softrig_power.lines import bergeron
from softrig_power.lines.modal import CLARKE
from softrig_power.lines.section import Section
from softrig_power.pv import converter
from softrig_power.rectifier import diodes
from softrig_power.rectifier.circuit import Circuit, Period


def bridge(function, chance):
    """The diodes for currents of all signs and zero."""
    both = Circuit.of(377.0, 2e-3, 0.3, 1e-3, 1.2), Period(0.0, 1e-3, 180.0, 20.0, 16.0, 1.0, 0.0, False, 0.0, 0.0)
    for k in range(60):
        x = np.array([*chance.uniform(-3.0, 3.0, 3), chance.uniform(150.0, 330.0)])
        x[k % 3] = -x[(k + 1) % 3] if k % 2 else 0.0
        x[(k + 2) % 3] = -x[:3].sum() + x[(k + 2) % 3] if k % 5 else 0.0
        function(chance.uniform(0.0, 0.02), 10.0 ** chance.uniform(-6.0, -3.5), x, both)
        yield x


def string(function, chance):
    """The converter on a characteristic of ten lines, with both limits active."""
    a, b = np.sort(chance.uniform(1.0, 9.0, 10)), -np.sort(chance.uniform(0.1, 1.0, 10))
    for v, i in ((0.5, 0.0), (4.0, 3.0), (-0.9, 6.0)):
        yield np.array(function(v, i, 2.0, 1e-4, 9, (a, b, -1.0, 1.0, 1e3, 400.0, 200.0, 300.0, 50.0, 800.0, 500.0)))


def waves(function, chance):
    """The waves that arrive along lines at the ends of two sections."""
    prepared = bergeron.lines([Section(0.03, 1e-3, 1.2e-8, length) for length in (40.0, 60.0)], 5e-6)
    ring = chance.normal(size=(2, 2, bergeron.history_length(prepared)))
    for k in (1, 7, 90):
        out = np.empty((2, 2, 1 + k % 6))
        function(prepared, ring, k, out)
        yield out


def stored(function, chance):
    """The waves that leave the ends of two sections."""
    prepared = bergeron.lines([Section(0.03, 1e-3, 1.2e-8, length) for length in (40.0, 60.0)], 5e-6)
    ring, current = np.zeros((2, 2, bergeron.history_length(prepared))), np.empty((2, 2, 3))
    for k in (1, 7, 90):
        function(prepared, ring, k, chance.normal(size=(2, 2, 3)), chance.normal(size=(2, 2, 3)), current)
        yield from (ring.copy(), current.copy())


def objective(function, chance):
    """The objective of the fault locator along the line."""
    out = np.empty(4)
    model = equations.model(Section(0.03, 1e-3, 1.2e-8, 100.0))
    function(model, chance.normal(size=(4, 80)), 20_000.0, 30, 7, np.array([0.0, 20.0, 77.7, 100.0]), out)
    yield out


def network(function, chance):
    """The faulted network over the closing of the fault."""
    line = simulation.FaultedLine(RigParams())
    state = line.state
    function(line.net, line.chain, CLARKE, state, 19_990, 20)
    yield from state


def resampled(function, chance):
    """A signal at other times."""
    out = np.empty((3, 2))
    function(chance.normal(size=(60, 2)), np.array([20.2, 30.0, 33.7]), 0.5, out)
    yield out


def boxes(function, chance):
    """A proof with losses and reserve in a few boxes."""
    units = Units.read("units_3")
    losses = Losses(1e-5 * (np.eye(3) + 0.3), np.full(3, 1e-3), 0.1)
    problem = branch.Problem(
        units.table, np.arange(3), 850.0, 1e-3, NARROW, units.p_min, units.p_max, losses.B, losses.B0, losses.B00,
        100.0, np.array([60.0, 50.0, 100.0]), True)  # fmt: skip
    cost, bound, nodes, best = function(problem, units.p_min.copy(), 12, 40, 30)
    yield from (np.array([cost, bound, nodes]), best)


@pytest.mark.parametrize(
    ("function", "numbers"),
    [
        (diodes.conduct, bridge),
        (converter._advance, string),
        (bergeron.histories, waves),
        (bergeron.store, stored),
        (equations.objectives, objective),
        (simulation.advance, network),
        (resample._resample, resampled),
        (branch._search, boxes),
    ],
)
def test_native_code_gives_the_bits_of_plain_python(function, numbers):
    native, plain = (list(numbers(f, np.random.default_rng(4))) for f in (function, function.py_func))
    for a, b in zip(native, plain, strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
