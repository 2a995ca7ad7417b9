"""Photovoltaic rig: the acceptance numbers, the models against independent solutions, bad input."""

import functools
import math

import numpy as np
import pytest
from conftest import differences, few, in_process
from hypothesis import given, settings, strategies as st
from simulated import SimulatedRig, World
from softrig_bringup.study.definition import load_study, make_study
from softrig_bringup.study.draw import cases
from softrig_bringup.study.table import results
from softrig_bringup.study.work import Work, run as run_case
from softrig_core import (
    ByHand,
    Level,
    Signals,
    evaluate,
    list_scenarios,
    load_scenario,
    rig_of,
    simulate,
)
from softrig_core.block.loop import Loop
from softrig_core.block.tables import Tables
from softrig_core.judge.measures import mean
from softrig_core.run.inprocess import wired
from softrig_optim.algorithms import AlgorithmParams
from softrig_optim.search import run
from softrig_power.baselines.algorithms import make
from softrig_power.pv import figures as pv_figures
from softrig_power.pv.converter import (
    BuckBoostMatching,
    Circuit,
    Converter,
    ConverterParams,
    seen_resistance,
    steady_state,
)
from softrig_power.pv.curves import PvCurves
from softrig_power.pv.figures import POWER
from softrig_power.pv.module import ModuleParams, cell
from softrig_power.pv.mppt import MpptOptimiser
from softrig_power.pv.plant import PvPlant
from softrig_power.pv.string import characteristic

MODULE, CONVERTER = ModuleParams(), ConverterParams()
PATTERN1, PATTERN2 = (1000.0, 800.0, 600.0, 400.0), (1000.0, 800.0, 500.0, 300.0)
FIG4, UNIFORM = (1000.0, 850.0, 700.0, 300.0), (1000.0,) * 4
ROOM = (25.0,) * 4


def string(irradiance, temperature=ROOM):
    return characteristic(MODULE, irradiance, temperature)


def duty_for(p, R):
    """Duty under which the source sees R in steady state, the inverse of `seen_resistance`."""
    # The root below 1 of (R_L - R) d^2 - 2 R_L d + (R_L + r) = 0, in a form that also holds for R = R_L.
    return (p.R_L + p.r) / (p.R_L + math.sqrt(p.R_L**2 - (p.R_L - R) * (p.R_L + p.r)))


@functools.cache
def result(name, seed=None):
    """Signals and metrics of a scenario."""
    scenario = load_scenario(name)
    rig = rig_of(scenario)
    signals = Signals(in_process(rig, scenario.seed if seed is None else seed))
    return signals, {m.name: m for m in evaluate(rig, signals)}


# the string -----------------------------------------------------------------------------------------------------

PEAKS = {  # power (W), voltage (V) and duty of each peak by a reference calculation; None where it lists none
    PATTERN1: [(51.493, None, 0.7516), (96.421, 33.35, 0.6416), (116.460, 52.94, 0.5510), (107.980, 73.34, 0.4590)],
    PATTERN2: [(51.493, None, 0.7516), (96.421, None, 0.6416), (98.224, 53.59, 0.5264), (81.079, None, 0.4221)],
    FIG4: [(51.493, None, None), (101.609, None, None), (134.281, 52.35, 0.5717), (82.112, None, None)],
    UNIFORM: [(239.528, 68.17, 0.5780)],
}
BOUNDARIES = {PATTERN1: [0.7299, 0.6021, 0.4934], PATTERN2: [0.7299, 0.5764, 0.4555]}


@pytest.mark.parametrize("pattern", PEAKS)
def test_peaks_of_the_static_map(pattern):
    """Acceptance 1: powers within 0.05 W, voltages within 0.02 V, duties within 0.001."""
    peaks = string(pattern).peaks
    assert len(peaks) == len(PEAKS[pattern])
    for peak, (p, v, d) in zip(peaks, PEAKS[pattern], strict=True):
        assert peak.p == pytest.approx(p, abs=0.05)
        assert v is None or peak.v == pytest.approx(v, abs=0.02)
        assert d is None or duty_for(CONVERTER, peak.v / peak.i) == pytest.approx(d, abs=0.001)


@pytest.mark.parametrize("pattern", BOUNDARIES)
def test_basins_in_duty(pattern):
    source = string(pattern)
    gathered = [duty_for(CONVERTER, dip.v / dip.i) for dip in source.valleys]
    assert gathered == pytest.approx(BOUNDARIES[pattern], abs=0.001)
    assert [source.basin(peak.v) for peak in source.peaks] == [0, 1, 2, 3]
    assert source.global_basin == 2


