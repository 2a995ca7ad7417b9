"""The motor: constants, inductance profile, and one Runge-Kutta step, written once for numba."""

from __future__ import annotations

import math
from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator
from softrig_core import Params, jit, param

Array = NDArray[np.float64]
Triple = tuple[float, float, float]

# State vector: flux linkages of the phases a to d (Wb), then position (m) and speed (m/s).
N_PHASES = 4
X = 4
V = 5
STATES = 6

# Within so much of a pole pitch around the aligned position the number of pitches that lie before it is sure without a
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

    @model_validator(mode="after")
    def _shape(self) -> Self:
        if self.w >= self.h:
            raise ValueError(f"w = {self.w:g} m: expected less than h = {self.h:g} m, the edges overlap")
        if self.c - self.h - self.w < 0.0 or self.c + self.h + self.w > self.tau / 2:
            raise ValueError(
                f"the ramp from c - h - w = {self.c - self.h - self.w:g} m to c + h + w = {self.c + self.h + self.w:g} "
                f"m leaves 0 to tau/2 = {self.tau / 2:g} m"
            )
        return self

    def numbers(self) -> Array:
        """Give the constants as `profile` takes them: the parameters, then what it makes of them at each call."""
        given = [self.tau, self.shift, self.G, self.L_u, self.c, self.h, self.w]
        return np.array([*given, 2.0 * self.w, self.h - self.w, 2.0 * self.w / math.pi, self.G * 0.5])


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
    """Give inductance L (H) and its slope g = dL/dx (H/m) at the distance `xi` from the aligned position.

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
    """Give current i = lambda/L (A) of a phase and its force g i^2/2 (N, eq. 6 of the paper)."""
    if not flux > 0.0:
        return 0.0, 0.0
    L, g = profile(xi, geometry)
    i = flux / L
    return i, 0.5 * g * i * i


@jit
def electromagnetic(state: Array, geometry: Array) -> float:
    """Force of all phases, N."""
    total = 0.0
    for k in range(N_PHASES):
        total += phase(state[k], distance(state[X], k, geometry), geometry)[1]
    return total


@jit
def advance(
    state: Array, u: Array, geometry: Array, constants: Triple, friction: float, locked: bool, h: float, steps: int
) -> None:
    """Move the state by `steps` Runge-Kutta steps of order 4 and size `h`, voltages held.

    ::

        lambda_k' = u_k - R i_k,  i_k = lambda_k/L_k(x);  0 where lambda_k = 0 and that is negative (diodes block)
        x'        = v
        M v'      = sum of g_k(x) i_k^2/2 - (C + k_p) v - drag

    A flux linkage ends at zero in the step in which it gets there (asymmetric half bridge). Coulomb friction keeps its
    sign within a step; a translator whose speed changes sign stops, and sticks while the force is below the friction.

    Parameters
    ----------
    state : array (6,)
        Changed in place.
    u : array (4,)
        Voltages, V.
    constants : tuple
        R in ohm, M in kg, C + k_p in N s/m.
    friction : float
        N.
    locked : bool
        Translator clamped.
    """
    R, mass, damping = constants
    near = NEAR * geometry[0]
    turn, rate, total = np.empty((3, N_PHASES))  # turn: whole pole pitches, nearly always those at the beginning
    for k in range(N_PHASES):
        pitches = math.floor((state[X] - k * geometry[1]) / geometry[0] + 0.5)
        turn[k] = geometry[0] * pitches if abs(pitches) < FAR else math.inf
    for _ in range(steps):
        x, v = state[X], state[V]
        drag = 0.0
        stuck = locked
        if friction > 0.0:
            if v != 0.0:
                drag = math.copysign(friction, v)
            else:
                pull = electromagnetic(state, geometry)
                drag = math.copysign(friction, pull)
                stuck = stuck or abs(pull) <= friction
        x_rate = v_rate = x_total = v_total = 0.0
        for k in range(N_PHASES):
            rate[k] = total[k] = 0.0
        for stage in range(4):
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            at, x_rate = x + ahead * x_rate, v + ahead * v_rate
            pull = 0.0
            for k in range(N_PHASES):
                flux = state[k] + ahead * rate[k]
                if flux > 0.0:
                    xi = at - k * geometry[1] - turn[k]
                    if not abs(xi) < near:
                        xi = distance(at, k, geometry)
                    i, force = phase(flux, xi, geometry)
                    pull += force
                    rate[k] = u[k] - R * i
                else:
                    rate[k] = u[k] if u[k] > 0.0 else 0.0
                total[k] += weight * rate[k]
            v_rate = (pull - damping * x_rate - drag) / mass
            if stuck:
                x_rate = v_rate = 0.0
            x_total += weight * x_rate
            v_total += weight * v_rate
        for k in range(N_PHASES):
            state[k] += h / 6.0 * total[k]
            if state[k] < 0.0:
                state[k] = 0.0
        state[X] = x + h / 6.0 * x_total
        state[V] = v + h / 6.0 * v_total
        if friction > 0.0 and v * state[V] < 0.0:
            state[V] = 0.0
