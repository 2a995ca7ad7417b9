"""Controllers and plants of the drives over random inputs, against independent code.

Sources: the equations of the papers as the pages dc_motor_smc, dc_motor_fsfb and induction_dtc print them, in loops;
scipy for the sampled motor and the Kalman filter, numpy's least squares for slopes, Runge-Kutta steps in complex
numbers for the machine. Figures stand here on even grids; on others in test_figures_over_time.py.
"""

import cmath
import math
from random import Random

import numpy as np
import pytest
from helpers import near
from scipy.linalg import expm, solve_discrete_are
from softrig_control.state_feedback import StateFeedback
from softrig_core import ByHand, Level, Sample
from softrig_core.block.params import build
from softrig_drives.dc_axis.buttons import StepButtons
from softrig_drives.dc_axis.controller import FsfbController
from softrig_drives.dc_axis.motor import MotorParams
from softrig_drives.dc_axis.nominal import NominalAxis
from softrig_drives.dc_axis.plant import DcAxisPlant
from softrig_drives.dc_axis.set_point import Asked, SetPoint
from softrig_drives.dc_motor.kalman_surface import DcMotorSmcKalman
from softrig_drives.dc_motor.pid import DcMotorPid
from softrig_drives.dc_motor.plant import DcMotorPlant
from softrig_drives.dc_motor.sliding_mode import DcMotorSmc
from softrig_drives.induction_dtc import figures as flux
from softrig_drives.induction_dtc.adc import AdcParams, Converter, draw
from softrig_drives.induction_dtc.dtc import DtcController
from softrig_drives.induction_dtc.estimator import EstimatorParams, Flux, make_estimator
from softrig_drives.induction_dtc.machine import MachineConstants, numbers, step_function
from softrig_drives.induction_dtc.plant import ImPlant
from softrig_drives.induction_dtc.speed import SpeedController
from softrig_drives.induction_dtc.switching import TABLES, VECTORS, flux_level, sector, torque_level, voltage

MS = 1_000_000


# the axis --------------------------------------------------------------------------------------------------------


def test_the_set_point_follows_references_and_presses():
    """A new reference sets it, a press moves it, both buttons move nothing; steps beyond 4 mm are reported."""
    draw_ = Random(1)
    messages = []
    accept = SetPoint(2.0, lambda level, key, text: messages.append(key), 4.0)
    asked, value, known, down = Asked(), 0.0, None, (False, False)
    for _ in range(400):
        reference = draw_.choice((None, 4.0, 0.0, -1.5))
        buttons = draw_.random() < 0.5, draw_.random() < 0.4
        fresh = [now and not before for now, before in zip(buttons, down, strict=True)]
        before, reported = value, []
        if reference is not None and reference != known:
            value = known = reference
        if buttons == (True, True):
            reported += ["buttons"] if any(fresh) else []
        else:
            value += 2.0 * fresh[0] - 2.0 * fresh[1]
        reported += ["step"] if abs(value - before) > 4.0 else []
        asked = accept(asked, reference, *buttons)
        assert (asked.value, asked.forward, asked.reverse, messages) == (value, *buttons, reported)
        messages.clear()
        down = buttons


def test_buttons_are_down_from_each_time_on_for_their_duration():
    buttons = ByHand(StepButtons(forward=(0.0, 0.3), reverse=(0.05,), hold=0.1))
    late = 700 * MS  # time counts from the first tick
    for ms in range(0, 500, 10):
        outputs = buttons.update(late + ms * MS)
        assert outputs == {"forward": (float(ms < 100 or 300 <= ms < 400),), "reverse": (float(50 <= ms < 150),)}


def sampled(p):
    """The motor over a period: (v, y) and the voltage to (v, y)."""
    whole = expm(p.period * np.array([[*p.a[0], p.b[0]], [*p.a[1], p.b[1]], [0.0, 0.0, 0.0]]))
    return whole[:2, :2], whole[:2, 2:]


