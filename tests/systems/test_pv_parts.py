"""Each part of the photovoltaic rig against independent code: scipy's roots, loops over the formulas, tables of
limits.
"""

from __future__ import annotations

import math
import types

import numpy as np
import pytest
from helpers import interpreted
from scipy.optimize import brentq
from softrig_core import ByHand, Level, ParameterError
from softrig_core.block.params import build
from softrig_optim.load_line import CertifiedSearch, RampScan
from softrig_power.pv import array, converter, figures, string
from softrig_power.pv.converter import BuckBoostMatching, ConverterParams, seen_resistance, steady_state
from softrig_power.pv.curves import PvCurves
from softrig_power.pv.module import Cell, ModuleParams, cell
from softrig_power.pv.mppt import MpptOptimiser, MpptParams
from softrig_power.pv.plant import PvPlant, PvPlantParams
from softrig_power.pv.shading import ShadingSource, ShadingSourceParams
from softrig_power.pv.string import Characteristic, Peak, characteristic

CELLS = [Cell(3.0, 2e-8, 1.2, 0.2, 600.0), Cell(0.5, 1e-9, 1.0, 0.0, 50.0), Cell(0.0, 1e-7, 1.5, 0.4, 1e4)]


def current(c, v):
    """The single-diode equation solved for the current by scipy."""

    def rest(i):
        u = v + c.R_s * i
        return c.I_ph - c.I_0 * math.expm1(u / c.aV_t) - u / c.R_p - i

    return brentq(rest, -200.0, c.I_ph + 50.0, xtol=1e-14)


@pytest.mark.parametrize("c", CELLS)
def test_a_module_equals_its_equation_from_reverse_to_beyond_open_circuit(c):
    for v in (-20.0, -0.8, 0.0, 5.0, 15.0, 20.0, 24.0):
        assert c.current(v) == pytest.approx(current(c, v), abs=1e-9)


@pytest.mark.parametrize("c", CELLS)
def test_the_junction_voltage_and_its_slope_by_scipy(c):
    i = np.array([-0.5, 0.0, 0.2, 0.9 * c.I_ph, c.I_ph + 0.1])

    def of(u):
        return c.I_ph - c.I_0 * math.expm1(u / c.aV_t) - u / c.R_p

    wanted = [brentq(lambda u, k=k: of(u) - k, -2e4, 40.0, xtol=1e-12) for k in i]
    top = c.start(i)
    assert (top >= np.array(wanted) - 1e-9).all()
    # The bound assumes that all current flows through the diode, or all through the resistance; the lower one holds.
    for k, bound in zip(i, top, strict=True):
        remaining = c.I_ph - k
        diode = c.aV_t * math.log1p(remaining / c.I_0) if remaining > 0.0 else math.inf
        assert bound == pytest.approx(min(diode, (remaining + c.I_0) * c.R_p))
    for guess in (None, top - 0.3, top + 5.0):
        u, slope = c.junction(i, guess)
        assert u.tolist() == pytest.approx(wanted, abs=1e-8)
        exact = [-c.I_0 / c.aV_t * math.exp(x / c.aV_t) - 1.0 / c.R_p for x in wanted]
        assert slope.tolist() == pytest.approx(exact, rel=1e-6)


def test_the_circuit_of_a_module_follows_light_and_temperature():
    p = ModuleParams(V_oc=20.0, I_sc=4.0, N_s=30, K_I=0.003, K_V=-0.07, a=1.2, R_s=0.3, R_p=500.0)
    for g, t in ((1000.0, 25.0), (250.0, 60.0), (0.0, -10.0)):
        result = cell(p, g, t)
        aV_t = 1.2 * 30 * 1.380649e-23 * (t + 273.15) / 1.602176634e-19
        short, open_v = 4.0 + 0.003 * (t - 25.0), 20.0 - 0.07 * (t - 25.0)
        assert result == pytest.approx((short * g / 1000.0, short / (math.exp(open_v / aV_t) - 1.0), aV_t, 0.3, 500.0))


# The string ----------------------------------------------------------------------------------------------


# Powers 0, 4, 9, 8, 9.6, 10, 6, 0: maxima at 3 and 6 V, a minimum at 4 V.
STEPS = Characteristic(np.arange(-1.0, 9.0), np.array([5.0, 4.5, 4.0, 3.5, 3.0, 2.0, 1.9, 10 / 6, 6 / 7, 0.0]))


