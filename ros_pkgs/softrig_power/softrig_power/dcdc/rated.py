"""A buck converter from its requirements: the parts that follow, and a voltage controller for them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from softrig_control.data_sheet import check, head, mapping, plausible, text

# name: (what it is, unit)
ASKED = {
    "U_in": ("input voltage", "V"),
    "U_out": ("output voltage", "V"),
    "current": ("rated output current", "A"),
    "power": ("rated output power", "W"),
    "f_sw": ("switching frequency", "Hz"),
    "L": ("inductance", "H"),
    "C": ("capacitance", "F"),
    "R_L": ("resistance of the inductor", "ohm"),
    "R_C": ("series resistance of the capacitor (ESR)", "ohm"),
    "R_on": ("resistance of the switch", "ohm"),
    "v_diode": ("forward voltage of the diode", "V"),
    "ripple_current": ("ripple of the inductor's current, peak to peak", "A"),
    "ripple_voltage": ("ripple of the output voltage, peak to peak", "V"),
}
CURRENT, VOLTAGE = 0.3, 0.01  # ripple over rated current and output voltage where nothing is given
CROSSOVER = 2.4  # crossover over the resonance of L and C
# The least ratio of switching frequency to crossover, so that the delay of 1.5 periods leaves a phase margin.
LEAST = 20.0


class Converter(NamedTuple):
    """Parameters of `DcdcPlant` and `PidController`, and a description of the assumptions."""

    plant: dict[str, float]
    law: dict[str, float]
    assumed: tuple[str, ...]


def buck(rated: Mapping[str, float]) -> Converter:
    """Turn rated values into a converter.

    ::

        L = (1 - D) U_out/(ripple f_sw),  C = ripple/(8 f_sw ripple_voltage),  D = U_out/U_in

    The controller is Kp (1 + 1/(Ti s) + Td s) with Td = 1/w_0, Ti = 3.2/w_0 and a crossover at 2.4 w_0, where
    w_0 = 1/sqrt(L C) and the converter is U_in (w_0/w)^2.

    Parameters
    ----------
    rated : mapping of str to float
        By the names and in the units of `ASKED`. Voltages, switching frequency, and current or power are needed.

    Returns
    -------
    Converter

    Raises
    ------
    ValueError
        An unknown name, a value that is not a number above zero, a missing value, or values that contradict each other.

    References
    ----------
    R. W. Erickson, D. Maksimovic, Fundamentals of Power Electronics, 2nd ed., 2001, sections 2.2, 2.5 and 9.5.
    """
    check(rated, ASKED, ("U_in", "U_out", "f_sw", ("current", "power")),
          (("current", "power"), ("L", "ripple_current"), ("C", "ripple_voltage")))  # fmt: skip
    U, v, f = rated["U_in"], rated["U_out"], rated["f_sw"]
    if v >= 0.95 * U:
        raise ValueError(
            f"U_out = {v:g} V: expected less than 0.95 U_in = {0.95 * U:.4g} V; a buck converter lowers a voltage"
        )
    current = rated["current"] if "current" in rated else rated["power"] / v
    assumed: list[str] = []
    plausible("f_sw", f, "Hz", 100.0, 1e8, "is it in Hz?")
    L = rated.get("L")
    if L is None:
        ripple = rated.get("ripple_current", CURRENT * current)
        L = (1.0 - v / U) * v / (ripple * f)
        if "ripple_current" not in rated:
            assumed.append(f"L = {L:.4g} H: a ripple of {CURRENT:.0%} of the rated current")
    swing = (1.0 - v / U) * v / (L * f)
    plausible("L", swing / current, "times the rated current as ripple", 1e-3, 20.0, "is it in H?")
    C = rated.get("C")
    if C is None:
        ripple = rated.get("ripple_voltage", VOLTAGE * v)
        C = max(swing / (8.0 * f * ripple), (LEAST * CROSSOVER / (2.0 * math.pi * f)) ** 2 / L)
        assumed.append(
            f"C = {C:.4g} F: for a ripple of {ripple:.4g} V, and a resonance at most 1/{LEAST * CROSSOVER:g} of f_sw"
        )
    plausible("C", swing / (8.0 * f * C) / v, "times the output voltage as ripple", 1e-9, 0.2, "is it in F?")
    w = 1.0 / math.sqrt(L * C)
    if w * CROSSOVER * LEAST > 2.0 * math.pi * f * (1.0 + 1e-9):
        raise ValueError(
            f"L and C resonate at {w / (2.0 * math.pi):.4g} Hz: expected at most f_sw/{LEAST * CROSSOVER:g} = "
            f"{f / (LEAST * CROSSOVER):.4g} Hz for this controller; a larger L or C, or leave C out"
        )
    plant = {"period": 1.0 / f, "U": U, "L": L, "C": C, "R": v / current}
    for name, largest in (
        ("R_L", 0.5 * v / current),
        ("R_on", 0.5 * v / current),
        ("R_C", v / current),
        ("v_diode", v),
    ):
        if name in rated:
            plausible(name, rated[name], ASKED[name][1], 0.0, largest, "it would take half of the voltage or more")
            plant[name] = rated[name]
    lost = {"R_L", "R_on", "R_C", "v_diode"} - rated.keys()
    if lost:
        assumed.append(f"{', '.join(sorted(lost))} = 0")
    plant |= dict.fromkeys(lost, 0.0)
    if current < 0.5 * swing:
        assumed.append(
            f"the current is zero for a part of each period (discontinuous conduction): below {0.5 * swing:.4g} A"
        )
    law = {"kp": CROSSOVER**2 / (U * math.hypot(1.0, CROSSOVER)), "t_i": 3.2 / w, "t_d": 1.0 / w,
           "n_filter": 2.0 * f}  # fmt: skip
    assumed.append(
        f"controller: crossover at {CROSSOVER * w / (2.0 * math.pi):.4g} Hz, {CROSSOVER:g} times the resonance"
    )
    return Converter(plant, law, tuple(assumed))


def scenario(name: str, rated: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Write a scenario for a buck converter.

    Returns
    -------
    str
        YAML, which extends `buck_pi`.
    tuple of str
        What was assumed.
    """
    result = buck(rated)
    v, t_i = rated["U_out"], result.law["t_i"]
    loaded, end = 30.0 * t_i, 60.0 * t_i
    message = f"""{head(rated, ASKED, result.assumed, "A buck converter")}
extends: buck_pi
title: Voltage control of {name}
system: {name}
source: data sheet
duration: {text(end)}
shared: {{target: {text(v)}, loaded: {text(loaded)}}}
nodes:
  dcdc_plant:
    parameters: {mapping(result.plant | {"load_currents": f"[0.0, {text(0.5 * v / result.plant['R'])}]"})}
  voltage_controller:
    parameters: {mapping(result.law)}
figures:
  v_mean: {{arguments: {{start: 0.8 * $dcdc_plant.load_times.1}}}}
  i_mean: {{arguments: {{start: 0.8 * $dcdc_plant.load_times.1}}}}
  v_end: {{arguments: {{start: {text(0.9 * end)}}}}}
expect:
  v_mean: $voltage_controller.set_point +- 0.5 %
  v_end: $voltage_controller.set_point +- 1 %
"""
    return message, result.assumed
