"""Three-phase machines, inverter, field orientation: against closed forms, scipy in phase coordinates, brute force."""

import math
import typing

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import jv
from softrig_core import ByHand, Level, load_scenario, simulate
from softrig_drives.machines import inverter as legs
from softrig_drives.machines.control.current_references import currents as least_currents, mtpa
from softrig_drives.machines.control.foc import FocController, FocControllerParams
from softrig_drives.machines.control.modulation import Modulation, duties, linear_range
from softrig_drives.machines.plant import PmsmPlant, PmsmPlantParams
from softrig_drives.machines.synchronous import SynchronousConstants, linkage

THIRD = 2.0 * math.pi / 3.0
NS = 1e9


def plant(**values):
    return ByHand(PmsmPlant(PmsmPlantParams(**{"delay": 0, "trip_current": 1e3, **values})))


# plant ------------------------------------------------------------------------------------------------------------


def in_phases(p, duty, x, t_end):
    """Integrate the machine in coordinates of the phases: L(theta) i' = u - R i - w L' i - e; two masses, DC link."""
    L_0, L_2 = (p.L_d + p.L_q) / 3.0, (p.L_d - p.L_q) / 3.0

    def inductances(theta):  # inductance matrix of the phases without zero sequence
        angles = [2.0 * (p.pole_pairs * theta) - (j + k) * THIRD for j in range(3) for k in range(3)]
        first = np.array([[L_0 if j == k else -0.5 * L_0 for k in range(3)] for j in range(3)])
        return first + L_2 * np.cos(angles).reshape(3, 3), -2.0 * p.pole_pairs * L_2 * np.sin(angles).reshape(3, 3)

    turn = THIRD * np.arange(3)
    clarke = np.array([[1.0, 0.0], [-0.5, 0.75**0.5], [-0.5, -(0.75**0.5)]])

    def slope(_, y):
        i, (w, theta, w_l, theta_l, u_dc) = clarke @ y[:2], y[2:]
        L, dL = inductances(theta)
        # The derivative of psi_f cos(p theta - k 2 pi/3).
        e = -p.pole_pairs * p.psi_f * np.sin(p.pole_pairs * theta - turn)
        u = (np.array(duty) - np.mean(duty)) * u_dc
        right = u - p.R_s * i - w * (dL @ i) - w * e
        rate = np.linalg.solve((clarke.T @ L @ clarke), clarke.T @ right)
        torque = 0.5 * i @ dL @ i + e @ i
        drag = p.B * w + (p.T_coulomb + (p.T_static - p.T_coulomb) * math.exp(-((w / p.w_stribeck) ** 2))) * math.tanh(
            w / p.w_stick
        )
        shaft = p.K_shaft * (theta - theta_l) + p.C_shaft * (w - w_l)
        link = ((p.U_dc - u_dc) / p.R_dc - np.array(duty) @ i) / p.C_dc
        fan = p.load_square * w_l * abs(w_l)
        return [*rate, (torque - drag - shaft) / p.J, w, (shaft - fan - 2.0) / p.J_load, w_l, link]

    return solve_ivp(slope, (0.0, t_end), x, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]