def test_the_table_as_lines():
    a, b, low, scale = STEPS.segments
    assert (low, scale) == (-1.0, 1.0)
    for k in range(9):
        assert a[k] + b[k] * STEPS.v[k] == pytest.approx(STEPS.i[k])
        assert a[k] + b[k] * STEPS.v[k + 1] == pytest.approx(STEPS.i[k + 1])
    narrow = Characteristic(np.linspace(0.0, 2.0, 5), np.arange(4.0, -1.0, -1.0))
    assert narrow.segments[3] == 2.0
    for v in np.linspace(-3.0, 11.0, 57):
        k = min(max(math.floor(v + 1.0), 0), 8)  # outside the table its end segments continue
        wanted = STEPS.i[k] + (STEPS.i[k + 1] - STEPS.i[k]) * (v - STEPS.v[k])
        assert STEPS.current(v) == pytest.approx(wanted)
        assert string._current.py_func(v, -1.0, 1.0, a, b) == pytest.approx(wanted)


def test_tops_dips_and_basins():
    assert STEPS.peaks == [Peak(3.0, 3.0, 9.0), Peak(6.0, 10 / 6, 10.0)]
    assert STEPS.valleys == [Peak(4.0, 2.0, 8.0)]
    assert STEPS.gmpp == STEPS.peaks[1]
    assert STEPS.global_basin == 1
    assert [STEPS.basin(v) for v in (0.0, 4.0, 4.1, 8.0)] == [0, 0, 1, 1]
    assert STEPS.open_circuit == 8.0
    between = Characteristic(np.arange(4.0), np.array([3.0, 2.0, 1.0, -1.0]))
    assert between.open_circuit == 2.5
    # Powers 0, 6, 6, 3, 0.
    flat = Characteristic(np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([8.0, 6.0, 3.0, 1.0, 0.0]))
    assert flat.peaks == [Peak(1.0, 6.0, 6.0)]  # the first of equal powers counts
    dark = Characteristic(np.array([-1.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]))
    assert (dark.peaks, dark.valleys, dark.gmpp, dark.basin(3.0)) == ([], [], Peak(0.0, 0.0, 0.0), 0)
    reverse = Characteristic(np.array([-3.0, -2.0, -1.0, 0.0, 1.0]), np.array([1.0, 3.0, 1.0, 1.0, 0.5]))
    assert reverse.peaks == []  # a peak needs a positive voltage and current


def test_the_point_under_a_load_by_crossing_the_lines():
    R = np.array([0.01, 0.3, 1.0, 1.3, 2.0, 5.0, 50.0])
    v, i = STEPS.under_load(R)
    for k, r in enumerate(R):
        wanted = brentq(lambda x, r=r: STEPS.current(x) - x / r, 0.0, 8.0)
        assert (v[k], i[k]) == pytest.approx((wanted, wanted / r))
    dark = Characteristic(np.array([-1.0, 0.0, 1.0]), np.array([0.1, -0.1, -1.0]))
    assert [x.tolist() for x in dark.under_load(R[:2])] == [[0.0, 0.0], [0.0, 0.0]]
    lit = Characteristic(np.array([-1.0, 0.0, 1.0]), np.array([3.0, 2.0, 0.0]))
    assert lit.under_load(np.array([1.0]))[0].tolist() == pytest.approx([2.0 / 3.0])


def test_the_string_is_the_sum_of_its_modules_or_their_diodes():
    p = ModuleParams()
    g, t = (900.0, 300.0, 600.0), (25.0, 40.0, 10.0)
    source = characteristic(p, g, t)
    total = sum(21.1 - 0.080 * (x - 25.0) for x in t)
    assert (source.v.size, source.v[0], source.v[-1]) == (20001, pytest.approx(-2.4), pytest.approx(1.0664 * total))
    modules = [cell(p, *of) for of in zip(g, t, strict=True)]

    def volts(i):
        result = 0.0
        for c in modules:
            u = brentq(lambda u, c=c: c.I_ph - c.I_0 * math.expm1(u / c.aV_t) - u / c.R_p - i, -5e3, 40.0, xtol=1e-12)
            result += max(u - c.R_s * i, -0.8)
        return result

    for k in (40, 3000, 9000, 15000, 18000, 20000):
        assert volts(source.i[k]) == pytest.approx(source.v[k], abs=1e-6)
    assert source.i[0] == max(c.current(-0.8) for c in modules)  # at higher currents all bypass diodes conduct


