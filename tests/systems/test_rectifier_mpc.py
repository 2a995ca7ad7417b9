"""Rectifier under generalised predictive control: the controller, its certificate, the plants, the scenarios, bad
input.
"""

import json
import math
import subprocess
import sys
from collections import Counter
from functools import cache

import mpmath
import numpy as np
import pytest
from conftest import few
from hypothesis import given, strategies as st
from pages.drawn import rectifier_mpc as pictures
from scipy import linalg, signal
from scipy.optimize import brentq
from scipy.special import jv
from softrig_control.nodes.linear_plant import LinearPlant
from softrig_control.predictive.carima import Carima, diophantine, multiply, predict
from softrig_control.predictive.certificate import assess, certify
from softrig_control.predictive.certificate_node import CertificateNode
from softrig_control.predictive.controller import GpcController
from softrig_control.predictive.gpc import Gpc, Tuning, invert
from softrig_control.predictive.qp import MoveSolver
from softrig_core import (
    ByHand,
    Level,
    ParameterError,
    Refused,
    list_scenarios,
    load_scenario,
    scalars,
    simulate,
)
from softrig_core.block.codec import Decoder
from softrig_core.verdict.findings import findings, values
from softrig_core.wire.cdr import Layout
from softrig_power.rectifier.circuit import SPWM, Circuit, Period, grid
from softrig_power.rectifier.models import SEED19_DEN, SEED19_NUM, d2, linearised, n3, seed19
from softrig_power.rectifier.parameters import RectifierConstants
from softrig_power.rectifier.plant import RectifierPlant
from softrig_power.rectifier.ports import DC_LINK, POWER_QUALITY, V_DROP, events

T = 0.83e-3
CONSTANTS = RectifierConstants()


SCENARIOS = sorted(n for n in list_scenarios() if n.startswith("rectifier_mpc"))


@cache
def run_of(name):
    """A whole run, cached: several tests use it."""
    return simulate(name)


@pytest.mark.parametrize("name", few(SCENARIOS, 6))
def test_scenario_meets_its_figures(name):
    run = run_of(name)
    assert run.results
    assert [(row.name, row.value) for row in run.missed] == []


def _radius(law):
    return max(map(abs, law.poles()))


def _dc_gain(model):
    return sum(model.b) / sum(model.a)


def _step_response(model, n):
    """y(1), ..., y(n) for u = 1 from t = 0 on, from rest."""
    return signal.lfilter((0.0, *model.b), model.a, np.ones(n + 1))[1:]


@pytest.mark.parametrize(
    ("period", "weight", "radius"),
    [(2e-4, 17.873, 0.9786), (1e-4, 17.873, 1.0173), (T, 17.873, 0.8077)],
)
def test_spectral_radius_of_the_closed_loop(period, weight, radius):
    assert _radius(Gpc(seed19(period), Tuning(weight=weight))) == pytest.approx(radius, abs=5e-4)


@pytest.mark.parametrize(
    ("period", "weight", "tolerance"),
    [(2e-4, 35.90, 0.05), (1.5e-4, 10.70, 0.0107), (3e-4, 219.4, 0.22), (4e-4, 1041, 1.1)],
)
def test_critical_weight_puts_a_pole_on_the_unit_circle(period, weight, tolerance):
    model = seed19(period)
    result = brentq(lambda w: _radius(Gpc(model, Tuning(weight=w))) - 1.0, 0.5 * weight, 2.0 * weight)
    assert result == pytest.approx(weight, abs=tolerance)


@pytest.mark.long
def test_verdicts_on_the_papers_claims_hold():
    results = [
        finding
        for name in SCENARIOS
        for finding in findings(load_scenario(name), lambda other: values(run_of(other).results), {})
    ]
    assert [f"{f.scenario}: {f.false}" for f in results if not f.holds] == []
    assert Counter(f.verdict for f in results) == {"reproduced": 9, "fitted": 3, "refuted": 12}


def test_poles_are_those_of_the_simulated_loop():
    """The slowest mode in the start of the loop is the largest pole."""
    law, plant = Gpc(seed19(1e-4), Tuning(weight=17.873)), ByHand(LinearPlant(period=1e-4))
    y, x = [], law.first(0.0, 0.0)
    for k in range(1500):
        y.append(plant.outputs(k)["output"][0])
        x = law.measure(x, y[-1])
        x = law.applied(x, x.u + law.move(x, 400.0))
        plant.advance(k, command=(x.u,))
    growth = (np.abs(y[1000:]).max() / np.abs(y[500:1000]).max()) ** (1 / 500)
    assert growth == pytest.approx(_radius(law), abs=5e-4)


