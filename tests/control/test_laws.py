"""Small controllers, filters and signals against their formulas, in exact fractions or by another library."""

import cmath
import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.linalg import solve_discrete_are
from softrig_control.discretise import expm, matmul
from softrig_control.filters import SecondOrderFilter
from softrig_control.fuzzy import TakagiSugeno, sum_rules
from softrig_control.kalman import SteadyKalman, steady_kalman_gain
from softrig_control.limit_cycle import Swinging, limit_cycle
from softrig_control.nodes.linear_plant import LinearPlantParams
from softrig_control.nodes.requirement_monitor import RequirementMonitor
from softrig_control.nodes.signal_name import signal_port, split
from softrig_control.nodes.unit_delay import LinkParams
from softrig_control.phase_locked_loop import PhaseLockedLoop, PllParams
from softrig_control.pid import Pid, PidParams, PidState
from softrig_control.predictive.carima import Carima, add
from softrig_control.predictive.certificate import Certificate, companion
from softrig_control.predictive.certificate_node import CertificateParams
from softrig_control.predictive.controller import GpcController, GpcControllerParams
from softrig_control.predictive.gpc import Gpc, Tuning, invert
from softrig_control.profile import NEVER, ProfileParams, StepProfile
from softrig_control.sliding_mode import switching
from softrig_control.state_feedback import StateFeedback
from softrig_core import ByHand, ParameterError, RunError

EIGHTHS = st.integers(-40, 40).map(lambda n: n / 8.0)


@given(
    st.lists(EIGHTHS, min_size=2, max_size=4, unique=True).map(sorted),
    st.lists(EIGHTHS, min_size=2, max_size=4, unique=True).map(sorted),
    st.lists(EIGHTHS, min_size=16, max_size=16),
    st.sampled_from(["product", "min"]),
    st.tuples(EIGHTHS, EIGHTHS),
)
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_fuzzy_surface_is_the_mean_of_its_rules(first, second, constants, conjunction, at):
    """Over all rules, not the four that are active, with memberships by interpolation."""
    rules = [constants[4 * i : 4 * i + len(second)] for i in range(len(first))]
    conjoin = min if conjunction == "min" else lambda a, b: a * b
    terms = [
        [np.interp(x, peaks, np.eye(len(peaks))[k]) for k in range(len(peaks))]
        for x, peaks in zip(at, (first, second), strict=True)
    ]
    weights = {(i, j): conjoin(a, b) for i, a in enumerate(terms[0]) for j, b in enumerate(terms[1])}
    expected = sum(w * rules[i][j] for (i, j), w in weights.items()) / sum(weights.values())
    assert TakagiSugeno((first, second), rules, conjunction)(*at) == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_the_rules_of_a_fuzzy_controller_are_checked():
    assert sum_rules(3) == [[-1, -1, 0], [-1, 0, 1], [0, 1, 1]]
    assert sum_rules(5)[0] == [-2, -2, -2, -1, 0]
    for peaks, rules, text in (
        (([0.0], [0.0, 1.0]), [[0.0, 0.0]], r"^peaks \[0.0\]: expected at least two increasing numbers$"),
        (([0.0, 1.0], [0.0, 0.0]), [[0.0] * 2] * 2, r"^peaks \[0.0, 0.0\]: expected"),
        (([0.0, 1.0], [0.0, 1.0]), [[0.0] * 2], r"^rules: expected 2 rows of 2 constants$"),
        (([0.0, 1.0], [0.0, 1.0, 2.0]), [[0.0] * 3, [0.0] * 2], r"^rules: expected 2 rows of 3 constants$"),
    ):
        with pytest.raises(ValueError, match=text):
            TakagiSugeno(peaks, rules)


@pytest.mark.parametrize("seed", range(3))
def test_the_steady_filter_is_that_of_scipy(seed):
    rng = np.random.default_rng(seed)
    a, b, c = 0.6 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2)), rng.normal(size=(2, 3))
    q, r = rng.uniform(0.1, 1.0, 3), rng.uniform(0.1, 1.0, 2)
    p = solve_discrete_are(a.T, c.T, np.diag(q), np.diag(r))
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + np.diag(r))
    assert np.array(steady_kalman_gain(a, c, q, r)) == pytest.approx(gain, rel=1e-8)
    filtered = SteadyKalman(a, b, c, q, r)
    x, u, y = rng.normal(size=3), rng.normal(size=2), rng.normal(size=2)
    guess = a @ x + b @ u
    assert np.array(filtered(x, u, y)) == pytest.approx(guess + gain @ (y - c @ guess), rel=1e-8)
    assert filtered.first() == (0.0, 0.0, 0.0)
    for grows in (1.0, 2.0):
        with pytest.raises(np.linalg.LinAlgError, match="neither measured nor stable"):
            steady_kalman_gain([[grows, 0.0], [0.0, 0.5]], [[0.0, 1.0]], [1.0, 1.0], [1.0])
    for wrong in ((u[:1], y), (u, y[:1])):
        with pytest.raises(ValueError, match="zip"):
            filtered(x, *wrong)


