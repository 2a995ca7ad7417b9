"""The motor: constants, inductance profile, and one Runge-Kutta step, written once for numba."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from softrig_core import Array, Params, jit, param

Triple = tuple[float, float, float]

Vector = tuple[Any, ...]  # tuple of floats; a slice of a named tuple has the type of all its fields
State = tuple[float, float, float, float, float, float]

N_PHASES = 4
STATES = 6  # flux linkages of the phases a to d (Wb), then position (m) and speed (m/s)

# Within this part of a pole pitch around the aligned position the number of earlier pitches is known without a
# division, which a step would wait for: `distance` rounds a quotient that is at least a thousandth away from its edges.
NEAR = 0.499
FAR = 1e9  # pitches; there a rounded quotient may be that wrong


class Geometry(Params):
    """Inductance profile: the shape is chosen, the paper only plots its finite-element data."""

    tau: float = param(0.052, "pole pitch of the stator (pole 21 mm, slot 31 mm)", "m", gt=0.0, le=1.0)
    shift: float = param(0.013, "distance between neighbouring phases", "m", gt=0.0, le=1.0)
    G: float = param(
        0.8, "largest slope of the inductance, 2 x 12.57 D/2 H/m for a depth D of 64 mm", "H/m", gt=0.0, le=100.0
    )
    L_u: float = param(6e-3, "unaligned inductance L_u", "H", gt=0.0, le=1.0)
    c: float = param(10.5e-3, "centre of the overlap ramp, from the aligned position", "m", gt=0.0, le=1.0)
    h: float = param(6.5e-3, "half length of the overlap ramp", "m", gt=0.0, le=1.0)
    w: float = param(3e-3, "half width of the rounded edges of the slope (fringing, 1.5 air gaps)", "m", gt=0.0, le=1.0)

    def _check(self) -> None:
        if self.w >= self.h:
            raise ValueError(f"w = {self.w:g} m: expected less than h = {self.h:g} m, the edges overlap")
        if self.c - self.h - self.w < 0.0 or self.c + self.h + self.w > self.tau / 2:
            raise ValueError(
                f"the ramp from c - h - w = {self.c - self.h - self.w:g} m to c + h + w = {self.c + self.h + self.w:g} "
                f"m leaves 0 to tau/2 = {self.tau / 2:g} m"
            )

    def numbers(self) -> Array:
        """Return the constants in the order of `profile`: the parameters, then values derived from them."""
        parameters = [self.tau, self.shift, self.G, self.L_u, self.c, self.h, self.w]
        return np.array([*parameters, 2.0 * self.w, self.h - self.w, 2.0 * self.w / math.pi, self.G * 0.5])


class Mechanics(Params):
    """The moving part."""

    M: float = param(5.0, "moving mass M", "kg", gt=0.0, le=1000.0)
    C: float = param(10.0, "viscous friction C (the table prints N/m/s)", "N s/m", ge=0.0, le=1e4)
    k_p: float = param(14.0, "speed-proportional load: 12 N at 0.5 m/s", "N s/m", ge=0.0, le=1e4)


@jit
def distance(x: float, phase: int, geometry: Array) -> float:
    """Position xi (m) from the nearest aligned position of a phase, in [-tau/2, tau/2)."""
    tau = geometry[0]
    z = x - phase * geometry[1]
    return z - tau * math.floor(z / tau + 0.5)


@jit
def profile(xi: float, geometry: Array) -> tuple[float, float]:
    """Return inductance L (H) and its slope g = dL/dx (H/m) at the distance `xi` from the aligned position.

    ::

        d = ||xi| - c|,  z = d - h + w
        m = 1 for z <= 0;  (1 + cos(pi z/(2 w)))/2 for 0 < z < 2 w;  0 beyond
        I = d for z <= 0;  h - w + (z + (2 w/pi) sin(pi z/(2 w)))/2 for 0 < z < 2 w;  h beyond
        L = L_u + G (h + sgn(c - |xi|) I)
        g = +G m for xi <= 0, -G m for xi > 0
    """
    G, h, round_to = geometry[2], geometry[5], geometry[7]
    offset = geometry[4] - abs(xi)
    d = abs(offset)
    z = d - h + geometry[6]
    if z <= 0.0:
        area, g = d, G
    elif z < round_to:
        angle = math.pi * z / round_to
        area = geometry[8] + 0.5 * (z + geometry[9] * math.sin(angle))
        g = geometry[10] * (1.0 + math.cos(angle))
    else:
        area, g = h, 0.0
    return geometry[3] + G * (h + math.copysign(area, offset)), g if xi <= 0.0 else -g


@jit
def phase(flux: float, xi: float, geometry: Array) -> tuple[float, float]:
    """Return current i = lambda/L (A) of a phase and its force g i^2/2 (N, eq. 6 of the paper)."""
    if not flux > 0.0:
        return 0.0, 0.0
    L, g = profile(xi, geometry)
    i = flux / L
    return i, 0.5 * g * i * i


@jit
def forces(a: float, b: float, c: float, d: float, x: float, geometry: Array) -> float:
    """Force of all phases, N."""
    total = 0.0 + phase(a, distance(x, 0, geometry), geometry)[1]
    total += phase(b, distance(x, 1, geometry), geometry)[1]
    total += phase(c, distance(x, 2, geometry), geometry)[1]
    return total + phase(d, distance(x, 3, geometry), geometry)[1]


@jit
def turn(x: float, phase: int, geometry: Array) -> float:
    """Whole pole pitches (m) before the nearest aligned position of a phase."""
    pitches = math.floor((x - phase * geometry[1]) / geometry[0] + 0.5)
    return geometry[0] * pitches if abs(pitches) < FAR else math.inf


@jit
def charged(
    flux: float, u: float, R: float, x: float, phase_: int, turned: float, geometry: Array
) -> tuple[float, float]:
    """Return the rate of a flux linkage (V) and the force (N) of its phase; `turned`: its pole pitches, mostly."""
    if not flux > 0.0:
        return (u if u > 0.0 else 0.0), 0.0
    xi = x - phase_ * geometry[1] - turned
    if not abs(xi) < NEAR * geometry[0]:
        xi = distance(x, phase_, geometry)
    i, force = phase(flux, xi, geometry)
    return u - R * i, force


@jit
def advance(
    state: Vector, u: Vector, geometry: Array, constants: Triple, friction: float, locked: bool, h: float, steps: int
) -> State:
    """Move the state by `steps` Runge-Kutta steps of order 4 and size `h`, voltages held.

    ::

        lambda_k' = u_k - R i_k,  i_k = lambda_k/L_k(x);  0 where lambda_k = 0 and that is negative (diodes block)
        x'        = v
        M v'      = sum of g_k(x) i_k^2/2 - (C + k_p) v - drag

    A flux linkage ends at zero in the step in which it gets there (asymmetric half bridge). Coulomb friction keeps its
    sign within a step; a translator whose speed changes sign stops, and sticks while the force is below the friction.

    The state is a tuple of numbers, which native code keeps in registers; an array would be allocated at each call.

    Parameters
    ----------
    state : tuple (6,)
        Flux linkages (Wb), position (m), speed (m/s).
    u : tuple (4,)
        Voltages, V.
    constants : tuple
        R in ohm, M in kg, C + k_p in N s/m.
    friction : float
        N.
    locked : bool
        Translator clamped.

    Returns
    -------
    tuple (6,)
        The state after the steps.
    """
    R, mass, damping = constants
    a, b, c, d, x, v = state
    u_a, u_b, u_c, u_d = u
    turn_a, turn_b = turn(x, 0, geometry), turn(x, 1, geometry)
    turn_c, turn_d = turn(x, 2, geometry), turn(x, 3, geometry)
    on_a, on_b = a > 0.0 or u_a > 0.0, b > 0.0 or u_b > 0.0  # other phases carry no current
    on_c, on_d = c > 0.0 or u_c > 0.0, d > 0.0 or u_d > 0.0
    for _ in range(steps):
        drag = 0.0
        stuck = locked
        if friction > 0.0:
            if v != 0.0:
                drag = math.copysign(friction, v)
            else:
                pull = forces(a, b, c, d, x, geometry)
                drag = math.copysign(friction, pull)
                stuck = stuck or abs(pull) <= friction
        a_rate = b_rate = c_rate = d_rate = x_rate = v_rate = 0.0
        a_total = b_total = c_total = d_total = x_total = v_total = 0.0
        for stage in range(4):
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            x_ahead, x_rate = x + ahead * x_rate, v + ahead * v_rate
            pull = 0.0
            if on_a:
                a_rate, force = charged(a + ahead * a_rate, u_a, R, x_ahead, 0, turn_a, geometry)
                a_total, pull = a_total + weight * a_rate, pull + force
            if on_b:
                b_rate, force = charged(b + ahead * b_rate, u_b, R, x_ahead, 1, turn_b, geometry)
                b_total, pull = b_total + weight * b_rate, pull + force
            if on_c:
                c_rate, force = charged(c + ahead * c_rate, u_c, R, x_ahead, 2, turn_c, geometry)
                c_total, pull = c_total + weight * c_rate, pull + force
            if on_d:
                d_rate, force = charged(d + ahead * d_rate, u_d, R, x_ahead, 3, turn_d, geometry)
                d_total, pull = d_total + weight * d_rate, pull + force
            v_rate = (pull - damping * x_rate - drag) / mass
            if stuck:
                x_rate = v_rate = 0.0
            x_total, v_total = x_total + weight * x_rate, v_total + weight * v_rate
        a, b = max(a + h / 6.0 * a_total, 0.0), max(b + h / 6.0 * b_total, 0.0)
        c, d = max(c + h / 6.0 * c_total, 0.0), max(d + h / 6.0 * d_total, 0.0)
        before, x, v = v, x + h / 6.0 * x_total, v + h / 6.0 * v_total
        if friction > 0.0 and before * v < 0.0:
            v = 0.0
    return a, b, c, d, x, v