models = st.tuples(
    st.lists(st.floats(-0.95, 0.95), min_size=1, max_size=4), st.lists(st.floats(-2, 2), min_size=1, max_size=4)
).filter(lambda m: any(m[1]))


@given(models)
def test_diophantine_identity(m):
    a = np.real(np.poly(m[0])).tolist()
    for j, (e, f) in enumerate(diophantine(a, 11), 1):
        whole = np.zeros(j + len(a))
        product = multiply(e, multiply(a, (1.0, -1.0)))
        whole[: len(product)] += product
        whole[j : j + len(f)] += f
        whole[0] -= 1.0
        assert np.abs(whole).max() < 1e-10
        assert len(e) == j


@given(models, st.lists(st.floats(-3, 3), min_size=20, max_size=20))
def test_a_prediction_equals_the_response_of_the_model(m, moves):
    """From any past, free response and step matrix give the model's own future."""
    model = Carima(tuple(np.real(np.poly(m[0])).tolist()), tuple(m[1]))
    u = np.cumsum(moves)
    y = np.zeros(20)
    for t in range(1, 20):
        y[t] = sum(-a * y[t - i] for i, a in enumerate(model.a[1:], 1) if t >= i)
        y[t] += sum(b * u[t - 1 - i] for i, b in enumerate(model.b) if t - 1 - i >= 0)
    now, horizon = 10, 9
    g, f, h = predict(model, 1, horizon, horizon)
    past_y = [y[now - i] for i in range(len(f[0]))]
    past_moves = [moves[now - 1 - i] for i in range(len(h[0]))]
    result = np.array(g) @ moves[now : now + horizon] + np.array(f) @ past_y
    if past_moves:
        result = result + np.array(h) @ past_moves
    np.testing.assert_allclose(result, y[now + 1 : now + 1 + horizon], atol=1e-6)


def test_step_matrix_begins_with_the_step_response():
    model = n3(CONSTANTS, T)
    published = [-0.005536, 0.052710, 0.224145, 0.537383, 0.999847, 1.599348, 2.307336, 3.083394, 3.880437, 4.650077,
                 5.347639]  # fmt: skip
    column = [row[0] for row in predict(model, 1, 11, 2).g]
    np.testing.assert_allclose(column, published, atol=1e-6)
    np.testing.assert_allclose(column, _step_response(model, 11), atol=1e-9)
    a, b = linearised(CONSTANTS)
    _, exact = signal.step(signal.StateSpace(a, b, [[0, 0, 1]], [[0]]), T=np.arange(12) * T)
    np.testing.assert_allclose(column, exact[1:], atol=1e-9)


def numerator(num, den, a):
    """Numerator of a sampled model in 50 digits: its first impulses, weighed by its denominator.

    scipy gives it as a difference of polynomials, right to some 1e-15, with numbers of 1e-10.
    """
    with mpmath.workdps(50):
        A, B, C, _ = (mpmath.matrix(m.tolist()) for m in signal.tf2ss(num, den))
        n = len(den) - 1
        both = mpmath.zeros(n + 1)
        both[:n, :n], both[:n, n] = A * T, B * T
        step = mpmath.expm(both, method="taylor")
        impulses = [(C * step[:n, :n] ** k * step[:n, n])[0] for k in range(n)]
        exact, m = [mpmath.mpf(1)], mpmath.zeros(n)  # characteristic polynomial by Faddeev and LeVerrier
        for k in range(1, n + 1):
            m = step[:n, :n] * m + exact[-1] * mpmath.eye(n)
            product = step[:n, :n] * m
            exact.append(-sum(product[i, i] for i in range(n)) / k)
        np.testing.assert_allclose([float(x) for x in exact], a, rtol=1e-12)
        return [float(sum(exact[i] * impulses[k - i] for i in range(k + 1))) for k in range(n)]