def fed(levels, reference):
    x, result = Swinging(), []
    for y in levels:
        x, size = limit_cycle(x, y, reference)
        result.append(size)
    return result


@given(st.lists(st.integers(9, 20), min_size=9, max_size=16))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_loop_is_in_a_limit_cycle_after_eight_equal_swings_that_do_not_decay(steps):
    """One sample each, up and down by so many eighths: a swing is known one sample after its end."""
    levels = [0.0]
    for k, step in enumerate(steps):
        levels.append(levels[-1] + (step if k % 2 == 0 else -step) / 8.0)
    expected = []
    for k in range(len(levels)):
        known = [s / 8.0 for s in steps[: max(k - 1, 0)]][-8:]
        first, second = sum(known[:4]), sum(known[4:])
        swings = len(known) == 8 and min(known) >= 0.5 * max(known) and second >= 0.9 * first
        expected.append(second / 4.0 if swings else 0.0)
    assert fed(levels, 50.0) == expected  # a fiftieth of 50, below which swings are ignored, is less than each level


def test_the_detector_of_limit_cycles_is_exact_at_its_limits():
    level = [0.0, 1.0] * 6
    assert fed([x * 1.01 for x in level], 50.0)[-1] == 1.01
    assert fed(level, 50.0)[-1] == 0.0  # a swing of exactly the ignored amplitude
    assert fed(level, -49.0)[-1] == 1.0
    # The smallest of the eight swings is exactly half of the largest.
    halves = [0.0, 4.0, 2.0, 6.0, 2.0, 6.0, 2.0, 6.0, 2.0, 6.0, 2.0]
    assert fed(halves, 50.0)[-1] == 4.0
    decays = [0.0, 10.0, 0.0, 10.0, 0.0, 9.0, 0.0, 9.0, 0.0, 9.0]
    assert fed(decays, 50.0)[-1] == 9.0  # the second half has exactly nine tenths of the first
    rests = fed([0.0, 2.0] * 6 + [0.0] * 8, 50.0)
    assert rests[12:] == [2.0] * 4 + [0.0] * 4  # after three times its duration the swing has ended
    assert fed([0.0, 2.0] * 6, 50.0)[-1] == 2.0
    x = Swinging()
    for k in range(30):  # each new reference restarts the detector
        x, size = limit_cycle(x, 2.0 * (k % 2), 50.0 + k // 8)
        assert size == 0.0
    assert x.aside == "only a warning depends on it"


def held_levels(*levels):
    """Samples of levels, each for a number of samples."""
    return [y for y, samples in levels for _ in range(samples)]


def test_a_swing_has_ended_after_three_times_the_longest_of_the_newest_eight():
    def up_and_down(samples, times):
        return [(2.0 * (k % 2), samples) for k in range(times)]

    for samples in (2, 3, 5):  # a swing is complete with the first sample of the next level
        result = fed(held_levels(*up_and_down(samples, 12), (0.0, 40)), 50.0)
        assert result[12 * samples :] == [2.0] * (3 * samples + 1) + [0.0] * (39 - 3 * samples)
    for later in range(13):  # one swing of five samples counts while it is among the newest eight
        levels = [*up_and_down(2, 10), (0.0, 2), (2.0, 5), *up_and_down(2, later), (2.0 * (later % 2), 40)]
        result = fed(held_levels(*levels), 50.0)
        longest = 5 if later < 8 else 2
        assert result.count(0.0) == fed(held_levels(*levels[:-1]), 50.0).count(0.0) + 39 - 3 * longest, later


@pytest.mark.parametrize("anew", ["reference", "rest"])
def test_swings_before_a_new_reference_or_a_rest_do_not_count(anew):
    """Quick ones follow slow ones: a pause that is shorter than three slow swings ends them."""
    slow = held_levels(*[(2.0 * (k % 2), 8) for k in range(6)])
    quick = [0.0, 2.0] * 3
    for pause, swings in ((6, True), (20, False)):
        x, results = Swinging(), []
        for y in slow + [0.0] * (53 if anew == "rest" else 0):
            x, _ = limit_cycle(x, y, 50.0)
        for y in quick + [0.0] * pause + quick[1:] + [0.0]:
            x, size = limit_cycle(x, y, 50.0 if anew == "rest" else 60.0)
            results.append(size)
        assert (results[-1] == 2.0) == swings, pause


def test_a_pid_equals_its_difference_equations():
    rng = np.random.default_rng(5)
    for anti_windup in (True, False):
        p = PidParams(kp=2.5, ki=3.0, kd=0.25, n_filter=16.0, u_max=4.0, anti_windup=anti_windup)
        law, ts = Pid(p, 0.125), Fraction(1, 8)
        x, integral, d, last = PidState(), Fraction(0), Fraction(0), Fraction(0)
        for e in rng.integers(-16, 16, 60).tolist():
            error = Fraction(e, 8)
            d = (d + Fraction(p.kd) * 16 * (error - last)) / (1 + 16 * ts)
            u = Fraction(p.kp) * error + integral + d
            x, result = law(x, float(error))
            if not (anti_windup and abs(u) > 4 and u * error > 0):
                integral += 3 * error * ts
            last = error
            assert result == pytest.approx(float(u), rel=1e-12, abs=1e-12)
            assert x == pytest.approx((float(integral), float(d), float(error)), rel=1e-12, abs=1e-12)


def test_a_pid_is_exact_at_its_limits():
    """At the limit itself the integral continues, and without an error the limit does not stop it."""
    law = Pid(PidParams(kp=2.0, ki=1.0, u_max=1.0), 0.5)
    assert law(PidState(), 0.5)[0].integral == 0.25
    assert law(PidState(), 0.75)[0].integral == 0.0
    assert law(PidState(integral=-4.0), 0.5)[0].integral == -3.75  # the error reduces a negative integral
    before = PidParams(kp=2.0, ki=1.0)
    x = PidState(1.5, 0.0, 0.5)
    for ki, kept in ((1.0, False), (0.0, True)):
        after = Pid(PidParams(kp=3.0, ki=ki), 0.5)
        x_after = after.go_on(x, before)
        assert (x_after == x) == kept
        assert after(x_after, 0.5)[1] == pytest.approx(2.0 * 0.5 + 1.5 + (0.5 if kept else 0.0))
    assert Pid(PidParams(kp=2.0, ki=2.0), 0.5).go_on(x, before) == x


@given(st.lists(EIGHTHS, min_size=6, max_size=6), st.booleans(), st.sampled_from([0.0, 0.5]))
@settings(max_examples=40, deadline=None, derandomize=True)
def test_a_state_feedback_equals_its_equation(numbers, anti_windup, kr):
    xi, r, y, a, b, ki = map(Fraction, numbers)
    law = StateFeedback((0.5, -2.0), float(ki), 0.25, 3.0, kr=kr, anti_windup=anti_windup)
    u = Fraction(kr) * r + ki * xi - a / 2 + 2 * b
    limited = max(min(u, 3), -3)
    winds = anti_windup and ((limited - u) * (r - y) > 0 if ki < 0 else (limited - u) * (r - y) < 0)
    expected = (float(xi if winds else xi + (r - y) / 4), float(limited))
    assert law(float(xi), float(r), (float(a), float(b)), float(y)) == expected
    settled = law.settle((float(a), float(b)), float(r))
    assert settled == pytest.approx(float((a / 2 - 2 * b - Fraction(kr) * r) / ki) if ki else 0.0)
    assert law.settle((float(a), float(b))) == pytest.approx(float((a / 2 - 2 * b) / ki) if ki else 0.0)
    for other in (StateFeedback((0.5, -2.0), 1.5, 0.25, 3.0), StateFeedback((0.25, -2.0), float(ki), 0.25, 3.0)):
        went = law.go_on(float(xi), other, (float(a), float(b)), float(r))
        command = [k._unlimited(v, float(r), (float(a), float(b))) for k, v in ((other, float(xi)), (law, went))]
        assert command[0] == pytest.approx(command[1]) if ki else went == float(xi)
    same = StateFeedback((0.5, -2.0), float(ki), 0.25, 3.0)
    assert law.go_on(float(xi), same, (float(a), float(b)), float(r)) == float(xi)


def test_a_phase_locked_loop_equals_its_formula():
    gains, w0, T = PllParams(kp=20.0, ki=300.0, least=0.5), 314.0, 1e-3
    loop = PhaseLockedLoop(gains, w0, T)
    x, theta, summed, omega = loop.first(0.25), 0.25, 0.0, w0
    assert x == (0.25, w0, 0.0)
    for k in range(40):
        u = cmath.rect(1.0 if k != 7 else 0.4, 0.3 + 320.0 * T * k)
        lost = 3 if k == 20 else 0
        theta += lost * T * omega
        if k != 7:
            error = cmath.phase(u * cmath.exp(-1j * theta))
            summed += error
            omega = w0 + 20.0 * error + 300.0 * T * summed
        x, result = loop(x, u, lost) if lost else loop(x, u)
        assert result == pytest.approx(math.remainder(theta, 2.0 * math.pi), abs=1e-9)
        theta += T * omega
        assert x == pytest.approx((math.remainder(theta, 2.0 * math.pi), omega, 300.0 * T * summed), abs=1e-9)
    edge = loop(loop.first(0.0), 0.5j)[0]
    assert edge.omega == pytest.approx(w0 + (20.0 + 0.3) * math.pi / 2.0)


@pytest.mark.parametrize("step", [0.05, 0.5, 0.9, 1.5, 2.0, 2.5])
@pytest.mark.parametrize("damping", [0.0, 0.1, 0.5, 0.75, 1.0, 3.0])
def test_an_unstable_filter_is_refused(step, damping):
    omega, period = 40.0, step / 40.0
    rate = [-omega * omega * period, 1.0 - 2.0 * damping * step]
    stable = np.abs(np.linalg.eigvals([[1.0 + period * rate[0], period * rate[1]], rate])).max() < 1.0 - 1e-9
    if not stable:
        with pytest.raises(ValueError, match=f"omega = 40 rad/s with damping {damping:g} and a period of {period:g} s"):
            SecondOrderFilter(omega, damping, period)
        return
    law = SecondOrderFilter(omega, damping, period)
    x, y, speed = law.first(0.5 + 1j), 0.5 + 1j, 0.0
    for sample in (1.0, 0.0, 2j):
        speed += period * (omega**2 * (sample - y) - 2.0 * damping * omega * speed)
        y += period * speed
        x, result = law(x, sample)
        assert (result, x.rate) == (pytest.approx(y), pytest.approx(speed))


@given(st.lists(st.integers(0, 40), min_size=1, max_size=6, unique=True).map(sorted), st.integers(-2, 45))
@settings(max_examples=60, deadline=None, derandomize=True)
def test_a_profile_holds_each_value_until_the_next(times, at):
    profile = StepProfile([t / 8.0 for t in times], times)
    ns = 125_000_000
    for t in (at * ns, at * ns + 1, at * ns - 1):
        past = [k for k in times if k * ns <= t]
        assert profile.at(t) == (past[-1] if past else times[0])
        assert profile.next_change(t) == next((k * ns for k in times[1:] if k * ns > t), NEVER)
    assert NEVER == 2**63 - 1


def test_small_parts_are_as_expected():
    assert [switching(s, d) for s, d in ((2.0, 0.0), (-2.0, 2.0), (0.0, 0.0), (0.0, 1.0))] == [1.0, -0.5, 0.0, 0.0]
    assert switching(3.0) == 1.0
    assert add((1.0, 2.0), (3.0,)) == (4.0, 2.0)
    assert add((1.0,), (3.0, 4.0), 2) == (1.0, 0.0, 3.0, 4.0)
    rng = np.random.default_rng(1)
    for scale in (0.0, 0.01, 1.0, 30.0):
        a = scale * rng.normal(size=(3, 3))
        values, right = np.linalg.eig(a)
        expected = (right * np.exp(values)) @ np.linalg.inv(right)
        assert np.array(expm(a.tolist())) == pytest.approx(expected.real, rel=1e-9, abs=1e-9 * abs(expected).max())
        assert np.array(matmul(a.tolist(), a[:, :2].tolist())) == pytest.approx(a @ a[:, :2])
        positive = a @ a.T + np.eye(3)
        assert np.array(invert(positive.tolist())) == pytest.approx(np.linalg.inv(positive), rel=1e-7)
    assert split("a/b/c/effort") == ("a/b", "c", "effort")
    port = signal_port("y", "plant/v/velocity", "", also=("w",))
    assert (port.topic, port.channels, port.fields, port.units, port.held, port.safe) == (
        "plant",
        ("v", "w"),
        ("velocity",),
        ("1", ""),
        False,
        (0.0, 0.0),
    )


def certificate(modulus=0.5, definite=1.0, decrease=0.0, largest=1.0):
    return Certificate(np.zeros((1, 1)), np.array([[-largest]]), np.array([modulus]), definite, 0.0, decrease)


def test_a_certificate_states_its_conditions():
    assert certificate().valid
    assert certificate(np.nextafter(1.0, 0.0), 1.1e-9, -0.9e-9).valid
    for wrong in ((1.0,), (0.5, 1e-9), (0.5, 1.0, -1e-9), (0.5, 1.5e-9, 0.0, 2.0)):
        assert not certificate(*wrong).valid
    assert certificate(decrease=-1.5e-9, largest=2.0).valid
    assert certificate(decrease=-0.9e-9, largest=0.5).valid


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Tuning(0), "N1 = 0, Np = 11: expected 1 <= N1 <= Np"),
        (lambda: Tuning(3, 2), "N1 = 3, Np = 2: expected 1 <= N1 <= Np"),
        (lambda: Tuning(1, 2, 0), "Nc = 0, Np = 2: expected 1 <= Nc <= Np"),
        (lambda: Tuning(1, 2, 3), "Nc = 3, Np = 2: expected 1 <= Nc <= Np"),
        (lambda: Tuning(weight=-1e-9), "lambda = -1e-09: expected a finite number, not negative"),
        (lambda: Tuning(weight=math.inf), "lambda = inf: expected a finite number, not negative"),
        (lambda: Carima((), (1.0,)), "a = []: expected 1 as its first coefficient"),
        (lambda: Carima((2.0,), (1.0,)), "a = [2.0]: expected 1 as its first coefficient"),
        (lambda: Carima((1.0,), (0.0,)), "b = [0.0]: expected a coefficient other than zero"),
        (lambda: Carima((1.0, math.inf), (1.0,)), "a = [1.0, inf], b = [1.0]: expected finite numbers"),
        (lambda: Carima.from_continuous((1.0,), (), 0.1), "den = []: expected a first coefficient"),
        (lambda: Carima.from_continuous((1.0,), (0.0, 1.0), 0.1), "den = [0.0, 1.0]: expected a first coefficient"),
        (
            lambda: Carima.from_continuous((0.0, 1.0, 1.0), (1.0, 1.0), 0.1),
            "num = [1.0, 1.0]: expected a degree below the 1 of den",
        ),
        (lambda: Carima.from_continuous((0.0,), (1.0, 1.0), 0.1), "num = []: expected a degree below the 1 of den"),
        (lambda: invert([[1.0, 1.0], [1.0, 1.0]]), "G' G + lambda I is singular"),
        (lambda: StepProfile([], []), "times []: expected at least one"),
        (lambda: StepProfile([0.0, 0.0], [1, 2]), "times [0.0, 0.0]: expected at least one"),
        (lambda: StepProfile([0.0, 1.0], [1]), "1 values for 2 times"),
        (lambda: split("b/c/position/"), "'b/c/position/': expected topic/channel/field"),
        (lambda: split("c/position"), "'c/position': expected topic/channel/field"),
        (lambda: split("a//position"), "'a//position': expected topic/channel/field"),
    ],
)
def test_impossible_values_are_refused(make, text):
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        make()
    assert str(refused.value).startswith(text)