@pytest.mark.parametrize("wanted", [40.0, -40.0])
def test_the_loop_as_designed_reports_its_motion(wanted):
    """Position, speed clipped at its limit, acceleration, deceleration, and jerk by difference."""
    p = MotorParams(period=0.01, vmax=12.0)
    phi, gamma = sampled(p)
    law = StateFeedback((0.5, 4.0), 6.0, p.period, 3.0)
    loop = NominalAxis(p, phi.tolist(), gamma.tolist(), law)
    x = loop.rest(5.0)
    assert x == (0.0, 5.0, 0.0, near(4.0 * 5.0 / 6.0), (5.0, 0.0, 0.0, 0.0, 0.0))
    now, xi, last, fastest = np.array([0.0, 5.0]), 4.0 * 5.0 / 6.0, 0.0, 0.0
    for _ in range(150):
        x = loop(x, wanted)
        u = min(max(6.0 * xi - 0.5 * now[0] - 4.0 * now[1], -3.0), 3.0)
        xi += (wanted - now[1]) * p.period
        a = p.gain * p.mm_per_volt * u - p.pole * now[0]
        assert x.signals == near((now[1], min(max(now[0], -12.0), 12.0), a, -a, (a - last) / p.period))
        fastest = max(fastest, abs(now[0]))
        now, last = phi @ now + gamma[:, 0] * u, a
    assert fastest > 12.0
    other = NominalAxis(p, phi.tolist(), gamma.tolist(), StateFeedback((0.4, 5.0), 3.0, p.period, 3.0))
    then = other.go_on(x, law)
    # The command does not jump.
    assert 3.0 * then.xi - 0.4 * x.v - 5.0 * x.y == near(6.0 * x.xi - 0.5 * x.v - 4.0 * x.y)


@pytest.mark.parametrize("compensation", ["none", "velocity", "predictor"])
@pytest.mark.parametrize("options", [{}, {"integral": False}, {"aw": True, "count_mm": 0.5}, {"delay_from": "fixed"}])
def test_the_axis_controller_is_state_feedback_on_its_compensated_late_measurement(compensation, options):
    law = ByHand(FsfbController(compensation=compensation, period=0.01, u_limit_v=2.0, **options))
    p, draw_ = law.block.p, Random(compensation)
    phi, gamma = sampled(p)
    half = 0.5 * p.count_mm
    xi, r, sent, newest, measured = 0.0, None, [], None, None
    for k in range(60):
        t = k * 10 * MS
        stamp = t - draw_.choice((0, 0, 10, 20, 30) if k > 3 else (0,)) * MS
        y, v = draw_.uniform(-5.0, 5.0), draw_.uniform(-20.0, 20.0)
        wanted = draw_.choice((None, 3.0, -2.0)) if k else None
        outputs = law.update(
            t, feedback=Sample(stamp, (y, v)), reference=wanted and (wanted,), forward=None, reverse=None
        )
        if newest is None:  # the first measurement only sets the initial state
            r, xi = y, p.kp * (y + half) / p.ki if p.integral else 0.0
        if newest is None or stamp > newest:
            newest, measured = stamp, np.array([v, y + half])
        r = wanted or r
        late = 8 if p.delay_from == "fixed" else (t - newest) // (10 * MS)
        state = measured.copy()
        if compensation == "velocity":
            state[1] += state[0] * late * 0.01
        if compensation == "predictor":
            for u in ([0.0] * 8 + sent)[len(sent) + 8 - late :]:
                state = phi @ state + gamma[:, 0] * u
        mm = p.ki * xi if p.integral else r
        free = (mm - p.kv * state[0] - p.kp * state[1]) / p.mm_per_volt
        u = min(max(free, -2.0), 2.0)
        if not (p.aw and (u - free) * (r - state[1]) < 0.0):
            xi += (r - state[1]) * 0.01
        sent.append(u)
        assert outputs["command"] == near((u,))
        assert outputs["controller_state"] == near((r, state[1], state[0], xi, (t - newest) * 1e-9))


def test_changed_gains_of_the_axis_and_the_loop_as_designed_give_no_bump():
    before, after = FsfbController(), FsfbController(poles=(-4.0, -5.0, -6.0))
    x = before.first()
    for k in range(30):
        feedback = Sample(k * 10 * MS, (0.1 * k, 2.0))
        x, _ = before.update(x, k * 10 * MS, feedback=feedback, reference=(9.0,), forward=None, reverse=None)
    now = after.go_on(x, before.p)
    for (v, y), xi_before, xi in ((x.state, x.xi, now.xi), (x.nominal[:2], x.nominal.xi, now.nominal.xi)):
        commands = [
            p.gains()[2] * i - p.gains()[0] * v - p.gains()[1] * y for p, i in ((before.p, xi_before), (after.p, xi))
        ]
        assert commands[1] == near(commands[0])
    assert now._replace(xi=x.xi, nominal=x.nominal) == x
    assert now.nominal.xi != x.nominal.xi