def test_sampled_models_agree_with_scipy():
    for num, den in ((SEED19_NUM, SEED19_DEN), ((3.0,), (2.0, 0.5, 7.0, 1.0)), ((5.0,), (1.0, 0.0))):
        _, a, _ = signal.cont2discrete((num, den), T)
        model = Carima.from_continuous(num, den, T)
        np.testing.assert_allclose(model.a, a, rtol=1e-9)
        np.testing.assert_allclose(model.b, numerator(num, den, model.a), rtol=1e-7)
    assert _dc_gain(seed19(T)) == pytest.approx(77.003, abs=1e-3)
    assert seed19(T).b == pytest.approx((0.16467, 0.15255), abs=1e-5)  # printed as 0.116 and 0.107


def test_corrected_models_are_those_of_the_operating_point():
    c = CONSTANTS
    assert (c.current, c.drop, c.impedance) == pytest.approx((37.8322, 27.7852, 0.73443), abs=1e-4)
    assert math.degrees(c.phi) == pytest.approx(82.1743, abs=1e-4)
    assert [RectifierConstants(R_L=16 / f).current for f in (1.25, 1.5, 2, 2.5)] == pytest.approx(
        [47.553, 57.385, 77.402, 97.919], abs=1e-3
    )
    high = RectifierConstants(V_g=234.0)  # unity power factor needs a voltage above 400/sqrt(3)
    assert abs(234.0 - complex(c.R, 2 * math.pi * 60 * c.L) * high.current) == pytest.approx(232.07, abs=0.01)
    third, second = n3(c, T), d2(c, T)
    assert third.b == pytest.approx((-0.00553621, 0.07332316, -0.00135521), abs=1e-8)
    assert third.a == pytest.approx((1.0, -2.72329524, 2.55901776, -0.82629094), abs=1e-8)
    assert second.b == pytest.approx((-0.00074274, 0.51542369), abs=1e-8)
    assert second.a == pytest.approx((1.0, -0.90050642), abs=1e-8)
    assert (_dc_gain(third), _dc_gain(second)) == pytest.approx((7.0435, 5.1730), abs=1e-4)
    poles = np.linalg.eigvals(linearised(c)[0])
    assert sorted(poles.real) == pytest.approx([-126.26, -51.81, -51.81], abs=0.01)
    assert max(poles.imag) == pytest.approx(376.99, abs=0.01)
    a, b = (np.array(m) for m in linearised(c))
    pencil = np.block([[a, b], [np.array([[0, 0, 1.0, 0]])]])
    zeros = linalg.eigvals(pencil, np.diag([1.0, 1, 1, 0]))
    zeros = zeros[np.isfinite(zeros)].real
    assert sorted(zeros) == pytest.approx([-2794.8, 2361.6], abs=0.1)


def test_certificate():
    rows = {
        1e-3: ((-0.76362, 0.46805), (1.26553, -0.58845, 0.43951), 0.60815),
        T: ((-0.64812, 0.42658), (0.97640, -0.53451, 0.39160), 0.66098),
    }
    for period, (gain, terminal, modulus) in rows.items():
        certificate = certify(seed19(period))
        assert certificate.gain[0] == pytest.approx(gain, abs=1e-5)
        assert certificate.terminal[np.triu_indices(2)] == pytest.approx(terminal, abs=1e-5)
        assert certificate.moduli == pytest.approx([modulus] * 2, abs=1e-5)
        assert certificate.residual < 1e-10
        assert certificate.valid


@pytest.mark.parametrize(
    ("gain", "moduli"),
    [((1.833, 1.077), (3.73, 0.066)), ((-1.833, -1.077), (1.381, 1.381)), ((-1.833, 1.077), (0.498, 0.495))],
)
def test_the_papers_equation_33_is_not_a_certificate(gain, moduli):
    c = np.array([[0.2383, 0.218]])
    result = assess([[1.83, -0.83], [1, 0]], [[1], [0]], [gain], [[5.34, 1.83], [1.83, 1]], c.T @ c, 1.0)
    assert result.moduli == pytest.approx(moduli, abs=2e-3)
    assert result.definite > 0
    assert result.residual > 1.0
    assert not result.valid


def test_a_certificate_is_refused_when_one_entry_is_wrong():
    certificate = certify(seed19(T))
    a, b = [[-x for x in seed19(T).a[1:]], [1, 0]], [[1], [0]]
    c = np.array([seed19(T).b])
    assert assess(a, b, certificate.gain, certificate.terminal, c.T @ c, 1.0).valid
    assert not assess(a, b, certificate.gain, certificate.terminal * 0.99, c.T @ c, 1.0).valid