# The converter -------------------------------------------------------------------------------------------


def test_the_resistance_seen_by_the_source_and_the_ideal_converter():
    p = ConverterParams(R_L=20.0, r=0.5)
    assert seen_resistance(p, np.array([0.25, 0.5])).tolist() == pytest.approx([(20.0 * 0.5625 + 0.5) / 0.0625, 22.0])
    law = BuckBoostMatching()
    for d in (0.2, 0.5, 0.8):
        seen = 20.0 * (1.0 - d) ** 2 / d**2
        assert law.load(d, seen) == pytest.approx(20.0)
        assert law.command(seen, 20.0) == pytest.approx(d)


@pytest.mark.parametrize("d", [0.3, 0.7])
def test_the_steady_state_is_steady(d):
    p = ConverterParams(R_L=1.5, r=0.1)
    v, i, o = steady_state(p, STEPS, d)
    assert STEPS.current(v) == pytest.approx(d * i)
    assert d * v - (1.0 - d) * o - 0.1 * i == pytest.approx(0.0, abs=1e-12)
    assert (1.0 - d) * i == pytest.approx(o / 1.5)


@pytest.mark.parametrize(
    ("x", "d"),
    [
        ((3.0, 1.0, 2.0), 0.4),
        ((7.9, 0.0, 5.0), 1.0),
        ((1.0, 0.01, 9.0), 0.0),
        ((-0.99, 6.0, 0.0), 0.9),
        ((9.5, 0.2, 0.0), 0.2),
    ],
)
def test_the_averaged_equations_with_limits_at_each_stage(monkeypatch, x, d):
    interpreted(monkeypatch, converter, "_slopes", "_advance")
    p, h, n = ConverterParams(L=2e-3, C_i=1e-3, C_o=5e-4, R_L=4.0, r=0.3), 2e-4, 12

    def slope(y):
        v, i, o = y
        return np.array(
            [(STEPS.current(v) - d * i) / 1e-3, (d * v - (1 - d) * o - 0.3 * i) / 2e-3, ((1 - d) * i - o / 4.0) / 5e-4]
        )

    def limited(y):
        return np.array([max(y[0], -1.0), max(y[1], 0.0), y[2]])

    y = np.array(x)
    for _ in range(n):
        k1 = slope(y)
        k2 = slope(limited(y + 0.5 * h * k1))
        k3 = slope(limited(y + 0.5 * h * k2))
        k4 = slope(limited(y + h * k3))
        y = limited(y + h / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4))
    assert converter.Converter(p).step(x, STEPS, d, h, n) == pytest.approx(tuple(y), abs=1e-9)


