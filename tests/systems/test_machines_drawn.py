"""Machines, converters and controllers at the parameters of each shipped scenario and at random ones, against closed
forms.
"""

import math

import numpy as np
import pytest
from conftest import few
from scipy.special import jv
from softrig_core import ByHand, list_scenarios, load_scenario
from softrig_drives.machines.bldc import BldcPlant, BldcPlantParams
from softrig_drives.machines.control.current_control import Integrals
from softrig_drives.machines.control.current_references import currents as least_currents, mtpa
from softrig_drives.machines.control.foc import FocController, FocControllerParams
from softrig_drives.machines.control.induction_foc import ImFocController, ImFocParams, State as ImFocState
from softrig_drives.machines.control.six_step import SixStepController, SixStepParams
from softrig_drives.machines.induction import InductionConstants
from softrig_drives.machines.induction_plant import InductionPlant, InductionPlantParams
from softrig_drives.machines.plant import PmsmPlant, PmsmPlantParams
from softrig_drives.machines.sensors import ShaftSensor, ShaftSensorParams
from softrig_drives.machines.synchronous import SynchronousConstants
from softrig_power.dcdc.plant import DcdcPlant, DcdcPlantParams
from test_machines import edges

THIRD = 2.0 * math.pi / 3.0
NS = 1e9


def sets(node, of):
    """Return the constants of each machine that a scenario has, with its DC voltage, by the first of its names."""
    results = {}
    for name in sorted(list_scenarios(), key=len):
        parameters = load_scenario(name).nodes.get(node)
        if parameters is not None:
            parameters_of_plant = {
                k: v for k, v in parameters.parameters.items() if k in of.model_fields and "table" not in k
            }
            parameters_of_plant["U_dc"] = parameters.parameters.get("U_dc", 540.0)
            if parameters_of_plant not in results.values():
                results[name] = parameters_of_plant
    return results


SYNCHRONOUS = sets("pmsm_plant", SynchronousConstants)
INDUCTION = sets("induction_plant", InductionConstants)
BRUSHLESS = sets("bldc_plant", BldcPlantParams)


def drawn(kinds, most, draws):
    """Return each machine with several random parameter sets, of which `most` are tested daily."""
    return few([(name, seed) for seed in range(draws) for name in kinds], most)


def test_all_shipped_machines_are_tested():
    assert (len(SYNCHRONOUS), len(INDUCTION), len(BRUSHLESS)) == (7, 4, 4)


@pytest.mark.parametrize(("name", "seed"), drawn(SYNCHRONOUS, 3, 6))
def test_a_current_step_is_followed_at_any_bandwidth_and_speed(name, seed):
    """1 - exp(-alpha t) on one axis, nothing on the other, while the machine turns; the difference falls with the
    period.
    """
    draw = np.random.default_rng([seed, 1])
    drawn_machine = SYNCHRONOUS[name]
    m = SynchronousConstants(**{k: v for k, v in drawn_machine.items() if k != "U_dc"})
    axis = int(draw.integers(2))
    w = (
        draw.uniform(-0.4, 0.4)
        * drawn_machine["U_dc"]
        / 3**0.5
        / max(m.psi_f, 0.1 * drawn_machine["U_dc"] / 500.0)
        / m.pole_pairs
    )
    slow = max(m.R_s / min(m.L_d, m.L_q), m.pole_pairs * abs(w))
    alpha = slow * 10.0 ** draw.uniform(-0.3, 1.0)
    rate = max(alpha, slow)
    period = 0.01 / rate
    step = 0.3 * drawn_machine["U_dc"] / 3**0.5 / (rate * max(m.L_d, m.L_q))
    ref = (step, 0.0, 0.0) if axis == 0 else (0.0, step, 0.0)
    remaining = {k: v for k, v in drawn_machine.items() if k != "U_dc"}
    machine = ByHand(
        PmsmPlant(
            PmsmPlantParams(**drawn_machine, period=period, delay=0, J=1e6, w_0=w, trip_current=1e5, trip_voltage=1e4)
        )
    )
    law = ByHand(
        FocController(
            FocControllerParams(**remaining, mode="current", period=period, current_bandwidth=alpha, delay=0, i_max=1e5)
        )
    )
    law.x = law.x._replace(u=Integrals())
    times, rows = period * np.arange(round(4.0 / (alpha * period))), []
    for t in times:
        at = round(float(t) * NS)
        rows.append((machine.x.i_d, machine.x.i_q))
        seen = machine.outputs(at)
        shaft = seen["joint_states"][:2]
        outputs = law.update(
            at, currents=seen["currents"], joint_states=shaft, dc_link=(drawn_machine["U_dc"],), current_ref=ref
        )
        machine.advance(at, duty=outputs["duty"], load_torque=None)
    wanted = np.zeros((len(times), 2))
    wanted[:, axis] = 1.0 - np.exp(-alpha * times)
    assert np.abs(np.array(rows) / step - wanted).max() < 0.015