@pytest.mark.parametrize(
    "model", [Carima((1.0, -1.5, 0.75), (2.0,)), Carima((1.0, -0.5), (0.0, 1.0, 3.0)), Carima((1.0,), (4.0, 5.0))]
)
def test_the_companion_form_of_a_model_has_the_pulse_response_of_its_difference_equation(model):
    a, b, c = companion(model)
    n = max(len(model.a) - 1, len(model.b))
    assert (a.shape, b.shape, c.shape) == ((n, n), (n, 1), (1, n))
    x, y = b.copy(), [0.0]  # the state after a pulse at k = 0
    for k in range(1, 8):
        past = sum(-p * y[k - i] for i, p in enumerate(model.a) if 0 < i <= k)
        y.append(past + (model.b[k - 1] if k <= len(model.b) else 0.0))
        assert (c @ x).item() == pytest.approx(y[k])
        x = a @ x


@pytest.mark.parametrize(
    ("model", "parameters", "text"),
    [
        (GpcControllerParams, {"N1": 12}, "N1 = 12, Np = 11: expected 1 <= N1 <= Np"),
        (GpcControllerParams, {"den": (0.0, 1.0)}, "den = [0.0, 1.0]: expected a first coefficient other than zero"),
        (LinearPlantParams, {"command": "v"}, "'v': expected topic/channel/field"),
        (LinearPlantParams, {"output": "a/b/duty"}, "'a/b/duty': expected topic/channel/field"),
        (LinearPlantParams, {"den": (0.0, 1.0)}, "den = [0.0, 1.0]: expected a first coefficient other than zero"),
        (LinearPlantParams, {"num": (1.0, 2.0, 3.0)}, "num = [1.0, 2.0, 3.0]: expected a degree below the 2 of den"),
        (CertificateParams, {"K": (1.0,)}, "K has 1, Qbar 0 values, expected 2 and 4, or none"),
        (CertificateParams, {"K": (1.0, 2.0), "Qbar": (1.0,) * 3}, "K has 2, Qbar 3 values, expected 2 and 4, or none"),
    ],
)
def test_impossible_parameters_are_refused_before_they_are_used(model, parameters, text):
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        model(**parameters)
    assert text in str(refused.value)


