"""Linear switched reluctance motor: the acceptance, the model, the laws, bad input."""

import math
import os
import subprocess
import sys
from functools import cache

import numpy as np
import pytest
from conftest import few
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import solve_continuous_are
from softrig_control.fuzzy import TakagiSugeno, sum_rules
from softrig_core import ByHand, Level, Refused, list_scenarios, load_scenario, simulate
from softrig_core.block.codec import Decoder
from softrig_core.wire.cdr import Layout
from softrig_drives.lsrm.current_controller import CurrentController
from softrig_drives.lsrm.figures import FORCE, SPEED
from softrig_drives.lsrm.fuzzy import TABLE_II, THIRDS, LsrmFuzzy
from softrig_drives.lsrm.machine import Geometry, distance, profile
from softrig_drives.lsrm.mrac import LsrmMrac
from softrig_drives.lsrm.pi import LsrmPi
from softrig_drives.lsrm.plant import LsrmPlant
from softrig_drives.lsrm.ports import FORCE_CMD, LOAD, PHASE_CURRENTS, PHASE_VOLTAGE
from softrig_drives.lsrm.profile import Quintic
from softrig_drives.lsrm.profile_generator import ProfileGenerator

GEOMETRY = Geometry().numbers()
OFF = (0.0, 0.0, 0.0, 0.0)
MS = 1_000_000

SCENARIOS = sorted(n for n in list_scenarios() if n.startswith("lsrm_fuzzy"))
# The paper's three laws, its load and its arrival run daily.
MORE = {"10khz", "fast", "mrac_fast", "n2_fast", "n2_mrac", "n2_mrac_fast", "n2_pi_fast", "n2_s", "n2_s_fast", "n3",
        "n3_fast", "n3_mrac", "n3_mrac_fast", "n3_pi", "n3_pi_fast", "n3_s", "n3_s_fast", "n4_fast", "n4_p",
        "n4_p_fast", "n5", "n5_p", "n5_p_printed", "n5_printed", "pi_fast", "s", "s_fast", "s_smooth",
        "smooth", "relay"}  # fmt: skip
SHARED = ("lsrm_fuzzy", "lsrm_fuzzy_n2")  # several tests use these runs


@cache
def shared(name):
    assert name in SHARED
    return simulate(name)


@cache
def measured(name):
    """Results of a scenario by figure; without the recording."""
    return {row.name: row for row in (shared(name) if name in SHARED else simulate(name)).results}


def value(name, figure):
    """Measured value; infinity for an event that never happens."""
    result = measured(name)[figure].value
    return math.inf if result is None else result


def daily_or_long(names):
    return [pytest.param(n, marks=pytest.mark.long if n[11:] in MORE else []) for n in names]


@pytest.mark.parametrize("name", few(daily_or_long(SCENARIOS), 2))
def test_scenario_meets_its_numbers(name):
    assert [row for row in measured(name).values() if not row.passed] == []
    assert any(row.judged for row in measured(name).values())


@pytest.mark.parametrize("name", few(daily_or_long(n for n in SCENARIOS if load_scenario(n).claims), 2))
def test_verdicts_about_the_paper_hold(name):
    for key, claim in load_scenario(name).claims.items():
        others = {kind: value(*(r.rsplit(".", 1) if "." in r else (name, r))) for kind, r in claim.compared().items()}
        agrees = claim.agrees(value(name, claim.figure or key), others)
        assert claim.holds(agrees), key


def recorded(name, **arguments):
    return simulate(name, **arguments).signals


# the machine


@pytest.mark.parametrize(
    ("x", "inductances", "slopes"),
    [(0.004, (15.964e-3, 12.4e-3, 6e-3, 6.436e-3), (-0.4, 0.8, 0.0, -0.4)), (0.0415, (11.2e-3,), (0.8,))],
)
def test_inductance_and_slope(x, inductances, slopes):
    for k, (L, g) in enumerate(zip(inductances, slopes, strict=True)):
        xi = distance(x, k, GEOMETRY)
        assert profile(xi, GEOMETRY) == pytest.approx((L, g), abs=1e-6)


def _inductance(xi):
    return profile(xi, GEOMETRY)[0]