@pytest.mark.parametrize(
    ("pairs", "rpm", "R", "L", "psi", "period"),
    [
        (20, 9000.0, 0.1, 5e-5, 0.003, 1e-4),  # a drone's motor with a long period
        (1, 1e5, 0.05, 2e-5, 0.001, 1e-4),
        (3, -3000.0, 2.0, 1e-4, 0.1, 1e-4),  # the currents decay faster than the period
    ],
)
def test_currents_of_a_fast_machine_are_exponentials_whatever_the_substeps(pairs, rpm, R, L, psi, period):
    """Exact solution at constant speed: L i' = u - R i - j w psi exp(j w t), u held for each period."""
    omega, U = rpm * math.pi / 30.0, 24.0
    w = pairs * omega
    machine = {"R_s": R, "L_d": L, "L_q": L, "psi_f": psi, "pole_pairs": pairs, "U_dc": U, "trip_current": 1e6}
    block = ByHand(
        PmsmPlant(PmsmPlantParams(**machine, period=period, substeps=1, w_0=omega, J=1e6, delay=0, trip_voltage=1e4))
    )
    emf = -1j * w * psi / L / (1j * w + R / L)
    i, errors, largest = 0j, [], 0.0
    for k in range(100):
        duty = [0.5 + 0.3 * math.cos(w * k * period + 0.5 - THIRD * j) for j in range(3)]
        u = U * 2.0 / 3.0 * sum(d * np.exp(1j * THIRD * j) for j, d in enumerate(duty))
        begin, end = (u / R + emf * np.exp(1j * w * t * period) for t in (k, k + 1))
        i = (i - begin) * math.exp(-R / L * period) + end
        block.advance(round(k * period * NS), duty=tuple(duty), load_torque=None)
        a, b, c = block.outputs(0)["currents"]
        errors.append(abs(complex(a, (b - c) / 3**0.5) - i))
        largest = max(largest, abs(i))
    assert max(errors) < 1e-5 * largest


@pytest.mark.parametrize(("name", "seed"), drawn(INDUCTION, 2, 6))
def test_a_torque_step_of_an_induction_machine_too(name, seed):
    """At constant flux the torque is that of i_q, which follows as 1 - exp(-alpha t)."""
    draw = np.random.default_rng([seed, 2])
    drawn_machine = INDUCTION[name]
    remaining = {k: v for k, v in drawn_machine.items() if k != "U_dc"}
    m = InductionConstants(**remaining)
    flux = 0.0016 * drawn_machine["U_dc"] * draw.uniform(0.5, 1.0)
    w = draw.uniform(-0.3, 0.3) * drawn_machine["U_dc"] / 3**0.5 / flux / m.pole_pairs
    slow = max((m.R_s + m.R_R) / m.L_sigma, m.pole_pairs * abs(w))
    alpha = slow * 10.0 ** draw.uniform(-0.3, 0.7)
    period = 0.01 / max(alpha, slow)
    i_d, k = flux / m.L_M, 1.5 * m.pole_pairs
    i_q = min(i_d, 0.3 * drawn_machine["U_dc"] / 3**0.5 / (alpha * m.L_sigma))
    machine = ByHand(
        InductionPlant(
            InductionPlantParams(
                **drawn_machine, period=period, delay=0, J=1e6, w_0=w, trip_current=1e5, trip_voltage=1e4
            )
        )
    )
    machine.x = machine.x._replace(psi_R_alpha=flux, psi_s_alpha=flux + m.L_sigma * i_d)
    law = ByHand(
        ImFocController(
            ImFocParams(
                **remaining, mode="torque", period=period, current_bandwidth=alpha, delay=0, i_max=1e5, flux=flux,
                voltage_use=1.0, torque_max=1e6,
            )
        )
    )  # fmt: skip
    law.x = ImFocState(flux, 0.0, Integrals((m.R_s + m.R_R) * i_d, 0.0))
    times, rows = period * np.arange(round(4.0 / (alpha * period))), []
    for t in times:
        at = round(float(t) * NS)
        seen = machine.outputs(at)
        rows.append((seen["joint_states"][2], math.hypot(machine.x.psi_R_alpha, machine.x.psi_R_beta)))
        outputs = law.update(
            at, currents=seen["currents"], joint_states=seen["joint_states"][:2], dc_link=(drawn_machine["U_dc"],),
            torque_ref=(k * flux * i_q,),
        )  # fmt: skip
        machine.advance(at, duty=outputs["duty"], load_torque=None)
    torque, psi = np.array(rows).T
    assert np.abs(torque / (k * flux * i_q) - (1.0 - np.exp(-alpha * times))).max() < 0.02
    assert np.abs(psi / flux - 1.0).max() < 0.01