def test_values_at_the_limits_are_accepted():
    assert Tuning(1, 1, 1, 0.0)
    assert Tuning(2, 2, 2)
    assert Carima((1.0,), (0.0, 1.0)).b == (0.0, 1.0)
    assert Carima.from_continuous((0.0, 0.0, 2.0), (1.0, 1.0), 0.1).b == pytest.approx((2.0 * (1.0 - math.exp(-0.1)),))


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"u_min": 1.0, "u_max": 1.0}, "u_min = 1, u_max = 1: expected u_min < u_max"),
        ({"trip_low": 2.0, "trip_high": 2.0}, "trip_low = 2, trip_high = 2: expected trip_low below"),
        ({"du_max": 5.0}, "du_max = 5 needs a solver, solver = closed_form has none"),
        ({"measured": "v"}, "'v': expected topic/channel/field"),
        ({"reference": "v"}, "'v': expected topic/channel/field"),
        ({"command": "v"}, "'v': expected topic/channel/field"),
        ({"N1": 12}, "N1 = 12, Np = 11"),
    ],
)
def test_an_impossible_predictive_controller_is_refused(parameters, text):
    with pytest.raises(ParameterError, match=text):
        GpcController(**parameters)


def test_a_predictive_controller_trips_beyond_its_limits_and_at_the_third_bad_sample():
    """Below and at `trip_low`, above `trip_high`; from then on the command is the safe one, whatever is measured."""
    model = {"a": (1.0, -0.5), "b": (1.0,), "trip_low": 1.0, "trip_high": 3.0, "u_safe": 7.0, "set_point": 2.0}
    for y, trips in ((3.0, False), (3.0000001, True), (1.0, True), (1.0000001, False)):
        law = ByHand(GpcController(**model))
        outputs = law.update(0, measured=(y,), reference=None)
        assert (outputs["health"][0] == 3.0) == trips
        assert ("trip" in law.reports) == trips
        again = law.update(10_000_000, measured=(2.0,), reference=None)
        assert (again["command"] == (7.0,)) == trips
    law = ByHand(GpcController(**model, u_min=-0.25, u_max=0.25))
    outputs = law.update(0, measured=(1.5,), reference=(2.0,))
    assert outputs == {"command": (0.25,), "health": (1.0, 1.0, 0.0)}
    states = [law.refused(k * 10_000_000)["health"] for k in (1, 2, 3, 4)]
    assert states == [(2.0, 0.0, 0.0), (2.0, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 0.0, 0.0)]
    assert law.reports["bad_input"][1] == "a measurement or reference was refused; the last command is held"
    assert law.reports["trip"][1] == "3 bad samples in a row: tripped to 7 V for good"
    patient = ByHand(GpcController(**model))
    for k in range(8):
        outputs = (
            patient.refused(k * 10_000_000)
            if k % 3
            else patient.update(k * 10_000_000, measured=(2.0,), reference=None)
        )
        assert outputs["health"][0] == (2.0 if k % 3 else 0.0)


