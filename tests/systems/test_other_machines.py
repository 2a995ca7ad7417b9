"""Machines, networks and problems that the papers did not have: their figures against closed forms, scipy or
independent code.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from docs.outline import SYSTEMS, pages
from helpers import two_port
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, fsolve, minimize
from scipy.special import lambertw
from softrig_core import ParameterError, list_scenarios, load_scenario, simulate
from softrig_drives.dc_axis.controller import FsfbControllerParams
from softrig_drives.dc_motor.sliding_mode import SurfaceParams
from softrig_drives.stator import inverse_gamma
from softrig_robots.manipulator.plant import ManipulatorParams

GRAVITY = 9.81


def parameters(name, node):
    """The parameters of a node in a scenario."""
    return load_scenario(name).nodes[node].parameters


@pytest.mark.parametrize("name", SYSTEMS)
def test_every_system_has_another_machine_on_its_page(name):
    another = SYSTEMS[name].another
    assert another in list_scenarios()
    assert load_scenario(another).claims == {}
    text = pages()[name].read_text()
    section = text.partition("### Another machine\n")[2].partition("\n### ")[0]
    assert f"\n    scripts/softrig run {another} --mode inprocess\n" in section


# drives -----------------------------------------------------------------------------------------------------------


def test_a_motor_of_a_data_sheet_runs_at_its_no_load_point():
    p = parameters("dc_motor_smc_re40", "dc_motor_plant")
    R, b, k, V = p["R"], p["b"], p["Kt"], 24.0
    result = simulate("dc_motor_smc_re40").figures
    speed = k * V / (R * b + k * k)
    assert result["final_speed"] == pytest.approx(speed, rel=1e-6)
    assert speed == pytest.approx(7580 * np.pi / 30, rel=1e-3)  # 1/min, from the data sheet
    assert result["no_load_current"] == pytest.approx(b * speed / k, rel=1e-6)
    poles = np.roots([p["J"] * p["L"], R * p["J"] + p["L"] * b, R * b + k * k]).real
    fast, slow = poles

    def step(t):
        return 1 + (slow * np.exp(fast * t) - fast * np.exp(slow * t)) / (fast - slow)

    times = [brentq(lambda t, level=level: step(t) - level, 0.0, 0.1) for level in (0.1, 0.9)]
    assert result["rise_time"] == pytest.approx(times[1] - times[0], rel=2e-4)


def test_the_controller_of_a_motor_computes_its_model():
    assert SurfaceParams().coefficients() == (13.89, 5.648, 1.509)
    assert SurfaceParams(model="motor").coefficients() == pytest.approx((13.8889, 5.64815, 1.509259), rel=1e-5)
    law = parameters("dc_motor_smc_re40_law", "dc_motor_smc")
    r, c, K, delta = 400.0, law["c"], law["k"], law["delta"]

    def rate(t, x):
        e, s = x
        return [s - c * e, -K * s / (abs(s) + delta)]

    t = np.linspace(0.0, 0.06, 6001)
    w = r - solve_ivp(rate, (0.0, 0.06), [r, c * r], t_eval=t, rtol=1e-9, atol=1e-6).y[0]
    crossing = [np.interp(level * r, w, t) for level in (0.1, 0.9, 0.98)]
    result = simulate("dc_motor_smc_re40_law").figures
    assert result["rise_time"] == pytest.approx(crossing[1] - crossing[0], rel=0.01)  # 1 % for the sampling
    assert result["settling_time"] == pytest.approx(crossing[2], rel=0.01)
    printed = simulate("dc_motor_smc_re40_law", overrides={"dc_motor_smc.model": "printed"}).figures
    # The paper's rounded model misses this time.
    assert abs(printed["rise_time"] - result["rise_time"]) > 0.1 * result["rise_time"]


def test_an_axis_has_the_requested_poles():
    J, b, K, R, lead = 3.2284e-6, 3.5077e-6, 0.0274, 4.0, 10.0
    law = parameters("dc_motor_fsfb_ctms", "fsfb_controller")
    assert law["pole"] == pytest.approx(b / J + K * K / (R * J), rel=1e-6)
    assert law["gain"] * 140.0 / 12.0 == pytest.approx(K / (R * J) * lead / (2 * np.pi), rel=1e-6)
    pole, g, T, r = b / J + K * K / (R * J), K / (R * J) * lead / (2 * np.pi), 0.01, 10.0  # 1/s, mm/(s^2 V), s, mm
    _, a2, a1, a0 = np.poly(law["poles"])
    v = y = xi = 0.0
    motion = [0.0]
    for _ in range(300):
        u = (-(a2 - pole) * v - a1 * y + a0 * xi) / g
        xi += (r - y) * T
        decay = np.exp(-pole * T)
        y += v * (1 - decay) / pole + g * u / pole * (T - (1 - decay) / pole)
        v = v * decay + g * u / pole * (1 - decay)
        motion.append(y)
    times = [np.interp(level * r, motion, np.arange(301) * T) for level in (0.1, 0.9)]
    result = simulate("dc_motor_fsfb_ctms").figures
    assert result["rise_time"] == pytest.approx(times[1] - times[0], rel=0.01)
    assert result["rest_error"] <= 0.01
    fast = simulate("dc_motor_fsfb_ctms", overrides={"fsfb_controller.poles": [-8.0, -16.0, -60.0]}).figures
    assert fast["rise_time"] == pytest.approx(result["rise_time"] / 2, rel=0.03)


def test_poles_change_while_the_axis_rests_without_a_bump(tmp_path):
    (tmp_path / "axis.yaml").write_text(
        "extends: dc_motor_fsfb_ctms\ntitle: A\nduration: 3.4\n"
        "changes: [{at: 3.0, set: {fsfb_controller.poles: [-8.0, -16.0, -60.0]}}]\n"
        "figures: {bump: {function: peak, arguments: {signal: $position, reference: 10.0, start: 2.9}}}\n"
    )
    assert simulate(tmp_path / "axis.yaml").figures["bump"] <= 0.005  # mm, one count


def test_poles_that_cannot_be_placed_are_refused():
    for wrong in ([-1.0, -2.0], [-1.0, -2.0, 3.0]):
        with pytest.raises((ParameterError, ValueError), match="poles"):
            FsfbControllerParams(poles=wrong)
    with pytest.raises((ParameterError, ValueError), match="integrator"):
        FsfbControllerParams(poles=[-1.0, -2.0, -3.0], integral=False)


@pytest.mark.long
def test_an_induction_machine_of_a_t_circuit_draws_its_current():
    R_r, leak, L_m = 1.395, 5.839e-3, 0.1722
    p = parameters("induction_dtc_4kw", "im_plant")
    assert inverse_gamma(R_r, leak, leak, L_m) == pytest.approx((p["R_R"], p["L_sigma"], p["L_M"]), rel=1e-5)
    run = simulate("induction_dtc_4kw")
    torque, speed, flux = 20.0 + p["B"] * 100.0, 100.0, 0.95
    L = L_m + leak

    def steady(slip):  # T circuit in the frame of the stator flux; peak values of a phase
        matrix = np.array([[L, L_m], [1j * slip * L_m, R_r + 1j * slip * L]])
        i_s, _ = np.linalg.solve(matrix, [flux, 0.0])
        return i_s, 1.5 * 2 * flux * i_s.imag

    slip = brentq(lambda w: steady(w)[1] - torque, 0.01, 20.0)
    i_s, _ = steady(slip)
    assert run.figures["current_rms"] == pytest.approx(abs(i_s) / np.sqrt(2), rel=0.01)
    t, x = run.signals["flux_true/x"]
    angle = np.unwrap(np.angle(x + 1j * run.signals["flux_true/y"][1]))
    late = t >= 1.0
    turning = np.polyfit(t[late], angle[late], 1)[0]
    assert turning - 2 * speed == pytest.approx(slip, rel=0.02)


@pytest.mark.long
def test_phases_of_a_linear_motor_pull_as_the_relay_of_the_textbook():
    run = simulate("lsrm_fuzzy_relay")
    G = 4e-7 * np.pi * 1000**2 * 0.1 / (2 * 2e-3)
    assert pytest.approx(1570.8, rel=1e-4) == G * 10.0**2 / 2  # example 3.4 at 10 A
    assert parameters("lsrm_fuzzy_relay", "lsrm_plant")["G"] == pytest.approx(G)
    x = run.signals["joint_states/translator/position"][1]
    on_ramp = 0
    for k, phase in enumerate("abcd"):
        i = run.signals[f"phase_currents/{phase}/position"][1]
        F = run.signals[f"force_phases/{phase}/effort"][1]
        xi = (x - 0.1 * k + 0.2) % 0.4 - 0.2
        inside = (xi > -0.157) & (xi < -0.013) & (i > 0.5)  # the ramp without its rounded ends
        on_ramp += inside.sum()
        assert np.allclose(F[inside], 0.5 * G * i[inside] ** 2, rtol=1e-9)
    assert on_ramp > 10_000
    # At constant speed the force equals the load.
    assert run.figures["mean_force"] == pytest.approx(2500.0 * 0.2, rel=2e-3)


# power ------------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_a_string_of_other_modules_gives_its_maximum():
    m = parameters("pv_mppt_kc200gt", "pv_plant")["module"]

    def curve(T):  # equations (2) to (4)
        aVt = m["a"] * m["N_s"] * 1.380649e-23 * (T + 273.15) / 1.602176634e-19
        I_sc = m["I_sc"] + m["K_I"] * (T - 25)
        return I_sc, I_sc / np.expm1((m["V_oc"] + m["K_V"] * (T - 25)) / aVt), aVt

    I_sc, I_0, aVt = curve(45.0)

    def power(i):
        total = 0.0
        for G in (1000.0, 1000.0, 500.0, 300.0):
            U = brentq(lambda u, g=G: I_sc * g / 1e3 - I_0 * np.expm1(u / aVt) - u / m["R_p"] - i, -5e3, 40.0)
            total += max(U - m["R_s"] * i, -m["V_f"])
        return total * i

    best = max(power(i) for i in np.linspace(7.3, 7.9, 301))
    result = simulate("pv_mppt_kc200gt").figures
    assert result["gmpp"] == pytest.approx(best, abs=0.01)
    assert result["power"] == pytest.approx(best, rel=0.005)
    I_sc, I_0, aVt = curve(25.0)
    U = 26.3 + m["R_s"] * 7.61
    # The maximum power point of the data sheet.
    assert I_sc - I_0 * np.expm1(U / aVt) - U / m["R_p"] == pytest.approx(7.61, rel=0.01)


@pytest.mark.long
def test_three_units_of_the_textbook_are_dispatched_as_there():
    a, b, c = np.array([[0.001562, 0.00194, 0.00482], [7.92, 7.85, 7.97], [561.0, 310.0, 78.0]])
    result = simulate("economic_dispatch_wood").figures
    price = (850 + (b / (2 * a)).sum()) / (1 / (2 * a)).sum()
    P = (price - b) / (2 * a)
    assert result["cost"] == pytest.approx((a * P**2 + b * P + c).sum(), abs=1e-4)
    assert result["cost"] == pytest.approx(8194.3561, abs=1e-4)
    assert [result[f"{k}_unit"] for k in ("first", "second", "third")] == pytest.approx(P, abs=0.05)
    lossy = simulate("economic_dispatch_wood_losses").figures
    B = np.array([3e-5, 9e-5, 12e-5])
    best = minimize(lambda P: (a * P**2 + b * P + c).sum(), P, method="SLSQP", options={"ftol": 1e-12, "maxiter": 500},
                    constraints={"type": "eq", "fun": lambda P: P.sum() - 850 - (B * P**2).sum()})  # fmt: skip
    assert lossy["fleet_cost"] == pytest.approx(best.fun, abs=2e-3)
    assert lossy["fleet_output"] - 850 == pytest.approx((B * best.x**2).sum(), abs=0.01)


@pytest.mark.long
def test_the_generators_of_the_30_bus_system_are_dispatched_at_equal_slopes():
    result = simulate("economic_dispatch_ieee30").figures
    a = np.array([0.00375, 0.0175, 0.0625, 0.00834, 0.025, 0.025])
    b = np.array([2.0, 1.75, 1.0, 3.25, 3.0, 3.0])
    least, most = np.array([[50, 20, 15, 10, 10, 12], [200, 80, 50, 35, 30, 40]])

    def dispatch(price):
        return np.clip((price - b) / (2 * a), least, most)

    P = dispatch(brentq(lambda price: dispatch(price).sum() - 283.4, 1.0, 10.0, xtol=1e-13))
    assert result["cost"] == pytest.approx((a * P**2 + b * P).sum(), abs=1e-3)
    assert 0.0 <= result["gap"] + 1e-9 <= 1e-3
    assert [result[f"{k}_unit"] for k in ("first", "second", "third")] == pytest.approx(P[:3], abs=0.3)


def test_a_500_kv_line_carries_its_current_and_its_fault_is_found():
    result = simulate("fault_location_500kv").figures
    assert abs(result["error"]) <= 5.0  # m, on a line of 130 km
    Y = two_port(complex(0.028, 0.325), 5.20e-6j, 200.0) + np.eye(2) / complex(1.31, 15.0)
    E = 500e3 * np.sqrt(2 / 3) * np.exp(1j * np.radians([0.0, -10.0]))
    U = np.linalg.solve(Y, E / complex(1.31, 15.0))
    I = (E[0] - U[0]) / complex(1.31, 15.0)  # noqa: E741
    assert result["prefault_current"] == pytest.approx(abs(I), rel=2e-3)


def test_converters_in_another_double_line_give_the_powers_of_the_phasors():
    base = 345e3**2 / 400e6
    half = two_port(complex(0.037, 0.367) / base, 4.518e-6j * base, 100.0)
    at = {bus: k for k, bus in enumerate("A1234B")}
    Y = np.zeros((6, 6), dtype=complex)
    for pair in ("A1", "A3", "2B", "4B"):
        k = [at[bus] for bus in pair]
        Y[np.ix_(k, k)] += half
    source = 1 / complex(0.8716 / base, 2 * np.pi * 60 * 25.76e-3 / base)
    Y[0, 0] += source
    Y[5, 5] += source
    E = np.zeros(6, dtype=complex)
    E[0], E[5] = np.exp(0.2j) * source, np.exp(-0.2j) * source
    z_sh, z_se = complex(0.05 / 30, 0.05), complex(0.00625 / 30, 0.00625)

    def state(x):
        i12, i34, i_sh = x[:3] + 1j * x[3:]
        u = np.linalg.solve(Y, E + np.array([0, i_sh - i12, i12, -i34, i34, 0]))
        series = [(u[2] - u[1] + z_se * i12) * np.conj(i12), (u[4] - u[3] + z_se * i34) * np.conj(i34)]
        shunt = (u[1] + z_sh * i_sh) * np.conj(i_sh)
        return u, i12, i34, series, shunt

    def residual(x):
        u, i12, i34, series, shunt = state(x)
        s1, s2 = u[2] * np.conj(i12) - (1.15 + 0j), u[4] * np.conj(i34) - (0.95 - 0.1j)
        return [s1.real, s1.imag, s2.real, s2.imag, abs(u[1]) - 1, sum(series).real + shunt.real]

    x = fsolve(residual, [1.0, 1.0, 0.0, 0.0, 0.0, 0.0], xtol=1e-12)
    assert np.max(np.abs(residual(x))) < 1e-9
    u, i12, i34, _, shunt = state(x)
    result = simulate("gupfc_345kv").figures
    assert result["p_sh"] == pytest.approx(shunt.real, abs=0.001)
    assert result["v12"] == pytest.approx(abs(u[2] - u[1] + z_se * i12), abs=0.001)
    assert result["v34"] == pytest.approx(abs(u[4] - u[3] + z_se * i34), abs=0.001)


def test_another_rectifier_answers_its_commands_as_its_equations():
    run = simulate("rectifier_mpc_10kva")
    V, R, L, C, w = 326.6, 0.1, 0.01014, 0.001, 2 * np.pi * 50
    phi, T = np.arctan2(w * L, R), 0.00083
    t, command = run.signals["v_drop/command/v_drop/effort"]
    i0 = (V - np.sqrt(V**2 - 4 * R * 650**2 / 70.4 / 1.5)) / (2 * R)

    def rate(t, x, u, load):
        i_d, i_q, v = x
        r_d, r_q = V - u * np.cos(phi), -u * np.sin(phi)
        return [
            (V - R * i_d - r_d) / L + w * i_q,
            (-R * i_q - r_q) / L - w * i_d,
            (1.5 * (r_d * i_d + r_q * i_q) / v - v / load) / C,
        ]

    x, seen = np.array([i0, 0.0, 650.0]), [650.0]
    step_at = load_scenario("rectifier_mpc_10kva").nodes["event_source"].parameters["times"][1]
    for at, u in zip(t[:361], command[:361], strict=True):  # the first 0.3 s, with the step and its response
        load = 70.4 if at + 1e-9 < step_at else 42.25
        x = solve_ivp(rate, (0.0, T), x, args=(u, load), rtol=1e-8, atol=1e-8).y[:, -1]
        seen.append(x[2])
    voltage = run.signals["dc_link/voltage/position"][1][: len(seen)]
    assert voltage == pytest.approx(np.array(seen), abs=1.0)
    assert run.figures["v_min"] == pytest.approx(min(seen), abs=1.0)
    assert abs(run.figures["error"]) < 0.5


# robots -----------------------------------------------------------------------------------------------------------


def voltages(q, qd, qdd, links, motors, friction, upright):
    """Inverse dynamics of two links and their drives, implemented independently; angles (n, 2).

    Lagrange's equations with l1, centres d and inertias I; gravity acts with sin q of hanging links, cos q of
    lying ones.
    """
    (m1, m2), l1, (d1, d2), (I1, I2) = links
    R, K_m, K_b, gear, J, B = motors
    c2, s2 = np.cos(q[:, 1]), np.sin(q[:, 1])
    along = np.cos if upright else np.sin
    h = m2 * l1 * d2
    M11, M12, M22 = (
        m1 * d1**2 + I1 + m2 * l1**2 + I2 + m2 * d2**2 + 2 * h * c2,
        I2 + m2 * d2**2 + h * c2,
        I2 + m2 * d2**2,
    )
    g2 = m2 * GRAVITY * d2 * along(q.sum(axis=1))
    g1 = (m1 * d1 + m2 * l1) * GRAVITY * along(q[:, 0]) + g2
    turning = h * s2
    t1 = M11 * qdd[:, 0] + M12 * qdd[:, 1] - turning * (2 * qd[:, 0] * qd[:, 1] + qd[:, 1] ** 2) + g1
    t2 = M12 * qdd[:, 0] + M22 * qdd[:, 1] + turning * qd[:, 0] ** 2 + g2
    torque = np.column_stack([t1, t2]) + J / gear**2 * qdd + B / gear**2 * qd + friction(qd)
    current = torque * gear / K_m
    return R * current + K_b / gear * qd


def test_the_arm_of_the_textbook_has_the_voltages_of_its_equations():
    run = simulate("manipulator_adsmc_siciliano")
    joints = ("shoulder", "elbow")
    t = run.signals["joint_states/shoulder/position"][0]
    q, qd = (
        np.column_stack([run.signals[f"joint_states/{j}/{what}"][1] for j in joints])
        for what in ("position", "velocity")
    )
    qdd = np.gradient(qd, t, axis=0)
    # Each link has 50 kg, 0.5 m to its centre and 10 kg m^2; the second motor, of 5 kg, is at the elbow.
    centre = (50 * 0.5 + 5 * 1.0) / 55
    inertia = 10 + 50 * (0.5 - centre) ** 2 + 5 * (1 - centre) ** 2
    motors = (10.0, 2.0, 2.0, 0.01, 0.01, 0.01)
    expected = voltages(q, qd, qdd, ((55.0, 50.0), 1.0, (centre, 0.5), (inertia, 10.0)), motors, lambda qd: 0.0, True)
    for k in range(2):
        when, u = run.signals[f"motor_command/motor{k + 1}/effort"]
        late = (when >= 1.0) & (when < t[-1])
        gap = np.abs(u[late] - expected[: u.size, k][late])
        assert np.max(gap) < 0.005 * np.max(np.abs(u[late]))


def test_a_step_beyond_the_armature_s_time_constant_is_refused():
    motors = {"resistance": 10.0, "inductance": 0.001}
    with pytest.raises((ParameterError, ValueError), match="substeps = 2: expected at least 4"):
        ManipulatorParams(motors=motors)
    ManipulatorParams(motors=motors, substeps=4)


@pytest.mark.parametrize("name", ["position", "velocity", "disturbance.amplitude"])
def test_parameters_of_an_arm_are_one_value_or_one_for_each_joint(name):
    def arm(*values):
        group, _, field = name.rpartition(".")
        return ManipulatorParams(**({group: {field: values}} if group else {field: values}))

    arm(0.1)
    arm(0.1, 0.2, 0.3)
    for values in ((0.1, 0.2), (0.1, 0.2, 0.3, 0.4)):
        message = re.escape(f"{name} = {list(values)} has {len(values)} values, expected 1 or 3 (one a joint)")
        with pytest.raises((ParameterError, ValueError), match=message):
            arm(*values)


@pytest.mark.long
def test_another_leg_is_displaced_by_its_impedance():
    run = simulate("rehab_impedance_winter")
    joints = ("hip", "knee")
    H, M = 1.60, 60.0
    thigh, leg, whole = 0.245 * H, 0.246 * H, 0.285 * H
    t = run.signals["reference/hip/position"][0]
    q_d, rate, acceleration = (
        np.column_stack([run.signals[f"reference/{j}/{what}"][1] for j in joints])
        for what in ("position", "velocity", "acceleration")
    )
    q = np.column_stack([run.signals[f"joint_states/{j}/position"][1] for j in joints])
    q = q[: t.size]
    F = np.interp(t, *run.signals["patient_force/force/x"])
    foot = whole * np.cos(q.sum(axis=1))
    push = -np.column_stack([(thigh * np.cos(q[:, 0]) + foot) * F, foot * F])  # J^T F

    def slopes(s, x):
        return [*x[2:], *(np.array([np.interp(s, t, push[:, k]) for k in (0, 1)]) - 20 * x[2:] - 100 * x[:2])]

    bend = solve_ivp(slopes, (0.0, t[-1]), np.zeros(4), t_eval=t, max_step=0.01, rtol=1e-7, atol=1e-9).y
    assert run.figures["deflection_hip"] == pytest.approx(np.max(np.abs(bend[0])), rel=0.01)
    assert run.figures["deflection_knee"] == pytest.approx(np.max(np.abs(bend[1])), rel=0.02)

    def friction(v):
        return (0.8 + 0.1 * np.exp(-((v / 0.1) ** 2))) * np.tanh(v / 0.01) + 1.2 * v

    masses, centres = (0.100 * M, 0.061 * M), (0.433 * thigh, 0.606 * leg)
    inertias = (masses[0] * (0.323 * thigh) ** 2, masses[1] * (0.416 * leg) ** 2)
    # The paper does not print the rotors; these are the scenario's values.
    motors = (4.0, 4.32, 0.287, 1 / 16, 2e-4, 1e-3)
    expected = voltages(q_d, rate, acceleration, (masses, thigh, centres, inertias), motors, friction, False)
    quiet = (t > 3.0) & (t < 5.0)
    for k, joint in enumerate(joints):
        u = run.signals[f"motor_command/{joint}/effort"][1]
        assert np.max(np.abs(u - expected[:, k])[quiet]) < 0.03 * np.max(np.abs(expected[quiet, k]))


# systems ----------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_the_queue_of_another_router_follows_the_delay_equations():
    N, C, tau, goal, room = 60, 3750.0, 0.246 - 200 / 3750, 200.0, 800.0
    kp, ki, h = 1.819e-5, 9.6e-6, 1e-3
    steps = 20_000
    w, q, p, R = (np.zeros(steps + 1) for _ in range(4))
    w[0], R[0] = 1.0, tau
    integral = u = 0.0

    for k in range(steps):
        p[k] = min(max(kp * (q[k] - goal) + ki * integral, 0.0), 1.0)
        u = kp * (q[k] - goal) + ki * integral
        if not (u < 0.0 and q[k] < goal):
            integral += (q[k] - goal) * h
        R[k] = q[k] / C + tau
        back = round(R[k] / h)
        sent = p[k - back] if k >= back else 0.0
        w_R, R_R = w[max(k - back, 0)], R[max(k - back, 0)]
        w[k + 1] = min(max(w[k] + h * (1 / R[k] - w[k] * w_R / (2 * R_R) * sent), 1.0), 60.0)
        q[k + 1] = min(max(q[k] + h * (N * w[k] / R[k] - C), 0.0), room)
    result = simulate("tcp_aqm_smc_hollot").figures
    assert result["probability_end"] == pytest.approx(2 / (0.246 * C / N) ** 2, rel=2e-3)
    assert result["queue_end"] == pytest.approx(goal, abs=0.2)
    assert result["peak"] == pytest.approx(q.max(), rel=0.01)


@pytest.mark.long
def test_another_spacecraft_has_the_cost_that_scipy_finds():
    I = np.array([10000.0, 9000.0, 12000.0])  # noqa: E741
    w0 = np.radians([0.53, 0.53, 0.053])
    result = simulate("optimal_control_mvim_wie").figures
    assert result["J_exact"] == pytest.approx(np.sum((I * w0) ** 2) / 200.0, rel=1e-12)
    # The torque that reduces the size of the momentum linearly to zero, in Euler's equations.
    H = np.linalg.norm(I * w0)

    def slopes(t, x):
        w = x[:3]
        u = -I * w / np.linalg.norm(I * w) * H / 100.0
        return [*((-np.cross(w, I * w) + u) / I), u @ u / 2]

    end = solve_ivp(slopes, (0.0, 99.999), [*w0, 0.0], rtol=1e-10, atol=1e-14).y[:, -1]
    assert np.max(np.abs(end[:3])) < 1e-6
    assert result["J_plant"] == pytest.approx(end[3], rel=2e-5)
    assert result["infeasible"] == 0.0


@pytest.mark.long
@pytest.mark.parametrize(("name", "delay"), [("pwa_delay_hayes", 1.5), ("pwa_delay_hayes_beyond", 1.65)])
def test_oscillations_of_the_scalar_delay_equation_grow_as_lambert_s_function_says(name, delay):
    assert simulate(name).figures["growth"] == pytest.approx(float(lambertw(-delay).real) / delay, abs=2e-5)