def test_the_plant_equals_the_machine_in_phase_coordinates():
    """Another form of the equations, another solver: 20 periods of other duty ratios, within 1e-8."""
    p = PmsmPlantParams(
        delay=0, trip_current=1e3, substeps=8, C_dc=2e-4, R_dc=0.5, J=0.005, J_load=0.01, K_shaft=700.0, C_shaft=0.5,
        B=0.01, T_coulomb=0.3, T_static=0.5, w_stribeck=2.0, w_stick=0.5, load_square=1e-3, load_torques=(2.0,),
        w_0=5.0,
    )  # fmt: skip
    block = ByHand(PmsmPlant(p))
    draw = np.random.default_rng(1)
    y = [0.0, 0.0, 5.0, 0.0, 5.0, 0.0, p.U_dc]
    for k in range(20):
        duty = tuple((0.5 + 0.3 * np.cos(0.3 * k - THIRD * np.arange(3)) + 0.05 * draw.standard_normal(3)).tolist())
        block.advance(k * 100_000, duty=duty, load_torque=None)
        y = in_phases(p, duty, y, p.period)
    outputs = block.outputs(20 * 100_000)
    i_a, i_b, i_c = outputs["currents"]
    wanted = [y[0], y[1], y[2], y[3], y[4], y[5], y[6]]
    have = [i_a, (i_b - i_c) / 3**0.5, outputs["joint_states"][1], outputs["joint_states"][0]]
    have += [outputs["load_shaft"][1], outputs["load_shaft"][0], outputs["dc_link"][0]]
    assert have == pytest.approx(wanted, rel=1e-8, abs=1e-8)