def test_module_at_standard_conditions():
    module = characteristic(MODULE, (1000.0,), (25.0,))
    assert module.gmpp.p == pytest.approx(59.882, abs=1e-3)
    assert module.gmpp.v == pytest.approx(17.043, abs=5e-3)
    assert module.gmpp.i == pytest.approx(3.5136, abs=1e-3)
    assert module.open_circuit == pytest.approx(21.090, abs=1e-3)
    assert module.current(0.0) == pytest.approx(3.7986, abs=1e-4)
    assert characteristic(MODULE, (1000.0,), (55.0,)).gmpp.p == pytest.approx(51.44, abs=5e-3)


@pytest.mark.timeout(20)
def test_currents_too_large_for_the_fine_tolerance_are_found():
    c = cell(ModuleParams(V_oc=0.001, R_s=2.35e-6, R_p=1e12), 1000.0, 25.0)
    actual = c.current(-0.8)  # at thousands of A, neighbouring doubles differ by more than 1e-14 A
    junction = -0.8 + c.R_s * actual
    assert actual > 1e3
    assert c.I_ph - c.I_0 * math.expm1(junction / c.aV_t) - junction / c.R_p == pytest.approx(actual, rel=1e-12)


@pytest.mark.long
@given(
    st.lists(st.sampled_from([0.0, 1e-3, 30.0, 400.0, 400.5, 1000.0, 1500.0]), min_size=4, max_size=4),
    st.lists(st.floats(-40.0, 100.0), min_size=4, max_size=4),
)
@settings(max_examples=15, deadline=None, derandomize=True)
def test_current_never_rises_with_voltage(irradiance, temperature):
    """This makes a certified search possible; and the power is zero at open circuit with any shading."""
    source = string(tuple(irradiance), tuple(temperature))
    assert np.all(np.diff(source.i) <= 1e-9)
    assert source.current(source.open_circuit) == pytest.approx(0.0, abs=1e-6)
    assert source.gmpp.p >= 0.0


def test_dark_and_bypassed_modules():
    dark = string((0.0,) * 4)
    assert dark.gmpp.p == 0.0
    assert steady_state(CONVERTER, dark, 0.5) == (0.0, 0.0, 0.0)
    three = string((1000.0, 800.0, 600.0, 0.0)).gmpp
    lit = characteristic(MODULE, (1000.0, 800.0, 600.0), (25.0,) * 3)
    assert three.p == pytest.approx(lit.gmpp.p - 0.8 * three.i, rel=1e-3)


# the converter --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [0.1, 0.3, 0.459, 0.551, 0.75, 0.9])
def test_models_agree_in_steady_state(d):
    """Acceptance 2: averaged power equals the static map within 1e-4, switch by switch within 4e-4."""
    source, converter = string(PATTERN1), Converter(CONVERTER)
    start = steady_state(CONVERTER, source, d)
    static = start.v * source.current(start.v)
    assert start.v / source.current(start.v) == pytest.approx(float(seen_resistance(CONVERTER, np.array(d))))
    averaged = converter.step(Circuit(1.02 * start.v, start.i_L, start.v_o), source, d, 2e-5, 20000)
    assert averaged.v * source.current(averaged.v) == pytest.approx(static, rel=1e-4)
    x, T = start, 2e-5
    for _ in range(4000):
        x = converter.step(converter.step(x, source, 1.0, d * T / 4, 4), source, 0.0, (1.0 - d) * T / 4, 4)
    energy = 0.0
    for circuit, share in ((1.0, d), (0.0, 1.0 - d)):
        for _ in range(50):
            before = x.v * source.current(x.v)
            x = converter.step(x, source, circuit, share * T / 50, 1)
            energy += 0.5 * (before + x.v * source.current(x.v)) * share / 50
    assert energy == pytest.approx(static, rel=4e-4)


def test_efficiency_at_the_maximum():
    x = steady_state(CONVERTER, string(PATTERN1), duty_for(CONVERTER, 52.937 / 2.2))
    assert x.v_o**2 / 35.0 == pytest.approx(112.47, abs=0.02)
    assert (x.i_L, x.v_o) == pytest.approx((3.993, 62.74), abs=0.01)


