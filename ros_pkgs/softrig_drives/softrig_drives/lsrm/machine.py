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
        """Give the constants in the order in which `inductance` and `slope` take them."""
        return np.array([self.tau, self.shift, self.G, self.L_u, self.c, self.h, self.w])


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
def slope(xi: float, geometry: Array) -> float:
    """Slope g = dL/dx (H/m) at the distance `xi` from the aligned position.

    ::

        d = ||xi| - c|,  z = d - h + w
        m = 1 for z <= 0;  (1 + cos(pi z/(2 w)))/2 for 0 < z < 2 w;  0 beyond
        g = +G m for xi <= 0, -G m for xi > 0
    """
    c, h, w = geometry[4], geometry[5], geometry[6]
    z = abs(abs(xi) - c) - h + w
    if z <= 0.0:
        g = geometry[2]
    elif z < 2.0 * w:
        g = geometry[2] * 0.5 * (1.0 + math.cos(math.pi * z / (2.0 * w)))
    else:
        g = 0.0
    return g if xi <= 0.0 else -g


@jit
def inductance(xi: float, geometry: Array) -> float:
    """Inductance L (H) at the distance `xi` from the aligned position: the integral of `slope`.

    ::

        L = L_u + G (h + sgn(c - |xi|) I(d)),  d = ||xi| - c|,  z = d - h + w
        I = d for z <= 0;  h - w + (z + (2 w/pi) sin(pi z/(2 w)))/2 for 0 < z < 2 w;  h beyond
    """
    c, h, w = geometry[4], geometry[5], geometry[6]
    offset = c - abs(xi)
    d = abs(offset)
    z = d - h + w
    if z <= 0.0:
        area = d
    elif z < 2.0 * w:
        area = h - w + 0.5 * (z + 2.0 * w / math.pi * math.sin(math.pi * z / (2.0 * w)))
    else:
        area = h
    return geometry[3] + geometry[2] * (h + math.copysign(area, offset))


@jit
def current(flux: float, x: float, phase: int, geometry: Array) -> float:
    """Current i = lambda/L(x) (A) of a phase."""
    return flux / inductance(distance(x, phase, geometry), geometry) if flux > 0.0 else 0.0


@jit
def force(i: float, x: float, phase: int, geometry: Array) -> float:
    """Force g i^2/2 (N) of a phase (eq. 6 of the paper)."""
    return 0.5 * slope(distance(x, phase, geometry), geometry) * i * i if i > 0.0 else 0.0


@jit
def derivative(state: Array, u: Array, geometry: Array, constants: Triple, drag: float, rate: Array) -> None:
    """Write the rate of change of the state into `rate`.

    ::

        lambda_k' = u_k - R i_k,  i_k = lambda_k/L_k(x);  0 where lambda_k = 0 and that is negative (diodes block)
        x'        = v
        M v'      = sum of g_k(x) i_k^2/2 - (C + k_p) v - drag

    Parameters
    ----------
    u : array (4,)
        Voltages, V.
    constants : tuple
        R in ohm, M in kg, C + k_p in N s/m.
    drag : float
        Friction force in N with its sign.
    """
    R, mass, damping = constants
    x = state[X]
    total = 0.0
    for k in range(N_PHASES):
        i = current(state[k], x, k, geometry)
        total += force(i, x, k, geometry)
        rise = u[k] - R * i
        rate[k] = rise if state[k] > 0.0 or rise > 0.0 else 0.0
    rate[X] = state[V]
    rate[V] = (total - damping * state[V] - drag) / mass


@jit
def electromagnetic(state: Array, geometry: Array) -> float:
    """Force of all phases, N."""
    total = 0.0
    for k in range(N_PHASES):
        total += force(current(state[k], state[X], k, geometry), state[X], k, geometry)
    return total


@jit
def advance(
    state: Array, u: Array, geometry: Array, constants: Triple, friction: float, locked: bool, h: float, steps: int
) -> None:
    """Move the state by `steps` Runge-Kutta steps of order 4 and size `h`, voltages held.

    A flux linkage ends at zero in the step in which it gets there (asymmetric half bridge). Coulomb friction keeps its
    sign within a step; a translator whose speed changes sign stops, and sticks while the force is below the friction.

    Parameters
    ----------
    state : array (6,)
        Changed in place.
    constants : tuple
        As of `derivative`.
    friction : float
        N.
    locked : bool
        Translator clamped.
    """
    work, point = np.empty((4, STATES)), np.empty(STATES)  # the four rates
    for _ in range(steps):
        v = state[V]
        drag = 0.0
        stuck = locked
        if friction > 0.0:
            if v != 0.0:
                drag = math.copysign(friction, v)
            else:
                pull = electromagnetic(state, geometry)
                drag = math.copysign(friction, pull)
                stuck = stuck or abs(pull) <= friction
        for stage in range(4):
            ahead = 0.0 if stage == 0 else (h if stage == 3 else 0.5 * h)
            for n in range(STATES):
                point[n] = state[n] + ahead * work[stage - 1, n] if stage else state[n]
            derivative(point, u, geometry, constants, drag, work[stage])
            if stuck:
                work[stage, X] = 0.0
                work[stage, V] = 0.0
        for n in range(STATES):
            state[n] += h / 6.0 * (work[0, n] + 2.0 * work[1, n] + 2.0 * work[2, n] + work[3, n])
        for k in range(N_PHASES):
            if state[k] < 0.0:
                state[k] = 0.0
        if friction > 0.0 and v * state[V] < 0.0:
            state[V] = 0.0