@pytest.mark.parametrize("inverter", ["averaged", "switched"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_dead_time_reduces_the_voltage_as_in_textbooks(inverter, sign):
    """T_d f_c U_dc sign(i) for each leg: at standstill the current is that of the remaining voltage."""
    dead, U_dc, R = 4e-6, 540.0, 3.6
    block = plant(inverter=inverter, dead_time=dead, J=1e6, R_s=R, psi_f=0.0, L_d=0.03, L_q=0.03)
    share = 0.1 * sign
    for k in range(3000):
        block.advance(k * 100_000, duty=(0.5 + share, 0.5 - share / 2, 0.5 - share / 2), load_torque=None)
    i_a = block.outputs(3000 * 100_000)["currents"][0]
    # Voltage of a leg with current +i while two legs carry -i/2.
    u = share * U_dc - 4.0 / 3.0 * dead / 1e-4 * U_dc * sign
    assert i_a == pytest.approx(u / R, rel=2e-3)


def test_devices_have_their_voltage_drops():
    block = plant(v_switch=2.0, v_diode=1.0, r_on=0.4, J=1e6, psi_f=0.0, L_d=0.03, L_q=0.03)
    for k in range(3000):
        block.advance(k * 100_000, duty=(0.6, 0.45, 0.45), load_torque=None)
    drops = (0.6 * 2.0 + 0.4 * 1.0, -(0.45 * 1.0 + 0.55 * 2.0))
    u = 0.1 * 540.0 - (drops[0] - (drops[0] + 2.0 * drops[1]) / 3.0)
    assert block.outputs(0)["currents"][0] == pytest.approx(u / 4.0, rel=1e-6)


def edges(duty, updates, rising, period):
    """Times at which a leg switches on and off in a period, without dead time."""
    stage, time = legs.begin(duty, updates, rising, period)
    result = [(0.0, 1.0 if stage in (legs.ON, legs.FALLING) else 0.0)]
    while time < period:
        stage, after = legs.edge(stage, time, 1.0, duty, updates, period, 0.0)
        result.append((time, 1.0 if stage in (legs.ON, legs.FALLING) else 0.0))
        time = after
    return result


@pytest.mark.parametrize("updates", [1, 2])
def test_harmonics_of_the_carrier_are_bessel_functions(updates):
    """Regular sampling: Holmes and Lipo, equations 3.66 (symmetrical) and 3.73 (asymmetrical), in units of U_dc/2."""
    M, pulses = 0.8, 24
    period = 1.0 / (pulses * updates)
    corners = []
    for k in range(pulses * updates):
        sampled = 2.0 * math.pi * k * period
        corners += [
            (k * period + t, s) for t, s in edges(0.5 + 0.5 * M * math.cos(sampled), updates, k % 2 == 0, period)
        ]
    times = np.array([t for t, _ in corners] + [1.0])
    levels = np.array([2.0 * s - 1.0 for _, s in corners])
    for m, n in ((0, 1), (1, 0), (1, 2), (1, -2), (2, 1), (2, -1), (3, 0)):
        order = m * pulses + n
        rate = -2j * math.pi * order
        result = 2.0 * abs(np.sum(levels * (np.exp(rate * times[1:]) - np.exp(rate * times[:-1]))) / rate)
        q = m + n / pulses
        turn = 0.5 * math.pi * ((q + n) if updates == 1 else (m + n))
        wanted = abs(4.0 / (math.pi * q) * jv(n, q * math.pi / 2 * M) * math.sin(turn))
        assert result == pytest.approx(wanted, abs=2e-3 if n else 1e-9), (m, n)


def test_power_in_is_power_out():
    """Energy of source = losses + capacitor + field + motion over 0.1 s, by Simpson's rule over the periods."""
    p = PmsmPlantParams(C_dc=3e-4, R_dc=0.5, delay=0, load_torques=(4.0,), B=0.01, period=2e-5, trip_current=1e3)
    block = ByHand(PmsmPlant(p))
    rows = []
    for k in range(5001):
        x = block.x
        rows.append((x.i_d, x.i_q, x.omega, x.u_dc))
        duty = tuple(0.5 + 0.2 * math.cos(0.006 * k - j * THIRD) for j in range(3))
        block.advance(k * 20_000, duty=duty, load_torque=None)
    i_d, i_q, w, u = np.array(rows).T

    def total(power):
        return np.sum((power[:-2:2] + 4.0 * power[1:-1:2] + power[2::2]) * p.period / 3.0)

    source = (p.U_dc - u) / p.R_dc
    power_in = total(p.U_dc * source)
    lost = total(p.R_dc * source**2) + total(1.5 * p.R_s * (i_d**2 + i_q**2)) + total(p.B * w * w)
    stored = 0.5 * p.C_dc * (u[-1] ** 2 - u[0] ** 2) + 0.5 * p.J * w[-1] ** 2
    stored += 0.75 * (p.L_d * i_d[-1] ** 2 + p.L_q * i_q[-1] ** 2)
    assert power_in == pytest.approx(lost + stored + total(4.0 * w), rel=2e-3)
    assert power_in > 1.0


def test_flux_tables_of_constant_inductances_equal_the_constants():
    i_d, i_q = tuple(float(x) for x in range(-20, 21, 4)), tuple(float(x) for x in range(0, 21, 4))
    psi_d = tuple(0.545 + 0.036 * a for a in i_d for _ in i_q)
    psi_q = tuple(0.051 * b for _ in i_d for b in i_q)
    table = SynchronousConstants(table_i_d=i_d, table_i_q=i_q, table_psi_d=psi_d, table_psi_q=psi_q).numbers(0.0)
    plain = SynchronousConstants().numbers(0.0)
    for at in ((0.0, 0.0), (3.3, -7.7), (-25.0, 30.0), (20.0, -20.0)):
        assert linkage(*at, table) == pytest.approx(linkage(*at, plain), abs=1e-13)


def test_the_saturated_machine_equals_its_published_formula():
    """i_d and i_q of the flux linkages at the corners of the tables, and the slopes between them by differences."""
    values = load_scenario("pmsm_foc_synrm").nodes["pmsm_plant"].parameters
    p = SynchronousConstants(**{k: v for k, v in values.items() if k in SynchronousConstants.model_fields})
    m = p.numbers(0.0)
    for i_d in p.table_i_d[::5]:
        for i_q in p.table_i_q[::3]:
            d, q = linkage(i_d, i_q, m)[:2]
            assert (17.4 + 373 * abs(d) ** 5 + 560 * abs(d) * q * q) * d == pytest.approx(i_d, abs=3e-3)
            assert (52.1 + 658 * abs(q) + 1120 / 3 * abs(d) ** 3) * q == pytest.approx(i_q, abs=3e-3)
    h = 1e-6
    for at in ((5.1, 3.3), (-7.7, -12.1)):
        l_dd, l_dq, l_qd, l_qq = linkage(*at, m)[2:]
        more_d, more_q = linkage(at[0] + h, at[1], m), linkage(at[0], at[1] + h, m)
        now = linkage(*at, m)
        slopes = [(more[axis] - now[axis]) / h for axis in (0, 1) for more in (more_d, more_q)]
        assert (l_dd, l_dq, l_qd, l_qq) == pytest.approx(slopes, abs=1e-6)


def test_currents_beyond_the_flux_tables_are_reported():
    axis = (-2.0, 0.0, 2.0)
    tables = {"table_i_d": axis, "table_i_q": axis[1:], "table_psi_d": [0.04 * d for d in axis for _ in axis[1:]],
              "table_psi_q": [0.05 * q for _ in axis for q in axis[1:]]}  # fmt: skip
    for duty, beyond in (((0.5, 0.5, 0.5), False), ((0.9, 0.1, 0.1), True), ((0.1, 0.9, 0.9), True)):
        block = plant(**tables, R_s=1.0, psi_f=0.0)
        for k in range(5):
            block.advance(k * 100_000, duty=duty, load_torque=None)
        assert ("beyond_tables" in block.reports) is beyond


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"table_i_d": (0.0, 1.0)}, "expected at least two currents of each axis"),
        ({"table_i_d": (0.0, 1.0, 3.0), "table_i_q": (0.0, 1.0), "table_psi_d": (0.0,) * 6, "table_psi_q": (0.0,) * 6},
         "increase by equal steps"),
        ({"table_i_d": (0.0, 1.0), "table_i_q": (0.0, 1.0), "table_psi_d": (0.0,) * 4, "table_psi_q": (0.0,) * 4},
         "without a fold"),
        ({"T_static": 0.1, "T_coulomb": 0.2}, "at least T_coulomb"),
        ({"T_coulomb": 10.0, "w_stick": 1e-4}, "friction, w_stick and J: its fastest time constant is 1.5e-07 s"),
        ({"load_times": (0.0, 1e-5), "load_torques": (0.0, 1.0)}, "at least a period"),
        ({"load_torques": (0.0, 1.0)}, "2 values for 1 times"),
        ({"dead_time": 9e-5}, "less than half the period"),
        ({"U_dc": 2000.0}, "more than U_dc"),
    ],
)  # fmt: skip
def test_impossible_machines_are_refused(values, text):
    with pytest.raises(ValueError, match=text):
        PmsmPlantParams(**values)