def test_a_predictive_controller_replaces_a_bad_sample_by_the_prediction_under_the_held_command():
    parameters = {"a": (1.0, -0.5), "b": (1.0, 0.25), "set_point": 2.0, "lam": 0.5}
    law, gpc = ByHand(GpcController(**parameters)), Gpc(Carima(parameters["a"], parameters["b"]), Tuning(weight=0.5))
    x, last = gpc.first(1.5, 0.0), 1.5
    for k, y in enumerate((1.5, 1.0, None, 1.25, None, None, 0.5)):
        if y is None:
            x = gpc.applied(gpc.measure(x, last), x.u)
            answer = law.refused(k * 10_000_000)
        else:
            x, last = gpc.measure(x, y), y
            x = gpc.applied(x, x.u + gpc.move(x, 2.0))
            answer = law.update(k * 10_000_000, measured=(y,), reference=None)
        assert answer["command"] == (x.u,)
    first = ByHand(GpcController(**parameters))
    assert first.refused(0)["command"] == (0.0,)  # no earlier command exists to hold
    assert first.update(10_000_000, measured=(1.5,), reference=None) == ByHand(GpcController(**parameters)).update(
        0, measured=(1.5,), reference=None
    )


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"topic_in": "a", "topic_out": "a"}, "topic_in and topic_out are both 'a'"),
        ({"fields": ("speed",)}, "fields ['speed'], expected some of ['effort', 'position', 'velocity']"),
        ({"fields": ()}, "fields [], expected some of ['effort', 'position', 'velocity']"),
        ({"dims": ("a",), "sizes": (2,)}, "dims ['a'] with sizes [2], expected none"),
        ({"message": "std_msgs/msg/Float64MultiArray"}, "dims [] with sizes [], expected one size"),
        (
            {"message": "std_msgs/msg/Float64MultiArray", "dims": ("a", "b"), "sizes": (2,)},
            "dims ['a', 'b'] with sizes [2], expected one size",
        ),
        ({"initial": (1.0,)}, "initial has 1 values, expected 2"),
        ({"units": ("m",) * 3}, "units has 3 values, expected 2"),
        ({"limits": (1.0,)}, "limits has 1 values, expected 2"),
    ],
)
def test_an_impossible_link_is_refused(parameters, text):
    with pytest.raises(ValueError) as refused:  # noqa: PT011
        LinkParams(**parameters)
    assert text in str(refused.value)