@pytest.mark.parametrize(("before", "after", "peak"), [(0.4, 0.551, 16.5), (0.1, 0.9, 49.1), (0.82, 0.44, 4.33)])
def test_transients_converge(before, after, peak):
    """Halving the step of 20 us moves a transient with diode events by less than 0.002 V and 0.0005 A.

    A clamp at the end of each step would leave 0.03 V and 0.25 V here; it would also let the string go to -51 V in the
    step from 0.1 to 0.9, where in truth all bypass diodes conduct.
    """
    source, converter = string(PATTERN1), Converter(CONVERTER)
    x = y = steady_state(CONVERTER, source, before)
    largest, lowest = 0.0, x.v
    for _ in range(2000):
        x = converter.step(x, source, after, 2e-5, 1)
        y = converter.step(y, source, after, 1e-5, 2)
        assert x.v == pytest.approx(y.v, abs=0.002)
        assert x.i_L == pytest.approx(y.i_L, abs=5e-4)
        assert x.v_o == pytest.approx(y.v_o, abs=0.002)
        largest, lowest = max(largest, x.i_L), min(lowest, x.v)
    assert largest == pytest.approx(peak, abs=0.1)
    assert lowest >= -3.2
    assert x.i_L >= 0.0


def test_switched_plant_follows_the_averaged_one():
    """The step 0.4 to 0.551 with its interval of zero current: within 0.6 V and 5 W, then the same."""
    plants = [ByHand(PvPlant(model=model)) for model in ("averaged", "switched")]
    for plant in plants:
        for _ in range(60):
            plant.advance(0, duty=(0.4,), environment=None)
    worst_v = worst_p = 0.0
    for _ in range(60):
        for plant in plants:
            plant.advance(0, duty=(0.551,), environment=None)
        a, b = (plant.outputs(0)["converter"] for plant in plants)
        worst_v, worst_p = max(worst_v, abs(a[0] - b[0])), max(worst_p, abs(a[3] - b[3]))
    assert 0.1 < worst_v < 0.6
    assert worst_p < 5.0
    assert a[0] == pytest.approx(b[0], abs=0.02)
    assert a[3] == pytest.approx(b[3], rel=1e-4)


@given(st.floats(0.1, 0.9), st.floats(1.0, 500.0))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_duty_and_resistance_are_inverse(d, load):
    p = ConverterParams(R_L=load)
    assert duty_for(p, float(seen_resistance(p, np.array(d)))) == pytest.approx(d, rel=1e-9)
    ideal = BuckBoostMatching()
    assert ideal.command(load * (1.0 - d) ** 2 / d**2, load) == pytest.approx(d, rel=1e-9)
    assert ideal.load(d, load * (1.0 - d) ** 2 / d**2) == pytest.approx(load, rel=1e-9)


# the trackers on the static map ---------------------------------------------------------------------------------


@functools.cache
def static_runs(algorithm, n=400, **settings):
    """Best duty and power, and evaluations, of n seeds on pattern 2."""
    source = string(PATTERN2)
    duties = np.linspace(0.1, 0.9, 8001)
    v, i = source.under_load(seen_resistance(CONVERTER, duties))
    powers = (v * i).tolist()

    def power(x):
        at = (x[0] - 0.1) * 1e4
        k = min(int(at), 7999)
        return powers[k] + (at - k) * (powers[k + 1] - powers[k])

    gathered = []
    for seed in range(n):
        search = make(algorithm, [0.1], [0.9], seed, AlgorithmParams(), maximise=True, **settings)
        best = run(search, power)
        gathered.append((best.x[0], best.value, search.evaluations))
    return np.array(gathered).T


@pytest.mark.parametrize(
    ("algorithm", "settings", "hits", "close"),
    few(
        [
            ("issa", {}, 230, 203),
            ("ssa", {}, 293, 253),
            ("pso", {}, 254, 247),
            pytest.param("de_rand1", {}, 259, 225, marks=pytest.mark.long),
            pytest.param("de_best1", {}, 220, 198, marks=pytest.mark.long),
            ("fa", {}, 269, 201),
            ("issa", {"c3_threshold": 0.0}, 51, 41),
        ],
        2,
    ),
)
def test_hit_rates(algorithm, settings, hits, close):
    """Acceptance 3: how many of 400 seeds end in the global basin of pattern 2, and above 99 % of its power.

    A reference calculation had 54, 72, 67, 66, 51, 70 and 13 %. A run repeats bit for bit; another C library may decide
    a draw or two at an edge.
    """
    duty, power, _ = static_runs(algorithm, **settings)
    assert np.sum((duty > 0.4555) & (duty < 0.5764)) == pytest.approx(hits, abs=2)
    assert np.sum(power > 0.99 * 98.224) == pytest.approx(close, abs=2)