def test_a_load_step_within_a_period_and_trips():
    block = plant(load_times=(0.0, 0.00025), load_torques=(0.0, 3.0), psi_f=0.0, J=0.015)
    for k in range(4):
        block.advance(k * 100_000, duty=(0.5, 0.5, 0.5), load_torque=(1.0,))
    assert block.x.omega == pytest.approx(-(1.0 * 4e-4 + 3.0 * 1.5e-4) / 0.015, rel=1e-12)
    block = plant(trip_current=5.0)
    for k in range(200):
        block.advance(k * 100_000, duty=(0.8, 0.4, 0.4), load_torque=None)
        block.outputs(k * 100_000)
    assert block.x.fault
    assert block.reports["overcurrent"][0] == Level.ERROR
    assert abs(block.outputs(0)["currents"][0]) < 5.0  # the current of the short circuit has decayed
    block = plant(C_dc=1e-5, R_dc=100.0, one_way=True, w_0=200.0, U_dc=300.0, trip_voltage=320.0)
    # Zero voltage and voltage against the rotation in turn charge the DC link from the moving mass.
    for k in range(100):
        duty = (0.5, 0.5, 0.5) if k % 2 else tuple(0.5 - 0.05 * math.sin(0.06 * k - j * THIRD) for j in range(3))
        block.advance(k * 100_000, duty=duty, load_torque=None)
    assert block.reports["overvoltage"][0] == Level.ERROR