@given(st.floats(-0.3, 0.3))
def test_positive_slopes_add_up_to_one_maximum_slope(x):
    slopes = [profile(distance(x, k, GEOMETRY), GEOMETRY)[1] for k in range(4)]
    assert sum(max(g, 0.0) for g in slopes) == pytest.approx(0.8, abs=1e-9)
    assert sum(min(g, 0.0) for g in slopes) == pytest.approx(-0.8, abs=1e-9)
    for k, g in enumerate(slopes):
        near = [_inductance(distance(x + dx, k, GEOMETRY)) for dx in (-1e-7, 1e-7)]
        assert (near[1] - near[0]) / 2e-7 == pytest.approx(g, abs=2e-5)
        assert _inductance(distance(x + 0.052, k, GEOMETRY)) == pytest.approx(
            _inductance(distance(x, k, GEOMETRY)), abs=1e-12
        )


def test_locked_translator():
    plant = ByHand(LsrmPlant(locked=True, x_0=0.0415))
    for k in range(200):
        plant.advance(k, phase_voltage=(15.0, 0.0, 0.0, 0.0), load=None)
    outputs = plant.outputs(0)
    assert outputs["phase_currents"][0] == pytest.approx(5.35621, abs=1e-4)
    assert outputs["phase_currents"][0] == pytest.approx(6.0 * (1.0 - math.exp(-0.01 * 2.5 / 11.2e-3)), abs=1e-8)
    assert outputs["joint_states"] == (0.0415, 0.0, pytest.approx(11.4756, abs=1e-3))
    assert outputs["force_phases"] == (outputs["joint_states"][2], 0.0, 0.0, 0.0)


def independent(state, u, duration):
    """The equations implemented again, by an adaptive solver, over one period of constant voltages."""

    def profile(xi):
        d = abs(abs(xi) - 0.0105)
        z = d - 0.0035
        if z <= 0:
            shape, area = 1.0, d
        elif z < 0.006:
            shape = 0.5 * (1 + math.cos(math.pi * z / 0.006))
            area = 0.0035 + 0.5 * (z + 0.006 / math.pi * math.sin(math.pi * z / 0.006))
        else:
            shape, area = 0.0, 0.0065
        sign = 1 if abs(xi) < 0.0105 else -1
        return 0.006 + 0.8 * (0.0065 + sign * area), (0.8 if xi <= 0 else -0.8) * shape

    def derivative(_, s):
        force, rates = 0.0, []
        for k in range(4):
            L, g = profile((s[4] - 0.013 * k + 0.026) % 0.052 - 0.026)
            i = max(s[k], 0.0) / L
            force += 0.5 * g * i * i
            rate = u[k] - 2.5 * i
            rates.append(rate if s[k] > 0 or rate > 0 else 0.0)
        return (*rates, s[5], (force - 24.0 * s[5]) / 5.0)

    return solve_ivp(derivative, (0.0, duration), state, method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]


@pytest.mark.long  # golden bags check the bytes of the plant daily
def test_recorded_voltages_agree_with_an_independent_solver():
    signals = recorded("lsrm_fuzzy", duration=0.3)
    voltages = np.column_stack([signals[f"phase_voltage/{k}/effort"].x for k in "abcd"])
    state = np.zeros(6)
    for row in voltages:
        state = independent(state, row, 5e-5)
        state[:4] = np.maximum(state[:4], 0.0)
    assert len(voltages) == 6000
    assert signals[SPEED].x[-1] == pytest.approx(state[5], abs=1e-9)
    assert signals[SPEED].x[-1] > 0.35
    assert signals["phase_currents/b/position"].x[-1] == 0.0 < signals["phase_currents/b/position"].x.max()


@pytest.mark.long
def test_finer_steps_give_the_same_figures():
    coarse, fine = (simulate("lsrm_fuzzy", overrides={"lsrm_plant.substeps": n}) for n in (5, 50))
    for figure in ("overshoot", "iae", "peak_force"):
        assert coarse.figures[figure] == pytest.approx(fine.figures[figure], rel=2e-4)
    assert 0.0 < np.abs(coarse.signals[SPEED].x - fine.signals[SPEED].x).max() < 2e-6


def test_flux_ends_at_zero():
    plant = ByHand(LsrmPlant(locked=True, x_0=0.0415))
    for k in range(20):
        plant.advance(k, phase_voltage=(150.0, 0.0, 0.0, 0.0), load=None)
    assert plant.outputs(0)["phase_currents"][0] > 5.0
    for k in range(40):
        plant.advance(k, phase_voltage=(-150.0, -150.0, 0.0, 0.0), load=None)
        assert min(plant.outputs(0)["phase_currents"]) >= 0.0
    assert plant.outputs(0)["phase_currents"] == OFF