def total(power, period):
    return float(np.sum((power[:-2:2] + 4.0 * power[1:-1:2] + power[2::2]) * period / 3.0))


@pytest.mark.parametrize(("name", "seed"), drawn([*SYNCHRONOUS, *INDUCTION], 3, 4))
def test_power_in_is_power_out_of_each_machine(name, seed):
    """Source = losses + capacitor + field + motion over periods of drawn voltages, by Simpson's rule."""
    draw = np.random.default_rng([seed, 3])
    synchronous = name in SYNCHRONOUS
    machine = (SYNCHRONOUS if synchronous else INDUCTION)[name]
    plant, params = (PmsmPlant, PmsmPlantParams) if synchronous else (InductionPlant, InductionPlantParams)
    U, R = machine["U_dc"], machine.get("R_s", 3.6 if synchronous else 3.7)
    R_dc, B, load = 0.02 * R, 1e-4, draw.uniform(0.0, 1e-3) * U / 540.0
    period = 1e-5
    p = params(**machine, C_dc=1e-2 / R, R_dc=R_dc, delay=0, B=B, period=period, trip_current=1e5, trip_voltage=1e4,
               load_torques=(load,), J=load + 1e-3)  # fmt: skip
    block = ByHand(plant(p))
    size, speed, turn, rows = draw.uniform(0.02, 0.1), draw.uniform(0.001, 0.01), draw.uniform(0.0, 6.0), []
    for k in range(2001):
        x = block.x
        if synchronous:
            psi_R, i = 0j, complex(x.i_d, x.i_q)
        else:
            psi_R = complex(x.psi_R_alpha, x.psi_R_beta)
            i = (complex(x.psi_s_alpha, x.psi_s_beta) - psi_R) / p.L_sigma
        rows.append((i.real, i.imag, psi_R.real, psi_R.imag, x.omega, x.u_dc))
        duty = tuple(0.5 + size * math.cos(speed * k + turn - j * THIRD) for j in range(3))
        block.advance(round(k * period * NS), duty=duty, load_torque=None)
    i_a, i_b, r_a, r_b, w, u = np.array(rows).T
    source = (p.U_dc - u) / R_dc
    lost = 1.5 * R * (i_a**2 + i_b**2) + R_dc * source**2 + B * w * w
    if synchronous:
        field = 0.75 * (p.L_d * i_a**2 + p.L_q * i_b**2)
    else:
        lost += 1.5 * p.R_R * ((r_a / p.L_M - i_a) ** 2 + (r_b / p.L_M - i_b) ** 2)
        field = 0.75 * (p.L_sigma * (i_a**2 + i_b**2) + (r_a**2 + r_b**2) / p.L_M)
    stored = field + 0.5 * p.C_dc * u**2 + 0.5 * p.J * w**2
    given_in, out = total(p.U_dc * source, period), total(lost + load * w, period) + stored[-1] - stored[0]
    assert given_in == pytest.approx(out, rel=5e-3)
    assert given_in > 0.0


@pytest.mark.parametrize("seed", few(range(20), 3))
def test_dead_time_reduces_the_voltage_of_each_leg_by_t_d_f_s_u_dc(seed):
    """At standstill the current is that of the remaining voltage, averaged and switched, of either sign."""
    draw = np.random.default_rng([seed, 4])
    inverter, sign = ("averaged", "switched")[seed % 2], float(draw.choice([-1.0, 1.0]))
    period, U, R = 10.0 ** draw.uniform(-4.7, -3.5), 10.0 ** draw.uniform(1.3, 2.9), 10.0 ** draw.uniform(-2.0, 1.0)
    share, dead = sign * draw.uniform(0.1, 0.3), period * draw.uniform(0.002, 0.05)
    L = 100.0 * R * period
    p = PmsmPlantParams(
        R_s=R, L_d=L, L_q=L, psi_f=0.0, J=1e6, delay=0, U_dc=U, period=period, dead_time=dead, inverter=inverter,
        trip_current=1e6, trip_voltage=1e4,
    )  # fmt: skip
    block = ByHand(PmsmPlant(p))
    for k in range(1500):
        block.advance(k, duty=(0.5 + share, 0.5 - share / 2, 0.5 - share / 2), load_torque=None)
    u = share * U - 4.0 / 3.0 * dead / period * U * sign
    assert block.outputs(0)["currents"][0] == pytest.approx(u / R, rel=2e-3)


