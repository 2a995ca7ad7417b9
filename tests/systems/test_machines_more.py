"""Induction and brushless machines, sensors, observer: against closed forms, and scipy with another form of the
model.
"""

import math

import numpy as np
import pytest
from conftest import few
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.signal import lti
from softrig_bringup.cli import main
from softrig_core import ByHand, load_scenario, rig_of, simulate
from softrig_drives.machines.bldc import BldcPlant, BldcPlantParams, shape
from softrig_drives.machines.control.induction_foc import ImFocController, ImFocParams
from softrig_drives.machines.control.six_step import STEPS, SixStepController, SixStepParams
from softrig_drives.machines.induction_plant import InductionPlant, InductionPlantParams
from softrig_drives.machines.rated.pmsm import pmsm, scenario
from softrig_drives.machines.sensors import CurrentSensor, CurrentSensorParams, ShaftSensor, ShaftSensorParams
from softrig_drives.machines.synchronous import SynchronousConstants, outputs_of
from softrig_drives.stator import inverse_gamma

THIRD = 2.0 * math.pi / 3.0


def test_the_induction_machine_equals_its_t_circuit():
    """Currents of stator and rotor as states, mutual inductances: within 1e-8 after 20 periods of other voltages."""
    R_s, R_r, L_ls, L_lr, L_m, p, J = 1.405, 1.395, 0.005839, 0.004, 0.1722, 2, 0.0131
    R_R, L_sigma, L_M = inverse_gamma(R_r, L_ls, L_lr, L_m)
    block = ByHand(InductionPlant(InductionPlantParams(
        R_s=R_s, R_R=R_R, L_sigma=L_sigma, L_M=L_M, J=J, delay=0, substeps=8, trip_current=1e3, w_0=3.0
    )))  # fmt: skip
    L = np.array([[L_ls + L_m, L_m], [L_m, L_lr + L_m]])

    def slope(_, y, u):
        i, w = np.array([y[0] + 1j * y[1], y[2] + 1j * y[3]]), y[4]
        psi = L @ i
        di = np.linalg.solve(L, np.array([u - R_s * i[0], 1j * p * w * psi[1] - R_r * i[1]]))
        torque = 1.5 * p * (np.conj(psi[0]) * i[0]).imag
        return [di[0].real, di[0].imag, di[1].real, di[1].imag, (torque - 1.0) / J]

    y = [0.0, 0.0, 0.0, 0.0, 3.0]
    for k in range(20):
        duty = tuple((0.5 + 0.4 * np.cos(0.15 * k - THIRD * np.arange(3))).tolist())
        u = 540.0 * complex((2 * duty[0] - duty[1] - duty[2]) / 3, (duty[1] - duty[2]) / 3**0.5)
        block.advance(k * 100_000, duty=duty, load_torque=(1.0,))
        y = solve_ivp(slope, (0.0, 1e-4), y, args=(u,), method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    outputs = block.outputs(0)
    have = [
        outputs["currents"][0],
        (outputs["currents"][1] - outputs["currents"][2]) / 3**0.5,
        outputs["joint_states"][1],
    ]
    assert have == pytest.approx([y[0], y[1], y[4]], rel=1e-8, abs=1e-8)


@pytest.mark.long
def test_voltage_over_frequency_has_the_slip_of_the_circuit():
    """The steady state of the T circuit without rotor leakage: the slip at which the torque is the load."""
    R_s, R_R, L_sigma, L_M, p = 3.7, 2.1, 0.021, 0.224, 2
    w_s = 300.0
    u = 1.04 * w_s + 15.0
    u = min(u, 540.0 / 3**0.5)

    def torque(w_r):
        rotor = 1.0 / (1.0 / (1j * w_s * L_M) + w_r / (w_s * R_R))
        i = u / (R_s + 1j * w_s * L_sigma + rotor)
        return 1.5 * p * abs(i * rotor) ** 2 * w_r / (w_s * R_R) / w_s

    slip = brentq(lambda w_r: torque(w_r) - 10.0, 0.0, 30.0)
    result = simulate("im_vhz")
    assert not result.missed
    assert result.figures["speed_end"] == pytest.approx((w_s - slip) / p, abs=0.05)


def loop(alpha_s, alpha_c, J, sensor=None):
    """Reference and load torque (N m) to speed, with the lags of the current and of the speed's sensor."""
    k, ki = alpha_s * J, alpha_s**2 * J
    lag, num, den = np.array([1.0 / alpha_c, 1.0]), np.array([1.0]), np.array([1.0])
    if sensor:
        num, den = np.array([sensor**2]), np.array([1.0, 2.0 * sensor, sensor**2])
    plant = np.polymul([J, 0.0], [1.0, 0.0])
    closed = np.polyadd(np.polymul(np.polymul(plant, lag), den), np.polymul([2.0 * k, ki], num))
    return (np.polymul([k, ki], den), closed), (np.polymul(np.polymul([1.0, 0.0], lag), den), closed)


@pytest.mark.parametrize(
    ("name", "sensor", "within"),
    [
        ("im_foc", None, 0.01),
        pytest.param("pmsm_foc_encoder", 600.0, 0.015, marks=pytest.mark.long),
        pytest.param("pmsm_foc_sensorless", 250.0, 0.02, marks=pytest.mark.long),
    ],
)
def test_drives_equal_their_linear_loops(name, sensor, within):
    run = simulate(name)
    assert not run.missed
    t = np.linspace(0.0, 0.4, 20001)
    up, dip = (lti(*part).step(T=t)[1] for part in loop(25.0, 400.0 * math.pi, 0.015, sensor))
    assert run.figures["load_dip"] == pytest.approx(10.0 * dip.max(), rel=within)
    if "rise_time" in run.figures:
        assert run.figures["rise_time"] == pytest.approx(np.interp(0.9, up, t) - np.interp(0.1, up, t), rel=within)
    if name == "pmsm_foc_sensorless":
        true, seen = (run.signals[f"{topic}/shaft/position"] for topic in ("joint_states", "shaft_estimate"))
        assert np.abs(true.x[4000:6400] - seen.x[4000:6400]).max() < 0.03


def test_the_flux_of_the_controller_is_that_of_the_machine():
    machine = ByHand(InductionPlant(InductionPlantParams(delay=0, trip_current=1e3)))
    law = ByHand(ImFocController(ImFocParams(mode="torque", delay=0)))
    for k in range(1500):
        seen = machine.outputs(k * 100_000)
        duty = law.update(
            k * 100_000, currents=seen["currents"], joint_states=seen["joint_states"][:2], dc_link=(540.0,),
            torque_ref=(3.0 if k > 1000 else 0.0,),
        )["duty"]  # fmt: skip
        machine.advance(k * 100_000, duty=duty, load_torque=None)
    x = machine.x
    assert math.hypot(x.psi_R_alpha, x.psi_R_beta) == pytest.approx(law.x.psi, rel=5e-3)
    off = math.remainder(math.atan2(x.psi_R_beta, x.psi_R_alpha) - law.x.angle, math.tau)
    assert off == pytest.approx(0.0, abs=0.02)
    assert machine.outputs(0)["joint_states"][2] == pytest.approx(3.0, rel=0.01)


@pytest.mark.long
def test_flux_falls_with_speed():
    run = simulate("im_foc_weak")
    assert not run.missed
    assert run.figures["flux_end"] == pytest.approx(0.85 * 540.0 / 3**0.5 / (2.0 * run.figures["speed_end"]), rel=0.01)


# brushless --------------------------------------------------------------------------------------------------------


def test_the_trapezoid_of_the_emf():
    for angle, value in (
        (0.0, 0.0),
        (30, 1.0),
        (90, 1.0),
        (150, 1.0),
        (165, 0.5),
        (180, 0.0),
        (240, -1.0),
        (345, -0.5),
    ):
        assert shape(math.radians(angle)) == pytest.approx(value, abs=1e-12)
        assert shape(math.radians(angle) - 4.0 * math.pi) == pytest.approx(value, abs=1e-9)


def test_commutation_at_standstill_is_the_matrix_exponential():
    """a+ b- for ten periods, then a+ c-: the current of b decays through the upper diode to zero and stays there."""
    p = BldcPlantParams(J=1e3, substeps=20, v_diode=0.7)
    block = ByHand(BldcPlant(p))
    for k in range(10):
        block.advance(k * 50_000, gates=(0.5, 0.0, -1.0), load_torque=None)
    i = 12.0 / (2 * p.R) * (1.0 - math.exp(-p.R / p.L * 10 * p.period))
    assert (block.x.i_a, block.x.i_b, block.x.i_c) == pytest.approx((i, -i, 0.0), rel=1e-6)
    u = np.array([12.0, 24.7, 0.0])  # terminal voltages while b conducts through its diode
    drive = (u - u.mean()) / p.R  # final values of the currents
    decay = math.exp(-p.R / p.L * p.period)
    now = np.array([i, -i, 0.0])
    ended = p.L / p.R * math.log((-i - drive[1]) / (0.0 - drive[1]))
    for k in range(10, 30):
        block.advance(k * 50_000, gates=(0.5, -1.0, 0.0), load_torque=None)
        t = (k - 9) * p.period
        if t < ended:
            now = drive + (np.array([i, -i, 0.0]) - drive) * decay ** (k - 9)
        else:
            begin = drive[0] + (i - drive[0]) * math.exp(-p.R / p.L * ended)
            one = 12.0 / (2 * p.R) + (begin - 12.0 / (2 * p.R)) * math.exp(-p.R / p.L * (t - ended))
            now = np.array([one, 0.0, -one])
        assert (block.x.i_a, block.x.i_b, block.x.i_c) == pytest.approx(now, abs=2e-3 * i), k
    assert block.x.i_b == 0.0


def test_an_absurd_speed_ends_a_period_as_well():
    """The cut of a step cannot bring its currents to zero: the number of cuts in a period is limited."""
    block = ByHand(BldcPlant(BldcPlantParams()))
    for k in range(3):
        block.advance(k * 50_000, gates=(1.0, 0.0, -1.0), load_torque=None)
    block.x = block.x._replace(omega=1e200, i_c=1e-3)
    block.advance(150_000, gates=(-1.0, -1.0, -1.0), load_torque=None)


def test_an_emf_beyond_the_supply_charges_it_through_the_diodes():
    """All legs off: no current until the EMF between two terminals is U and two diodes, then braking."""
    limit = (24.0 + 2 * 0.7) / (2 * 0.01675)
    for share, flows in ((0.98, False), (1.1, True)):
        block = ByHand(BldcPlant(BldcPlantParams()))
        block.x = block.x._replace(omega=share * limit)
        for k in range(40):
            block.advance(k * 50_000, gates=(-1.0, -1.0, -1.0), load_torque=None)
        assert (block.x.omega < 0.999 * share * limit) == flows
        assert (abs(block.x.i_a) + abs(block.x.i_b) > 0.0) == flows or not flows


def test_each_sector_drives_the_flat_tops():
    sensor = ByHand(ShaftSensor(ShaftSensorParams(kind="hall", pole_pairs=1)))
    law = SixStepController(SixStepParams())
    for n in range(6):
        angle = math.pi / 6 + math.pi / 3 * (n + 0.5)
        hall = sensor.update(n, joint_states=(angle, 0.0))["hall"]
        remaining = {"currents": (0.0, 0.0, 0.0), "joint_states": (0.0, 0.0), "dc_link": (24.0,), "speed_ref": (10.0,)}
        _, result = law.update(law.first(), 0, hall=hall, **remaining)
        upper, lower = STEPS[n]
        assert (shape(angle - upper * THIRD), shape(angle - lower * THIRD)) == (1.0, -1.0)
        gates = result["gates"]
        assert gates[upper] > 0.0 == gates[lower]
        assert gates[3 - upper - lower] == -1.0
    node = ByHand(law)
    node.update(0, currents=(0.0,) * 3, hall=(1.0,) * 3, joint_states=(0.0, 0.0), dc_link=(24.0,), speed_ref=None)
    assert "hall" in node.reports


@pytest.mark.parametrize("name", ["bldc_six_step", pytest.param("bldc_six_step_1kw", marks=pytest.mark.long)])
def test_the_brushless_drive_meets_its_expectations(name):
    assert not simulate(name).missed


# sensors ----------------------------------------------------------------------------------------------------------


def test_the_encoder_counts_and_the_index_makes_it_absolute():
    sensor = ByHand(ShaftSensor(ShaftSensorParams(lines=100, start=0.0)))
    width = math.tau / 400
    for k, angle in enumerate(np.arange(1.0, 7.0, 0.01)):
        seen = sensor.update(k, joint_states=(float(angle), 0.0))["measured"][0]
        true = angle if angle >= math.tau else angle - math.floor(1.0 / width) * width
        assert abs(seen - true) <= width / 2 * (1 + 1e-9), angle
    assert sensor.x.absolute


def test_speed_follows_with_the_bandwidth():
    """A ramp of the angle: the loop's speed is 1 - (1 + alpha t) exp(-alpha t) of it."""
    sensor = ByHand(ShaftSensor(ShaftSensorParams(lines=10_000_000, bandwidth=200.0)))
    times = np.arange(600) * 1e-4
    seen = [sensor.update(k, joint_states=(50.0 * float(t), 50.0))["measured"][1] for k, t in enumerate(times)]
    wanted = 50.0 * (1.0 - (1.0 + 200.0 * times) * np.exp(-200.0 * times))
    assert np.abs(np.array(seen) - wanted).max() < 1.0


def test_a_resolver_of_unequal_amplitudes_errs_at_twice_the_angle():
    """By imbalance/2 sin(2 theta), slowly turned, so that the loop follows."""
    sensor = ByHand(ShaftSensor(ShaftSensorParams(kind="resolver", imbalance=0.02, bits=16, bandwidth=2000.0)))
    angles = np.arange(4000) * 2e-3
    seen = np.array([sensor.update(k, joint_states=(float(a), 0.0))["measured"][0] for k, a in enumerate(angles)])
    error = (seen - angles)[1000:]
    assert error == pytest.approx(0.01 * np.sin(2.0 * angles[1000:]), abs=1.5e-3)


def test_currents_are_converted():
    p = CurrentSensorParams(gain=(1.1, 1.0, 1.0), offset=(0.0, 0.5, 0.0), lsb=0.25, limit=3.0)
    sensor = ByHand(CurrentSensor(p))
    assert sensor.update(0, currents=(1.0, 1.0, -9.0))["measured"] == (1.0, 1.5, -3.0)
    assert "range" in sensor.reports
    noisy = [ByHand(CurrentSensor(CurrentSensorParams(noise=0.1))) for _ in range(2)]
    for one in noisy:
        one.reset(3)
    rows = [[one.update(k, currents=(0.0,) * 3)["measured"] for k in range(2000)] for one in noisy]
    assert rows[0] == rows[1]
    assert np.std(rows[0]) == pytest.approx(0.1, rel=0.05)
    assert abs(np.corrcoef(np.array(rows[0]).T)[0, 1]) < 0.06


@pytest.mark.parametrize(
    ("name", "circuit", "w"),
    [
        ("im_foc_4kw", (1.395, 0.005839, 0.005839, 0.1722), 1.0),
        ("im_foc_krause", (0.816, 0.754, 0.754, 26.13), 120 * math.pi),  # reactances at 60 Hz
    ],
)
def test_a_machine_published_as_a_t_circuit_is_reproduced(name, circuit, w):
    p = load_scenario(name).nodes["induction_plant"].parameters
    R_r, *inductances = circuit
    wanted = inverse_gamma(R_r, *(x / w for x in inductances))
    assert (p["R_R"], p["L_sigma"], p["L_M"]) == pytest.approx(wanted, rel=1e-6)


def test_a_reluctance_machine_published_by_its_reactances():
    """The torque of its two reactances over the load angle, as in textbooks; enough for its example's load."""
    parameters = load_scenario("pmsm_foc_synrm_msl").nodes["pmsm_plant"].parameters
    m = SynchronousConstants(**{k: v for k, v in parameters.items() if k in SynchronousConstants.model_fields}).numbers(
        0.0
    )
    U, w, X_d, X_q = 100.0 * 2.0**0.5, 100.0 * math.pi, 3.0, 1.0
    pull_out = 1.5 * U * U * (1.0 / X_q - 1.0 / X_d) / 2.0 / (w / 2.0)
    for delta in (0.1, 0.7, math.pi / 4.0, 1.2):
        torque = outputs_of(U * math.cos(delta) / X_d, U * math.sin(delta) / X_q, 0.0, 0.0, 0.0, m)[2]
        assert torque == pytest.approx(pull_out * math.sin(2.0 * delta), rel=1e-7)
    assert pull_out > 46.0


@pytest.mark.long
@pytest.mark.parametrize(
    "name", ["im_foc_4kw", "im_foc_krause", "bldc_six_step_anaheim", "pmsm_foc_servo", "pmsm_foc_synrm_msl"]
)
def test_other_machines_meet_their_expectations(name):
    assert not simulate(name).missed


# data sheets ------------------------------------------------------------------------------------------------------

SHEET = {"speed": 1500.0, "current": 4.3, "pole_pairs": 3, "torque": 14.0, "R_s": 3.6, "L_d": 0.036, "L_q": 0.051}


def test_the_machine_has_the_values_of_its_data_sheet():
    """Three ways to specify the same magnet; its voltage at 1000 1/min and its torque over rms current by
    definition.
    """
    psi = 0.545
    volts = psi * 3 * (1000 * math.pi / 30) * math.sqrt(1.5)
    ways = ({"psi_f": psi}, {"K_e": volts}, {"K_t": 1.5 * 3 * psi * math.sqrt(2.0)})
    for way in ways:
        drive = pmsm({**SHEET, **way})
        assert drive.plant["psi_f"] == pytest.approx(psi, rel=1e-12)
        assert not any(line.startswith(("psi_f", "R_s", "L_d")) for line in drive.assumed)
    between = {k: v for k, v in SHEET.items() if k not in ("R_s", "L_d", "L_q")} | {"R_tt": 7.2, "L_tt": 0.07}
    drive = pmsm(between)
    assert (drive.plant["R_s"], drive.plant["L_d"], drive.plant["L_q"]) == pytest.approx((3.6, 0.035, 0.035))


def test_assumptions_are_consistent_with_the_rated_point():
    """Rated current makes the rated torque, at the rated voltage and speed; the losses are the stated share."""
    rated = {"speed": 1500.0, "current": 4.3, "pole_pairs": 3, "power": 2200.0, "voltage": 370.0}
    p = pmsm(rated).plant
    peak, w = 4.3 * math.sqrt(2.0), 1500 * math.pi / 30
    assert 1.5 * 3 * p["psi_f"] * peak * w == pytest.approx(2200.0, rel=1e-12)
    u = complex(p["R_s"] * peak + 3 * w * p["psi_f"], 3 * w * p["L_q"] * peak)
    assert abs(u) * math.sqrt(1.5) == pytest.approx(370.0, rel=1e-12)
    assert 1.5 * p["R_s"] * peak**2 == pytest.approx(0.05 * 2200.0, rel=1e-12)


SERVO = {"speed": 6000.0, "current": 7.1, "pole_pairs": 4, "torque": 0.27, "R_tt": 0.79, "L_tt": 0.00038, "U_dc": 24.0}


@pytest.mark.parametrize("sheet", few([{**SHEET, "psi_f": 0.545, "J": 0.015}, SERVO], 1))
def test_the_rig_of_a_data_sheet_meets_its_expectations(sheet, tmp_path):
    text, assumed = scenario("mine", sheet)
    path = tmp_path / "mine.yaml"
    path.write_text(text)
    assert all(line in text for line in assumed)
    run = simulate(str(path))
    assert not run.missed, run.figures


@pytest.mark.parametrize(
    ("sheet", "text"),
    [
        ({}, "missing speed, current, pole_pairs, torque"),
        ({**SHEET, "poles": 6.0}, "poles: not asked for"),
        ({**SHEET, "torque": -1.0}, "above zero"),
        ({**SHEET, "torque": math.nan}, "above zero"),
        ({**SHEET, "pole_pairs": 2.5}, "whole number"),
        ({**SHEET, "R_tt": 7.2}, "mean the same"),
        ({k: v for k, v in SHEET.items() if k != "L_q"}, "give both"),
        ({k: v for k, v in SHEET.items() if k[0] != "L"}, "no inductance: give L_tt"),
        ({**{k: v for k, v in SHEET.items() if k[0] != "L"}, "voltage": 100.0}, "less than back-EMF"),
    ],
)
def test_an_impossible_data_sheet_is_refused(sheet, text):
    with pytest.raises(ValueError, match=text):
        pmsm(sheet)


def test_the_verb_writes_the_scenario(tmp_path, capsys):
    values = [f"{k}={v}" for k, v in SHEET.items()]
    assert main(["new", "my_drive", "--plant", "pmsm", "--into", str(tmp_path), "--rated", *values]) == 0
    assert "i_max" in capsys.readouterr().out
    assert rig_of(str(tmp_path / "my_drive.yaml")).scenario.nodes["pmsm_plant"].parameters["R_s"] == 3.6
    for arguments, text in (
        (["my_drive", "--plant", "pmsm", "--into", str(tmp_path), "--rated", *values], "exists already"),
        (["other", "--plant", "dcmotor"], "unknown; there are bldc, buck, im, pmsm"),
        (["other", "--plant", "pmsm", "--rated", "speed"], "expected NAME=VALUE"),
        (["other", "--plant", "pmsm", "--rated", "speed=fast"], "expected NAME=VALUE"),
        (["other", "--plant", "pmsm", "--only", "law"], "leave --only"),
        (["other", "--rated", "speed=3000"], "needs"),
        (["pmsm_foc", "--plant", "pmsm", "--rated", *values], "scenario already"),
    ):
        assert main(["new", *arguments]) == 2
        assert text in capsys.readouterr().err