@pytest.mark.parametrize(
    "algorithm", ["issa", "ssa", "pso", *(pytest.param(a, marks=pytest.mark.long) for a in ("de_rand1", "de_best1"))]
)
def test_evaluation_counts(algorithm):
    """Acceptance 4."""
    assert set(static_runs(algorithm)[2]) == {44.0}


def test_firefly_evaluations():
    assert np.mean(static_runs("fa")[2]) == pytest.approx(41.0, abs=1.0)
    assert set(static_runs("fa_all_pairs", n=3)[2]) == {76.0}


# scenarios ------------------------------------------------------------------------------------------------------


# The paper's law, its baselines, a change of light and the certified search run daily.
LATER = {
    f"pv_mppt_{n}"
    for n in ("s4_pattern2", "s5_certified_transients", "s5_issa", "s6", "s6_no_rescan", "s7", "switched", "kc200gt")
}
NAMES = [n for n in list_scenarios() if n.startswith("pv_mppt")]


@pytest.mark.parametrize("name", few([pytest.param(n, marks=[pytest.mark.long] * (n in LATER)) for n in NAMES], 4))
def test_scenario_meets_its_metrics(name):
    _, figures = result(name)
    assert figures
    assert [m for m in figures.values() if not m.passed] == []


@pytest.mark.parametrize(
    ("name", "power", "tolerance"),
    [
        ("pv_mppt_perturb_observe", 107.6, 0.4),
        ("pv_mppt_perturb_observe_from_0_5", 116.2, 0.3),
        ("pv_mppt_perturb_observe_from_0_8", 51.4, 0.3),
    ],
)
def test_perturb_and_observe(name, power, tolerance):
    """Acceptance 5."""
    signals, _ = result(name)
    assert mean(signals, POWER, start=2.0) == pytest.approx(power, abs=tolerance)
    if name == "pv_mppt_perturb_observe":
        t, d = signals["converter/duty/duty/effort"]
        assert d[t > 2.0].min() >= 0.450 - 1e-9
        assert d[t > 2.0].max() <= 0.465 + 1e-9


STRING = {"module": {}, "first": (1000.0, 800.0, 600.0, 400.0, 25.0, 25.0, 25.0, 25.0)}


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["pv_mppt_s5", pytest.param("pv_mppt_s5_certified_transients", marks=pytest.mark.long)]
)
def test_irradiance_steps(name):
    """Acceptance 6: 99 % of the new maximum within 1.2 s of each step, the step seen within 0.08 s."""
    signals, _ = result(name)
    for start, best in ((0.0, 116.460), (3.0, 98.224), (6.0, 239.528)):
        assert pv_figures.gmpp(signals, at=start + 1.0, **STRING) == pytest.approx(best, abs=0.05)
        assert pv_figures.tracking_time(signals, start=start, end=start + 2.99, stay=0.5, **STRING) <= 1.2
    t, restarts = signals["mppt/status/restarts/position"]
    searches = t[1:][np.diff(restarts) > 0.0]
    assert searches == pytest.approx([3.08, 6.08], abs=0.0401)
    _, d = signals["converter/duty/duty/effort"]
    assert d.min() >= 0.1
    assert d.max() <= 0.9


@pytest.mark.long
def test_a_hidden_change_is_found():
    """Acceptance 6: found within 1.2 s of the timer, and never without it."""
    signals, _ = result("pv_mppt_s6")
    assert pv_figures.tracking_time(signals, start=4.0, end=7.99, stay=0.5, **STRING) <= 1.2
    assert mean(signals, POWER, start=7.9, end=7.99) == pytest.approx(132.73, abs=0.06)
    signals, _ = result("pv_mppt_s6_no_rescan")
    assert mean(signals, POWER, start=8.0) == pytest.approx(116.46, abs=0.01)
    assert pv_figures.efficiency(signals, start=8.0, **STRING) == pytest.approx(87.7, abs=0.05)


DAILY = ["issa"]
OTHERS = [  # includes a sweep, which passes each voltage once
    "certified",
    "pso",
    "ssa",
    "de_rand1",
    "de_best1",
    "fa",
    "fa_all_pairs",
    "gwo",
    "woa",
    "ga",
]