@pytest.mark.parametrize("seed", few(range(30), 4))
def test_harmonics_of_any_carrier_and_modulation_are_bessel_functions(seed):
    """Holmes and Lipo, equations 3.66 (symmetrical) and 3.73 (asymmetrical regular sampling), in units of U_dc/2."""
    draw = np.random.default_rng([seed, 5])
    M, pulses, updates = draw.uniform(0.1, 1.0), int(draw.integers(20, 80)), 1 + seed % 2
    period, corners = 1.0 / (pulses * updates), []
    for k in range(pulses * updates):
        duty = 0.5 + 0.5 * M * math.cos(2.0 * math.pi * k * period)
        corners += [(k * period + t, s) for t, s in edges(duty, updates, k % 2 == 0, period)]
    times = np.array([t for t, _ in corners] + [1.0])
    levels = np.array([2.0 * s - 1.0 for _, s in corners])
    for m, n in [(0, 1), (1, 0), *((int(draw.integers(1, 4)), int(draw.integers(-4, 5))) for _ in range(5))]:
        rate = -2j * math.pi * (m * pulses + n)
        result = 2.0 * abs(np.sum(levels * (np.exp(rate * times[1:]) - np.exp(rate * times[:-1]))) / rate)
        q = m + n / pulses
        turn = 0.5 * math.pi * ((q + n) if updates == 1 else (m + n))
        assert result == pytest.approx(abs(4.0 / (math.pi * q) * jv(n, q * math.pi / 2 * M) * math.sin(turn)), abs=2e-3)


def rivals(torque, k, L_d, L_q, psi_f):
    """Return the least current of a torque by search: for each angle the current from a quadratic equation."""
    angle = np.linspace(1e-9, math.pi - 1e-9, 200_001)
    a, b = k * (L_d - L_q) * np.sin(angle) * np.cos(angle), k * psi_f * np.sin(angle)
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b * b + 4.0 * a * torque)
        i = 2.0 * torque / (b + root)  # this form is accurate for small a
    return float(np.nanmin(i))


@pytest.mark.parametrize(("name", "seed"), drawn([*SYNCHRONOUS, "drawn"], 4, 6))
def test_mtpa_is_the_least_current_of_any_machine(name, seed):
    draw = np.random.default_rng([seed, 6])
    if name == "drawn":
        L_d, L_q, psi_f = (10.0 ** draw.uniform(-4.0, -1.0) for _ in range(3))
        p, i_max = int(draw.integers(1, 8)), 10.0 ** draw.uniform(0.0, 2.5)
    else:
        m = SynchronousConstants(**{k: v for k, v in SYNCHRONOUS[name].items() if k != "U_dc"})
        L_d, L_q, psi_f, p, i_max = m.L_d, m.L_q, m.psi_f, m.pole_pairs, 20.0
    k = 1.5 * p
    for _ in range(3):
        i = draw.uniform(0.05, 1.0) * i_max
        torque = k * i * (psi_f * 0.7 + abs(L_d - L_q) * i * 0.5)
        i_d, i_q = mtpa(torque, k, L_d, L_q, psi_f)
        assert k * (psi_f + (L_d - L_q) * i_d) * i_q == pytest.approx(torque, rel=1e-9)
        assert math.hypot(i_d, i_q) == pytest.approx(rivals(torque, k, L_d, L_q, psi_f), rel=1e-7)
        assert least_currents(-torque, 1e9, 10.0 * i_max + 1e3, k, L_d, L_q, psi_f) == pytest.approx(
            (i_d, -i_q, -torque), rel=1e-9
        )


