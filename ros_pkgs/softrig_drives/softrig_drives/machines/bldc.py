"""The brushless DC machine with trapezoidal back-EMF on an inverter whose legs may be off."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from softrig_control.profile import StepProfile
from softrig_core import BlockParams, Level, Plant, Values, command, jit, param, resolving_step, to_ns

from .mechanics import Mechanics, finer, friction
from .ports import CURRENTS, DC_LINK, JOINT_STATES, LEGS, LOAD_TORQUE

GATES = command("gates", "gates", LEGS, "1")
OFF = -1.0
SIXTH = math.pi / 3.0


class BldcPlantParams(Mechanics, BlockParams):
    """maxon EC 45 flat, 50 W, 24 V (251601), of its data sheet; a phase has half of the terminal values."""

    period: float = param(5e-5, "time between two outputs, period of the pulse width modulation", "s", gt=0.0, le=0.01)
    substeps: int = param(10, "Runge-Kutta steps in one period, at least", ge=1, le=1000)
    U_dc: float = param(24.0, "supply voltage", "V", gt=0.0, le=1e4, live=True)
    v_diode: float = param(0.7, "voltage across a diode that conducts", "V", ge=0.0, le=10.0, live=True)
    R: float = param(0.515, "resistance of a phase", "ohm", gt=0.0, le=1e3)
    L: float = param(2.86e-4, "inductance of a phase less mutual inductance", "H", gt=0.0, le=10.0)
    k_e: float = param(0.01675, "back-EMF of a phase over speed, on its flat top: half the torque constant", "V s/rad",
                       gt=0.0, le=1e3)  # fmt: skip
    pole_pairs: int = param(8, "pole pairs p", ge=1, le=1000)
    J: float = param(1.35e-5, "inertia of the rotor", "kg m^2", gt=0.0, le=1e6)
    trip_current: float = param(50.0, "phase current at which all legs switch off permanently", "A", gt=0.0, live=True)

    def step(self) -> float:
        """Return the largest step of the integration at a low speed, s."""
        swing = math.sqrt(2.0 / (self.L * self.J)) * self.k_e
        currents = (
            max(self.R / self.L, swing),
            f"R = {self.R:g} ohm, L = {self.L:g} H, k_e = {self.k_e:g}, J = {self.J:g}",
        )
        return resolving_step(self.period, self.substeps, *self.mechanical_rates(), currents)

    def _check(self) -> None:
        self.step()
        if self.J_load:
            raise ValueError("J_load: this machine has one mass")


class State(NamedTuple):
    """Phase currents (A), speed (rad/s), angle (rad), whether it has tripped."""

    i_a: float = 0.0
    i_b: float = 0.0
    i_c: float = 0.0
    omega: float = 0.0
    theta: float = 0.0
    fault: bool = False


CUTS = 100  # cuts of a period, usually a few: beyond all physical speeds they would never end


@jit
def shape(angle: float) -> float:
    """Return the trapezoid: 1 from pi/6 to 5 pi/6, -1 half a turn later, straight between them."""
    x = angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi))
    if x < math.pi / 6.0:
        return x * 6.0 / math.pi
    if x < 5.0 * math.pi / 6.0:
        return 1.0
    if x < 7.0 * math.pi / 6.0:
        return (math.pi - x) * 6.0 / math.pi
    if x < 11.0 * math.pi / 6.0:
        return -1.0
    return (x - 2.0 * math.pi) * 6.0 / math.pi


@jit
def leg(gate: float, current: float, U: float, v_diode: float) -> tuple[bool, float]:
    """Return whether a phase conducts, and the voltage (V) of its terminal: by its leg, or by a diode until i = 0."""
    if gate >= 0.0:
        return True, gate * U
    if current > 0.0:
        return True, -v_diode
    if current < 0.0:
        return True, U + v_diode
    return False, 0.0


@jit
def rates(
    i_a: float, i_b: float, i_c: float, w: float, theta: float, on_a: bool, on_b: bool, on_c: bool, u_a: float,
    u_b: float, u_c: float, load: float, m: Any
) -> tuple[float, float, float, float]:  # fmt: skip
    """Return the rates of the currents (A/s) and of the speed (rad/s^2).

    ::

        L i_k' = u_k - v_n - R i_k - k_e w f(p theta - k 2 pi/3)    of the phases that conduct; the others have i = 0
        v_n    = mean over these of u_k - R i_k - e_k, so that the currents add up to zero
        T      = k_e (f_a i_a + f_b i_b + f_c i_c)
    """
    angle = m[3] * theta
    f_a, f_b, f_c = shape(angle), shape(angle - 2.0 * math.pi / 3.0), shape(angle + 2.0 * math.pi / 3.0)
    d_a = u_a - m[0] * i_a - m[2] * w * f_a if on_a else 0.0
    d_b = u_b - m[0] * i_b - m[2] * w * f_b if on_b else 0.0
    d_c = u_c - m[0] * i_c - m[2] * w * f_c if on_c else 0.0
    count = (1.0 if on_a else 0.0) + (1.0 if on_b else 0.0) + (1.0 if on_c else 0.0)
    v_n = (d_a + d_b + d_c) / count if count > 0.0 else 0.0
    torque = m[2] * (f_a * i_a + f_b * i_b + f_c * i_c)
    drag = friction(w, m[5], m[6], m[7], m[8], m[9]) + load + m[10] * w * abs(w)
    return (
        (d_a - v_n) * m[1] if on_a else 0.0,
        (d_b - v_n) * m[1] if on_b else 0.0,
        (d_c - v_n) * m[1] if on_c else 0.0,
        (torque - drag) * m[4],
    )


@jit
def opened(on: bool, u: float, e: float, v_n: float, U: float, v_diode: float) -> tuple[bool, float]:
    """Return whether the EMF of a phase without current opens a diode, and the voltage of the terminal then."""
    if on:
        return True, u
    if v_n + e > U + v_diode:
        return True, U + v_diode
    if v_n + e < -v_diode:
        return True, -v_diode
    return False, 0.0


@jit
def advance(
    i_a: float, i_b: float, i_c: float, w: float, theta: float, gates: Any, U: float, v_diode: float, load: float,
    period: float, step: float, m: Any
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Move by one period; a current of a phase that is off ends at zero, in a step that is cut there."""
    t = 0.0
    cuts = 0
    # rates that grow with the speed: the electrical angle, the torque of a fan
    step = finer(step, abs(w) * max(m[3], 2.0 * m[10] * m[4]))
    while t < period:
        on_a, u_a = leg(gates[0], i_a, U, v_diode)
        on_b, u_b = leg(gates[1], i_b, U, v_diode)
        on_c, u_c = leg(gates[2], i_c, U, v_diode)
        angle = m[3] * theta
        e_a, e_b = m[2] * w * shape(angle), m[2] * w * shape(angle - 2.0 * math.pi / 3.0)
        e_c = m[2] * w * shape(angle + 2.0 * math.pi / 3.0)
        total, count = 0.0, 0.0
        if on_a:
            total, count = total + u_a - m[0] * i_a - e_a, count + 1.0
        if on_b:
            total, count = total + u_b - m[0] * i_b - e_b, count + 1.0
        if on_c:
            total, count = total + u_c - m[0] * i_c - e_c, count + 1.0
        if count > 0.0:
            v_n = total / count
        else:  # all open: the star floats in the middle of its largest and least EMF
            v_n = 0.5 * U - 0.5 * (max(e_a, e_b, e_c) + min(e_a, e_b, e_c))
        on_a, u_a = opened(on_a, u_a, e_a, v_n, U, v_diode)
        on_b, u_b = opened(on_b, u_b, e_b, v_n, U, v_diode)
        on_c, u_c = opened(on_c, u_c, e_c, v_n, U, v_diode)
        h = min(step, period - t)
        for tried in range(2):
            a1, b1, c1, w1 = rates(i_a, i_b, i_c, w, theta, on_a, on_b, on_c, u_a, u_b, u_c, load, m)
            v = w + 0.5 * h * w1
            a2, b2, c2, w2 = rates(
                i_a + 0.5 * h * a1, i_b + 0.5 * h * b1, i_c + 0.5 * h * c1, v, theta + 0.5 * h * w, on_a, on_b, on_c,
                u_a, u_b, u_c, load, m
            )  # fmt: skip
            v3 = w + 0.5 * h * w2
            a3, b3, c3, w3 = rates(
                i_a + 0.5 * h * a2, i_b + 0.5 * h * b2, i_c + 0.5 * h * c2, v3, theta + 0.5 * h * v, on_a, on_b, on_c,
                u_a, u_b, u_c, load, m
            )  # fmt: skip
            v4 = w + h * w3
            a4, b4, c4, w4 = rates(
                i_a + h * a3, i_b + h * b3, i_c + h * c3, v4, theta + h * v3, on_a, on_b, on_c, u_a, u_b, u_c, load, m
            )
            n_a, n_b = i_a + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), i_b + h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
            n_c = i_c + h / 6.0 * (c1 + 2.0 * c2 + 2.0 * c3 + c4)
            if tried == 1:
                break
            share = 1.0  # share of the step until the first current of a phase that is off becomes zero
            if gates[0] < 0.0 and i_a * n_a < 0.0:
                share = min(share, i_a / (i_a - n_a))
            if gates[1] < 0.0 and i_b * n_b < 0.0:
                share = min(share, i_b / (i_b - n_b))
            if gates[2] < 0.0 and i_c * n_c < 0.0:
                share = min(share, i_c / (i_c - n_c))
            if share == 1.0 or cuts == CUTS:
                break
            cuts += 1
            h = share * h
        # a current that has reached zero within the rounding of the cut is zero, and the others share the rest of the
        # sum
        small = 1e-3 * (abs(i_a) + abs(i_b) + abs(i_c)) if h < step and h < period - t else 0.0
        zero_a = gates[0] < 0.0 and i_a != 0.0 and (i_a * n_a <= 0.0 or abs(n_a) < small)
        zero_b = gates[1] < 0.0 and i_b != 0.0 and (i_b * n_b <= 0.0 or abs(n_b) < small)
        zero_c = gates[2] < 0.0 and i_c != 0.0 and (i_c * n_c <= 0.0 or abs(n_c) < small)
        theta, w = theta + h / 6.0 * (w + 2.0 * v + 2.0 * v3 + v4), w + h / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
        t = t + h
        if zero_a:
            n_a = 0.0
        if zero_b:
            n_b = 0.0
        if zero_c:
            n_c = 0.0
        remaining = n_a + n_b + n_c
        left = (0.0 if n_a == 0.0 else 1.0) + (0.0 if n_b == 0.0 else 1.0) + (0.0 if n_c == 0.0 else 1.0)
        if left < 2.0:
            n_a = n_b = n_c = 0.0
        else:
            i_a, i_b, i_c = n_a, n_b, n_c
            n_a = 0.0 if i_a == 0.0 else i_a - remaining / left
            n_b = 0.0 if i_b == 0.0 else i_b - remaining / left
            n_c = 0.0 if i_c == 0.0 else i_c - remaining / left
        i_a, i_b, i_c = n_a, n_b, n_c
        if period - t < 1e-12 * period:
            break
    return i_a, i_b, i_c, w, theta