def test_the_axis_controller_is_exact_at_its_limits():
    """Present feedback, of the largest allowed age, and after the longest allowed gap is used; beyond each 0 V."""
    made = {"period": 0.01, "max_age": 0.1}
    law = ByHand(FsfbController(**made))
    assert law.refused(0) == {"command": (0.0,), "model": (0.0,) * 5, "controller_state": (0.0,) * 5}

    def reported(compensation, *ticks):
        law = ByHand(FsfbController(compensation=compensation, **made))
        for t, stamp in ticks:
            outputs = law.update(
                t * MS, feedback=Sample(stamp * MS, (1.0, 0.5)), reference=None, forward=None, reverse=None
            )
        return sorted(law.reports), outputs["command"][0]

    assert reported("none", (0, 0), (100, 0))[0] == []
    assert reported("none", (0, 0), (110, 0)) == (["feedback age"], 0.0)
    assert reported("none", (0, 0), (10, 11)) == (["feedback time"], 0.0)
    assert reported("none", (0, 0), (10, 0), (20, 0))[0] == []  # a repeated time is no step back
    assert reported("none", (0, 0), (10, 10), (20, 0))[0] == ["feedback order"]
    assert reported("predictor", (0, 0), (10, 10), (20, 0))[1] != 0.0
    assert reported("predictor", (0, 0), (60, 0))[0] == []  # five missing periods are still allowed
    assert reported("predictor", (0, 0), (70, 0)) == (["predictor"], 0.0)
    assert reported("predictor", (50, 50), (60, 40)) == (["feedback order"], pytest.approx(-0.222, abs=1e-3))
    assert reported("predictor", (0, 0), (10, 0))[0] == []  # one command is needed, and one is known


def test_the_axis_sticks_up_to_its_stiction_and_no_speed_is_beyond_its_limit():
    p = {"period": 0.001, "friction": True, "coulomb": 30.0, "stiction": 60.0, "gain": 2.0, "mm_per_volt": 10.0}
    for volts, moves in ((3.0, False), (-3.0, False), (3.0001, True)):  # 60 mm/s^2 at 3 V
        axis = ByHand(DcAxisPlant(**p))
        axis.advance(0, command=(volts,))
        assert (axis.outputs(MS)["true_state"][1] != 0.0) is moves
    # A value equal to the limit is allowed.
    assert ByHand(DcAxisPlant(**{**p, "coulomb": 60.0})).outputs(0)["true_state"] == (0.0, 0.0)


# the DC motor ----------------------------------------------------------------------------------------------------


def references(draw_, limit):
    """Messages: none, in range, at its end, beyond it, zero."""
    return draw_.choice((None, None, draw_.uniform(-limit, limit), limit, -limit, 1.001 * limit, 0.0))


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"model": "motor", "delta": 2.0},
        {"k": 40.0, "wd_source": "diff"},
        {"wd_source": "diff", "wd_lp": 0.004, "publish_surface": True, "set_point": 0.0},
    ],
)
def test_the_sliding_mode_controller_equals_its_formula(options):
    law = ByHand(DcMotorSmc(**{"reference_limit": 15.0, "period": 0.001, "c": 4.0, **options}))
    p, draw_ = law.block.p, Random(3)
    gain, a1, a0, per_i, per_w = p.model_gain, p.model_a1, p.model_a0, p.wd_i, p.wd_w
    if p.model == "motor":
        per_i, per_w = p.Kt / p.J, p.b / p.J
        gain = p.Kt / (p.J * p.L)
        a1, a0 = p.R / p.L + p.b / p.J, (p.R * p.b + p.Kt * p.Ke) / (p.J * p.L)
    r, size, before, wd = p.set_point, abs(p.set_point), None, 0.0
    for k in range(80):
        w, i, asked = draw_.uniform(-12.0, 12.0), draw_.uniform(-2.0, 2.0), references(draw_, 15.0)
        outputs = law.update(k * MS, state=(w,), sensors=(0.0, i), reference=None if asked is None else (asked,))
        if asked is not None and abs(asked) <= 15.0:
            r = asked
        assert ("reference_range" in law.reports) is (asked is not None and abs(asked) > 15.0 and asked != r)
        law.reports.clear()
        size = abs(r) if r != 0.0 else size
        if p.wd_source == "current":
            wd = per_i * i - per_w * w
        elif before is not None:
            share = 1.0 - math.exp(-0.001 / p.wd_lp) if p.wd_lp else 1.0
            wd = (1.0 - share) * wd + share * (w - before) / 0.001
        before = w
        s = 4.0 * (r - w) - wd
        K = p.k if p.k is not None else p.k_per_ref * size
        u = (a0 * w + a1 * wd - 4.0 * wd + K * s / (abs(s) + p.delta)) / gain
        assert outputs == {"command": near((u,))} | ({"surface": near((s,))} if p.publish_surface else {})


