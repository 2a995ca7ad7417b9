"""From the rated values of a data sheet to a drive: what follows, and what has to be assumed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

# name: (what it is, unit); the first four are needed, of torque and power one
ASKED = {
    "speed": ("rated speed", "1/min"),
    "current": ("rated current, rms", "A"),
    "pole_pairs": ("pole pairs", ""),
    "torque": ("rated torque", "N m"),
    "power": ("rated power", "W"),
    "voltage": ("rated voltage between terminals, rms", "V"),
    "U_dc": ("DC voltage of the inverter", "V"),
    "R_tt": ("resistance between terminals", "ohm"),
    "R_s": ("resistance of a phase", "ohm"),
    "L_tt": ("inductance between terminals", "H"),
    "L_d": ("inductance of the direct axis", "H"),
    "L_q": ("inductance of the quadrature axis", "H"),
    "K_e": ("back-EMF between terminals, rms, at 1000 1/min", "V"),
    "K_t": ("torque over rms current", "N m/A"),
    "psi_f": ("flux linkage of the magnet, peak", "Wb"),
    "J": ("inertia of the rotor", "kg m^2"),
    "i_max": ("largest current, rms", "A"),
    "period": ("sampling period", "s"),
}
LOSS = 0.05  # share of the rated power that the windings take where no resistance is given
START = 0.1  # s to the rated speed with the rated torque, where no inertia is given


class Drive(NamedTuple):
    """Parameters of `PmsmPlant` and `FocController`, a step that the drive can do, and what was assumed, in words."""

    plant: dict[str, float]
    law: dict[str, float]
    step: dict[str, float]
    assumed: tuple[str, ...]


def pmsm(given: Mapping[str, float]) -> Drive:
    """Turn rated values into a drive with a permanent magnet machine.

    Parameters
    ----------
    given : mapping of str to float
        By the names and in the units of `ASKED`. Speed, current, pole pairs, and torque or power are needed.

    Returns
    -------
    Drive
        SI units; currents and fluxes as amplitudes.

    Raises
    ------
    ValueError
        A name that is not asked for, a value that is no number above zero, one that is missing, or values that
        contradict each other.
    """
    _check(given)
    assumed: list[str] = []
    p, peak = round(given["pole_pairs"]), math.sqrt(2.0) * given["current"]
    w = given["speed"] * math.pi / 30.0
    torque = given["torque"] if "torque" in given else given["power"] / w
    psi = _flux(given, p, torque, peak, assumed)
    R = given.get("R_s", 0.5 * given["R_tt"] if "R_tt" in given else None)
    if R is None:
        R = LOSS * torque * w / (1.5 * peak * peak)
        assumed.append(f"R_s = {R:.4g} ohm: the windings lose {LOSS:.0%} of the rated power")
    L_d, L_q = _inductances(given, p * w, psi, R, peak, assumed)
    U_dc = given.get("U_dc")
    if U_dc is None:
        needed = math.hypot(p * w * psi + R * peak, p * w * L_q * peak)
        voltage = given.get("voltage", math.sqrt(1.5) * needed)
        U_dc = 1.15 * math.sqrt(2.0) * voltage
        assumed.append(f"U_dc = {U_dc:.4g} V: 15 % above the amplitude of the rated voltage between terminals")
    J = given.get("J")
    if J is None:
        J = torque * START / w
        assumed.append(f"J = {J:.4g} kg m^2: at rated torque the rotor needs {START:g} s to its rated speed")
    most = math.sqrt(2.0) * given["i_max"] if "i_max" in given else 1.5 * peak
    if "i_max" not in given:
        assumed.append(f"i_max = {most:.4g} A: 1.5 times the amplitude of the rated current")
    period = given.get("period", min(1e-4, round(0.05 * L_d / R, 6) or 1e-6))
    if "period" not in given:
        assumed.append(f"period = {period:g} s: 10 kHz, or a twentieth of L_d/R where that is less")
    alpha_c = min(400.0 * math.pi, 0.15 / period)
    alpha_s = min(alpha_c / 40.0, 0.8 * torque / (0.2 * w * J))
    assumed.append(f"bandwidths of {alpha_c:.4g} (current) and {alpha_s:.4g} rad/s (speed): chosen by the period and J")
    assumed.append("no friction, no saturation, an ideal inverter with averaged voltages")
    plant = {"R_s": R, "L_d": L_d, "L_q": L_q, "psi_f": psi, "pole_pairs": p, "J": J, "U_dc": U_dc, "period": period,
             "trip_current": 1.5 * most, "trip_voltage": 1.5 * U_dc}  # fmt: skip
    law = {"i_max": most, "current_bandwidth": alpha_c, "speed_bandwidth": alpha_s}
    step = {"speed": min(0.2 * w, 0.8 * torque / (alpha_s * J)), "torque": 0.5 * torque}
    return Drive(plant, law, step, tuple(assumed))


def _check(given: Mapping[str, float]) -> None:
    for name, value in given.items():
        if name not in ASKED:
            raise ValueError(f"{name}: not asked for; known are {', '.join(ASKED)}")
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} = {value:g}: expected a number above zero")
    missing = [name for name in ("speed", "current", "pole_pairs") if name not in given]
    if "torque" not in given and "power" not in given:
        missing.append("torque (or power)")
    if missing:
        raise ValueError(f"missing {', '.join(missing)}: give what the data sheet has, as {missing[0].split()[0]}=...")
    if given["pole_pairs"] != round(given["pole_pairs"]):
        raise ValueError(f"pole_pairs = {given['pole_pairs']:g}: expected a whole number")
    for one, other in (("R_s", "R_tt"), ("psi_f", "K_e"), ("psi_f", "K_t"), ("K_e", "K_t"), ("L_d", "L_tt")):
        if one in given and other in given:
            raise ValueError(f"{one} and {other} say the same: give one of them")
    if ("L_d" in given) != ("L_q" in given):
        raise ValueError("L_d and L_q: give both, or L_tt")


def _flux(given: Mapping[str, float], p: int, torque: float, peak: float, assumed: list[str]) -> float:
    """Return the flux linkage of the magnet, Wb."""
    if "psi_f" in given:
        return given["psi_f"]
    if "K_e" in given:
        return given["K_e"] * math.sqrt(2.0 / 3.0) / (1000.0 * math.pi / 30.0 * p)
    constant = given.get("K_t", torque * math.sqrt(2.0) / peak)
    if "K_t" not in given:
        assumed.append(f"psi_f: all torque at the rated current is that of the magnet, {constant:.4g} N m/A")
    return constant / (1.5 * p * math.sqrt(2.0))


def _inductances(
    given: Mapping[str, float], w: float, psi: float, R: float, peak: float, assumed: list[str]
) -> tuple[float, float]:
    """Return L_d and L_q, H."""
    if "L_d" in given:
        return given["L_d"], given["L_q"]
    if "L_tt" in given:
        assumed.append("L_d = L_q = L_tt/2: surface magnets")
        return 0.5 * given["L_tt"], 0.5 * given["L_tt"]
    along = w * psi + R * peak
    left = 2.0 / 3.0 * given["voltage"] ** 2 - along * along if "voltage" in given else 0.0
    if left <= 0.0:
        raise ValueError(
            "no inductance: give L_tt, or L_d and L_q"
            + (f"; the rated voltage is less than back-EMF and resistance need, {along * math.sqrt(1.5):.4g} V"
               if "voltage" in given else ", or the rated voltage, from which one follows")
        )  # fmt: skip
    L = math.sqrt(left) / (w * peak)
    assumed.append(f"L_d = L_q = {L:.4g} H: what the rated voltage leaves at rated current and speed, i_d = 0")
    return L, L


def scenario(name: str, given: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Write a scenario for a machine of a data sheet.

    Returns
    -------
    str
        YAML, which extends `pmsm_foc`.
    tuple of str
        What was assumed.
    """
    drive = pmsm(given)
    alpha, step = drive.law["speed_bandwidth"], drive.step
    begin, settle = 0.005, 10.0 / alpha
    said = "\n".join(f"#   {name} = {value:g} {ASKED[name][1]}: {ASKED[name][0]}" for name, value in given.items())
    noted = "\n".join(f"#   {line}" for line in drive.assumed)
    return (
        f"""# A drive from the rated values of a data sheet:
{said}
# Assumed, to be replaced by what you know:
{noted}
extends: pmsm_foc
title: Field-oriented control of {name}
system: {name}
source: data sheet
duration: {_text(begin + 2.0 * settle)}
shared: {{begins: {_text(begin)}, loaded: {_text(begin + settle)}, target: {_text(step["speed"])}}}
nodes:
  pmsm_plant:
    parameters: {_map(drive.plant)}
  foc_controller:
    parameters: {_map(drive.law)}
  speed_source: {{parameters: {{period: $pmsm_plant.period}}}}
  load_source: {{parameters: {{period: $pmsm_plant.period, values: [0.0, {_text(step["torque"])}]}}}}
expect:
  rise_time: {_text(math.log(9.0) / alpha)} +- 8 %
  overshoot: at most 3
  speed_end: {_text(step["speed"])} +- 3 %
""",
        drive.assumed,
    )


def _text(value: float) -> str:
    text = f"{value:.6g}"
    return text if "." in text and "e" not in text else repr(float(text))


def _map(values: Mapping[str, Any]) -> str:
    return "{" + ", ".join(f"{k}: {v if isinstance(v, int) else _text(v)}" for k, v in values.items()) + "}"