class BldcPlant(Plant[BldcPlantParams]):
    """Brushless DC machine; see `rates` for the equations.

    A gate is the share of the period for which the upper switch of a leg is on, the lower one for the rest, or -1:
    both off. The current of a leg that is off flows through a diode until it is zero. Then the phase carries none,
    unless its EMF opens a diode. Voltages are means over the period of the modulation.
    """

    DRAWN_BY = "softrig_drives.machines.drawing:MachineDrawing"
    TRIPS: ClassVar[frozenset[str]] = frozenset({"overcurrent"})
    INPUTS = (GATES, LOAD_TORQUE)
    OUTPUTS = (JOINT_STATES, CURRENTS, DC_LINK)
    STATE = State
    AGREED = {"machines/pole_pairs": "pole_pairs"}

    def setup(self) -> None:
        """Arrange the constants."""
        p = self.p
        mechanics = p.mechanics_numbers()
        self._m = np.array([p.R, 1.0 / p.L, p.k_e, float(p.pole_pairs), *mechanics[:6], p.load_square])
        self._step = p.step()
        self._profile = StepProfile(p.load_times, p.load_torques)
        self._period = to_ns(p.period)

    def outputs(self, x: State, t: int) -> Values:
        """Return shaft, phase currents, supply."""
        angle = self.p.pole_pairs * x.theta
        third = 2.0 * math.pi / 3.0
        f_a, f_b, f_c = shape(angle), shape(angle - third), shape(angle + third)
        torque = self.p.k_e * (f_a * x.i_a + f_b * x.i_b + f_c * x.i_c)
        return {
            "joint_states": (x.theta, x.omega, torque),
            "currents": (x.i_a, x.i_b, x.i_c),
            "dc_link": (self.p.U_dc,),
        }

    def advance(self, x: State, t: int, *, gates: tuple[float, ...], load_torque: tuple[float, ...] | None) -> State:
        """Hold the gates for one period; a step of the load acts from the next period on."""
        p = self.p
        a, b, c = gates
        if _wrong(a) or _wrong(b) or _wrong(c):
            self.report(Level.WARN, "clipped", f"gates {gates}, expected 0 to 1, or -1 for off: clipped")
        applied = (OFF, OFF, OFF) if x.fault else (_gate(a), _gate(b), _gate(c))
        load = self._profile.at(t) + (0.0 if load_torque is None else load_torque[0])
        i_a, i_b, i_c, w, theta = advance(
            x.i_a, x.i_b, x.i_c, x.omega, x.theta, applied, p.U_dc, p.v_diode, load, p.period, self._step, self._m
        )
        fault = x.fault
        if not fault and max(abs(i_a), abs(i_b), abs(i_c)) > p.trip_current:
            fault = True
            self.report(
                Level.ERROR, "overcurrent", f"phase currents {i_a:.3g}, {i_b:.3g}, {i_c:.3g} A: all legs off for good"
            )
        return State(i_a, i_b, i_c, w, theta, fault)


def _wrong(g: float) -> bool:
    return g != OFF and not 0.0 <= g <= 1.0


def _gate(g: float) -> float:
    return -1.0 if g < 0.0 else min(g, 1.0)