# laws -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("L_d", "L_q", "psi_f", "i_max"),
    [
        (0.036, 0.051, 0.545, 9.0),
        (0.00037, 0.0012, 0.066, 400.0),
        (0.0415, 0.0062, 0.0, 32.0),
        (0.01, 0.01, 0.1, 20.0),
        (0.06, 0.03, 0.2, 10.0),
        (0.0062, 0.0415, 0.0, 32.0),
    ],
)
def test_currents_are_the_smallest_that_make_the_torque(L_d, L_q, psi_f, i_max):
    """Against brute force over 300 magnitudes and 721 angles, over speeds from rest to the deepest field weakening."""
    k = 4.5
    size, angle = np.meshgrid(np.linspace(0.0, i_max, 300), np.linspace(-math.pi, math.pi, 721))
    d, q = size * np.cos(angle), size * np.sin(angle)
    torque, flux = k * ((psi_f + L_d * d) * q - L_q * q * d), np.hypot(psi_f + L_d * d, L_q * q)
    full = np.hypot(psi_f + L_d * i_max * 0.7, L_q * i_max)
    largest = torque.max()
    for psi_max in full * np.array([2.0, 0.8, 0.5, 0.3, 0.1]):
        possible = flux <= psi_max
        most = torque[possible].max() if possible.any() else 0.0
        for share in (2.0, 0.6, 0.2, -0.5):
            i_d, i_q, made = least_currents(share * largest, psi_max, i_max, k, L_d, L_q, psi_f)
            if (i_d, i_q, made) == (-i_max, 0.0, 0.0):
                assert most < 0.02 * largest
                continue
            assert made == pytest.approx(k * ((psi_f + L_d * i_d) * i_q - L_q * i_q * i_d), abs=1e-9 * largest)
            assert math.hypot(psi_f + L_d * i_d, L_q * i_q) <= psi_max * (1 + 1e-9)
            assert math.hypot(i_d, i_q) <= i_max * (1 + 1e-9)
            assert abs(made) >= min(abs(share) * largest, most) * (1 - 1e-9)
            assert abs(made) <= min(abs(share) * largest, most + 0.02 * largest) + 1e-9 * largest
            rivals = size[possible & (torque >= abs(made) * 1.0)]
            if rivals.size:
                assert math.hypot(i_d, i_q) <= rivals.min() + 1e-6 * i_max


def test_mtpa_without_a_magnet_is_45_degrees_and_without_saliency_all_q():
    i_d, i_q = mtpa(10.0, 3.0, 0.04, 0.006, 0.0)
    assert i_d == pytest.approx(i_q, rel=1e-14) == math.sqrt(10.0 / 3.0 / 0.034)
    assert mtpa(10.0, 3.0, 0.01, 0.01, 0.5) == (0.0, pytest.approx(10.0 / 1.5, rel=1e-14))


@pytest.mark.parametrize("modulation", typing.get_args(Modulation))
def test_duty_ratios_give_the_voltage_up_to_the_range_of_the_modulation(modulation):
    most = linear_range(modulation) * 540.0
    for angle in np.linspace(0.0, 2.0 * math.pi, 97):
        u = 0.999999 * most * np.array([math.cos(angle), math.sin(angle)])
        a, b, c = duties(float(u[0]), float(u[1]), 540.0, modulation)
        assert 540.0 * np.array([(2 * a - b - c) / 3, (b - c) / 3**0.5]) == pytest.approx(u, abs=1e-3)
        if modulation.startswith("discontinuous"):
            assert {0.0, 1.0} & {a, b, c}
            assert modulation == "discontinuous" or min(a, b, c) == 0.0
    assert duties(0.0, 0.0, 540.0, "sinusoidal") == (0.5, 0.5, 0.5)


