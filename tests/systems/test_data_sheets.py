"""Rigs from rated values: results are compared with independent equations, impossible values are refused."""

import cmath
import math

import pytest
from softrig_bringup.cli import main
from softrig_core import simulate
from softrig_drives.machines.control.foc import FocController
from softrig_drives.machines.induction_plant import InductionPlant
from softrig_drives.machines.plant import PmsmPlant
from softrig_drives.machines.rated import bldc as bldc_sheet, induction as im_sheet
from softrig_drives.machines.rated.bldc import bldc
from softrig_drives.machines.rated.induction import induction
from softrig_drives.machines.rated.pmsm import pmsm
from softrig_power.dcdc import rated as buck_sheet
from softrig_power.dcdc.rated import buck

PLATE = {"power": 7500.0, "voltage": 400.0, "current": 14.5, "frequency": 50.0, "speed": 1455.0, "cos_phi": 0.85}
LESS = {k: v for k, v in PLATE.items() if k != "cos_phi"}
CIRCUIT = {"R_s": 0.7, "R_r": 0.5, "L_ls": 0.004, "L_lr": 0.005, "L_m": 0.1}
# The maxon EC 45 flat of `bldc_six_step`.
FLAT = {"voltage": 24.0, "speed": 5240.0, "torque": 0.0843, "current": 2.36, "pole_pairs": 8.0, "K_t": 0.0335,
        "R_tt": 1.03, "L_tt": 5.72e-4, "J": 1.35e-5}  # fmt: skip
SUPPLY = {"U_in": 28.0, "U_out": 15.0, "current": 5.0, "f_sw": 1e5}
SERVO = {"speed": 3000.0, "current": 2.2, "pole_pairs": 4.0, "torque": 1.27, "R_tt": 7.1, "L_tt": 0.0244, "K_e": 38.0}


def drawn(plant, slip, voltage, frequency):
    """Phasors of the inverse-Gamma circuit by its two loop equations; rms current and shaft power of one machine."""
    w = 2.0 * math.pi * frequency
    own = complex(plant["R_s"], w * (plant["L_sigma"] + plant["L_M"]))
    across, rotor = 1j * w * plant["L_M"], complex(plant["R_R"] / slip, w * plant["L_M"])
    U = voltage / math.sqrt(3.0)
    # Voltage equations of stator and rotor: u = own i_s + across i_r, 0 = across i_s + rotor i_r.
    i_s = U * rotor / (own * rotor - across * across)
    i_r = -across * i_s / rotor
    return i_s, 3.0 * abs(i_r) ** 2 * plant["R_R"] * (1.0 - slip) / slip, plant["L_M"] * (i_s + i_r)


@pytest.mark.parametrize("plate", [PLATE, {**PLATE, "R_s": 0.5}, {**LESS, "efficiency": 0.88}])
def test_an_induction_machine_draws_the_current_of_its_name_plate(plate):
    drive = induction(plate)
    current, power, flux = drawn(drive.plant, 0.03, 400.0, 50.0)
    assert abs(current) == pytest.approx(14.5, rel=1e-12)
    cosine = plate.get("cos_phi", 7500.0 / (math.sqrt(3.0) * 400.0 * 14.5 * 0.88))
    assert math.cos(cmath.phase(current)) == pytest.approx(cosine, rel=1e-12)
    assert abs(flux) * math.sqrt(2.0) == pytest.approx(drive.law["flux"], rel=1e-12)
    assert 1.0 < power / 7500.0 < 1.15  # the model has neither iron losses nor friction
    assert drive.plant["pole_pairs"] == 2