@pytest.mark.long
@pytest.mark.parametrize("algorithm", [*DAILY, *(pytest.param(a, marks=pytest.mark.long) for a in OTHERS)])
def test_light_that_returns_during_a_search_starts_another(algorithm):
    """The result holds again at the end of the search, but the samples measured in the shade do not."""

    best = string(PATTERN1).gmpp.p

    def searches(light, **changes):
        """The number of searches after the first, and whether one of them all ended lower than a scan finds."""
        overrides = {"mppt_optimizer.algorithm": algorithm, "shading_source.times": (0.0, 0.1, 0.3)}
        overrides["shading_source.irradiance"] = PATTERN1 + light + PATTERN1
        run = simulate("pv_mppt_s5", duration=7.0, overrides=overrides | changes)
        restarts, actual = (run.signals[f"mppt/status/{key}/position"].x for key in ("restarts", "best_value"))
        ends = np.flatnonzero(np.diff(restarts)).tolist()
        return restarts[-1], any(actual[k] < best / 1.04 for k in (*ends, -1))

    count, missed = searches(tuple(0.7 * g for g in PATTERN1))
    # The change is detected when the light falls, when it returns, or both times.
    assert count in ((1.0, 2.0, 3.0) if missed else (1.0, 2.0))
    for noise in (0.0, 0.005):
        count, missed = searches(PATTERN1, **{"pv_plant.noise": noise})
        assert (count > 0.0) == missed


CLOUDS = [  # irradiance during the cloud, and its begin and end in s
    ((285.0, 292.0, 89.0, 164.0), 0.68, 1.171),
    ((504.0, 577.0, 299.0, 583.0), 0.05, 0.186),  # samples of both lights would prove a bound of 108.99 W
    # No later candidate shows that the light has changed since the start.
    ((910.0, 123.0, 309.0, 641.0), 1.868, 1.999),
    # A ramp ends within the cloud, and the search would stay at 51.4 W of 116.5 W.
    ((305.0, 185.0, 242.0, 973.0), 0.333, 0.929),
    ((400.0, 880.0, 944.0, 491.0), 0.958, 1.114),  # the later characteristic differs mainly in its largest power
]


def tracked(tracker, t, measurement):
    return tracker.update(t, measurement=measurement, start=None, stop=None, restart=None)


def power_of(plant):
    return plant.outputs(0)["converter"][3]


def after_a_cloud(algorithm, light, begin, end, seconds, seed=0):
    """Power at each tick after a cloud over pattern 1, and the states."""
    powers, states = [], []
    plant, tracker = ByHand(PvPlant()), ByHand(MpptOptimiser(algorithm=algorithm))
    tracker.reset(seed)
    for tick in range(round((end + seconds) * 1000)):
        t = tick * 1_000_000
        outputs = plant.outputs(t)
        answer = tracked(tracker, t, outputs["port"])
        powers.append(outputs["converter"][3])
        states.append(answer["state"])
        plant.advance(t, duty=answer["command"], environment=(light if begin <= tick / 1000 < end else PATTERN1) + ROOM)
    return np.array(powers)[round(end * 1000) + 1 :], np.array(states)[round(end * 1000) + 1 :]


@pytest.mark.parametrize("cloud", few([pytest.param(cloud) for cloud in CLOUDS], 2))
@pytest.mark.parametrize("algorithm", ["certified", "certified_transients", "ramp"])
def test_a_cloud_during_a_search_is_noticed(algorithm, cloud):
    """The maximum after it, and no proven bound below the actual power."""
    powers, states = after_a_cloud(algorithm, *cloud, 2.5)
    best = string(PATTERN1).gmpp.p
    # The search may have restarted.
    assert 0.997 * best < np.median(powers[-300:]) <= powers.max() <= best * (1.0 + 1e-9)
    seen = states[20:]
    assert not np.any((seen[:, 0] == 2.0) & (seen[:, 5] > 0.0) & (seen[:, 5] < best))
    assert states[-1, 3] <= 3.0
    if algorithm == "certified":
        assert states[-1, 5] >= best


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("algorithm", "good"), [("certified", 200), ("certified_transients", 199), ("ramp", 199)])
def test_two_hundred_clouds(algorithm, good):
    """95 % of the energy of the 10 s after a cloud of 50 to 1000 W/m^2; a change invisible at the held point is
    missed.
    """
    rng, best, shares, false = np.random.default_rng(46), string(PATTERN1).gmpp.p, [], 0
    for seed in range(200):
        light = tuple(rng.uniform(50.0, 1000.0, 4).round(0).tolist())
        begin = round(float(rng.uniform(0.0, 2.0)), 3)
        end = begin + round(float(rng.uniform(0.05, 1.0)), 3)
        powers, states = after_a_cloud(algorithm, light, begin, end, 10.0, seed)
        shares.append(powers.mean() / best)
        seen = states[100:]
        false += bool(np.any((seen[:, 0] == 2.0) & (seen[:, 5] > 0.0) & (seen[:, 5] < best)))
    assert np.count_nonzero(np.array(shares) >= 0.95) == pytest.approx(good, abs=2)
    assert false <= 4