def test_a_watched_margin_of_zero_holds_and_a_negative_one_is_reported_once():
    watched = ByHand(RequirementMonitor(formula="always x <= 1"))
    watched.block.ages = lambda name: 0
    results = []
    for k, x in enumerate((0.5, 1.0, 1.25, 2.0, 0.0)):
        results.append(watched.update(k * 10_000_000, state=(x,))["margin"])
        assert ("violated" in watched.reports) == (k > 1)
    assert results == [(-1e12, upper, 0.0) for upper in (0.5, 0.0, -0.25, -1.0, -1.0)]
    text = "always x <= 1 is violated, its margin is at most -0.25 m, known at t = 0.02 s"
    assert watched.reports["violated"][1] == text
    ends = ByHand(RequirementMonitor(formula="always x <= 1", ends=True, name="limit"))
    ends.block.ages = lambda name: 0
    ends.update(0, state=(1.0,))
    with pytest.raises(
        RunError, match=r"^limit: always x <= 1 is violated, its margin is at most -1 m, known at t = 0\.01 s$"
    ):
        ends.update(10_000_000, state=(2.0,))


def test_rows_of_a_profile_are_checked():
    class Params(ProfileParams):
        values: tuple[float, ...] = (1.0, 2.0)

    profile = Params(channels=("a", "b"), times=(0.0, 1.0), values=(1.0, 2.0, 3.0, 4.0))
    assert profile.rows("values") == [(1.0, 2.0), (3.0, 4.0)]
    with pytest.raises(ValueError, match=r"values has 3 values, expected 4 \(2 times, 2 channels\)"):
        Params(channels=("a", "b"), times=(0.0, 1.0), values=(1.0, 2.0, 3.0)).rows("values")
    with pytest.raises(ValueError, match=r"times begins with 0\.5 s, expected 0"):
        Params(times=(0.5,))