def test_closed_form_is_the_least_squares_solution():
    law = Gpc(n3(CONSTANTS, T), Tuning(2, 9, 3, 7.0))
    g, f, h = (np.array(m) for m in predict(law.model, 2, 9, 3))
    x = law.first(398.0, 27.0)
    for y, u in ((401.0, 28.5), (399.0, 26.0), (397.5, None)):
        x = law.measure(x, y)
        if u is not None:
            x = law.applied(x, u)
    free = f @ [397.5, 399.0, 401.0, 398.0] + h @ [-2.5, 1.5]
    stacked = np.vstack([g, np.sqrt(7.0) * np.eye(3)])
    moves = np.linalg.lstsq(stacked, np.concatenate([400.0 - free, np.zeros(3)]), rcond=None)[0]
    assert law.move(x, 400.0) == pytest.approx(moves[0], rel=1e-10)
    assert -np.linalg.solve(law.hessian, law.gradient(x, 400.0)) == pytest.approx(moves, rel=1e-9)


def test_the_solver_agrees_with_an_enumeration_of_active_sets():
    law = Gpc(n3(CONSTANTS, T), Tuning(weight=500.0))
    solver = MoveSolver(law.hessian, 2.0)
    rng = np.random.default_rng(5)
    active = 0
    for q, u in zip(rng.normal(0, 3000, (200, 2)), rng.uniform(-38, 88, 200), strict=True):
        moves, status = solver.solve(q.tolist(), -40.0 - u, 90.0 - u)
        assert status == "optimal"
        expected = best_of_active_sets(np.array(law.hessian), q, -40.0 - u, 90.0 - u, 2.0)
        assert moves == pytest.approx(expected, abs=1e-6)
        active += max(abs(moves[0]), abs(moves[1])) > 2.0 - 1e-6
    assert active > 100


def best_of_active_sets(h, q, low, high, most):
    """Every choice of at most two bounds held with equality; the feasible stationary point of least cost."""
    rows = np.array([[1.0, 0], [0, 1], [1, 0], [1, 1]])
    limits = [(-most, most), (-most, most), (low, high), (low, high)]
    bounds = [(rows[i], b) for i in range(4) for b in limits[i]]
    choices = [[], *([b] for b in bounds), *([a, b] for i, a in enumerate(bounds) for b in bounds[i + 1 :])]
    results = []
    for chosen in choices:
        e = np.array([r for r, _ in chosen]).reshape(-1, 2)
        system = np.block([[h, e.T], [e, np.zeros((len(e), len(e)))]])
        if abs(np.linalg.det(system)) < 1e-9:
            continue
        x = np.linalg.solve(system, np.concatenate([-q, [b for _, b in chosen]]))[:2]
        if all(lo - 1e-9 <= r @ x <= hi + 1e-9 for r, (lo, hi) in zip(rows, limits, strict=True)):
            results.append((0.5 * x @ h @ x + q @ x, *x))
    return min(results)[1:]


def test_infeasible_programme_is_reported_and_solved_again_afterwards():
    solver = MoveSolver(((584.0, 68.0), (68.0, 555.0)), 2.0)
    before = solver.solve([10.0, 20.0], -5.0, 5.0)
    assert solver.solve([0.0, 0.0], 30.0, 40.0).moves is None
    assert solver.solve([0.0, 0.0], 30.0, 40.0).status != "optimal"
    assert solver.solve([10.0, 20.0], -5.0, 5.0).moves == pytest.approx(before.moves, abs=1e-12)


def test_active_bounds_are_counted_over_all_moves():
    law = GpcController(solver="daqp", u_min=-1.0, u_max=1.0, du_max=2.0, u_start=0.0)
    # The first move has one active bound, the second two, the third none.
    assert law._active(0.0, (1.0, -2.0, 0.5)) == 3
    assert GpcController()._active(0.0, (1.0, -2.0, 0.5)) == 0
    # A distance below 1e-7 of the bound counts as active.
    edge = GpcController(solver="daqp", u_min=0.0, u_max=0.5, du_max=1.0)
    assert [edge._active(0.0, (u,)) for u in (1e-7, 1.0000001e-7, 0.5 - 0.9e-7, 0.5 - 1.1e-7)] == [1, 0, 1, 0]
    assert [edge._active(u, (-u,)) for u in (1.0 - 0.9e-7, 1.0 - 1.1e-7)] == [2, 1]