def test_an_equivalent_circuit_is_used_unchanged():
    """The T circuit draws the same current, and has the same power, as the constants of the plant."""
    drive = induction({**PLATE, **CIRCUIT})
    w, slip = 100.0 * math.pi, 0.03
    rotor = complex(CIRCUIT["R_r"] / slip, w * CIRCUIT["L_lr"])
    magnet = 1j * w * CIRCUIT["L_m"]
    z = complex(CIRCUIT["R_s"], w * CIRCUIT["L_ls"]) + rotor * magnet / (rotor + magnet)
    current, power, flux = drawn(drive.plant, slip, 400.0, 50.0)
    assert current == pytest.approx(400.0 / math.sqrt(3.0) / z, rel=1e-12)
    i_r = current * magnet / (rotor + magnet)
    assert power == pytest.approx(3.0 * abs(i_r) ** 2 * CIRCUIT["R_r"] * (1.0 - slip) / slip, rel=1e-12)
    assert abs(flux) * math.sqrt(2.0) == pytest.approx(drive.law["flux"], rel=1e-12)
    assert not any(line.startswith(("R_s", "L_sigma", "R_R")) for line in drive.assumed)


def test_a_phase_of_a_brushless_machine_has_half_of_the_terminal_resistance():
    plant = bldc(FLAT).plant
    assert [plant[n] for n in ("R", "L", "k_e")] == pytest.approx([0.515, 2.86e-4, 0.01675])
    by_speed = bldc({k: v for k, v in FLAT.items() if k != "K_t"} | {"K_v": 285.05})
    assert by_speed.plant["k_e"] == pytest.approx(0.01675, rel=1e-4)  # 285 1/min/V correspond to 33.5 mN m/A
    assumed = bldc({k: FLAT[k] for k in ("voltage", "speed", "torque", "current", "pole_pairs")}).plant
    K = 2.0 * assumed["k_e"]
    assert pytest.approx(0.0843) == K * 2.36
    assert K * 5240.0 * math.pi / 30.0 + 2.0 * assumed["R"] * 2.36 == pytest.approx(24.0)


def test_the_parts_of_a_buck_converter_give_the_requested_ripples():
    """By the areas of volt-seconds and of charge, not by the formulas of the module."""
    result = buck({**SUPPLY, "ripple_current": 1.0, "ripple_voltage": 0.05})
    L, C, T, D = result.plant["L"], result.plant["C"], 1e-5, 15.0 / 28.0
    assert pytest.approx(1.0) == (28.0 - 15.0) * D * T / L
    # The charge of the ripple above its mean, a triangle of half its size and half a period, sets the voltage ripple.
    assert 0.5 * (T / 2.0) * 0.5 / C <= 0.05
    assert 2.0 * math.pi * 1e5 * math.sqrt(L * C) >= 48.0 * (1.0 - 1e-9)
    # The loop gain of controller and converter is 1 at the stated crossover.
    law, w = result.law, 2.4 / math.sqrt(L * C)
    assert abs(law["kp"] * complex(1.0, w * law["t_d"])) * 28.0 / (w * w * L * C) == pytest.approx(1.0)


RIGS = {
    "im": (im_sheet.scenario, PLATE),
    "im_circuit": (im_sheet.scenario, {**PLATE, **CIRCUIT, "J": 0.03}),
    "bldc": (bldc_sheet.scenario, {**FLAT, "current_idle": 0.185}),
    "buck": (buck_sheet.scenario, {**SUPPLY, "L": 5e-5, "C": 5e-4}),
    "buck_fast": (buck_sheet.scenario, {"U_in": 12.0, "U_out": 1.2, "current": 20.0, "f_sw": 5e5}),
}


@pytest.mark.parametrize("name", [n if n != "im" else pytest.param(n, marks=pytest.mark.long) for n in RIGS])
def test_the_rig_meets_its_expectations(name, tmp_path):
    written, sheet = RIGS[name]
    text, assumed = written("mine", sheet)
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    assert all(line in text for line in assumed)
    run = simulate(str(file))
    assert not run.missed, run.figures


