"""Machines of other sources in the shipped rigs: verdicts pass, figures are those of closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar
from scipy.signal import step
from softrig_core import simulate

pytestmark = pytest.mark.long
LOADED = 0.25  # s from the load step to the end of the drives' runs


def run(name, nodes, **more):
    """Run a scenario with parameters by node; what it is judged by holds."""
    given = {f"{node}.{key}": value for node, values in nodes.items() for key, value in values.items()} | more
    result = simulate(name, overrides=given)
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


@pytest.mark.parametrize(("flows", "C", "tau", "queue"), [(40, 2500.0, 0.1, 80.0), (100, 10000.0, 0.15, 200.0)])
def test_the_queue_of_another_network_rests_where_misra_s_equations_do(flows, C, tau, queue):
    network = {"N": flows, "C": C, "tau_p": tau}
    nodes = {"tcp_fluid": network, "aqm_controller": {**network, "set_point": queue},
             "queue_reference": {"values": [queue]}}  # fmt: skip
    signals = run("tcp_aqm_smc", nodes).signals
    window = (tau + queue / C) * C / flows  # W = R C/N, p = 2/W^2
    assert signals["network/state/window/position"].x[-1] == pytest.approx(window, rel=1e-5)
    # the law changes between two values at each period
    assert np.mean(signals["aqm/command/drop_probability/effort"].x[-2000:]) == pytest.approx(2.0 / window**2, rel=1e-6)


@pytest.mark.parametrize(
    ("V", "f", "L", "R", "C", "R_L", "v"),
    [(325.0, 50.0, 5e-3, 0.2, 2e-3, 50.0, 700.0), (98.0, 60.0, 1e-3, 0.05, 4.7e-3, 10.0, 250.0)],
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