def test_no_solution_holds_the_last_command_and_warns():
    law = ByHand(GpcController(solver="daqp", u_min=10.0, u_max=20.0, du_max=1.0, u_start=0.0, set_point=400.0))
    for k in range(2):
        outputs = law.update(k, measured=(390.0,), reference=None)
        assert outputs["command"] == (0.0,)
        assert outputs["health"] == (2.0, 0.0, k + 1.0)
    level, text, _ = law.reports["no_solution"]
    assert (level, text) == (Level.WARN, "daqp: infeasible; the last command is held")


def test_constrained_without_bounds_is_the_closed_form():
    free, bounded = ByHand(GpcController(set_point=400.0)), ByHand(GpcController(set_point=400.0, solver="daqp"))
    for k in range(30):
        y = (400.0 * (1 - 0.8**k),)
        expected = free.update(k, measured=y, reference=None)["command"][0]
        assert bounded.update(k, measured=y, reference=None)["command"][0] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("solver", ["closed_form", "daqp"])
def test_anti_windup(solver):
    """After any time on a bound the law is as if the bound had been its command from the start."""
    values = {"set_point": 400.0, "u_min": 0.0, "u_max": 3.0, "period": T, "solver": solver}
    law, fresh = ByHand(GpcController(**values)), ByHand(GpcController(**values, u_start=3.0))
    for k in range(30):
        outputs = law.update(k, measured=(100.0,), reference=None)
    assert outputs["command"] == (3.0,)
    assert outputs["health"][0] == 1.0
    fresh.update(0, measured=(100.0,), reference=None)
    assert law.block.law.move(law.x.law, 400.0) == pytest.approx(fresh.block.law.move(fresh.x.law, 400.0), abs=1e-9)
    back = [[x.update(k, measured=(500.0,), reference=None)["command"][0] for k in range(5)] for x in (law, fresh)]
    assert back[0] == pytest.approx(back[1], abs=1e-9)
    assert back[0][0] < 3.0


def test_inverse():
    m = np.array(Gpc(n3(CONSTANTS, T), Tuning(moves=4, weight=3.0)).hessian)
    np.testing.assert_allclose(np.array(invert(m)) @ m, np.eye(4), atol=1e-12)
    with pytest.raises(ValueError, match="singular"):
        invert([[1.0, 2.0], [2.0, 4.0]])


NS = 830_000
NOMINAL = (16.0, 180.0, 0.0)


def moving(plant):
    """Currents and voltage of a plant."""
    return plant.x[: plant.x._fields.index("v") + 1]


def run_held(plant, periods, command=CONSTANTS.drop, events=NOMINAL):
    """Run a plant with a constant command; return its power-quality figures by name."""
    for k in range(periods):
        plant.advance(k * NS, command=(command,), events=events)
    result = plant.outputs(periods * NS)["power_quality"]
    return dict(zip(POWER_QUALITY.channels, result, strict=True))


