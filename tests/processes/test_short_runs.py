"""Runs of a few ticks: whatever figure cannot be computed says so; no library warns of numbers."""

import warnings

import pytest
from softrig_core import simulate
from test_outside import SYSTEMS, short


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_short_run_gives_no_warnings(system):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        results = simulate(short(system).scenario).results
    assert results
    assert all(r.value is not None or r.error for r in results)
