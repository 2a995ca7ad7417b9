"""Runs of a few ticks: a figure that cannot be computed is reported as such; no library warns."""

import warnings

import pytest
from softrig_core import simulate
from test_outside import SYSTEMS, short

LATER = ("optimal_control_mvim", "pwa_delay", "economic_dispatch")  # their solvers alone take seconds


@pytest.mark.parametrize("system", [pytest.param(s, marks=[pytest.mark.long] * (s in LATER)) for s in SYSTEMS])
def test_a_short_run_gives_no_warnings(system):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        results = simulate(short(system).scenario).results
    assert results
    assert all(r.value is not None or r.error for r in results)