def test_the_controller_on_estimates_equals_the_one_on_scipys_kalman_filter():
    law = ByHand(DcMotorSmcKalman(period=0.001, delta=3.0, set_point=7.0))
    p, draw_ = law.block.p, Random(5)
    count = math.tau / p.counts_per_rev
    a = np.zeros((5, 5))  # states w, i, theta, load and voltage
    a[0, :4] = -p.b / p.J, p.Kt / p.J, 0.0, -1.0 / p.J
    a[1, :5] = -p.Ke / p.L, -p.R / p.L, 0.0, 0.0, 1.0 / p.L
    a[2, 0] = 1.0
    whole = expm(0.001 * a)
    A, B = whole[:4, :4], whole[:4, 4]
    C = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    Q, R = np.diag([p.var_w, p.var_i, p.var_theta, p.var_load]), np.diag([p.var_current, count**2 / 12.0])
    P = solve_discrete_are(A.T, C.T, Q, R)
    gain = P @ C.T @ np.linalg.inv(C @ P @ C.T + R)
    x, r = np.zeros(4), 7.0
    for k in range(30):
        n, i, v = draw_.randrange(-20, 20), draw_.uniform(-1.0, 1.0), draw_.uniform(-10.0, 10.0)
        asked = draw_.choice((None, 5.0, -9.0))
        outputs = law.update(k * MS, sensors=(float(n), i), applied=(v,), reference=asked and (asked,))
        x = A @ x + B * v
        x = x + gain @ (np.array([i, (n + 0.5) * count]) - C @ x)
        r = asked or r
        wd = (-p.b * x[0] + p.Kt * x[1] - x[3]) / p.J
        s = p.c * (r - x[0]) - wd
        u = (p.model_a0 * x[0] + (p.model_a1 - p.c) * wd + p.k_per_ref * abs(r) * s / (abs(s) + 3.0)) / p.model_gain
        assert outputs["command"][0] == pytest.approx(u, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("make", [DcMotorPid, DcMotorSmc, DcMotorSmcKalman], ids=lambda make: make.__name__)
def test_another_set_point_counts_unless_a_reference_has_overruled_it(make):
    before, after = make(set_point=5.0), make(set_point=-8.0)
    x = after.go_on(before.first(), before.p)
    assert x.r == -8.0
    if make is not DcMotorPid:
        assert x.size == 8.0
        assert make(set_point=0.0).go_on(x, after.p)[:2] == (0.0, 8.0)  # K is still that of the previous block
    same = make(set_point=5.0, reference_limit=6.0)
    assert same.go_on(x, before.p).r == -8.0  # a reference followed before stays when the limit is reduced


@pytest.mark.parametrize("command", [12.0, -12.0])
def test_the_full_supply_and_the_full_range_are_not_beyond_it(command):
    motor = ByHand(DcMotorPlant(rig=True, current_limit=3.2, current_lsb=0.0008))
    motor.advance(0, command=(command,))
    assert motor.reports == {}
    motor.x = motor.x._replace(i=math.copysign(3.2, command))
    assert motor.outputs(MS)["sensors"][1] == near(math.copysign(3.2, command))
    assert motor.reports == {}
    motor.x = motor.x._replace(i=math.copysign(3.2008, command))
    assert motor.outputs(MS)["sensors"][1] == math.copysign(3.2, command)
    assert motor.reports["current_range"][:2] == (
        Level.WARN,
        f"current {math.copysign(3.2008, command):g} A beyond the sensor's 3.2 A",
    )


# the induction motor ---------------------------------------------------------------------------------------------


def test_flux_sectors_and_levels_are_exact_at_their_edges():
    """Sector n is the 60 degrees around 60 (n - 1) with its lower end; levels change only beyond their band."""
    for degrees in range(0, 360, 7):
        assert sector(cmath.rect(0.9, math.radians(degrees))) == math.floor((degrees + 30.0) / 60.0) % 6 + 1
    wide = math.sqrt(3.0)
    edges = [complex(wide, -1.0), complex(wide, 1.0), 1j, complex(-wide, 1.0), complex(-wide, -1.0), -1j]
    assert [sector(z) for z in edges] == [1, 2, 3, 4, 5, 6]
    for level in (0, 1):
        assert [flux_level(level, e, 0.5) for e in (0.51, 0.5, 0.0, -0.5, -0.51)] == [1, level, level, level, 0]
    for level in (-1, 0, 1):
        inside = [torque_level(level, e, 0.5) for e in (0.5, 0.1, 0.0, -0.1, -0.5)]
        assert inside == [max(level, 0), max(level, 0), 0, min(level, 0), min(level, 0)]
        assert (torque_level(level, 0.51, 0.5), torque_level(level, -0.51, 0.5)) == (1, -1)


@pytest.mark.parametrize("mode", ["none", "ideal", "offset", "dither"])
def test_a_converter_is_floor_after_its_shift_within_its_codes(mode):
    p = build(AdcParams, {"adc_mode": mode, "bits": 4, "full_scale": 16.0, "offset_lsb": 0.25, "dither_p": 0.5})
    convert, q, shift = Converter(p), 2.0, 0.5 if mode == "ideal" else 0.25
    for eighths in range(-160, 160):
        x = eighths / 8.0
        code = min(max(math.floor(x / q + shift), -8), 7)
        for uniform, bit in ((0.0, 1), (0.499, 1), (0.5, 0), (0.9, 0)):
            expected = x if mode == "none" else q * (code + bit * (mode == "dither"))
            assert convert(x, uniform) == expected
        assert convert.beyond(x) is (mode != "none" and not -8.0 <= x / q + shift < 8.0)
    places = [draw(k, channel) for k in range(2 * 4096 + 3) for channel in (0, 1)]
    assert len(set(places)) == len(places)
    assert [draw(k, c) for k, c in ((0, 0), (4095, 0), (0, 1), (4096, 0), (4097, 1))] == [0, 4095, 4096, 8192, 12289]


@pytest.mark.parametrize("estimator", ["voltage_model", "observer"])
def test_flux_estimates_solve_their_equations(estimator):
    """By the trapezoidal rule, the observer's correction added afterwards; the first sample only begins."""
    p = build(EstimatorParams, {"estimator": estimator, "R_s_hat": 3.0, "observer_gain": 20.0, "pole_pairs": 3})
    T, draw_ = 1e-3, Random(8)
    estimate = make_estimator(p, T)
    x = estimate(Flux(0.5 + 0.2j), 400.0 + 0j, 1.0 - 2.0j, 50.0)
    assert x == (0.5 + 0.2j, 1.0 - 2.0j, 0j)
    for _ in range(20):
        u, i, w = (complex(draw_.uniform(-9.0, 9.0), draw_.uniform(-9.0, 9.0)) for _ in range(3))
        after = estimate(x, u, i, w.real)
        pulled = after.psi
        if estimator == "observer":
            rate = p.R_R * (x.i + i) / 2 - (p.R_R / p.L_M - 1j * 3 * w.real) * (x.psi_R + after.psi_R) / 2
            assert (after.psi_R - x.psi_R) / T == near(rate)
            raw = x.psi + T * (u - 3.0 * (x.i + i) / 2)
            pulled -= 20.0 * T * (p.L_sigma * i + after.psi_R - raw)
        assert (pulled - x.psi) / T == near(u - 3.0 * (x.i + i) / 2)
        torque = 1.5 * 3 * (after.psi.conjugate() * i).imag
        assert estimate.torque(after) == near(torque)
        x = after


@pytest.mark.parametrize("options", [{}, {"delay_steps": 2, "table": "minimal_switching"}, {"estimator": "observer"}])
def test_direct_torque_control_step_by_step(options):
    """Magnetising by V1 and V0 under a ramp, then the table; two ticks in ten are refused."""
    made = {"period": 1e-3, "magnetising_time": 0.02, "flux_ramp": 0.01, "flux_ref": 0.8, "current_correction": 0.3}
    law = ByHand(DtcController(**made, **options))
    p, draw_ = law.block.p, Random(2)
    estimate, table = make_estimator(p, 1e-3), TABLES[p.table]
    x, increase, more, pipe, vector, link, omega = Flux(), 1, 0, [0] * p.delay_steps, 0, 0.0, 0.0
    for k in range(120):
        t = k * MS
        if draw_.random() < 0.2:
            answer = law.refused(t)
            x = estimate(x, voltage(VECTORS[vector]) * link, x.i or 0j, omega)
            if pipe:
                vector, pipe = pipe[0], [*pipe[1:], pipe[-1]]
        else:
            i_a, i_b, link_now, asked, w = (draw_.uniform(-4.0, 4.0) for _ in range(5))
            link_now = 500.0 + 20.0 * link_now
            inputs = {"joint_states": (40.0 * w,)} if p.estimator == "observer" else {}
            answer = law.update(
                t, currents_meas=(i_a, i_b, 0.0), dc_link=(link_now,), torque_ref=(5.0 * asked,), **inputs
            )
            omega = 40.0 * w if inputs else 0.0
            i_a, i_b = i_a + 0.3, i_b + 0.3
            x = estimate(x, voltage(VECTORS[vector]) * link, complex(i_a, (i_a + 2.0 * i_b) / math.sqrt(3.0)), omega)
            wanted = 0.8 * min(1.0, k / 10.0) if k < 20 else 0.8
            increase = flux_level(increase, wanted - abs(x.psi), p.flux_band)
            chosen = increase
            if k >= 20:
                more = torque_level(more, 5.0 * asked - estimate.torque(x), p.torque_band)
                chosen = table[increase][more][math.floor((math.degrees(cmath.phase(x.psi)) + 30.0) / 60.0) % 6]
            pipe.append(chosen)
            vector, link = pipe.pop(0), link_now
        assert answer["switches"] == VECTORS[vector]
        assert answer["flux_estimate"] == near((x.psi.real, x.psi.imag, 0.0))
        assert answer["torque_estimate"] == near((estimate.torque(x),))


def test_the_flux_is_lost_below_a_tenth_of_its_reference():
    for size, lost in ((0.0901, False), (0.0899, True)):
        law = ByHand(DtcController(magnetising_time=0.0, flux_ref=0.9))
        law.x = law.x._replace(flux=Flux(complex(size, 0.0)))
        law.update(0, currents_meas=(0.0, 0.0, 0.0), dc_link=(540.0,), torque_ref=(0.0,))
        assert law.reports.keys() == ({"flux_lost"} if lost else set())


def test_the_speed_loop_slews_its_reference_and_limits_its_torque():
    law = ByHand(SpeedController(kp=0.5, ki=4.0, u_max=6.0, slew=100.0, period=0.01))
    draw_, reference, integral = Random(4), 0.0, 0.0
    for k in range(80):
        asked, w = draw_.choice((None, 12.0, -12.0, 0.5)), draw_.uniform(-8.0, 8.0)
        outputs = law.update(k * 10 * MS, joint_states=(w,), speed_ref=asked and (asked,))
        target = asked or 0.0
        reference = min(max(target, reference - 1.0), reference + 1.0)
        error = reference - w
        torque = 0.5 * error + integral
        if abs(torque) <= 6.0 or torque * error <= 0.0:
            integral += 4.0 * 0.01 * error
        assert outputs["torque_ref"] == near((min(max(torque, -6.0), 6.0),))


def test_the_machine_moves_by_its_equations():
    """Against explicit Runge-Kutta steps in complex numbers, over two periods of two steps."""
    m = build(MachineConstants, {"B": 0.02, "J": 0.01, "pole_pairs": 2})
    h, u, T_L = 2e-4, complex(200.0, -120.0), 3.0

    def slope(x):
        psi_s, psi_R, w, _ = x
        i = (psi_s - psi_R) / m.L_sigma
        torque = 1.5 * 2 * (psi_s.conjugate() * i).imag
        turn = m.R_R / m.L_M - 2j * w
        return np.array([u - m.R_s * i, m.R_R * i - turn * psi_R, (torque - T_L - m.B * w) / m.J, w])

    x = np.array([0.7 + 0.3j, 0.6 + 0.2j, 30.0, 0.4])
    flat = [0.7, 0.3, 0.6, 0.2, 30.0, 0.4]
    after, y = step_function(2)(flat, [u.real, u.imag, T_L], numbers(m, h))
    for _ in range(2):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
    wanted = [x[0].real, x[0].imag, x[1].real, x[1].imag, x[2].real, x[3].real]
    assert after.full().ravel().tolist() == near(wanted)
    i = (x[0] - x[1]) / m.L_sigma
    phases = [(i * cmath.exp(-2j * math.pi * k / 3)).real for k in range(3)]
    assert y.full().ravel().tolist() == near([*phases, 3.0 * (x[0].conjugate() * i).imag])


def test_the_inverter_is_exact_at_its_limits():
    plant = ByHand(ImPlant())
    plant.advance(0, switches=(1.0 - 1e-9, 1e-9, 0.0), load_torque=None)
    assert (plant.x.vector, plant.reports) == (1, {})
    plant.advance(0, switches=(1.0 - 1.1e-9, 0.0, 0.0), load_torque=None)
    assert (plant.x.vector, list(plant.reports)) == (1, ["bad_switches"])
    plant.advance(0, switches=(0.0, 1.0, 0.0), load_torque=None)
    assert (plant.x.vector, plant.x.refused, plant.x.fault) == (3, False, False)


@pytest.mark.parametrize("phase", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_each_phase_trips_the_inverter_and_saturates_its_converter(phase, sign):
    """A flux that makes 28.5 A in one phase and half of it in the others; the converters end at 16 A."""
    i = sign * 28.5 * cmath.exp(2j * math.pi * phase / 3)
    psi = 0.021 * i
    for limit, trips in ((28.0, True), (29.0, False)):
        plant = ByHand(ImPlant(trip_current=limit, period=1e-7))
        plant.x = plant.x._replace(psi_s_alpha=psi.real, psi_s_beta=psi.imag)
        outputs = plant.outputs(0)
        a, b, c = outputs["currents_meas"]
        assert (a + b + c, abs(a) > 5.0) == (0.0, True)
        for k in range(11):
            plant.advance(k, switches=(0.0, 0.0, 0.0), load_torque=None)
            assert plant.x.fault is trips
            assert ("adc_saturated" in plant.reports) is (phase < 2 and k == 10)
        assert outputs["currents_true"][phase] == near(28.5 * sign)
        assert ("overcurrent" in plant.reports) is trips


@pytest.mark.parametrize("phase", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_current_at_the_trip_is_not_beyond_it(phase, sign):
    plant = ImPlant(trip_current=5.0)
    currents = [0.0, 0.0, 0.0]
    for size, trips in ((5.0, False), (math.nextafter(5.0, 6.0), True)):
        currents[phase] = sign * size
        plant._step = lambda flat: (*flat[:6], *currents, 0.0)
        assert plant.advance(plant.first(), 0, switches=(0.0, 0.0, 0.0), load_torque=None).fault is trips


def flux_signals(t, estimate, true):
    true_t = np.append(t, 2 * t[-1] - t[-2])  # the true flux has one sample more
    named = {}
    for name, times, z in (("flux_estimate", t, estimate), ("flux_true", true_t, np.append(true, 0j))):
        named[f"{name}/x"], named[f"{name}/y"] = (times, z.real), (times, z.imag)
    return named


def test_figures_of_the_flux_are_loops_over_its_samples():
    rng = np.random.default_rng(6)
    t = np.arange(60) * 0.01
    true = 0.9 * np.exp(1j * (0.3 * np.arange(60))) + complex(0.05, -0.02)
    error = (0.02 - 0.03j) * (t - 0.1) + 1e-3 * (rng.normal(size=60) + 1j * rng.normal(size=60))
    signals = flux_signals(t, true + error, true)
    assert flux.flux_error_peak(signals) == near(max(abs(e) for e in error))
    assert flux.flux_error_peak(signals, start=0.3, end=0.4) == near(max(abs(error[k]) for k in range(30, 41)))
    assert flux.flux_error_end(signals, end=0.4) == near(abs(error[40]))
    fits = [complex(*(np.polyfit(t[k:], part[k:], 1)[0] for part in (error.real, error.imag))) for k in (30, 0)]
    for component, value in (("alpha", fits[0].real), ("beta", fits[0].imag), ("magnitude", abs(fits[0]))):
        assert flux.flux_error_slope(signals, component=component) == pytest.approx(value, rel=1e-6)
    assert flux.flux_error_slope(signals, start=0.0) == pytest.approx(abs(fits[1]), rel=1e-6)
    assert flux.flux_error_direction(signals) == pytest.approx(math.degrees(cmath.phase(fits[0])), rel=1e-6)
    assert math.isnan(flux.flux_error_slope(flux_signals(t[:2], true[:2], true[:2]), start=0.01))
    for component, value in (("alpha", 0.05), ("beta", -0.02), ("magnitude", abs(0.05 - 0.02j))):
        assert flux.circle_centre(
            signals | {"flux_true/x": (t, true.real), "flux_true/y": (t, true.imag)}, component=component
        ) == near(value)
    assert math.isnan(flux.circle_centre(signals, topic="flux_true", end=0.1))
    sizes = [abs(z) for z in true + error]
    assert flux.flux_magnitude(signals, topic="flux_estimate", extreme="min", start=0.1) == near(min(sizes[10:]))
    assert flux.flux_magnitude(signals, topic="flux_estimate", extreme="max", end=0.3) == near(max(sizes[:31]))


def test_the_last_revolution_is_the_last_whole_turn():
    turned = np.exp(1j * np.radians(np.arange(0.0, 900.0, 45.0)))  # 20 samples, the last one at 855 degrees
    assert flux.last_revolution(turned).size == 8  # the sample one turn before the last is not included
    assert flux.last_revolution(turned[:8]) is None
    backwards = flux.last_revolution(turned.conj())
    assert backwards.tolist() == turned.conj()[-8:].tolist()
    centre, radius = flux.circle(2.0 * turned + (3.0 - 1.0j))
    assert (centre, radius) == (near(3.0 - 1.0j), near(2.0))


def test_figures_of_converters_and_switches_are_loops_over_their_samples():
    t = np.arange(50) * 0.02
    wave = {"x": np.sin(9.0 * t), "y": np.cos(9.0 * t), "z": -2.5 * np.sin(9.0 * t + 0.5)}
    off = {"x": 0.03 * t, "y": -0.01 + 0.02 * t}
    signals = {f"currents_true/{n}": (t, w) for n, w in wave.items()}
    signals |= {f"currents_meas/{n}": (t, wave[n] + off[n]) for n in "xy"}
    for channel in "xy":
        late = [float(e) / 0.05 for at, e in zip(t, off[channel], strict=True) if at >= 0.3 - 1e-9]
        mean = sum(late) / len(late)
        spread = math.sqrt(sum((e - mean) ** 2 for e in late) / len(late))
        assert flux.converter_error(signals, lsb=0.05, channel=channel) == near(mean)
        assert flux.converter_error(signals, lsb=0.05, channel=channel, statistic="std") == near(spread)
    assert flux.current_peak(signals) == near(max(abs(v) for w in wave.values() for v in w))
    assert flux.current_peak(signals, end=0.0) == near(max(1.0, 2.5 * math.sin(0.5)))
    legs = [[0, 1, 1, 0], [0, 0, 0, 0], [1, 0, 1, 0]]
    when = np.array([0.0, 0.1, 0.2, 0.25])
    switches = {f"switches/{leg}/effort": (when, np.array(v, float)) for leg, v in zip(("Sa", "Sb", "Sc"), legs)}
    assert flux.switching_frequency(switches) == near(5 / 6 / 0.25)