def test_permanently_changing_light_does_not_make_it_search_forever():
    """Three searches are interrupted, then the result is held for twice as long as they took, and twice that the next
    time.
    """
    light = [tuple(g * f for g in PATTERN1) for f in (1.0, 0.8)]
    _, states, tracker = in_changing_light(lambda s: light[int(s / 0.13) % 2], 12.0, algorithm="certified")
    phases = np.array(states)[:, 0]
    assert np.mean(phases[2000:] == 2.0) > 0.1
    assert tracker.reports["changed"][0] is Level.WARN


@pytest.mark.long
def test_the_same_seed_gives_the_same_bits():
    """Acceptance 7, in process: every message of every topic; another seed draws other conditions."""
    rig = rig_of("pv_mppt_s4_issa")
    first, again, other = (in_process(rig, seed) for seed in (5, 5, 6))
    assert differences(first, again) == []
    assert "pv/environment" in differences(first, other)
    assert "converter/duty" in differences(first, other)


def short(name, **changes):
    """Judge a few draws of a study in this process."""
    study = make_study(load_study(name).model_dump() | changes)
    rows = [run_case(Work(case, study.duration, tuple(study.figures), (), 2)) for case in cases(study)]
    return {r.name: r for r in results(study, rows)}


@pytest.mark.long
@pytest.mark.parametrize("name", ["pv_mppt_draws", "pv_mppt_draws_random"])
def test_the_stretch_target(name):
    """Short form of the target beyond the paper: 3 of the 60 draws of conditions and unknown load."""
    draws = load_study(name).draws.model_dump() | {"count": 3, "seed": 5}
    actual = short(name, draws=draws)
    bounds = ("certified", "certified_3", "certified_transients", "ramp", "search_time_ramp")
    assert [(n, actual[n].value) for n in bounds if not actual[n].passed] == []


def test_noise_costs_a_percent():
    """With 0.5 % of noise on voltage and current and eps = 2 %, the global peak is still reached within 2 %."""
    noisy = {"pv_plant.noise": 0.005, "mppt_optimizer.eps": 0.02, "mppt_optimizer.algorithm": "certified"}
    figures = simulate("pv_mppt_s2", overrides=noisy, seed=4).figures
    assert figures["in_global_basin"] == 1.0
    assert figures["tracking_efficiency"] > 98.0


# the other nodes ------------------------------------------------------------------------------------------------


def test_the_tracker_does_not_use_the_plant():
    """Its only measurement is the port of the string."""
    inputs, outputs = MpptOptimiser.ports(MpptOptimiser.Params())
    assert [p.topic for p in inputs] == ["pv/port", "mppt/start", "mppt/stop", "mppt/restart"]
    assert [p.topic for p in outputs] == ["converter/duty", "mppt/status"]
    assert not {"module", "converter", "irradiance", "R_L"} & set(MpptOptimiser.Params.model_fields)


@pytest.mark.parametrize("name", ["pv_mppt", "pv_mppt_certified_transients", "pv_mppt_s5_cloud"])
def test_going_back_during_a_search_repeats_it(name):
    """Three times from the same tick: a search with an older state gets its earlier results again."""
    rig = rig_of(load_scenario(name).changed(duration=0.4))
    steps = wired(rig, {m.name: m.block(1) for m in rig.members})
    ticks = Loop(list(steps.values())).run()
    for _ in range(150):
        next(ticks)
    tables = Tables(steps.values())
    kept = tables.keep()
    reported = steps["mppt_optimizer"].x.search.now.evaluations
    ways = []
    for _ in range(3):
        tables.go_back(kept)
        again = Loop(list(steps.values())).run(150)
        ways.append([(next(again), *(s.x for s in steps.values())) for _ in range(200)])
        assert steps["mppt_optimizer"].x.search.now.evaluations > reported
    assert ways[0] == ways[1] == ways[2]