HOSTILE = [
    (induction, {}, "missing power, voltage, current, frequency, speed: .* known are power"),
    (induction, {**PLATE, "power": 7.5}, "efficiency = 0.0008783 by power, .* expected 0.2 to 0.99; power is in W"),
    (induction, {**PLATE, "speed": 1500.0}, "slip of 0, expected 0 to 0.3; the name plate has the speed under load"),
    (induction, {**PLATE, "speed": 152.4}, "19 pole pairs: is it in 1/min"),  # the speed is in rad/s by mistake
    # Number of poles instead of pole pairs.
    (induction, {**PLATE, "pole_pairs": 4.0}, "4 pole pairs: a slip of -0.94"),
    (induction, {**PLATE, "pole_pairs": 1.5}, "whole number"),
    (induction, {**PLATE, "cos_phi": 85.0}, "between 0 and 1"),
    (induction, {**PLATE, "R_s": 700.0}, "leave no voltage"),
    (induction, {**PLATE, **CIRCUIT, "L_m": 100.0, "L_ls": 4.0}, "inductances in H"),
    (induction, {**PLATE, "R_r": 0.5}, "give the whole equivalent circuit"),
    (induction, {**PLATE, "J": 330.0}, "1 g cm"),
    (induction, {**PLATE, "U_dc": 0.54}, "both are in V"),
    (induction, {**PLATE, "i_max": 0.1}, "rated current: expected 0.5"),
    (induction, LESS, "missing cos_phi"),
    (induction, {**PLATE, "poles": 4.0}, "poles: not asked for"),
    (bldc, {**FLAT, "K_t": 33.5}, "K_t is in N m/A"),
    (bldc, {**FLAT, "R_tt": 1030.0}, "is it in ohm"),
    (bldc, {**FLAT, "L_tt": 0.572}, "is it in H"),
    (bldc, {**FLAT, "J": 92.5}, "1 g cm"),
    (bldc, {**FLAT, "torque": 84.3}, "torque is in N m"),
    (bldc, {**FLAT, "speed": 0.0}, "above zero"),
    (bldc, {**FLAT, "current_idle": 185.0}, "it is in A"),
    (bldc, {**FLAT, "K_v": 285.0}, "mean the same"),
    (bldc, {**{k: v for k, v in FLAT.items() if k != "R_tt"}, "K_t": 0.05}, "no resistance"),
    (buck, {**SUPPLY, "U_out": 28.0}, "a buck converter lowers"),
    (buck, {**SUPPLY, "f_sw": 10.0}, "is it in Hz"),
    (buck, {**SUPPLY, "L": 50.0}, "is it in H"),
    (buck, {**SUPPLY, "C": 1e-9}, "is it in F"),
    (buck, {**SUPPLY, "L": 5e-5, "C": 1e-6}, "resonate at 2.251e[+]04 Hz: expected at most"),
    (buck, {**SUPPLY, "R_L": 20.0}, "half of the voltage"),
    (buck, {**SUPPLY, "power": 75.0}, "mean the same"),
    (pmsm, {**SERVO, "R_tt": 7100.0}, "is the resistance in ohm"),
    (pmsm, {**SERVO, "L_tt": 24.4}, "L = .* is it in H"),
    (pmsm, {**SERVO, "K_e": 0.038}, "K_e is V"),
    (pmsm, {**SERVO, "J": 60.0}, "1 g cm"),
    (pmsm, {**SERVO, "current": 2200.0}, "ohm"),
    (pmsm, {**SERVO, "torque": 1270.0}, "torque N m"),
    (pmsm, {**SERVO, "U_dc": 0.3}, "times the voltage"),
]


@pytest.mark.parametrize(("sheet", "numbers", "text"), HOSTILE)
def test_values_of_another_unit_or_machine_are_refused_in_a_line(sheet, numbers, text):
    with pytest.raises(ValueError, match=text) as error:
        sheet(numbers)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("speed", ["3,000", "1_000", "nan", "inf", "２", "3000 rpm", ""])
