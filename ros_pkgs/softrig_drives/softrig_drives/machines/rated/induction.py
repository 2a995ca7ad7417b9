"""A drive with an induction machine from its name plate, or from its equivalent circuit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from softrig_control.data_sheet import check, head, plausible, whole

from ...stator import inverse_gamma
from .loops import Drive, inertia, loops, most, written

# name: (what it is, unit)
ASKED = {
    "power": ("rated power at the shaft", "W"),
    "voltage": ("rated voltage between terminals, rms", "V"),
    "current": ("rated current, rms", "A"),
    "frequency": ("rated frequency", "Hz"),
    "speed": ("rated speed", "1/min"),
    "cos_phi": ("power factor", ""),
    "efficiency": ("efficiency, 0 to 1", ""),
    "pole_pairs": ("pole pairs", ""),
    "U_dc": ("DC voltage of the inverter", "V"),
    "R_s": ("resistance of a stator phase", "ohm"),
    "R_r": ("resistance of the rotor, referred to the stator", "ohm"),
    "L_ls": ("leakage inductance of the stator", "H"),
    "L_lr": ("leakage inductance of the rotor, referred to the stator", "H"),
    "L_m": ("magnetising inductance", "H"),
    "J": ("inertia of the rotor", "kg m^2"),
    "i_max": ("largest current, rms", "A"),
    "period": ("sampling period", "s"),
}
CIRCUIT = ("R_s", "R_r", "L_ls", "L_lr", "L_m")
LEAKAGE = 0.17  # total leakage reactance over rated voltage and current, where no circuit is given
WINDING = 0.5  # share of the losses outside of the rotor that the stator winding takes
USUAL = 8  # pole pairs at most, where the name plate does not say them
FLUX_LOOP = 50.0  # bandwidth of the flux control, rad/s


class Machine(NamedTuple):
    """R_s, R_R (ohm), L_sigma, L_M (H), and the amplitude of the rotor flux at the rated point (Wb)."""

    R_s: float
    R_R: float
    L_sigma: float
    L_M: float
    flux: float


def induction(rated: Mapping[str, float]) -> Drive:
    """Turn a name plate into a drive.

    Parameters
    ----------
    rated : mapping of str to float
        By the names and in the units of `ASKED`. Power, voltage, current, frequency, speed, and power factor or
        efficiency or the whole equivalent circuit are needed.

    Returns
    -------
    Drive
        SI units; currents and fluxes as amplitudes.

    Raises
    ------
    ValueError
        An unknown name, a value that is not a number above zero, a missing value, or values that contradict each other.
    """
    check(rated, ASKED, ("power", "voltage", "current", "frequency", "speed"))
    assumed: list[str] = []
    synchronous = 60.0 * rated["frequency"]
    p = whole(rated, "pole_pairs") if "pole_pairs" in rated else int(synchronous / rated["speed"])
    if p > USUAL and "pole_pairs" not in rated:
        raise ValueError(f"speed = {rated['speed']:g} 1/min makes {p} pole pairs: is it in 1/min? Else give pole_pairs")
    slip = 1.0 - p * rated["speed"] / synchronous if p else -1.0
    if not 0.0 < slip <= 0.3:
        raise ValueError(
            f"speed = {rated['speed']:g} 1/min at {rated['frequency']:g} Hz, {p} pole pairs: a slip of {slip:.3g}, "
            "expected 0 to 0.3; the name plate has the speed under load, in 1/min"
        )
    w, peak = rated["speed"] * math.pi / 30.0, math.sqrt(2.0) * rated["current"]
    torque = rated["power"] / w
    shares = 2.0 * math.pi * rated["frequency"]
    if all(name in rated for name in CIRCUIT):
        machine = _of_circuit(rated, shares, slip)
    elif some := [name for name in CIRCUIT[1:] if name in rated]:
        raise ValueError(f"{', '.join(some)}: give the whole equivalent circuit, {', '.join(CIRCUIT)}, or R_s alone")
    else:
        machine = _of_plate(rated, shares, slip, torque * w, assumed)
    U_dc = rated.get("U_dc")
    if U_dc is None:
        U_dc = 1.35 * rated["voltage"]
        assumed.append(f"U_dc = {U_dc:.4g} V: the mean of a three-phase rectifier at the rated voltage")
    plausible("U_dc", U_dc / rated["voltage"], "times the rated voltage", 0.2, 5.0, "both are in V")
    J, largest = inertia(rated, torque, w, assumed), most(rated, peak, math.sqrt(2.0), assumed)
    fast = machine.L_sigma / (machine.R_s + machine.R_R)
    period = rated.get("period", min(1e-4, round(0.05 * fast, 6) or 1e-6))
    if "period" not in rated:
        assumed.append(f"period = {period:g} s: 10 kHz, or a twentieth of L_sigma/(R_s + R_R) where that is less")
    alpha_c, alpha_s, step = loops(torque, w, J, period, assumed)
    assumed.append("no friction, no iron losses, no saturation, an ideal inverter with averaged voltages")
    plant = {"R_s": machine.R_s, "R_R": machine.R_R, "L_sigma": machine.L_sigma, "L_M": machine.L_M, "pole_pairs": p,
             "J": J, "U_dc": U_dc, "period": period,
             "trip_current": 1.5 * largest, "trip_voltage": 1.5 * U_dc}  # fmt: skip
    law = {"flux": machine.flux, "flux_bandwidth": FLUX_LOOP, "i_max": largest, "current_bandwidth": alpha_c,
           "speed_bandwidth": alpha_s}  # fmt: skip
    return Drive(plant, law, step, tuple(assumed))


def _of_plate(rated: Mapping[str, float], w: float, slip: float, power: float, assumed: list[str]) -> Machine:
    """Return the machine that draws the rated current at the rated power factor and slip; `w` is electrical, rad/s.

    With the phase voltage U, the current I at its angle, and E = U - (R_s + j w L_sigma) I = j w psi_R::

        I = (s/R_R - j/(w L_M)) E
    """
    apparent = math.sqrt(3.0) * rated["voltage"] * rated["current"]
    if "cos_phi" in rated:
        cosine = rated["cos_phi"]
    elif "efficiency" in rated:
        cosine = power / (apparent * rated["efficiency"])
        assumed.append(f"cos_phi = {cosine:.4g}: by power, voltage, current and efficiency")
    else:
        raise ValueError(f"missing cos_phi (or efficiency, or the circuit {', '.join(CIRCUIT)}): as cos_phi=0.82")
    plausible("cos_phi", cosine, "", 0.2, 0.99, "it is a number between 0 and 1")
    plausible("efficiency", power / (apparent * cosine), "by power, voltage, current and cos_phi", 0.2, 0.99,
              "power is in W, voltage between terminals, current rms")  # fmt: skip
    R_s = rated.get("R_s")
    if R_s is None:
        R_s = WINDING * (apparent * cosine - power / (1.0 - slip)) / (3.0 * rated["current"] ** 2)
        if R_s <= 0.0:
            raise ValueError(
                f"the slip of {slip:.3g} takes more than all losses that power and cos_phi leave: check speed"
            )
        assumed.append(f"R_s = {R_s:.4g} ohm: the winding takes {WINDING:.0%} of the losses outside of the rotor")
    U = rated["voltage"] / math.sqrt(3.0)
    L = LEAKAGE * U / (rated["current"] * w)
    assumed.append(f"L_sigma = {L:.4g} H: {LEAKAGE:g} of rated voltage over rated current")
    current = rated["current"] * complex(cosine, -math.sqrt(1.0 - cosine * cosine))
    E = U - complex(R_s, w * L) * current
    admittance = current / E
    if R_s * rated["current"] >= 0.5 * U or min(admittance.real, -admittance.imag) <= 0.0:
        raise ValueError(
            f"R_s = {R_s:.4g} ohm, L_sigma = {L:.4g} H and cos_phi = {cosine:.4g} leave no voltage or no magnetising "
            "current: check cos_phi, current (rms, of one terminal) and voltage (rms, between terminals)"
        )
    assumed.append("R_R and L_M: so that the rated current flows at the rated power factor and slip")
    return Machine(R_s, slip / admittance.real, L, -1.0 / (w * admittance.imag), math.sqrt(2.0) * abs(E) / w)


def _of_circuit(rated: Mapping[str, float], w: float, slip: float) -> Machine:
    """Return the machine of a T equivalent circuit, and its flux at the rated voltage, frequency and slip."""
    R_R, L, L_M = inverse_gamma(rated["R_r"], rated["L_ls"], rated["L_lr"], rated["L_m"])
    across = 1.0 / (slip / R_R - 1j / (w * L_M))
    current = rated["voltage"] / math.sqrt(3.0) / (complex(rated["R_s"], w * L) + across)
    plausible("circuit", abs(current) / rated["current"], "times the rated current at the rated point", 0.5, 2.0,
              "resistances are in ohm, inductances in H (x = w L)")  # fmt: skip
    return Machine(rated["R_s"], R_R, L, L_M, math.sqrt(2.0) * abs(current * across) / w)


def scenario(name: str, rated: Mapping[str, float]) -> tuple[str, tuple[str, ...]]:
    """Write a scenario for an induction machine.

    Returns
    -------
    str
        YAML, which extends `im_foc`.
    tuple of str
        What was assumed.
    """
    drive = induction(rated)
    plant, flux = drive.plant, drive.law["flux"]
    # i_d is at most 0.9 i_max: then the flux needs this time, and the loop some time constants more
    reached = flux / (0.9 * drive.law["i_max"] * plant["L_M"])
    plausible(
        "i_max", reached, "of what it can magnetise is needed for the rated flux", 0.0, 0.95, "give a larger i_max"
    )
    begin = -math.log(1.0 - reached) * plant["L_M"] / plant["R_R"] + 8.0 / FLUX_LOOP
    text = f"""{head(rated, ASKED, drive.assumed, "A drive")}
extends: im_foc
title: Field-oriented control of {name}
system: {name}
source: data sheet
{written(drive, ("induction_plant", "im_foc_controller"), begin, "  flux_end: $im_foc_controller.flux +- 2 %")}
"""
    return text, drive.assumed