# What may be asked -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("irradiance", "temperature", "text"),
    [
        ((0.0, 1500.0), (-40.0, 100.0), ""),
        ((1.0,), (1.0, 2.0), "irradiance of 1 modules, temperature of 2"),
        ((1.0, 1500.1), (1.0, 2.0), "irradiance of module 2 is 1500.1 W/m^2, expected 0 to 1500"),
        ((-0.1, 1.0), (1.0, 2.0), "irradiance of module 1 is -0.1 W/m^2, expected 0 to 1500"),
        ((1.0, 1.0), (1.0, 100.5), "temperature of module 2 is 100.5 deg C, expected -40 to 100"),
        ((1.0, 1.0), (-41.0, 0.0), "temperature of module 1 is -41 deg C, expected -40 to 100"),
        ((1.0, math.nan), (1.0, 2.0), "irradiance of module 2 is nan W/m^2, expected 0 to 1500"),
    ],
)
def test_possible_conditions_are_accepted(irradiance, temperature, text):
    assert array.refuse(irradiance, temperature) == text
    block = PvCurves()
    assert (
        array.split(irradiance + temperature)[0]
        == (irradiance + temperature)[: (len(irradiance) + len(temperature)) // 2]
    )
    if len(irradiance) == len(temperature):
        assert array.possible(block, irradiance + temperature) == (not text)
        reported = f"pv/environment refused, the last one holds: {text}"
        assert block.events == ([(Level.ERROR, "environment", reported, False)] if text else [])


@pytest.mark.parametrize(
    ("model", "parameters", "text"),
    [
        (PvPlantParams, {"d_min": 0.5, "d_max": 0.5}, "d_min = 0.5 is not below d_max = 0.5"),
        (PvPlantParams, {"period": 1e-3, "step": 3e-4}, "period = 0.001 s is not a multiple of step = 0.0003 s"),
        (PvPlantParams, {"period": 1e-3, "step": 3e-3}, "period = 0.001 s is not a multiple of step = 0.003 s"),
        (
            PvPlantParams,
            {"model": "switched", "period": 1.01e-3, "converter.f_sw": 5e4},
            "period = 0.00101 s is not a multiple of 1/f_sw = 2e-05 s",
        ),
        (
            PvPlantParams,
            {"period": 1.0, "step": 1e-6},
            "period = 1 s takes 1e+06 steps of step = 1e-06 s, expected at most 100000",
        ),
        (PvPlantParams, {"irradiance": (1.0, 2.0)}, "irradiance of 2 modules, temperature of 4"),
        (MpptParams, {"d_min": 0.9}, "d_min = 0.9 is not below d_max = 0.9"),
        (ShadingSourceParams, {"times": (0.0, 1.0)}, "irradiance has 4 values, expected 4 modules x 2 times"),
        (ShadingSourceParams, {"temperature": (1.0,)}, "temperature has 1 values, expected 4 or 4"),
        (ShadingSourceParams, {"times": (0.0, 0.0), "irradiance": (1.0,) * 8}, "times: "),
        (
            ShadingSourceParams,
            {"times": (0.0, 1.0), "irradiance": (1.0,) * 4 + (1.0, 1.0, 2000.0, 1.0)},
            "pattern 2: irradiance of module 3 is 2000 W/m^2, expected 0 to 1500",
        ),
        (
            ShadingSourceParams,
            {"times": (0.0, 1.0), "irradiance": (1.0,) * 8, "temperature": (1.0,) * 7 + (200.0,)},
            "pattern 2: temperature of module 4 is 200 deg C, expected -40 to 100",
        ),
    ],
)
def test_impossible_parameters_are_refused(model, parameters, text):
    with pytest.raises(ParameterError) as refused:
        build(model, parameters)
    assert text in str(refused.value)


def test_parameters_at_the_limits_are_accepted():
    assert build(PvPlantParams, {"period": 1e-3, "step": 1e-3}).step == 1e-3
    assert build(PvPlantParams, {"model": "switched", "period": 1e-3, "converter.f_sw": 5e4, "step": 0.7}).step == 0.7


def test_patterns_follow_one_another_with_random_fluctuation():
    p = build(
        ShadingSourceParams,
        {"modules": 2, "times": (0.0, 1.0), "irradiance": (1.0, 2.0, 3.0, 4.0), "temperature": (5.0, 6.0)},
    )
    assert [p.pattern(k) for k in (0, 1)] == [((1.0, 2.0), (5.0, 6.0)), ((3.0, 4.0), (5.0, 6.0))]
    q = p.model_copy(update={"temperature": (5.0, 6.0, 7.0, 8.0)})
    assert [q.pattern(k)[1] for k in (0, 1)] == [(5.0, 6.0), (7.0, 8.0)]
    source = ByHand(ShadingSource(modules=2, irradiance=(1490.0, 100.0), temperature=(-39.0, 90.0), fluctuation=0.5))
    draws = source.block.generator().uniform(-1.0, 1.0, 4)
    base, limits = (1490.0, 100.0, -39.0, 90.0), ((0.0, 1500.0), (0.0, 1500.0), (-40.0, 100.0), (-40.0, 100.0))
    wanted = [min(max(x * (1.0 + 0.5 * u), low), high) for x, u, (low, high) in zip(base, draws, limits, strict=True)]
    assert source.update(0)["environment"] == pytest.approx(wanted)


# The nodes -------------------------------------------------------------------------------------------------


def test_the_published_curve_is_as_expected():
    node = ByHand(PvCurves(n_points=5))
    light, other = (1000.0, 800.0, 600.0, 400.0, *(25.0,) * 4), (900.0,) * 4 + (30.0,) * 4

    def shown(of):
        source = characteristic(ModuleParams(), of[:4], of[4:])
        v = np.linspace(0.0, source.open_circuit, 5)
        i = np.array([source.current(x) for x in v])
        return pytest.approx((*v, *i, *(v * i)), abs=1e-6)

    for environment, request, of in [
        (None, None, light),
        (other, None, light),
        (other, (0.0,), light),
        (other, (1.0,), other),
        (light, (1.0,), other),
        (light, None, other),
        (light, (1.0,), light),
        ((2000.0,) * 8, (1.0,), light),
        (None, (0.0,), light),
        (None, (1.0,), light),
    ]:
        assert node.update(0, environment=environment, request=request)["curves"] == shown(of)
    assert node.reports["environment"][2] == 1


def test_the_plant_reports_itself_and_its_sensors():
    block = PvPlant(noise=0.1, temperature=(20.0, 30.0, 40.0, 70.0))
    x = block.first()
    source = characteristic(ModuleParams(), x.conditions[:4], x.conditions[4:])
    assert x[:3] == pytest.approx(steady_state(ConverterParams(), source, 0.1))
    i = source.current(x.v)
    outputs = block.outputs(x, 0)
    assert outputs["converter"] == pytest.approx((x.v, x.i_L, x.v_o, x.v * i))
    drawn = [block.standard_normal(k) for k in (0, 1)]
    assert outputs["port"] == pytest.approx((x.v * (1.0 + 0.1 * drawn[0]), i * (1.0 + 0.1 * drawn[1]), 40.0))
    after = block.advance(x, 0, duty=(0.1,), environment=None)
    assert after.k == 2
    assert block.events == []
    quiet = PvPlant(temperature=(20.0, 30.0, 40.0, 70.0))
    assert quiet.outputs(x, 0)["port"] == pytest.approx((x.v, i, 40.0))
    assert quiet.advance(x, 0, duty=(0.1,), environment=None)[:5] == (*after[:4], 0)


@pytest.mark.parametrize(("duty", "used"), [(0.95, 0.9), (0.9, 0.9), (0.1, 0.1), (0.05, 0.1), (0.5, 0.5)])
def test_a_duty_beyond_its_limits_is_clipped_and_reported(duty, used):
    reported, silent = PvPlant(), PvPlant()
    x = reported.first()
    assert reported.advance(x, 0, duty=(duty,), environment=None) == silent.advance(
        x, 0, duty=(used,), environment=None
    )
    text = f"the duty {duty:g} is outside [0.1, 0.9]: clipped"
    assert reported.events == ([(Level.WARN, "duty", text, False)] if duty != used else [])


def test_a_switched_period_is_one_circuit_after_the_other():
    block = PvPlant(model="switched", period=1e-4)
    x = block.first()
    source = characteristic(ModuleParams(), x.conditions[:4], x.conditions[4:])
    circuit, work = x[:3], converter.Converter(ConverterParams())
    for _ in range(5):  # five periods of 20 us with eight steps in each state, and the switch on for 30 %
        circuit = work.step(circuit, source, 1.0, 0.3 * 2e-5 / 8, 8)
        circuit = work.step(circuit, source, 0.0, 0.7 * 2e-5 / 8, 8)
    assert block.advance(x, 0, duty=(0.3,), environment=None)[:3] == pytest.approx(tuple(circuit), rel=1e-12)
    new = (500.0,) * 4 + (25.0,) * 4
    assert block.advance(x, 0, duty=(0.3,), environment=new).conditions == new
    assert block.advance(x, 0, duty=(0.3,), environment=(-1.0,) * 8).conditions == x.conditions


def test_the_tracker_makes_the_requested_search():
    rng = np.random.default_rng(0)
    certified = MpptParams(algorithm="certified", eps=0.02, d_min=0.2, d_max=0.7).search(rng)
    assert isinstance(certified, CertifiedSearch)
    transients = MpptParams(algorithm="certified_transients").search(rng)
    assert isinstance(transients, CertifiedSearch)
    ramp = MpptParams(algorithm="ramp", ramp_time=0.12, period=0.04).search(rng)
    assert isinstance(ramp, RampScan)
    assert not isinstance(MpptParams().search(rng), CertifiedSearch | RampScan)
    tracker = MpptOptimiser(duty_slew=3.0)
    assert (tracker.objective((20.0, 2.5, 40.0)), tracker.slew()) == (50.0, 3.0)


@pytest.mark.parametrize(
    ("floor", "sample", "dark"),
    [
        (0.1, (5.0, 0.01), True),
        (0.1, (9.0, 0.0101), False),
        (0.1, (20.0, 0.01), False),
        (0.1, (10.0, 0.01), True),
        (0.2, (9.0, 0.02), True),
        (0.2, (9.0, 0.0201), False),
        (None, (0.0, 0.0), False),
    ],
)
def test_darkness_means_no_power_and_no_current(floor, sample, dark):
    tracker = MpptOptimiser(floor=floor)
    assert tracker.no_signal(sample, sample[0] * sample[1]) == dark


# Figures ---------------------------------------------------------------------------------------------------


def made_up(conditions, module):
    """A characteristic that gives the first irradiance as the largest power, the second as the next one."""
    power, next_one = conditions[0], conditions[1]
    return types.SimpleNamespace(
        gmpp=Peak(1.0, 1.0, power),
        peaks=[Peak(1.0, 1.0, next_one), Peak(2.0, 1.0, power), Peak(3.0, 1.0, 1.0)],
        basin=lambda v: int(v > 5.0),
        global_basin=1,
    )


FIRST = (100.0, 40.0, 25.0, 25.0)


def signals(power, volts=None, changes=((0.25, 200.0, 50.0), (0.55, 100.0, 60.0))):
    """Powers (W) every 0.1 s, and the light that changes between."""
    t = np.arange(len(power)) / 10.0
    at = np.array([c[0] for c in changes])
    result = {
        figures.POWER: (t, np.array(power, float)),
        figures.VOLTAGE: (t, np.full(len(power), 6.0) if volts is None else np.array(volts, float)),
    }
    for k, name in enumerate(("g1", "g2")):
        result[f"pv/environment/{name}/position"] = (at, np.array([c[k + 1] for c in changes]))
    for name in ("t1", "t2"):
        result[f"pv/environment/{name}/position"] = (at, np.full(len(at), 25.0))
    return result


@pytest.fixture
def string_of(monkeypatch):
    monkeypatch.setattr(figures, "characteristic_of", made_up)
    return {"module": {}, "first": FIRST}


def test_figures_are_compared_with_the_power_of_the_light_at_each_sample(string_of):
    run = signals([50.0, 100.0, 90.0, 150.0, 200.0, 190.0, 100.0, 99.0, 98.9, 100.0])
    true = [100.0] * 3 + [200.0] * 3 + [100.0] * 4  # W; a sample sees the last light published before it
    assert [figures.gmpp(run, at=0.1 * k, **string_of) for k in range(10)] == true
    assert [figures.local_maximum(run, at=t, **string_of) for t in (0.0, 0.3, 0.6)] == [40.0, 50.0, 60.0]
    assert figures.efficiency(run, **string_of) == pytest.approx(100.0 * run[figures.POWER][1].sum() / sum(true))
    part = 100.0 * (150.0 + 200.0 + 190.0 + 100.0) / 700.0
    assert figures.efficiency(run, start=0.3, end=0.6, **string_of) == pytest.approx(part)


def test_the_voltage_is_in_the_right_basin_or_not(string_of):
    run = signals([1.0] * 4, [6.0, 4.0, 6.0, 4.0])
    assert [figures.in_global_basin(run, at=0.1 * k, **string_of) for k in range(4)] == [1.0, 0.0, 1.0, 0.0]
    assert figures.in_global_basin(run, **string_of) == 0.0


@pytest.mark.parametrize(
    ("good", "more", "wanted"),
    [
        ("1111111111", {}, 0.0),
        ("0000111111", {}, 0.4),
        ("0001101111", {}, 0.6),
        ("0000000000", {}, math.inf),
        ("1111111110", {}, math.inf),
        ("0111110000", {}, math.inf),
        ("0000000001", {}, 0.9),
        ("0111110000", {"stay": 0.5}, 0.1),
        ("0111110000", {"stay": 0.51}, math.inf),
        ("1101110111", {"stay": 0.3}, 0.3),
        ("1101110111", {"stay": 0.1}, 0.0),
        ("1101110111", {"start": 0.1}, 0.6),
        ("0011001111", {"end": 0.3}, 0.2),
        ("0011001111", {"start": 0.2, "end": 0.3}, 0.0),
    ],
)
def test_the_time_at_which_the_power_has_settled(string_of, good, more, wanted):
    still = ((-1.0, 100.0, 1.0),)
    run = signals([99.0 if c == "1" else 98.9 for c in good], changes=still)
    assert figures.tracking_time(run, **string_of, **more) == pytest.approx(wanted)
    loose = signals([98.0 if c == "1" else 97.9 for c in good], changes=still)
    assert figures.tracking_time(loose, level=0.98, **string_of, **more) == pytest.approx(wanted)