@pytest.mark.long
def test_without_numba_the_bits_are_the_same():
    code = (
        "from softrig_core.run.simulate import simulate\n"
        "plant = simulate('lsrm_fuzzy', duration=0.02).blocks['lsrm_plant']\n"
        "print([float(x).hex() for x in plant.x[:6]])\n"
    )
    plain = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"SOFTRIG_JIT": "0"}, check=True, capture_output=True, text=True
    ).stdout
    assert os.environ.get("SOFTRIG_JIT", "1") == "1"
    compiled = simulate("lsrm_fuzzy", duration=0.02).blocks["lsrm_plant"]
    assert f"{[float(x).hex() for x in compiled.x[:6]]}\n" == plain
    assert "0x0.0p+0" in plain
    assert plain.count("0x1.") >= 3


def test_friction_holds_a_translator_at_rest_and_stops_a_moving_one():
    plant = ByHand(LsrmPlant(x_0=0.0415, C=0.0, k_p=0.0))
    load = (8.0, 5.0)
    for k in range(100):
        plant.advance(k, phase_voltage=(8.0, 0.0, 0.0, 0.0), load=load)
    assert 0.5 < plant.outputs(0)["joint_states"][2] < 5.0
    assert plant.outputs(0)["joint_states"][:2] == (0.0415, 0.0)
    for k in range(100):
        plant.advance(k, phase_voltage=(40.0, 0.0, 0.0, 0.0), load=load)
    assert plant.outputs(0)["joint_states"][1] > 0.005
    for k in range(2000):
        plant.advance(k, phase_voltage=OFF, load=load)
    assert plant.outputs(0)["joint_states"][1] == 0.0


# profile


@given(*(st.floats(-2, 2) for _ in range(4)), st.floats(0.1, 2))
def test_quintic_agrees_with_a_linear_solve(v_0, a_0, v_d, D, T):
    rows = [
        [n * T ** (n - 1) for n in range(1, 6)],
        [n * (n - 1) * T ** (n - 2) for n in range(1, 6)],
        [T**n for n in range(1, 6)],
        [1, 0, 0, 0, 0],
        [0, 2, 0, 0, 0],
    ]
    alpha = np.linalg.solve(rows, [v_d, 0.0, D, v_0, a_0])
    result = Quintic.between(v_0, a_0, v_d, T, D)
    for t in (0.3 * T, 0.8 * T):
        x = sum(a * t**n for n, a in enumerate(alpha, 1))
        v = sum(n * a * t ** (n - 1) for n, a in enumerate(alpha, 1))
        assert result.at(t)[:2] == pytest.approx((x, v), abs=1e-9)


def test_free_distance_has_the_least_jerk():
    def jerk_squared(D):
        _, _, a3, a4, a5 = Quintic.between(0.0, 0.0, 0.5, 0.4, D).alpha
        t = np.linspace(0.0, 0.4, 4001)
        return np.trapezoid((60 * a5 * t**2 + 24 * a4 * t + 6 * a3) ** 2, t)

    best = Quintic.between(0.0, 0.0, 0.5, 0.4)
    assert [best.at(t)[1] for t in (0.1, 0.2, 0.4)] == pytest.approx([0.078125, 0.25, 0.5], abs=1e-12)
    assert best.at(0.2)[2] == pytest.approx(1.5 * 0.5 / 0.4)
    assert jerk_squared(0.1) == pytest.approx(12 * 0.5**2 / 0.4**3, rel=1e-5)
    assert min(jerk_squared(0.09), jerk_squared(0.11)) > 1.05 * jerk_squared(0.1)


# fuzzy


@pytest.fixture
def surface():
    return LsrmFuzzy()._surface


SURFACE = [(0.5, 0.4, 0.866667), (0.8, 0.5, 1.0), (-0.9, 0.2, -0.7), (0.25, -0.4, -0.15), (1.7, -0.35, 0.65)]


@pytest.mark.parametrize(("x", "y", "expected"), SURFACE)
def test_surface_has_the_reference_values(surface, x, y, expected):
    assert surface(x, y) == pytest.approx(expected, abs=1e-6)


@given(st.floats(-2, 2), st.floats(-2, 2))
def test_surface_is_odd_to_the_bit(x, y):
    for conjunction in ("product", "min"):
        surface = LsrmFuzzy(conjunction=conjunction)._surface
        assert surface(-x, -y) == -surface(x, y)


def test_table_is_the_clipped_sum():
    assert len(TABLE_II) == 49
    rows = [TABLE_II[k : k + 7] for k in range(0, 49, 7)]
    assert rows == [tuple(min(max(i + j, -3), 3) for j in range(-3, 4)) for i in range(-3, 4)]
    assert sum_rules(3) == [[-1, -1, 0], [-1, 0, 1], [0, 1, 1]]


