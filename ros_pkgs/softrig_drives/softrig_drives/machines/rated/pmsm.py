"""A drive with a permanent magnet machine from the rated values of its data sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping

from softrig_control.data_sheet import check, head, plausible, whole

from .loops import Drive, inertia, loops, most, written

# name: (description, unit); the first four are needed, and one of torque and power
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
ONE = (("R_s", "R_tt"), ("psi_f", "K_e"), ("psi_f", "K_t"), ("K_e", "K_t"), ("L_d", "L_tt"), ("L_q", "L_tt"))


def pmsm(rated: Mapping[str, float]) -> Drive:
    """Turn rated values into a drive with a permanent magnet machine.

    Parameters
    ----------
    rated : mapping of str to float
        By the names and in the units of `ASKED`. Speed, current, pole pairs, and torque or power are needed.

    Returns
    -------
    Drive
        SI units; currents and fluxes as amplitudes.

    Raises
    ------
    ValueError
        An unknown name, a value that is not a number above zero, a missing value, or values that contradict each other.
    """
    check(rated, ASKED, ("speed", "current", "pole_pairs", ("torque", "power")), ONE)
    if ("L_d" in rated) != ("L_q" in rated):
        raise ValueError("L_d and L_q: give both, or L_tt")
    assumed: list[str] = []
    p, peak = whole(rated, "pole_pairs"), math.sqrt(2.0) * rated["current"]
    w = rated["speed"] * math.pi / 30.0
    torque = rated["torque"] if "torque" in rated else rated["power"] / w
    psi = _flux(rated, p, torque, peak, assumed)
    R = rated.get("R_s", 0.5 * rated["R_tt"] if "R_tt" in rated else None)
    if R is None:
        R = LOSS * torque * w / (1.5 * peak * peak)
        assumed.append(f"R_s = {R:.4g} ohm: the windings lose {LOSS:.0%} of the rated power")
    L_d, L_q = _inductances(rated, p * w, psi, R, peak, assumed)
    U_dc = rated.get("U_dc")
    if U_dc is None:
        needed = math.hypot(p * w * psi + R * peak, p * w * L_q * peak)
        voltage = rated.get("voltage", math.sqrt(1.5) * needed)
        U_dc = 1.15 * math.sqrt(2.0) * voltage
        assumed.append(f"U_dc = {U_dc:.4g} V: 15 % above the amplitude of the rated voltage between terminals")
    _check_orders(rated, p * w, psi, R, max(L_d, L_q), U_dc, torque, peak, assumed)
    J, largest = inertia(rated, torque, w, assumed), most(rated, peak, math.sqrt(2.0), assumed)
    period = rated.get("period", min(1e-4, round(0.05 * L_d / R, 6) or 1e-6))
    if "period" not in rated:
        assumed.append(f"period = {period:g} s: 10 kHz, or a twentieth of L_d/R where that is less")
    alpha_c, alpha_s, step = loops(torque, w, J, period, assumed)
    assumed.append("no friction, no saturation, an ideal inverter with averaged voltages")
    plant = {"R_s": R, "L_d": L_d, "L_q": L_q, "psi_f": psi, "pole_pairs": p, "J": J, "U_dc": U_dc, "period": period,
             "trip_current": 1.5 * largest, "trip_voltage": 1.5 * U_dc}  # fmt: skip
    law = {"i_max": largest, "current_bandwidth": alpha_c, "speed_bandwidth": alpha_s}
    return Drive(plant, law, step, tuple(assumed))


def _check_orders(
    rated: Mapping[str, float], w: float, psi: float, R: float, L: float, U_dc: float, torque: float, peak: float,
    assumed: list[str],
) -> None:  # fmt: skip
    """Refuse values that are wrong by a unit, and remark small contradictions; `w` is electrical, rad/s."""
    shaft_power = torque * w / round(rated["pole_pairs"])
    reach = U_dc / math.sqrt(3.0) if {"U_dc", "voltage"} & rated.keys() else w * psi + R * peak
    lost = 1.5 * R * peak * peak / shaft_power
    plausible("R_s", lost, "times the rated power lost in the windings", 1e-5, 5.0, "is the resistance in ohm?")
    magnet = 1.5 * round(rated["pole_pairs"]) * psi * peak
    units = "K_e is V (rms, between terminals) at 1000 1/min, psi_f Wb (peak), K_t N m/A, torque N m, current A (rms)"
    plausible("psi_f", magnet / torque, "times the rated torque at the rated current", 0.1, 3.0, units)
    plausible("psi_f", w * psi / reach, "times the voltage as back-EMF at rated speed", 1e-3, 4.0, units)
    plausible("L", w * L * peak / reach, "times the voltage at rated speed and current", 1e-4, 5.0, "is it in H?")
    if not 0.8 < magnet / torque < 1.25:
        assumed.append(f"the magnet's torque at the rated current is {magnet:.4g} N m, the rated torque {torque:.4g}: "
                       "the rest is reluctance torque, losses, or another convention of K_e or K_t")  # fmt: skip


def _flux(rated: Mapping[str, float], p: int, torque: float, peak: float, assumed: list[str]) -> float:
    """Return the flux linkage of the magnet, Wb."""
    if "psi_f" in rated:
        return rated["psi_f"]
    if "K_e" in rated:
        return rated["K_e"] * math.sqrt(2.0 / 3.0) / (1000.0 * math.pi / 30.0 * p)
    constant = rated.get("K_t", torque * math.sqrt(2.0) / peak)
    if "K_t" not in rated:
        assumed.append(f"psi_f: all torque at the rated current is that of the magnet, {constant:.4g} N m/A")
    return constant / (1.5 * p * math.sqrt(2.0))


def _inductances(
    rated: Mapping[str, float], w: float, psi: float, R: float, peak: float, assumed: list[str]
) -> tuple[float, float]:
    """Return L_d and L_q, H."""
    if "L_d" in rated:
        return rated["L_d"], rated["L_q"]
    if "L_tt" in rated:
        assumed.append("L_d = L_q = L_tt/2: surface magnets")
        return 0.5 * rated["L_tt"], 0.5 * rated["L_tt"]
    along = w * psi + R * peak
    left = 2.0 / 3.0 * rated["voltage"] ** 2 - along * along if "voltage" in rated else 0.0
    if left <= 0.0:
        raise ValueError(
            "no inductance: give L_tt, or L_d and L_q"
            + (f"; the rated voltage is less than back-EMF and resistance need, {along * math.sqrt(1.5):.4g} V"
               if "voltage" in rated else ", or the rated voltage, from which one follows")
        )  # fmt: skip
    L = math.sqrt(left) / (w * peak)
    assumed.append(f"L_d = L_q = {L:.4g} H: what the rated voltage leaves at rated current and speed, i_d = 0")
    return L, L


def scenario(name: str, rated: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Write a scenario for a machine of a data sheet.

    Returns
    -------
    str
        YAML, which extends `pmsm_foc`.
    tuple of str
        What was assumed.
    """
    drive = pmsm(rated)
    text = f"""{head(rated, ASKED, drive.assumed, "A drive")}
extends: pmsm_foc
title: Field-oriented control of {name}
system: {name}
source: data sheet
{written(drive, ("pmsm_plant", "foc_controller"), 0.005, "  overshoot: at most 3")}
"""
    return text, drive.assumed
