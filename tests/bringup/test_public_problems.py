"""The public falsification problems of the bench: their models reimplemented independently, and which searches find a
violation.
"""

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def bench():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        from bench.falsification import cars, f16, methods, steam, table, transmission
    finally:
        sys.path.remove(str(ROOT / "scripts"))
    return cars, methods, table, f16, steam, transmission


@pytest.fixture(scope="module")
def problems(bench):
    return {p.name: p for p in bench[2].problems()}


def test_full_throttle_is_just_beyond_the_bounds_of_at1_and_at2(problems):
    full = (1.0,) * 10 + (0.0,) * 10
    assert -0.5 < problems["AT1"].margin(full) < 0.0  # 120 mph after 20 s
    assert -0.5 < problems["AT2"].margin(full) < 0.0  # 4750 rpm; the unit is 100 rpm
    half = (0.5,) * 10 + (0.0,) * 10
    assert problems["AT1"].margin(half) > 10.0


def test_the_first_gear_agrees_with_an_independent_implementation(bench):
    """Equations 1 to 5 at full throttle until the first shift, by `solve_ivp`, with numpy's interpolation."""
    from scipy.integrate import solve_ivp

    *_, car = bench
    result = car.drive(np.full(car.SEGMENTS, 100.0), np.zeros(car.SEGMENTS))
    t = np.arange(len(result)) * car.PERIOD
    first = result[:, 0] < car.UP[-1, 0]  # mph, up to which the car stays in first gear
    ratio = result[:, 0] / car.MPH * 3.23 * 2.393 / result[:, 1]
    # numpy's interpolation does not extrapolate beyond the tables.
    first[np.argmin(first & (ratio < car.RATIOS[-1])) :] = False

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
    assert result[first, 1] == pytest.approx(other.y[0], rel=2e-4)
    assert result[first, 0] == pytest.approx(other.y[1] * 2 * np.pi * 60 / 5280, abs=2e-3)


def test_cars_keep_the_distances_of_their_modes(bench):
    cars, *_ = bench
    y = cars.drive(np.full(cars.SEGMENTS, 0.0), np.zeros(cars.SEGMENTS))
    assert np.all(y[:, 0] == 0.0)  # the first car has no throttle
    assert np.all(y[:, 1] == 10.0)  # the second car keeps its distance of 10 m, since its speed is zero
    y = cars.drive(np.ones(cars.SEGMENTS), np.zeros(cars.SEGMENTS))
    t = np.arange(len(y)) * cars.PERIOD
    assert y[:, 0] == pytest.approx(-(t**2) / 2.0, abs=1e-6)  # full throttle, no brake


def test_the_condenser_agrees_with_an_independent_block_diagram(bench):
    """Balances and network by `solve_ivp` piece by piece, with numpy's interpolation and products of matrices."""
    from scipy.integrate import solve_ivp

    s = bench[4]
    steam = np.random.default_rng(46).uniform(3.99, 4.01, s.SEGMENTS)

    def slopes(t, x, fs, wanted):
        p, T, flow, seen, *lags = x
        boiling = np.interp(p, s.PRESSURES, s.BOILING)
        mean = ((boiling - 60) - (boiling - T)) / np.log((boiling - 60) / (boiling - T))
        heat = mean / (0.0872924756541668 / flow**0.8 + 0.00073786772008033)
        into = np.interp(seen - wanted, s.IN, (-1, 1))
        neurons = 2 / (1 + np.exp(-2 * (s.W_IN * into + s.W_BACK @ lags + s.BIAS))) - 1
        asked = 107.8880952381 + np.interp(s.W_OUT @ neurons + s.BIAS_OUT, (-1, 1), s.OUT)
        made = heat / np.interp(p, s.PRESSURES, s.EVAPORATION)
        balances = [0.461526 / 3 * (fs - made) * boiling, (heat / 4.2 + (60 - T) * flow) / 500]
        return np.array(
            [*balances, asked - flow, (p - seen) / 0.5, *(np.append(neurons, lags[:3]) - 10 * np.array(lags))]
        )

    x, ends = np.array([90, 80, 107.8880952381, 90] + [0.0] * 6), sorted([*(1.75 * np.arange(21)), 2.0])
    for a, b in pairwise(ends):
        inputs = (steam[int(a / 1.75 + 1e-9)], 87 if a >= 2 else 90)
        x = solve_ivp(slopes, (a, b), x, args=inputs, rtol=1e-10, atol=1e-10).y[:, -1]
        assert s.condense(steam)[round(b / s.PERIOD)] == pytest.approx(x[3], abs=1e-5)


@pytest.mark.parametrize(
    ("start", "altitudes"),
    [
        ((np.pi / 4, -2 * np.pi / 5 + np.pi / 40, -np.pi / 4), (1823.2, 1291.29, 816.66, 259.03, 296.66, 586.83)),
        ((np.pi / 5, -2 * np.pi / 5, -3 * np.pi / 8), (1808.16, 1262.75, 781.82, 203.55, 228.64, 519.51)),
    ],
)
def test_the_aircraft_flies_as_in_the_public_python_version(bench, start, altitudes):
    """Altitudes after 1 to 15 s from that version (with its modes each 10 ms, too), run outside."""
    result = bench[3].fly(*start)
    assert [result[20 * t] for t in (1, 2, 3, 5, 8, 15)] == pytest.approx(altitudes, abs=0.1)


def test_no_steam_input_violates_the_condenser(bench):
    """It answers 1 % of steam almost linearly, so its worst inputs are at their bounds, by the signs of its slopes."""
    s = bench[4]
    n, window = s.SEGMENTS, slice(round(30 / s.PERIOD), round(35 / s.PERIOD) + 1)

    def pressure(u):
        return s.condense(3.99 + 0.02 * u)[window]

    middle, step = pressure(np.full(n, 0.5)), 0.05
    slopes = np.array([(pressure(np.full(n, 0.5) + step * e) - middle) / step for e in np.eye(n)])
    margins = [
        min(y.min() - 87.0, 87.5 - y.max())
        for k in range(slopes.shape[1])
        for sign in (1, -1)
        for y in [pressure((sign * slopes[:, k] > 0.0).astype(float))]
    ]
    assert min(margins) == pytest.approx(0.02029, abs=1e-4)  # kPa; a search of 3,000 runs ends there, too


def test_no_start_in_the_box_violates_the_aircraft(problems):
    grid = np.linspace(0.0, 1.0, 9)
    least = min(problems["F16"].margin((a, b, c)) for a in grid for b in grid for c in grid)
    assert least == pytest.approx(4.11, abs=0.01)  # ft; 4.07 after 3,000 runs of a search


@pytest.mark.parametrize("name", ["AT1", "AT2", "CC1", "CC2", "CC3"])
def test_a_violation_at_a_corner_is_found_with_a_tenth_of_the_budget(problems, bench, name):
    _, methods, *_ = bench
    assert max(methods.runs_to_violation(problems[name], "softrig", 300, seed) for seed in range(3)) <= 30


@pytest.mark.parametrize("name", ["AT6a", "AT6b", "AT6c", "CC5"])
def test_a_violation_between_the_bounds_is_found_with_constant_inputs(problems, bench, name):
    _, methods, *_ = bench
    runs = sorted(methods.runs_to_violation(problems[name], "softrig", 300, seed) for seed in range(200, 209))
    assert runs[4] <= 40