@pytest.mark.parametrize("axis", ["d", "q"])
def test_a_current_step_is_followed_with_the_specified_bandwidth(axis):
    """1 - exp(-alpha t), at standstill and without computing delay; the difference is of the order of the period."""
    alpha, errors = 500.0, []
    for period in (1e-4, 5e-5):
        machine = plant(period=period, J=1e6)
        p = FocControllerParams(mode="current", period=period, current_bandwidth=alpha, delay=0)
        law = ByHand(FocController(p))
        ref = (4.0, 0.0, 0.0) if axis == "d" else (0.0, 4.0, 0.0)
        rows = []
        for k in range(round(0.012 / period)):
            t = round(k * period * NS)
            seen = machine.outputs(t)
            rows.append(machine.x.i_d if axis == "d" else machine.x.i_q)
            outputs = law.update(
                t, currents=seen["currents"], joint_states=seen["joint_states"][:2], dc_link=(540.0,), current_ref=ref
            )
            machine.advance(t, duty=outputs["duty"], load_torque=None)
        t = period * np.arange(len(rows))
        errors.append(np.abs(np.array(rows) / 4.0 - (1.0 - np.exp(-alpha * t))).max())
    assert errors[0] < 0.02
    assert errors[1] == pytest.approx(0.5 * errors[0], rel=0.1)


def loop(alpha_s, alpha_c, J):
    """Speed over its reference, with the torque a first-order lag behind: numerator, denominator."""
    k = alpha_s * J
    return [k, alpha_s * k], [J / alpha_c, J, 2.0 * k, alpha_s * k]


@pytest.mark.parametrize(
    ("name", "alpha_s", "J"),
    [("pmsm_foc", 25.0, 0.015), pytest.param("pmsm_foc_servo", 100.0, 7.061552e-6, marks=pytest.mark.long)],
)
def test_the_drive_equals_its_linear_loop(name, alpha_s, J):
    """Rise and dip of the closed form in scipy; the difference is due to sampling and delay."""
    from scipy.signal import lti

    p = load_scenario(name).nodes["foc_controller"].parameters
    alpha_c = p.get("current_bandwidth", 400.0 * math.pi)
    num, den = loop(alpha_s, alpha_c, J)
    t = np.linspace(0.0, 10.0 / alpha_s, 20001)
    up = lti(num, den).step(T=t)[1]
    run = simulate(name)
    assert not run.missed
    result = run.figures
    assert result["rise_time"] == pytest.approx(np.interp(0.9, up, t) - np.interp(0.1, up, t), rel=0.01)
    load = 10.0 if name == "pmsm_foc" else 0.05
    dip = lti([1.0 / alpha_c, 1.0, 0.0], den).step(T=t)[1].max()
    assert result["load_dip"] == pytest.approx(load * dip, rel=0.02)


def test_field_weakening_keeps_the_voltage():
    run = simulate("pmsm_field_weakening")
    t, d = run.signals["foc/u_d/position"]
    q = run.signals["foc/u_q/position"].x
    speed = run.signals["joint_states/shaft/velocity"]
    fast = t > 0.5
    assert 0.85 < np.hypot(d, q)[fast].max() * 3**0.5 / 540.0 <= 1.0
    assert speed.x[-1] * 3 * 0.545 > 1.5 * 540.0 / 3**0.5  # the magnet's voltage alone exceeds that of the link
    assert run.figures["i_d_idle"] == pytest.approx((0.9 * 540.0 / 3**0.5 / 900.0 - 0.545) / 0.036, rel=0.01)


def test_a_rejected_measurement_leaves_zero_voltage():
    law = ByHand(FocController(FocControllerParams()))
    before = law.x
    assert law.refused(0)["duty"] == (0.5, 0.5, 0.5)
    assert law.x == before


LATER = [pytest.param(f"pmsm_foc_{n}", marks=pytest.mark.long) for n in ("two_mass", "traction", "synrm")]


@pytest.mark.parametrize("name", ["pmsm_foc_switched", *LATER])
def test_scenarios_meet_their_expectations(name):
    assert not simulate(name).missed