def simpful_surface(peaks, conjunction):
    """The same rules in an independent fuzzy library."""
    import simpful

    operators = ["AND_PRODUCT"] if conjunction == "product" else None
    system = simpful.FuzzySystem(operators, show_banner=False, verbose=False)
    names = [f"t{n}" for n in range(len(peaks))]
    for variable in ("e", "de"):
        terms = []
        for n, name in enumerate(names):
            left = peaks[n - 1] if n else peaks[0] - 1.0
            right = peaks[n + 1] if n + 1 < len(peaks) else peaks[-1] + 1.0
            terms.append(simpful.TriangleFuzzySet(left, peaks[n], right, term=name))
        system.add_linguistic_variable(variable, simpful.LinguisticVariable(terms))
    for n in range(-3, 4):
        system.set_crisp_output_value(f"out{n + 3}", n / 3)
    rules = [
        f"IF (e IS {names[i]}) AND (de IS {names[j]}) THEN (u IS out{min(max(i + j - 6, -3), 3) + 3})"
        for i in range(7)
        for j in range(7)
    ]
    system.add_rules(rules)

    def evaluate(x, y):
        system.set_variable("e", min(max(x, peaks[0]), peaks[-1]))
        system.set_variable("de", min(max(y, peaks[0]), peaks[-1]))
        return float(system.Sugeno_inference(["u"])["u"])

    return evaluate


@pytest.mark.parametrize("conjunction", ["product", "min"])
@pytest.mark.parametrize("peaks", [THIRDS, (-1.0, -0.5, -0.2, 0.0, 0.25, 0.6, 1.0)])
def test_surface_agrees_with_an_independent_library(peaks, conjunction):
    surface = LsrmFuzzy(peaks=peaks, conjunction=conjunction)._surface
    simpful = simpful_surface(list(peaks), conjunction)
    rng = np.random.default_rng(1)
    for x, y in [*rng.uniform(-1.0, 1.0, (12, 2)).tolist(), (0.25, -0.4)]:
        assert surface(x, y) == pytest.approx(simpful(x, y), abs=1e-9)
    assert (LsrmFuzzy(conjunction="min")._surface(0.25, -0.4)) == pytest.approx(-0.202, abs=5e-4)


def test_surface_of_any_size():
    surface = TakagiSugeno(((0.0, 1.0), (0.0, 1.0, 3.0)), [[0.0, 1.0, 2.0], [10.0, 11.0, 12.0]])
    assert surface(0.5, 2.0) == pytest.approx(6.5)
    assert surface(-5.0, 99.0) == 2.0
    for peaks, rules in (
        (((0.0,), (0.0, 1.0)), [[0.0, 1.0]]),
        (((0.0, 1.0), (1.0, 0.0)), [[0, 0], [0, 0]]),
        (((0.0, 1.0), (0.0, 1.0)), [[0.0, 1.0]]),
    ):
        with pytest.raises(ValueError, match="expected"):
            TakagiSugeno(peaks, rules)


# the other laws


def test_mrac_gain_solves_the_riccati_equation():
    p = solve_continuous_are([[-4.8]], [[0.2]], [[4e4]], [[1.0]])[0, 0]
    closed = -(-4.8 - 0.2 * 0.2 * p)
    assert LsrmMrac().k == pytest.approx(closed, rel=1e-9)
    assert LsrmMrac().k == pytest.approx(40.29, abs=0.005)


def test_mrac_adapts_before_it_acts_and_stays_within_its_bounds():
    controller = ByHand(LsrmMrac())
    outputs = controller.update(0, joint_states=(0.1,), reference=(0.0, 0.2, 1.0))
    phi = (1.0 + controller.block.k * 0.1, 0.1, 1.0)
    theta = (3.0 + 0.2 * phi[0] * 0.1, 10.0 + 2.0 * 0.1 * 0.1, 0.0 + 2.0 * 0.1)
    assert outputs["theta"] == pytest.approx(theta)
    assert outputs["force_cmd"][0] == pytest.approx(sum(a * b for a, b in zip(theta, phi, strict=True)))
    for k in range(3000):
        outputs = controller.update(k, joint_states=(0.5,), reference=(0.0, 5.0, 0.0))
    assert outputs["theta"] == (20.0, 60.0, 20.0)
    assert outputs["force_cmd"] == (40.0,)