# bad input ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("gap", "stale"), [(0.15, False), (0.3, True)])
def test_plant_waits_for_a_slow_tracker(gap, stale):
    """In real time a duty is stale after 0.2 s, not after a few samples of the sensors."""
    world = World()
    rig = rig_of(load_scenario("pv_mppt").changed(duration=0.8))
    run = SimulatedRig(rig, world, "realtime")
    begin, end = run.epoch + 300_000_000, run.epoch + 300_000_000 + round(gap * 1e9)
    world.latency = lambda topic, *_: (
        end - world.now if topic == "/converter/duty" and begin < world.now < end else 10_000
    )
    assert set(run.run().values()) == {"done"}
    reports = run.adapters["pv_plant"].step.reports
    assert ("stale converter/duty" in reports) == stale
    assert ("recovered converter/duty" in reports) == stale


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ((-1.0, *PATTERN1[1:], *ROOM), "module 1 is -1 W/m"),
        ((*PATTERN1[:3], 1501.0, *ROOM), "module 4 is 1501 W/m"),
        ((*PATTERN1, 25.0, 101.0, 25.0, 25.0), "module 2 is 101"),
        ((*PATTERN1, -41.0, *ROOM[1:]), "module 1 is -41"),
        ((*PATTERN1, -300.0, *ROOM[1:]), "module 1 is -300"),
        ((math.nan, *PATTERN1[1:], *ROOM), "is nan"),
    ],
)
def test_impossible_conditions_are_refused(change, text):
    """The whole message is refused, the conditions before it hold."""
    plant, twin = ByHand(PvPlant()), ByHand(PvPlant())
    plant.advance(0, duty=(0.5,), environment=change)
    twin.advance(0, duty=(0.5,), environment=None)
    assert plant.x == twin.x
    assert text in plant.reports["environment"][1]
    plant.advance(0, duty=(0.5,), environment=PATTERN2 + ROOM)
    assert plant.x.conditions == PATTERN2 + ROOM

    node = ByHand(PvCurves())
    node.update(0, environment=PATTERN2 + ROOM, request=None)
    power = np.reshape(node.update(0, environment=change, request=(1.0,))["curves"], (3, -1))[2]
    assert text in node.reports["environment"][1]
    assert power.max() == pytest.approx(98.22, abs=0.3)


def test_a_tracker_keeps_its_duty_in_darkness_and_searches_when_the_light_returns():
    """All modules dark: no power, no division; the tracker keeps its duty and searches when the light is back."""
    plant, tracker = ByHand(PvPlant()), ByHand(MpptOptimiser(algorithm="ramp"))
    phases, duties, t = [], [], 0
    for tick in range(2000):
        light = PATTERN1 if tick < 500 or tick >= 1500 else (0.0,) * 4
        answer = tracked(tracker, t, plant.outputs(t)["port"])
        plant.advance(t, duty=answer["command"], environment=light + ROOM)
        phases.append(answer["state"][0])
        duties.append(answer["command"][0])
        t += 1_000_000
    assert phases[499] == 2.0
    assert set(phases[600:1500]) == {2.0}
    assert len(set(duties[600:1500])) == 1
    assert 1.0 in phases[1500:1600]
    assert phases[-1] == 2.0
    assert power_of(plant) > 115.9


def in_changing_light(light, duration, *, seed=0, **values):
    """Run tracker and string with light(s) on the modules; give the power at the end and the states."""
    plant, tracker, states = ByHand(PvPlant()), ByHand(MpptOptimiser(**values)), []
    tracker.reset(seed)
    for tick in range(round(duration * 1000)):
        t = tick * 1_000_000
        answer = tracked(tracker, t, plant.outputs(t)["port"])
        states.append(answer["state"])
        plant.advance(t, duty=answer["command"], environment=light(t / 1e9) + ROOM)
    return power_of(plant), states, tracker


SHIPPED = next(m.params for m in rig_of("pv_mppt").members if m.name == "mppt_optimizer")


@pytest.mark.parametrize("dark", [(0.0, 0.5), (0.3, 0.9), (1.7, 1.9), (0.5, 1.6)])
@pytest.mark.parametrize("algorithm", ["issa", "certified", "ramp"])
def test_a_search_interrupted_by_darkness_starts_again_in_the_light(algorithm, dark):
    """With the settings of the shipped scenario; before a fix, samples of the dark were kept: 18 to 90 % of the
    power.
    """
    values = SHIPPED.model_dump() | {"algorithm": algorithm}
    assert values["restart_threshold"] == 0.0
    begin, end = dark
    power, states, _ = in_changing_light(lambda s: (0.0,) * 4 if begin <= s < end else PATTERN1, end + 2.2, **values)
    actual = np.array(states)
    assert actual[-1][0] == 2.0
    assert actual[-1][3] == 1.0
    assert power > 0.98 * 116.46
    if algorithm == "issa":
        assert actual[-1][2] == 44.0  # 44 V, because all modules are lit