def test_models_agree_on_every_event():
    """The two averaged implementations under the same commands; the switched one except for its ripple."""
    commands = simulate("rectifier_mpc", duration=0.2).signals["v_drop/command/v_drop/effort"].x.tolist()
    events = [(16.0, 180.0, 0.0), (8.0, 180.0, 0.0), (16.0, 234.0, 0.0), (16.0, 180.0, 36.0)]
    traces = {}
    for model in ("averaged_dq", "averaged_abc", "switched"):
        plant = ByHand(RectifierPlant(model=model))
        traces[model] = []
        for k, u in enumerate(commands):
            outputs = plant.outputs(k * NS)
            traces[model].append((*outputs["grid_current"], outputs["dc_link"][0]))
            plant.advance(k * NS, command=(u,), events=events[k * len(events) // len(commands)])
    dq, abc, switched = (np.array(t) for t in traces.values())
    assert np.abs(dq - abc).max() < 1e-6
    assert np.ptp(dq[:, 3]) > 60
    assert np.abs(switched - dq)[:, 3].max() < 2.0
    assert np.abs(switched - dq)[:, :3].max() < 4.0


def test_the_equilibrium_is_at_rest():
    plant = ByHand(RectifierPlant())
    run_held(plant, 200)
    assert moving(plant) == pytest.approx((CONSTANTS.current, 0.0, 400.0), abs=1e-9)


def test_a_collapsing_voltage_stops_the_converter():
    plant = ByHand(RectifierPlant(v_least=401.0))
    plant.advance(0, command=(CONSTANTS.drop,), events=None)
    assert plant.reports == {"collapse": (Level.ERROR, "DC voltage 400 V, below 401 V: converter shut down", 1)}
    assert moving(plant) == (0.0, 0.0, 401.0)
    plant.advance(NS, command=(CONSTANTS.drop,), events=None)  # the converter stays off, whatever is commanded
    assert plant.reports["off"] == (Level.WARN, "switches off: the diodes carry the current", 1)
    assert plant.reports["collapse"][2] == 1


def test_decoupled_current_follows_its_ramp_exactly():
    plant = ByHand(RectifierPlant(structure="decoupled"))
    for k, i in enumerate((40.0, 45.0, 43.5, 38.0)):
        plant.advance(k * NS, command=(i,), events=None)
        assert moving(plant)[:2] == pytest.approx((i, 0.0), abs=1e-9)
    small = _step_response(d2(CONSTANTS, T), 3)
    plant = ByHand(RectifierPlant(structure="decoupled"))
    for k in range(3):
        plant.advance(k * NS, command=(CONSTANTS.current + 1e-4,), events=None)
        assert (plant.x.v - 400.0) / 1e-4 == pytest.approx(small[k], abs=1e-3)


@pytest.mark.parametrize(("carrier_hz", "thd"), [(5e3, 3.768), (1e4, 1.883), (2e4, 0.941)])
def test_switching_harmonics_are_those_of_the_double_fourier_series(carrier_hz, thd):
    """Open loop, so that only the carrier is present."""
    result = run_held(ByHand(RectifierPlant(model="switched", carrier_hz=carrier_hz)), 245)
    assert result["windows"] == 2.0
    assert result["thd"] == pytest.approx(thd, abs=0.003)
    assert result["thd50"] < 0.002
    assert result["current"] == pytest.approx(CONSTANTS.current, abs=0.01)


def test_the_grid_has_its_stated_values():
    c = CONSTANTS
    period = Period(0.0, T, 180.0, 36.0, 16.0, SPWM, 0.0, False, 0.0, 0.0)
    for t in (0.0, 0.0013, 0.0071):
        x = c.omega * t - np.arange(3) * 2 * np.pi / 3
        expected = 180 * np.sin(x) + 36 * np.sin(5 * x)
        assert grid(t, Circuit.of(c.omega, c.L, c.R, c.C, c.phi), period) == pytest.approx(expected, abs=1e-9)


def test_event_takes_effect_in_the_first_period_at_or_after_it():
    signals = simulate("rectifier_mpc", duration=0.16).signals
    t, load = signals["events/load_resistance/position"]
    first = t[np.flatnonzero(load == 8.0)[0]]
    assert first == pytest.approx(181 * T)
    v = signals["dc_link/voltage/position"]
    assert np.abs(v.x[v.t <= first + 1e-9] - 400).max() < 1e-6
    assert v.x[182] < 390


def off(plant, ticks):
    """Voltages of a link whose switches are off from the start."""
    results = []
    for k in range(ticks):
        plant.advance(k * NS, command=(0.0,), events=None)
        outputs = plant.outputs((k + 1) * NS)
        assert all(math.isfinite(x) for port in outputs.values() for x in port)
        assert sum(outputs["grid_current"]) == pytest.approx(0.0, abs=1e-9)
        results.append(outputs["dc_link"][0])
    return np.array(results)


@pytest.mark.parametrize("model", ["averaged_dq", "averaged_abc", "switched"])
@pytest.mark.parametrize(("load", "within"), [(160.0, 0.007), (16.0, 0.01)])
def test_with_the_switches_off_the_diodes_hold_the_link(model, load, within):
    """Six-pulse bridge: 3 sqrt(3)/pi V_g less commutation and resistance, 3 omega L/pi and 2 R of the mean current."""
    v = off(ByHand(RectifierPlant(model=model, R_L=load, i_start=0.0)), 400)[-145:].mean()
    fall = 3.0 * CONSTANTS.omega * CONSTANTS.L / math.pi + 2.0 * CONSTANTS.R
    assert v == pytest.approx(3.0 * math.sqrt(3.0) / math.pi * 180.0 / (1.0 + fall / load), rel=within)
    if load == 16.0:
        assert v == pytest.approx(281.0, abs=0.5)


def test_without_load_the_link_stays_at_the_peak_between_two_phases():
    v = off(ByHand(RectifierPlant(R_L=1e6, v_start=311.0, i_start=0.0)), 200)
    assert v[-1] == pytest.approx(math.sqrt(3.0) * 180.0, abs=0.5)  # a model without diodes falls to 189.6 V
    high = off(ByHand(RectifierPlant(R_L=1e6, v_start=400.0, i_start=0.0)), 20)
    assert high[-1] == pytest.approx(400.0 * math.exp(-20 * T / (1e6 * CONSTANTS.C)), rel=1e-9)


def test_half_the_step_of_the_diodes_changes_nothing(monkeypatch):
    from softrig_power.rectifier import diodes

    x = [np.array([0.0, 0.0, 0.0, 290.0]) for _ in range(2)]
    both = (
        Circuit.of(CONSTANTS.omega, CONSTANTS.L, CONSTANTS.R, CONSTANTS.C, CONSTANTS.phi),
        Period(0.0, 0.02, 180.0, 0.0, 16.0, 1.0, 0.0, False, 0.0, 0.0),
    )
    for state, steps in zip(x, (20_000, 40_000), strict=True):
        for k in range(steps):
            diodes.conduct((k + 0.5) * 0.02 / steps, 0.02 / steps, state, both)
    assert x[1][3] == pytest.approx(x[0][3], rel=1e-4)
    assert x[1][:3] == pytest.approx(x[0][:3], abs=0.02)


def test_a_trip_in_the_rig_leaves_the_link_to_the_diodes():
    run = simulate("rectifier_mpc", duration=0.45, overrides={"gpc_controller.trip_high": 400.3})
    assert run.blocks["gpc_controller"].x.tripped
    v = run.signals["dc_link/voltage/position"]
    assert v.x[v.t > 0.4].mean() == pytest.approx(267.2, abs=1.0)  # at 8 ohm
    assert "off" in run.blocks["rectifier_plant"].reports


def test_a_limit_cycle_is_reported():
    """A weight that is too small lets the loop collapse into a cycle at 250 V; loops that settle are not reported."""
    law = simulate("rectifier_mpc", overrides={"gpc_controller.lam": 5.0}).blocks["gpc_controller"]
    assert law.reports["limit_cycle"][0] == Level.WARN
    assert "the loop does not settle: voltage swings by 16.2 V about 400 V" in law.reports["limit_cycle"][1]
    for name in (
        "rectifier_mpc",
        "rectifier_mpc_n1",
        "rectifier_mpc_n2",
        "rectifier_mpc_n5",
        "rectifier_mpc_decoupled",
    ):
        assert "limit_cycle" not in run_of(name).blocks["gpc_controller"].reports


@pytest.mark.parametrize("command", [1e6, -1e6])
@pytest.mark.parametrize("model", ["averaged_dq", "averaged_abc", "switched"])
def test_absurd_commands_end_in_a_report_and_not_in_nan(model, command):
    plant = ByHand(RectifierPlant(model=model))
    for k in range(300):
        plant.advance(k * NS, command=(command,), events=(1.0, 180.0, 0.0))
        outputs = plant.outputs((k + 1) * NS)
        assert all(math.isfinite(x) for port in outputs.values() for x in port)


def test_divergence_ends_as_a_reported_trip():
    run = run_of("rectifier_mpc_l2_0p1ms")
    law = run.blocks["gpc_controller"]
    assert law.x.tripped
    assert law.reports["trip"][0] == Level.ERROR
    assert "outside" in law.reports["trip"][1]
    _, u = run.signals["command/u/effort"]
    _, state = run.signals["health/state/position"]
    assert set(u[state == 3.0]) == {0.0}
    assert np.isfinite(run.signals["output/v_dc/position"].x).all()


def test_the_certificate_of_the_papers_model_does_not_help_the_plant():
    """(19) has a valid certificate, its controller a limit cycle on the plant: the model is wrong, not the method."""
    assert certify(seed19(T)).valid
    assert run_of("rectifier_mpc_seed19_lam1").figures["peak_to_peak"] > 160
    assert run_of("rectifier_mpc_seed19").figures["peak_to_peak"] < 0.1


@pytest.mark.long
def test_native_and_plain_code_give_the_same_bits(monkeypatch):
    native = [ByHand(RectifierPlant(model=m)) for m in ("averaged_dq", "averaged_abc", "switched")]
    for plant in native:
        run_held(plant, 2, events=(12.0, 200.0, 20.0))
    code = (
        "import json, sys\n"
        "from softrig_core import ByHand\n"
        "from softrig_power.rectifier.plant import RectifierPlant\n"
        "states = []\n"
        "for m in ('averaged_dq', 'averaged_abc', 'switched'):\n"
        "    plant = ByHand(RectifierPlant(model=m))\n"
        "    for k in range(2):\n"
        f"        plant.advance(k * {NS}, command=({CONSTANTS.drop!r},), events=(12.0, 200.0, 20.0))\n"
        "    states.append(plant.x[:3 if m == 'averaged_dq' else 4])\n"
        "print(json.dumps(states))\n"
    )
    monkeypatch.setenv("SOFTRIG_JIT", "0")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert [tuple(x) for x in json.loads(out)] == [moving(plant) for plant in native]


def test_certificate_node_answers_a_press_once():
    node = ByHand(CertificateNode())
    outputs = node.update(0, certify=None)
    assert outputs["gain"] == pytest.approx((-0.76362, 0.46805), abs=1e-5)
    assert outputs["terminal"][1] == outputs["terminal"][2] == pytest.approx(-0.58845, abs=1e-5)
    assert outputs["verdict"][0] == 1.0
    assert node.update(1, certify=None) == {}
    assert node.update(2, certify=(1.0,)) == outputs
    assert node.update(3, certify=(1.0,)) == {}
    assert node.update(4, certify=(0.0,)) == {}
    assert node.update(5, certify=(1.0,)) == outputs
    assert node.refused(6) == {}
    printed = ByHand(CertificateNode(K=(-1.833, 1.077), Qbar=(5.34, 1.83, 1.83, 1.0)))
    assert printed.update(0, certify=(1.0,))["verdict"][0] == 0.0
    assert printed.reports["no_certificate"][0] == Level.WARN
    with pytest.raises(ParameterError, match="K has 1"):
        CertificateNode(K=(1.0,))


JOINT_STATE = "sensor_msgs/msg/JointState"


@pytest.mark.parametrize(
    ("port", "names", "field", "values", "reason"),
    [
        (V_DROP, ("v_drop",), "effort", (math.nan,), "nan"),
        (V_DROP, ("v_drop",), "effort", (math.inf,), "inf"),
        (V_DROP, ("i_ref",), "effort", (20.0,), "names"),
        (V_DROP, ("v_drop",), "effort", (), "0 values"),
        (DC_LINK, ("voltage", "current"), "position", (math.nan, 1.0), "nan"),
        (DC_LINK, ("voltage",), "position", (400.0,), "names"),
        (events(16.0, 180.0), ("load",), "position", (8.0,), "load"),
    ],
)
def test_bad_messages_are_refused_with_the_reason(port, names, field, values, reason):
    data = Layout(JOINT_STATE, "", names, {field: len(values)}).encode(0, values)
    with pytest.raises(Refused, match=reason):
        Decoder(port)(data)


def test_an_event_may_carry_one_channel():
    decode = Decoder(events(16.0, 180.0))
    channel = scalars("one", "events", {"h5_amplitude": "V"})
    assert decode(channel.layout().encode(0, (36.0,)))[1] == (16.0, 180.0, 36.0)


@pytest.mark.long
def test_pictures_run(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "PICTURES", {"load_steps": pictures.load_steps})
    pictures.draw(tmp_path)
    assert (tmp_path / "rectifier_mpc_load_steps.png").read_bytes()[:4] == b"\x89PNG"


def test_lines_of_the_spectrum_are_the_carriers_sidebands():
    """Double Fourier series of natural sampling: J_0, J_2 and so on of pi m/2, over the reactance at that frequency."""
    t, x = pictures.waveform("rectifier_mpc_n4")
    f, amplitude = pictures.spectrum(t, x["i_a"], 6, 60.0)
    c = CONSTANTS
    m = math.hypot(c.V_g - c.drop * math.cos(c.phi), c.drop * math.sin(c.phi)) / 200.0
    for n, k in ((1, 2), (1, -2), (2, 1), (2, -1)):
        at = n * 1e4 + k * 60.0
        bessel = abs(jv(k, n * math.pi * m / 2.0))
        line = 400.0 * 2.0 / (n * math.pi) * bessel / (2.0 * math.pi * at * c.L)
        assert amplitude[np.argmin(np.abs(f - at))] == pytest.approx(line, rel=0.02), (n, k)