def test_a_rated_value_is_one_number(speed, tmp_path, capsys):
    assert main(["new", "my_drive", "--plant", "pmsm", "--into", str(tmp_path), "--rated", f"speed={speed}"]) == 2
    reason = "3,000 may be 3000 or 3.000; write one" if speed == "3,000" else "expected NAME=VALUE with a number"
    assert f"--rated speed={speed}: {reason}" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_the_servo_is_accepted_and_another_convention_of_its_emf_is_remarked():
    assert not any("convention" in line for line in pmsm(SERVO).assumed)
    assert any("convention" in line for line in pmsm({**SERVO, "K_e": 38.0 * math.sqrt(2.0)}).assumed)


def test_the_verb_writes_each_kind(tmp_path, capsys):
    for kind, sheet in (("im", PLATE), ("bldc", FLAT), ("buck", SUPPLY)):
        values = [f"{k}={v}" for k, v in sheet.items()]
        assert main(["new", f"my_{kind}", "--plant", kind, "--into", str(tmp_path), "--rated", *values]) == 0
        assert f"my_{kind}.yaml; assumed" in capsys.readouterr().out
        assert main(["list", "--signals", str(tmp_path / f"my_{kind}.yaml")]) == 0
        capsys.readouterr()


def grid(i_d, i_q, psi_d, psi_q):
    return {
        "table_i_d": i_d,
        "table_i_q": i_q,
        "table_psi_d": [psi_d(d, q) for d in i_d for q in i_q],
        "table_psi_q": [psi_q(d, q) for d in i_d for q in i_q],
    }


BOTH, HALF = (-2.0, -1.0, 0.0, 1.0, 2.0), (0.0, 1.0, 2.0)


@pytest.mark.parametrize(
    ("plant", "values", "text"),
    [
        (PmsmPlant, {"R_s": 3600.0}, "R_s = 3600 ohm, L = 0.036 H: its fastest time constant is"),
        (PmsmPlant, {"L_d": 36e-6, "L_q": 51e-6}, "check the units, or use 100 substeps"),
        (PmsmPlant, {"psi_f": 545.0}, "psi_f = 545 Wb"),
        (PmsmPlant, {"w_0": 1e6}, "w_0 = 1e[+]06 rad/s"),
        (FocController, {"psi_f": 0.0, "L_q": 0.036}, "such a machine makes no torque"),
        (InductionPlant, {"R_R": 2100.0}, "R_R = 2100 ohm"),
        (InductionPlant, {"L_sigma": 21e-6}, "L_sigma = 2.1e-05 H"),
        (PmsmPlant, grid(BOTH, BOTH, lambda d, q: -0.1 * d, lambda d, q: 0.1 * q), "without a fold"),
        (PmsmPlant, grid(BOTH, BOTH, lambda d, q: 0.1 * d + 0.2 * q, lambda d, q: 0.2 * d + 0.1 * q), "cross coupling"),
        # The determinant is positive in all cells but one, so only that cell is at fault.
        (PmsmPlant, grid(BOTH, BOTH, lambda d, q: 0.1 * d + 0.012 * max(d, 0) ** 2 * q, lambda d, q: 0.1 * q + 0.3 * d),
         "cross coupling"),
        (PmsmPlant, grid(BOTH, HALF, lambda d, q: 0.1 * d, lambda d, q: 0.1 * q + 0.01), "expected 0 at i_q = 0"),
        (PmsmPlant, grid(BOTH, (1.0, 2.0), lambda d, q: 0.1 * d, lambda d, q: 0.1 * q), "begins at 1 A"),
    ],
)  # fmt: skip
def test_impossible_machines_and_those_that_no_step_resolves_are_refused(plant, values, text):
    """Previously speeds of 1e18 rad/s at run time, or a division by zero."""
    with pytest.raises(ValueError, match=text) as error:
        plant(**values)
    assert "\n" not in str(error.value)


def test_tables_with_the_largest_possible_coupling_are_accepted():
    PmsmPlant(**grid(BOTH, BOTH, lambda d, q: 0.1 * d + 0.099 * q, lambda d, q: 0.099 * d + 0.1 * q), substeps=10)