@pytest.mark.parametrize(("topology", "seed"), few([(t, s) for s in range(10) for t in ("buck", "boost")], 4))
def test_conduction_is_discontinuous_beyond_k_crit(topology, seed):
    """K = 2 L/(R T) beside K_crit, and the ratios of voltages on both sides; Erickson and Maksimovic, table 5.2."""
    draw = np.random.default_rng([seed, 7])
    D, L, T, U = draw.uniform(0.2, 0.75), 10.0 ** draw.uniform(-6.0, -3.0), 10.0 ** draw.uniform(-6.0, -4.0), 28.0
    critical = 1.0 - D if topology == "buck" else D * (1.0 - D) ** 2
    for share in (draw.uniform(0.2, 0.9), 0.97, 1.03, draw.uniform(1.1, 3.0)):
        K = share * critical
        R = 2.0 * L / (K * T)
        if share < 1.0:
            M = (
                2.0 / (1.0 + math.sqrt(1.0 + 4.0 * K / D**2))
                if topology == "buck"
                else 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * D**2 / K))
            )
        else:
            M = D if topology == "buck" else 1.0 / (1.0 - D)
        p = DcdcPlantParams(topology=topology, delay=0, L=L, C=100.0 * T / R, R=R, U=U, period=T, v_0=M * U)
        block, seen = ByHand(DcdcPlant(p)), []
        for k in range(1200):
            block.advance(k, duty=(D,), load_current=None)
            seen.append(block.outputs(k)["converter"][0])
        assert (block.x.i > 1e-6 * U / R) == (share > 1.0), share
        assert np.mean(seen[-100:]) == pytest.approx(M * U, rel=1e-2)


@pytest.mark.parametrize(("name", "seed"), drawn(BRUSHLESS, 1, 4))
def test_six_step_commutation_carries_load_and_losses(name, seed):
    """With two phases on their flat tops T = 2 k_e i; the electrical input is heat, field and motion."""
    draw = np.random.default_rng([seed, 8])
    machine = {k: v for k, v in BRUSHLESS[name].items() if k not in ("load_times", "load_torques", "B")}
    machine |= {"U_dc": load_scenario(name).nodes["bldc_plant"].parameters.get("U_dc", 24.0), "trip_current": 1e4}
    every, period, p = 10, 5e-6, BldcPlantParams(**machine)
    i_load = draw.uniform(0.05, 0.12) * p.U_dc / (2.0 * p.R)
    # The law samples the sectors once in a period.
    speed = min(draw.uniform(0.15, 0.35) * p.U_dc / (2.0 * p.k_e), 0.1 / (p.pole_pairs * every * period))
    load, J = 2.0 * p.k_e * i_load, 20.0 * p.J
    block = ByHand(
        BldcPlant(BldcPlantParams(**machine | {"J": J, "period": period, "substeps": 2, "load_torques": (load,)}))
    )
    block.x = block.x._replace(omega=speed)
    hall = ByHand(ShaftSensor(ShaftSensorParams(kind="hall", pole_pairs=p.pole_pairs, period=every * period)))
    same = {name: getattr(p, name) for name in ("R", "L", "k_e", "pole_pairs")}
    law = ByHand(SixStepController(SixStepParams(**same, J=J, i_max=3.0 * i_load, speed_bandwidth=40.0)))
    rows, gates = [], (0.0, 0.0, 0.0)
    for k in range(6000):
        t = k * 5000
        seen = block.outputs(t)
        (angle, w, torque), i = seen["joint_states"], seen["currents"]
        if k % every == 0:
            sector = hall.update(t, joint_states=(angle, w))["hall"]
            gates = law.update(
                t, currents=seen["currents"], hall=sector, joint_states=(angle, w), dc_link=(p.U_dc,),
                speed_ref=(speed,),
            )["gates"]  # fmt: skip
        rows.append((*i, *gates, torque, w))
        block.advance(t, gates=gates, load_torque=None)
    result = np.array(rows)
    i, gate, torque, w = result[:, :3], result[:, 3:6], result[:, 6], result[:, 7]
    largest, square = np.abs(i).max(axis=1), np.sum(i * i, axis=1)
    two = (np.abs(i).min(axis=1) == 0.0) & (largest > 0.3 * i_load)
    assert np.count_nonzero(two) > 1000
    assert np.median(np.abs(torque[two]) / (2.0 * p.k_e * largest[two])) == pytest.approx(1.0, rel=1e-6)
    mean = 0.5 * (i[1:] + i[:-1])
    diode = np.where(mean > 0.0, -p.v_diode, p.U_dc + p.v_diode)
    used = np.sum(np.where(gate[:-1] >= 0.0, gate[:-1] * p.U_dc, diode) * mean) * period
    out = np.sum(p.R * square + torque * w) * period + 0.5 * p.L * (square[-1] - square[0])
    # While braking, the input is a small difference of heat and motion.
    assert used == pytest.approx(out, abs=2e-3 * np.sum(p.R * square + np.abs(torque * w)) * period)
