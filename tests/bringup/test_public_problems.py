"""The public falsification problems of the bench: their models by another hand, and what finds them."""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from bench.falsification import cars, methods, table, transmission
    finally:
        sys.path.remove(str(ROOT / "scripts"))
    return cars, methods, table, transmission


@pytest.fixture(scope="module")
def problems(bench):
    return {p.name: p for p in bench[2].problems()}


def test_full_throttle_is_just_beyond_the_bounds_of_at1_and_at2(problems):
    full = (1.0,) * 10 + (0.0,) * 10
    assert -0.5 < problems["AT1"].margin(full) < 0.0  # 120 mph after 20 s
    assert -0.5 < problems["AT2"].margin(full) < 0.0  # 4750 rpm, in hundreds
    half = (0.5,) * 10 + (0.0,) * 10
    assert problems["AT1"].margin(half) > 10.0


def test_the_first_gear_is_that_of_the_equations_by_another_hand(bench):
    """Equations 1 to 5 at full throttle until the first shift, by `solve_ivp`, with numpy's interpolation."""
    from scipy.integrate import solve_ivp

    *_, car = bench
    found = car.drive(np.full(car.SEGMENTS, 100.0), np.zeros(car.SEGMENTS))
    t = np.arange(len(found)) * car.PERIOD
    first = found[:, 0] < car.UP[-1, 0]  # mph up to which it stays in first gear
    ratio = found[:, 0] / car.MPH * 3.23 * 2.393 / found[:, 1]
    first[np.argmin(first & (ratio < car.RATIOS[-1])) :] = False  # numpy does not go on beyond the tables

    def slopes(_, x):
        engine, wheel = x
        turbine = 3.23 * 2.393 * wheel
        impeller = (engine / np.interp(turbine / engine, car.RATIOS, car.CAPACITY)) ** 2
        drive = impeller * np.interp(turbine / engine, car.RATIOS, car.AMPLIFIED) * 2.393 * 3.23
        mph = wheel * 2 * np.pi * 60 / 5280
        torque = np.interp(engine, car.SPEEDS, car.TORQUES[-1])
        return (torque - impeller) / car.INERTIA, (drive - 40.0 - 0.02 * mph**2) / car.VEHICLE_INERTIA

    other = solve_ivp(slopes, (0.0, t[first][-1]), (1000.0, 0.0), t_eval=t[first], rtol=1e-9, atol=1e-9, max_step=0.01)
    assert first.sum() > 20
    assert found[first, 1] == pytest.approx(other.y[0], rel=2e-4)
    assert found[first, 0] == pytest.approx(other.y[1] * 2 * np.pi * 60 / 5280, abs=2e-3)


def test_cars_keep_the_distances_of_their_modes(bench):
    cars, *_ = bench
    y = cars.drive(np.full(cars.SEGMENTS, 0.0), np.zeros(cars.SEGMENTS))
    assert np.all(y[:, 0] == 0.0)  # nobody drives the first one
    assert np.all(y[:, 1] == 10.0)  # at 10 m it keeps its speed, which is none
    y = cars.drive(np.ones(cars.SEGMENTS), np.zeros(cars.SEGMENTS))
    t = np.arange(len(y)) * cars.PERIOD
    assert y[:, 0] == pytest.approx(-(t**2) / 2.0, abs=1e-6)  # full throttle, no brake


@pytest.mark.parametrize("name", ["AT1", "AT2", "CC1", "CC2", "CC3"])
def test_what_is_at_a_corner_is_found_with_a_tenth_of_the_budget(problems, bench, name):
    _, methods, *_ = bench
    assert max(methods.runs_to_violation(problems[name], "softrig", 300, seed) for seed in range(3)) <= 30
