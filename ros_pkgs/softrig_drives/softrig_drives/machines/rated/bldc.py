"""A drive with a brushless DC machine from the values of its data sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softrig_control.data_sheet import check, head, mapping, plausible, text, whole

from .loops import Drive, inertia, most

# name: (what it is, unit)
ASKED = {
    "voltage": ("nominal DC voltage", "V"),
    "speed": ("nominal speed (under the nominal torque)", "1/min"),
    "torque": ("nominal torque", "N m"),
    "current": ("nominal current of the DC side", "A"),
    "pole_pairs": ("pole pairs", ""),
    "K_t": ("torque constant", "N m/A"),
    "K_v": ("speed constant", "1/min/V"),
    "R_tt": ("resistance between terminals", "ohm"),
    "L_tt": ("inductance between terminals", "H"),
    "current_idle": ("no-load current", "A"),
    "J": ("inertia of the rotor", "kg m^2"),
    "i_max": ("largest current", "A"),
    "period": ("sampling period", "s"),
}
CONSTANT = 5e-4  # electrical time constant where no inductance is given, s
HALL = 300.0  # bandwidth of the speed estimate from Hall edges, rad/s


def bldc(rated: Mapping[str, float]) -> Drive:
    """Turn the values of a data sheet into a drive.

    Parameters
    ----------
    rated : mapping of str to float
        By the names and in the units of `ASKED`. Voltage, speed, torque, current and pole pairs are needed.

    Returns
    -------
    Drive
        SI units; a phase has half of the values between terminals.

    Raises
    ------
    ValueError
        An unknown name, a value that is not a number above zero, a missing value, or values that contradict each other.
    """
    check(rated, ASKED, ("voltage", "speed", "torque", "current", "pole_pairs"), (("K_t", "K_v"),))
    assumed: list[str] = []
    U, i, torque = rated["voltage"], rated["current"], rated["torque"]
    w = rated["speed"] * math.pi / 30.0
    K = rated.get("K_t", 30.0 / (math.pi * rated["K_v"]) if "K_v" in rated else None)
    if K is None:
        K = torque / i
        assumed.append(f"K_t = {K:.4g} N m/A: nominal torque over nominal current")
    plausible("K_t", K * w / U, "times the nominal voltage as back-EMF at the nominal speed", 0.02, 1.2,
              "K_t is in N m/A, K_v in 1/min/V, speed in 1/min")  # fmt: skip
    plausible("K_t", K * i / torque, "times the nominal torque at the nominal current", 0.3, 3.0,
              "torque is in N m, K_t in N m/A, current in A")  # fmt: skip
    R = rated.get("R_tt")
    if R is None:
        R = (U - K * w) / i
        if R <= 0.0:
            raise ValueError(f"no resistance: the back-EMF {K * w:.4g} V leaves nothing of {U:g} V; give R_tt")
        assumed.append(f"R_tt = {R:.4g} ohm: what the nominal voltage leaves at nominal speed and current")
    plausible("R_tt", R * i / U, "times the nominal voltage at the nominal current", 1e-4, 1.0, "is it in ohm?")
    L = rated.get("L_tt")
    if L is None:
        L = CONSTANT * R
        assumed.append(f"L_tt = {L:.4g} H: {CONSTANT:g} s times R_tt")
    plausible("L_tt", L / R, "s as time constant L/R", 1e-6, 0.1, "is it in H?")
    idle = K * rated.get("current_idle", 0.0)
    plausible("current_idle", idle / torque, "times the nominal torque as friction", 0.0, 0.8, "it is in A")
    J, largest = inertia(rated, torque, w, assumed), most(rated, i, 1.0, assumed)
    period = rated.get("period", min(5e-5, round(0.1 * L / R, 7) or 1e-7))
    if "period" not in rated:
        assumed.append(f"period = {period:g} s: 20 kHz, or a tenth of L/R where that is less")
    alpha_c = min(0.15 / period, 3000.0)
    alpha_s = min(HALL / 7.5, alpha_c / 40.0)
    assumed.append(f"bandwidths of {alpha_c:.4g} (current) and {alpha_s:.4g} rad/s (speed, by Hall sensors)")
    assumed.append(
        ("no friction beside the no-load current's" if idle else "no friction")
        + ", trapezoids of 120 degrees, no cogging"
    )
    plant = {"R": 0.5 * R, "L": 0.5 * L, "k_e": 0.5 * K, "pole_pairs": whole(rated, "pole_pairs"), "J": J, "U_dc": U,
             "period": period, "trip_current": 3.0 * largest}  # fmt: skip
    if idle:
        plant |= {"T_coulomb": idle, "w_stick": max(1.0, 0.01 * w)}
    law = {"i_max": largest, "current_bandwidth": alpha_c, "speed_bandwidth": alpha_s}
    return Drive(plant, law, {"speed": 0.5 * w, "torque": 0.5 * torque}, tuple(assumed))


def scenario(name: str, rated: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Write a scenario for a brushless DC machine.

    Returns
    -------
    str
        YAML, which extends `bldc_six_step`.
    tuple of str
        What was assumed.
    """
    drive = bldc(rated)
    step, alpha = drive.step, drive.law["speed_bandwidth"]
    start = drive.plant["J"] * step["speed"] / (2.0 * drive.plant["k_e"] * drive.law["i_max"])
    begin, settle = 0.002, 12.0 / alpha + 3.0 * start
    loaded, end = begin + settle, begin + 2.0 * settle
    message = f"""{head(rated, ASKED, drive.assumed, "A drive")}
extends: bldc_six_step
title: Six-step control of {name}
system: {name}
source: data sheet
duration: {text(end)}
shared: {{begins: {text(begin)}, loaded: {text(loaded)}, target: {text(step["speed"])}}}
nodes:
  bldc_plant:
    parameters: {mapping(drive.plant)}
  six_step_controller:
    parameters: {mapping(drive.law)}
  speed_source: {{parameters: {{period: $bldc_plant.period}}}}
  load_source: {{parameters: {{period: $bldc_plant.period, values: [0.0, {text(step["torque"])}]}}}}
figures:
  speed_idle: {{arguments: {{start: $load_source.times.1 - 3 / $six_step_controller.speed_bandwidth}}}}
  torque_mean: {{arguments: {{start: {text(end - 3.0 / alpha)}}}}}
expect:
  speed_idle: $speed_source.velocities.1 +- 2 %
  torque_mean: $load_source.values.1 + $bldc_plant.T_coulomb +- 10 %
"""
    return message, drive.assumed
