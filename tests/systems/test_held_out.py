"""Machines of other sources in the shipped rigs: verdicts pass, and figures equal closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers import two_port
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import step
from scipy.special import lambertw
from softrig_core import simulate
from softrig_core.block.params import build
from softrig_power.dispatch.certify import Optimiser
from softrig_power.dispatch.units import Units
from softrig_power.fault_location.line.parameters import RigParams
from softrig_power.fault_location.line.simulation import FaultedLine
from softrig_power.gupfc.flow.power_flow import PowerFlow, References
from softrig_power.gupfc.network import NetworkParams
from softrig_power.pv.module import ModuleParams
from softrig_power.pv.string import characteristic
from softrig_robots.arm.model import compile_arm

pytestmark = pytest.mark.long
DRAWN = range(10)
LOADED = 0.25  # s from the load step to the end of the drives' runs


def run(name, nodes, **more):
    """Run a scenario with parameters by node; its requirements must hold."""
    overrides = {f"{node}.{key}": value for node, values in nodes.items() for key, value in values.items()} | more
    result = simulate(name, overrides=overrides)
    assert [(r.name, r.value, r.error) for r in result.missed] == []
    return result


def transient(load, J, alpha, alpha_c=1256.6370614):
    """Speed lost (rad/s) and torque (N m) at the end: a PI loop of speed, 2 alpha J and alpha^2 J, around a lag."""
    lag = 1.0 / alpha_c
    poles = [lag, 1.0, 2.0 * alpha, alpha * alpha]
    _, lost = step((np.array([lag, 1.0, 0.0]) * load / J, poles), T=[0.0, LOADED])
    _, torque = step((np.array([2.0 * alpha, alpha * alpha]) * load, poles), T=[0.0, LOADED])
    return lost[-1], torque[-1]


def least_current(torque, psi, L_d, L_q, pole_pairs):
    """Currents i_d, i_q of the least amplitude that make a torque."""

    def amplitude(angle):
        def short(i):
            d, q = -i * math.sin(angle), i * math.cos(angle)
            return 1.5 * pole_pairs * (psi * q + (L_d - L_q) * d * q) - torque

        return brentq(short, 0.0, 1e5)

    angle = minimize_scalar(amplitude, bounds=(0.0, 1.2), method="bounded", options={"xatol": 1e-9}).x
    return -amplitude(angle) * math.sin(angle), amplitude(angle) * math.cos(angle)


# R_s, L_d, L_q, psi_f, pole pairs, J, U_dc, i_max, speed bandwidth, speed, load
MAGNETS = {
    "traction": (0.011, 1.0e-4, 3.0e-4, 0.07, 4, 0.06, 360.0, 450.0, 30.0, 20.0, 80.0),
    "servo": (0.38, 1.1e-3, 1.1e-3, 0.0085, 7, 2.2e-5, 36.0, 30.0, 60.0, 60.0, 0.1),
    "spindle": (0.9, 3.0e-3, 4.5e-3, 0.2, 3, 4.0e-3, 560.0, 40.0, 40.0, 50.0, 15.0),
    "pump": (2.5, 0.02, 0.03, 0.4, 2, 0.01, 540.0, 12.0, 25.0, 25.0, 5.0),
}


@pytest.mark.parametrize("machine", MAGNETS)
def test_another_magnet_motor(machine):
    R_s, L_d, L_q, psi, pole_pairs, J, U, i_max, alpha, speed, load = MAGNETS[machine]
    plant = {"R_s": R_s, "L_d": L_d, "L_q": L_q, "psi_f": psi, "pole_pairs": pole_pairs, "J": J, "U_dc": U,
             "trip_current": 3.0 * i_max, "trip_voltage": 2.0 * U}  # fmt: skip
    nodes = {"pmsm_plant": plant, "foc_controller": {"i_max": i_max, "speed_bandwidth": alpha},
             "speed_source": {"velocities": [0.0, speed]}, "load_source": {"values": [0.0, load]}}  # fmt: skip
    result = run("pmsm_foc", nodes).figures
    lost, torque = transient(load, J, alpha)
    assert result["torque_end"] == pytest.approx(torque, rel=1e-3)
    assert result["speed_end"] == pytest.approx(speed - lost, abs=0.01 * lost + 1e-3)
    i_d, i_q = least_current(result["torque_end"], psi, L_d, L_q, pole_pairs)
    assert (result["i_d_end"], result["i_q_end"]) == pytest.approx((i_d, i_q), abs=1e-4 * i_q)


# R_s, R_R, L_sigma, L_M (inverse Gamma), pole pairs, J, U_dc, i_max, flux, speed, load
CAGES = {
    "fifty horsepower": (0.087, 0.216, 0.0016, 0.0347, 2, 0.4986, 750.0, 150.0, 0.95, 10.0, 90.0),
    "four kilowatts": (1.405, 1.28, 0.0115, 0.172, 2, 0.0131, 560.0, 20.0, 0.9, 25.0, 8.0),
}


@pytest.mark.parametrize("machine", CAGES)
def test_another_cage_motor(machine):
    R_s, R_R, L_sigma, L_M, pole_pairs, J, U, i_max, flux, speed, load = CAGES[machine]
    plant = {"R_s": R_s, "R_R": R_R, "L_sigma": L_sigma, "L_M": L_M, "pole_pairs": pole_pairs, "J": J, "U_dc": U,
             "trip_current": 3.0 * i_max, "trip_voltage": 2.0 * U}  # fmt: skip
    nodes = {"induction_plant": plant, "im_foc_controller": {"i_max": i_max, "flux": flux},
             "speed_source": {"velocities": [0.0, speed]}, "load_source": {"values": [0.0, load]}}  # fmt: skip
    result = run("im_foc", nodes)
    lost, torque = transient(load, J, 25.0)
    assert result.figures["flux_end"] == pytest.approx(flux, rel=1e-5)
    assert result.figures["torque_end"] == pytest.approx(torque, rel=1e-3)
    assert result.figures["speed_end"] == pytest.approx(speed - lost, abs=0.01 * lost + 1e-3)
    amplitude = math.hypot(flux / L_M, result.figures["torque_end"] / (1.5 * pole_pairs * flux))
    i = np.array([result.signals[f"currents/{axis}"].x[-1] for axis in "xyz"])
    assert math.sqrt(2.0 / 3.0 * float(i @ i)) == pytest.approx(amplitude, rel=0.01)


@pytest.mark.parametrize(("U", "v", "L", "C", "R"), [(12.0, 3.3, 22e-6, 470e-6, 1.0), (48.0, 12.0, 1e-4, 470e-6, 2.0)])
def test_another_buck_converter(U, v, L, C, R):
    plant = {"U": U, "L": L, "C": C, "R": R, "load_currents": [0.0, 0.5 * v / R]}
    result = run("buck_pi", {"dcdc_plant": plant, "voltage_controller": {"set_point": v, "kp": 2.52 / U}}).figures
    assert result["v_mean"] == pytest.approx(v, rel=1e-6)
    assert result["i_mean"] == pytest.approx(v / R, rel=5e-4)


NETWORKS = [
    (40, 2500.0, 0.1, 80.0), (100, 10000.0, 0.15, 200.0), (60, 3750.0, 0.2, 150.0), (25, 1250.0, 0.15, 60.0),
    (80, 5000.0, 0.12, 120.0), (120, 12500.0, 0.18, 250.0), (50, 4000.0, 0.2, 100.0), (200, 15000.0, 0.1, 250.0),
    (30, 2000.0, 0.25, 90.0), (70, 6000.0, 0.16, 180.0),
]  # fmt: skip


@pytest.mark.parametrize(("flows", "C", "tau", "queue"), NETWORKS)
def test_the_queue_of_another_network_rests_where_misra_s_equations_do(flows, C, tau, queue):
    network = {"N": flows, "C": C, "tau_p": tau}
    nodes = {"tcp_fluid": network, "aqm_controller": {**network, "set_point": queue},
             "queue_reference": {"values": [queue]}}  # fmt: skip
    signals = run("tcp_aqm_smc", nodes).signals
    window = (tau + queue / C) * C / flows  # steady state: W = R C/N and p = 2/W^2
    assert signals["network/state/window/position"].x[-1] == pytest.approx(window, rel=1e-5)
    # At each period the law changes between two values.
    assert np.mean(signals["aqm/command/drop_probability/effort"].x[-2000:]) == pytest.approx(2.0 / window**2, rel=1e-6)


@pytest.mark.parametrize(
    ("V", "f", "L", "R", "C", "R_L", "v"),
    [
        (325.0, 50.0, 5e-3, 0.2, 2e-3, 50.0, 700.0),
        (98.0, 60.0, 1e-3, 0.05, 4.7e-3, 10.0, 250.0),
        (170.0, 50.0, 2e-3, 0.1, 3e-3, 20.0, 400.0),
        (325.0, 60.0, 8e-3, 0.3, 1.5e-3, 80.0, 650.0),
        # At 1100 V the carrier would clip the phase voltages, which need up to v/2, and distort the currents.
        (563.0, 50.0, 6e-3, 0.2, 1.1e-3, 90.0, 1200.0),
        (49.0, 50.0, 5e-4, 0.02, 1e-2, 5.0, 120.0),
        (281.0, 60.0, 3e-3, 0.1, 4e-3, 30.0, 600.0),
        (311.0, 50.0, 1e-2, 0.5, 1e-3, 120.0, 680.0),
        (135.0, 60.0, 1.5e-3, 0.08, 3.3e-3, 15.0, 320.0),
        (400.0, 50.0, 4e-3, 0.1, 2.2e-3, 60.0, 850.0),
    ],
)
def test_another_rectifier_rests_at_its_balance_of_power(V, f, L, R, C, R_L, v):
    machine = {"V_g": V, "f": f, "L": L, "R": R, "C": C, "R_L": R_L, "v_ref": v}
    nodes = {"rectifier_plant": {**machine, "v_start": v},
             "gpc_controller": {**machine, "set_point": v, "trip_high": 1.4 * v, "u_max": 0.45 * V},
             "event_source": {"values": [R_L, R_L / 1.5]}}  # fmt: skip
    result = run("rectifier_mpc_n1", nodes)
    i = (V - math.sqrt(V * V - 4.0 * R * v * v / (R_L / 1.5) / 1.5)) / (2.0 * R)
    drop = result.signals["v_drop/command/v_drop/effort"].x[-1]
    assert drop == pytest.approx(i * math.hypot(R, 2.0 * math.pi * f * L), rel=1e-4)


# ten draws of each of these, by number
# -------------------------------------------------------------------------------


@pytest.mark.parametrize("number", DRAWN)
def test_a_random_line_carries_the_current_of_its_phasors_and_its_waves_arrive_in_time(number):
    chance = np.random.default_rng([1, number])
    frequency, voltage, angle = chance.choice([50.0, 60.0]), chance.uniform(60e3, 800e3), -chance.uniform(0.02, 0.5)
    names = ("length", "r1", "l1", "c1", "r0", "l0", "c0")
    values = chance.uniform((60, 0.01, 8e-4, 8e-9, 0.1, 2e-3, 5e-9), (280, 0.1, 1.6e-3, 15e-9, 0.4, 5e-3, 7.9e-9))
    line = dict(zip(names, values, strict=True))
    R, X = chance.uniform((0.1, 2.0), (3.0, 40.0))
    x, closing = line["length"] * chance.uniform(0.1, 0.9), 1500
    overrides = {f"line.{key}": value for key, value in line.items()} | {
        "source.voltage": voltage, "source.frequency": frequency, "source.angle_r": angle, "source.r1": R,
        "source.x1": X, "fault.x_km": x, "fault.t_on": closing * 1e-6, "measurement.profile": "raw1m"}  # fmt: skip
    faulted, sound = (FaultedLine(build(RigParams, overrides | {"fault.type": kind})) for kind in ("AG", "none"))
    s = 2j * np.pi * frequency
    Y = two_port(line["r1"] + s * line["l1"], s * line["c1"], line["length"])
    E = voltage / np.sqrt(3.0) * np.exp([0.0, 1j * angle])
    U = np.linalg.solve(Y + np.eye(2) / complex(R, X), E / complex(R, X))
    into = Y @ U
    rms = sound.prefault_rms
    assert [rms[0], rms[6]] == pytest.approx(np.abs(U), rel=1e-3)
    assert [rms[3], rms[9]] == pytest.approx(np.abs(into), rel=3e-3, abs=1e-3 * voltage / X / 1e3)
    differs = faulted.run(4000) != sound.run(4000)
    slowness = min(np.sqrt(line["l1"] * line["c1"]), np.sqrt(line["l0"] * line["c0"]))  # s/km, of the faster mode
    for channels, length in ((slice(0, 6), x), (slice(6, 12), line["length"] - x)):
        arrival = closing + length * slowness * 1e6  # in steps; the cubic interpolation uses two samples ahead
        assert arrival - 3.0 <= np.flatnonzero(differs[:, channels].any(axis=1))[0] <= arrival + 1.0


@pytest.mark.parametrize("number", DRAWN)
def test_a_random_string_has_the_maximum_of_the_diode_equation(number):
    chance = np.random.default_rng([2, number])
    cells = int(chance.integers(36, 97))
    V_oc, I_sc, a = cells * chance.uniform(0.55, 0.72), chance.uniform(2.0, 14.0), chance.uniform(1.0, 1.5)
    R_s, R_p = chance.uniform(0.01, 0.06) * V_oc / I_sc, chance.uniform(20.0, 300.0) * V_oc / I_sc
    K_I, K_V, V_f = 5e-4 * I_sc, -0.003 * V_oc, chance.uniform(0.3, 0.9)
    n = int(chance.integers(1, 8))
    suns, warm = tuple(chance.uniform(100.0, 1200.0, n).tolist()), tuple(chance.uniform(-10.0, 75.0, n).tolist())
    module = ModuleParams(N_s=cells, V_oc=V_oc, I_sc=I_sc, a=a, R_s=R_s, R_p=R_p, K_I=K_I, K_V=K_V, V_f=V_f)

    def voltage(i):  # solves I = I_ph - I_0 (exp(U/v) - 1) - U/R_p for U by Lambert's function
        total = 0.0
        for G, T in zip(suns, warm, strict=True):
            v = a * cells * 1.380649e-23 * (T + 273.15) / 1.602176634e-19
            short = I_sc + K_I * (T - 25.0)
            I_0 = short / np.expm1((V_oc + K_V * (T - 25.0)) / v)
            rest = short * G / 1e3 + I_0 - i
            # U = R_p rest - v W(z) with ln z = ln(R_p I_0/v) + R_p rest/v. Where z overflows, W solves w + ln w = ln
            # z.
            log = np.log(R_p * I_0 / v) + R_p * rest / v
            if log < 600.0:
                w = float(lambertw(np.exp(log)).real)
            else:
                w = brentq(lambda w, log=log: w + np.log(w) - log, 1.0, log)
            total += max(R_p * rest - v * w - R_s * i, -V_f)
        return total

    grid = np.linspace(0.0, 1.3 * I_sc, 2001)
    powers = [i * voltage(i) for i in grid]
    at = int(np.argmax(powers))
    best = -minimize_scalar(lambda i: -i * voltage(i), bounds=(grid[at - 1], grid[at + 1]), method="bounded").fun
    assert characteristic(module, suns, warm).gmpp.p == pytest.approx(max(best, powers[at]), rel=2e-5)


@pytest.mark.parametrize("number", DRAWN)
def test_a_random_fleet_is_dispatched_at_equal_slopes(number):
    chance = np.random.default_rng([3, number])
    n = int(chance.integers(2, 10))
    least, more = chance.uniform(10.0, 100.0, n), chance.uniform(20.0, 400.0, n)
    a, b, c = chance.uniform(5e-4, 5e-2, n), chance.uniform(1.0, 12.0, n), chance.uniform(0.0, 500.0, n)
    demand = least.sum() + chance.uniform(0.05, 0.95) * more.sum()
    table = np.column_stack([least, least + more, a, b, c, np.zeros(n), np.zeros(n)])
    result = Optimiser(Units(tuple(f"g{k}" for k in range(n)), table)).certified(demand)

    def outputs(price):
        return np.clip((price - b) / (2.0 * a), least, least + more)

    P = outputs(brentq(lambda price: outputs(price).sum() - demand, 0.0, 100.0, xtol=1e-13))
    wanted = (a * P * P + b * P + c).sum()
    assert result.P.sum() == pytest.approx(demand, abs=1e-6)
    assert wanted - 1e-6 <= result.cost <= wanted + 1.001e-3
    assert result.bound <= wanted + 1e-6 <= result.cost + 2e-6


@pytest.mark.parametrize("number", DRAWN)
def test_the_flow_of_a_random_double_line_satisfies_its_equations(number):
    chance = np.random.default_rng([4, number])
    frequency, power, voltage = chance.choice([50.0, 60.0]), chance.uniform(100e6, 1e9), chance.uniform(110e3, 500e3)
    base, omega = voltage**2 / power, 2.0 * np.pi * frequency
    r, l, c, length = chance.uniform((0.015, 8e-4, 9e-9, 30.0), (0.06, 1.2e-3, 14e-9, 150.0))  # noqa: E741
    at, other = chance.uniform(0.05, 0.3, 2)
    network = NetworkParams(
        frequency=frequency, power_base=power, voltage_base=voltage, r1=r, l1=l, c1=c, half_length=length,
        source_r=0.003 * base, source_l=0.02 * base / omega, source1_angle=-at, source2_angle=other,
        source1_voltage=chance.uniform(0.97, 1.03),
    )  # fmt: skip
    names = "A1234B"
    half = two_port(complex(r, omega * l) / base, 1j * omega * c * base, length)
    source = 1.0 / complex(0.003, 0.02)
    Y = np.zeros((6, 6), dtype=complex)
    for pair in ("A1", "A3", "2B", "4B"):
        k = [names.index(bus) for bus in pair]
        Y[np.ix_(k, k)] += half
    Y[0, 0] += source
    Y[5, 5] += source
    E = np.zeros(6, dtype=complex)
    E[0], E[5] = source * np.exp(1j * other), source * network.source1_voltage * np.exp(-1j * at)
    through = Y.copy()  # with both circuits closed and no converters, buses 1 and 2 are one, and so are 3 and 4
    joined = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    u = joined @ np.linalg.solve(joined.T @ through @ joined, joined.T @ E)
    natural = u[2] * np.conj(-(Y @ u)[2])
    asked = [natural + complex(*chance.uniform(-0.05, 0.05, 2)) for _ in range(2)]
    wanted = References(p1=asked[0].real, q1=asked[0].imag, p2=asked[1].real, q2=asked[1].imag, v=abs(u[1]))
    flow = PowerFlow(network, converter_loss=number % 2 == 1).solve(wanted, 1e-10)
    i12, i34, i_sh = flow.i12, flow.i34, flow.i_sh
    u = np.linalg.solve(Y, E + np.array([0, i_sh - i12, i12, -i34, i34, 0]))
    assert [flow.bus[name] for name in names] == pytest.approx(u, abs=1e-7)
    assert [u[2] * np.conj(i12), u[4] * np.conj(i34)] == pytest.approx(asked, abs=1e-7)
    assert abs(u[1]) == pytest.approx(wanted.v, abs=1e-7)
    v12, v34 = u[2] - u[1] + network.z_se * i12, u[4] - u[3] + network.z_se * i34
    v_sh = u[1] + network.z_sh * i_sh
    assert [flow.v12, flow.v34, flow.v_sh] == pytest.approx([v12, v34, v_sh], abs=1e-7)
    shunt = v_sh if number % 2 else u[1]  # the paper balances the power at bus 1
    delivered = (v12 * np.conj(i12) + v34 * np.conj(i34) + shunt * np.conj(i_sh)).real
    assert delivered == pytest.approx(0.0, abs=1e-7)


LINK = """<link name="{0}"><inertial><origin xyz="{1} 0 0"/><mass value="{2}"/>
<inertia ixx="{3}" iyy="{3}" izz="{3}" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><origin xyz="{3} 0 0"/>
<axis xyz="0 -1 0"/><limit lower="-6" upper="6" effort="1e4" velocity="100"/></joint>"""
TOOL = """<joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="{} 0 0"/></joint>
<link name="tool"/>"""


@pytest.mark.parametrize("number", DRAWN)
def test_a_random_arm_of_two_links_moves_by_lagrange_s_equations(number):
    """Angles from the horizontal; rotors turn with the joints and the payload is a point at the tool."""
    chance = np.random.default_rng([5, number])
    l1, l2, m1, m2 = chance.uniform((0.1, 0.1, 0.2, 0.1), (1.5, 1.5, 60.0, 40.0))
    d1, d2 = l1 * chance.uniform(0.2, 0.8), l2 * chance.uniform(0.2, 0.8)
    I1, I2 = m1 * l1**2 * chance.uniform(0.02, 0.1), m2 * l2**2 * chance.uniform(0.02, 0.1)
    load, rotors = chance.uniform(0.0, 5.0), chance.uniform(0.0, 2.0, 2)
    urdf = "".join((
        '<robot name="drawn"><link name="base"/>', JOINT.format("one", "base", "upper", 0.0),
        LINK.format("upper", d1, m1, I1), JOINT.format("two", "upper", "lower", l1), LINK.format("lower", d2, m2, I2),
        TOOL.format(l2), "</robot>",
    ))  # fmt: skip
    arm = compile_arm(urdf, "tool", ("one", "two"), 1.0)
    h = (m2 * d2 + load * l2) * l1  # the payload adds a mass to the second link
    second = I2 + m2 * d2**2 + load * l2**2
    for q, v, a in chance.uniform(-3.0, 3.0, (5, 3, 2)):
        c, s = math.cos(q[1]), math.sin(q[1])
        M = np.array([[m1 * d1**2 + I1 + (m2 + load) * l1**2 + second + 2.0 * h * c, second + h * c],
                      [second + h * c, second]]) + np.diag(rotors)  # fmt: skip
        turning = h * s * np.array([-2.0 * v[0] * v[1] - v[1] ** 2, v[0] ** 2])
        outer = 9.81 * (m2 * d2 + load * l2) * math.cos(q.sum())
        weight = np.array([9.81 * (m1 * d1 + (m2 + load) * l1) * math.cos(q[0]) + outer, outer])
        torque = M @ a + turning + weight
        assert arm.inverse((*q, *v, *a, *rotors, load)) == pytest.approx(torque, rel=1e-9, abs=1e-9 * abs(torque).max())
        place = (l1 * math.cos(q[0]) + l2 * math.cos(q.sum()), 0.0, l1 * math.sin(q[0]) + l2 * math.sin(q.sum()))
        assert arm.tool(tuple(q))[:3] == pytest.approx(place, abs=1e-12)
        moved = np.array(arm.step((*q, *v, *torque, 0.0, 0.0, 0.0, 1e-7, *rotors, load)))[2:]
        assert (moved - v) / 1e-7 == pytest.approx(a, abs=1e-3)