def test_a_search_in_the_dark_pauses_at_open_circuit():
    power, states, tracker = in_changing_light(lambda s: (0.0,) * 4 if s >= 0.3 else PATTERN1, 1.5, algorithm="issa")
    dark = np.array(states)[500:]
    assert power < 1e-3
    assert set(dark[:, 0]) == {1.0}
    assert len(set(dark[:, 2])) == 1
    assert set(tracked(tracker, 1_500_000_000, (0.0, 0.0, 25.0))["command"]) == {0.1}


def test_after_a_short_gap_the_candidate_is_measured_again():
    whole, states, _ = in_changing_light(lambda s: PATTERN1, 3.0, algorithm="issa", restart_threshold=0.0)
    gap, others, _ = in_changing_light(
        lambda s: (0.0,) * 4 if 0.3 <= s < 0.32 else PATTERN1, 3.0, algorithm="issa", restart_threshold=0.0
    )
    assert (others[-1][2], others[-1][3]) == (44.0, 0.0)
    assert gap == pytest.approx(whole, rel=2e-3)
    assert others[-1][4] == pytest.approx(states[-1][4], rel=2e-3)


def test_dim_light_is_not_darkness():
    """At a duty of 0.9 it gives milliwatts, but current; no search is interrupted."""
    _, states, tracker = in_changing_light(lambda s: (20.0, 15.0, 10.0, 5.0), 2.5, algorithm="certified", initial=0.5)
    assert states[-1][0] == 2.0
    assert states[-1][3] == 0.0
    assert "no signal" not in tracker.reports


@pytest.mark.parametrize("algorithm", ["certified", "certified_transients"])
def test_the_proven_bound_is_withdrawn_when_the_light_changes(algorithm):
    """During a search its samples contradict each other; after it, the held power is not the found one."""
    values = {"algorithm": algorithm, "restart_threshold": 0.0, "rescan_period": 0.0}
    true = string(PATTERN1).gmpp.p
    for change in (0.25, 1.6):
        _, states, _ = in_changing_light(lambda s, change=change: PATTERN2 if s >= change else PATTERN1, 2.4, **values)
        bounds = np.array(states)[:, 5]
        assert bounds[-1] == 0.0 or bounds[-1] >= string(PATTERN2).gmpp.p
    assert bounds[1500] >= true
    assert bounds[-1] == 0.0
    # More light moves the true maximum above the proven bound.
    _, states, tracker = in_changing_light(lambda s: (1000.0,) * 4 if s >= 1.6 else PATTERN1, 2.4, **values)
    assert (states[1500][5] >= true, states[-1][5]) == (True, 0.0)
    assert tracker.reports["proof"][::2] == (Level.WARN, 1)


@pytest.mark.parametrize("algorithm", ["certified", "ramp"])
def test_rejected_measurements_leave_a_gap_and_no_other_effect(algorithm):
    """The node rejects NaN: the tracker holds its duty, measures it again, and finds the same as without."""
    plant, tracker, gathered = ByHand(PvPlant()), ByHand(MpptOptimiser(algorithm=algorithm)), []
    for tick in range(1500):
        t, duty = tick * 1_000_000, gathered[-1] if gathered else None
        if tick % 50 == 30:
            answer = tracker.refused(t)
            assert answer["command"] == duty
        else:
            answer = tracked(tracker, t, plant.outputs(t)["port"])
        gathered.append(answer["command"])
        plant.advance(t, duty=gathered[-1], environment=None)
    assert answer["state"][0] == 2.0
    assert power_of(plant) > 0.99 * 116.46


def test_search_in_the_dark_makes_no_claim():
    tracker = ByHand(MpptOptimiser(algorithm="issa"))
    for tick in range(4000):
        state = tracked(tracker, tick * 1_000_000, (0.0, 0.0, 25.0))["state"]
        assert state[0] == 1.0
    assert tracker.reports["no signal"][0] is Level.WARN


def test_metric_outside_the_record():
    signals, _ = result("pv_mppt")
    with pytest.raises(ValueError, match="has 0 samples"):
        mean(signals, POWER, start=5.0)


def test_the_cell_equals_the_printed_equation():
    """Photocurrent rises and voltage falls with temperature: the sign of eq. (2) as in (3)."""
    warm, cold = cell(MODULE, 1000.0, 55.0), cell(MODULE, 1000.0, 25.0)
    assert warm.I_ph - cold.I_ph == pytest.approx(30.0 * 2.47e-3)
    assert warm.current(20.0) < cold.current(20.0)