def test_reversed_force_switches_to_the_phases_with_negative_slope():
    controller = ByHand(CurrentController())
    at = {"joint_states": (0.004, 0.0), "phase_currents": OFF}
    forward = controller.update(0, force_cmd=(12.0,), **at)["phase_voltage"]
    controller.reset(0)
    backward = controller.update(0, force_cmd=(-12.0,), **at)["phase_voltage"]
    i_ref = math.sqrt(2 * 12 / 0.8)
    assert forward == pytest.approx((0.0, 150 * 0.05 * i_ref, 0.0, 0.0))
    assert backward == pytest.approx((150 * 0.05 * i_ref, 0.0, 0.0, 150 * 0.05 * i_ref))
    assert controller.update(0, force_cmd=(0.0,), **at)["phase_voltage"] == OFF
    carrying = controller.update(0, joint_states=(0.004, 0.0), phase_currents=(5.0, 5.0, 0.01, 0.0), force_cmd=(12.0,))
    assert carrying["phase_voltage"][0] == -150.0
    assert carrying["phase_voltage"][2] == 0.0


@pytest.mark.long
def test_reversed_force_pushes_back_without_negative_current():
    signals = recorded("lsrm_fuzzy_n3_s")
    for phase in "abcd":
        assert signals[f"phase_currents/{phase}/position"].x.min() >= 0.0
    assert signals[FORCE].x.min() < -5.0


def test_position_is_quantised():
    controller = ByHand(CurrentController(threshold=0.5))
    edge = 0.004  # here g_a = -0.4 H/m = -threshold G; the sensor changes half a count later
    seen = [
        controller.update(0, joint_states=(edge + dx, 0.0), phase_currents=OFF, force_cmd=(-12.0,))["phase_voltage"][0]
        for dx in (0.0, 4e-6, 6e-6)
    ]
    assert seen[0] == seen[1] == 0.0
    assert seen[2] > 0.0


# monitor


# bad input


def test_reference_that_the_motor_cannot_follow_warns():
    assert "infeasible" not in ByHand(ProfileGenerator()).reports
    fast = ByHand(ProfileGenerator(v_d=2.5, t_d=0.8))
    assert fast.reports["infeasible"][2] == 1
    assert fast.reports["infeasible"][0] == Level.WARN
    assert "needs 68.8 N" in fast.reports["infeasible"][1]  # of which the speed alone needs 60 N
    assert "infeasible" not in ByHand(ProfileGenerator(v_d=2.5, t_d=0.8, k_p=0.0)).reports  # needs only 39.4 N
    assert "infeasible" in ByHand(ProfileGenerator(v_d=0.5, t_d=0.1)).reports
    assert "infeasible" in ByHand(ProfileGenerator(t_b=1.0, t_db=0.04)).reports
    fast.change(fast.block.p.model_copy(update={"k_p": 0.0, "v_d": 3.0}))
    fast.update(0)
    assert fast.reports["infeasible"][2] == 2


def test_distance_that_makes_the_speed_leave_its_range_warns():
    for x_d, warns in ((None, False), (0.1, False), (0.11, False), (0.02, True), (0.25, True), (-0.1, True)):
        assert ("distance" in ByHand(ProfileGenerator(x_d=x_d)).reports) == warns, x_d


@pytest.mark.parametrize(
    ("port", "names", "values", "text"),
    [
        (PHASE_VOLTAGE, ("a", "b", "c"), (1.0, 0.0, 0.0), "names"),
        (PHASE_VOLTAGE, ("a", "b", "c", "d"), (1.0, math.nan, 0.0, 0.0), "b/effort is nan"),
        (PHASE_VOLTAGE, ("a", "b", "c", "d"), (1.0, math.inf, 0.0, 0.0), "b/effort is inf"),
        (PHASE_CURRENTS, ("a", "b", "c", "e"), (0.0, 0.0, 0.0, 0.0), "names"),
        (LOAD, ("mass",), (1.0,), "names"),
    ],
)
def test_malformed_message_never_reaches_the_block(port, names, values, text):
    data = Layout(port.msgtype, "", names, {port.fields[0]: len(values)}).encode(0, values)
    with pytest.raises(Refused, match=text):
        Decoder(port)(data)


def test_a_rejected_measurement_holds_the_force_and_releases_the_phases():
    for controller in (LsrmFuzzy(), LsrmPi(), LsrmMrac(), CurrentController()):
        x = controller.first()
        assert controller.refused(x, MS) == (x, None)  # the controller holds its last command
    assert FORCE_CMD.safe == (0.0,)
    assert PHASE_VOLTAGE.safe == OFF
