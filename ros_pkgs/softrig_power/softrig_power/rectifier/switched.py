"""The switched model: six ideal switches, natural sampling of a triangular carrier, edges where they are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from softrig_core import jit, rk4_loop

from .circuit import Circuit, Period, grid, limited, phases, wanted
from .quality import PLAIN, WINDOWS, sample, turn_over

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Array = NDArray[np.float64]
    Three = tuple[float, float, float]
    Legs = tuple[Circuit, Period, float, float, float]


@jit
def ode(t: float, x: Array, p: Legs, dx: Array) -> None:
    """Equations by phase with the switches s_x (0 or 1) held, x = (i_a, i_b, i_c, v)::

    L i_x' = -R i_x + v_gx - (s_x - mean s) v
    C v'   = sum s_x i_x - v/R_L
    """
    circuit, period, s_a, s_b, s_c = p
    mean = (s_a + s_b + s_c) / 3.0
    i_a, i_b, i_c, v = x[0], x[1], x[2], x[3]
    g_a, g_b, g_c = grid(t, circuit, period)
    dx[0] = (-circuit.R * i_a + g_a - (s_a - mean) * v) / circuit.L
    dx[1] = (-circuit.R * i_b + g_b - (s_b - mean) * v) / circuit.L
    dx[2] = (-circuit.R * i_c + g_c - (s_c - mean) * v) / circuit.L
    dx[3] = (s_a * i_a + s_b * i_b + s_c * i_c - v / period.load) / circuit.C


step = rk4_loop(ode)


@jit
def modulation(t: float, v: float, circuit: Circuit, period: Period, injection: bool) -> Three:
    """Return m_x = 2 v_rx/v for the measured v: the paper's correction factor, taken from its (13)."""
    v_rd, v_rq = wanted(t, circuit, period)
    v_rd, v_rq = limited(v_rd, v_rq, v, period.reach)
    v_a, v_b, v_c = phases(v_rd, v_rq, circuit.omega * t)
    shift = 0.5 * (max(v_a, v_b, v_c) + min(v_a, v_b, v_c)) if injection else 0.0
    k = 2.0 / v
    return k * (v_a - shift), k * (v_b - shift), k * (v_c - shift)


@jit
def carrier(t: float, frequency: float, half: float) -> float:
    """Triangle from -1 at t = 0, in its half period number `half`: rising in the even ones."""
    z = 4.0 * frequency * t - 2.0 * half - 1.0
    return z if half % 2.0 == 0.0 else -z


@jit
def advance(
    x: Array,
    steps: int,
    window: float,
    p: tuple[Circuit, Period],
    frequency: float,
    injection: bool,
    sums: Array,
    complete: Array,
    trace: Array,
) -> float:
    """Move a state over one period.

    Parameters
    ----------
    x : (4,) ndarray
        (i_a, i_b, i_c, v), changed in place.
    steps : int
        The longest piece is length/steps.
    window : float
        Length of a power-quality window, s.
    p : (Circuit, Period)
    frequency : float
        Of the carrier, Hz.
    injection : bool
        Min-max zero sequence.
    sums, complete : ndarray
        See `quality`.
    trace : (steps, 5) ndarray
        Gets i_a, i_b, i_c, v_ga, v at the end of each step, when it has rows.
    """
    circuit, period = p
    h = period.length / steps
    t = period.start
    half = float(math.floor(2.0 * frequency * t + 1e-9))
    legs = x[:3].copy()  # `compare` sets them: the command has jumped
    compare(t, x[3], legs, circuit, period, frequency, half, injection)  # the command has jumped
    for j in range(steps):
        end = period.start + (j + 1) * h
        while t < end:
            corner = (half + 1.0) / (2.0 * frequency)
            border = (sums[PLAIN, WINDOWS] + 1.0) * window
            stop = min(end, corner, border)
            t, leg = crossing(t, stop, x, legs, circuit, period, frequency, half, injection, sums)
            if leg >= 0:
                legs[leg] = 1.0 - legs[leg]
            if t >= border:
                turn_over(sums, complete)
            if t >= corner:
                half += 1.0
                compare(t, x[3], legs, circuit, period, frequency, half, injection)
        if trace.shape[0] > 0:
            trace[j, 0], trace[j, 1], trace[j, 2], trace[j, 4] = x[0], x[1], x[2], x[3]
            trace[j, 3] = grid(end, circuit, period)[0]
    return x[3]


@jit
def compare(
    t: float, v: float, legs: Array, circuit: Circuit, period: Period, frequency: float, half: float, injection: bool
) -> None:
    """Set the legs by comparing with the carrier; where both are equal to rounding, by what comes next."""
    m_a, m_b, m_c = modulation(t, v, circuit, period, injection)
    z = carrier(t, frequency, half)
    legs[0] = 1.0 if m_a > z else 0.0
    legs[1] = 1.0 if m_b > z else 0.0
    legs[2] = 1.0 if m_c > z else 0.0


@jit
def crossing(
    t: float,
    stop: float,
    x: Array,
    legs: Array,
    circuit: Circuit,
    period: Period,
    frequency: float,
    half: float,
    injection: bool,
    sums: Array,
) -> tuple[float, int]:
    """Move to the first edge after t, at most to `stop`; return the time reached and the leg that is to switch, or -1.

    In a rising half period of the carrier a leg can only go off, in a falling one only on. Until then the voltage is
    v + v' s + v'' s^2/2, whose error over one piece is below a nanovolt; the edge follows by Newton's method, the slope
    of the carrier being nearly all of the slope.
    """
    p = (circuit, period, legs[0], legs[1], legs[2])
    slope = x.copy()
    ode(t, x, p, slope)
    bend = (legs[0] * slope[0] + legs[1] * slope[1] + legs[2] * slope[2] - slope[3] / period.load) / circuit.C
    v, rate = x[3], slope[3]
    sign = 1.0 if half % 2.0 == 0.0 else -1.0  # of m - carrier before the edge
    waiting = 1.0 if sign > 0.0 else 0.0  # state of a leg that has its edge before it
    steep = 4.0 * frequency
    tau, leg = stop, -1
    for _ in range(4):  # an earlier edge may show up at most once a leg
        s = tau - t
        now = modulation(tau, v + s * (rate + 0.5 * s * bend), circuit, period, injection)
        z = carrier(tau, frequency, half)
        first, most = -1, 1e-12
        for k in range(3):
            past = sign * (z - now[k])
            if legs[k] == waiting and k != leg and past > most:
                first, most = k, past
        if first < 0:
            break
        leg = first
        for _ in range(8):
            s = tau - t
            now = modulation(tau, v + s * (rate + 0.5 * s * bend), circuit, period, injection)
            change = sign * (carrier(tau, frequency, half) - now[leg]) / steep
            tau -= change
            if abs(change) < 1e-16:
                break
        if tau < t:
            tau = t
    if tau > t:
        piece(t, tau, x, slope, p, sums)
    return tau, leg


@jit
def piece(t: float, stop: float, x: Array, slope: Array, p: Legs, sums: Array) -> None:
    """Integrate one step between two edges, and add to the sums by Simpson's rule (middle from values and slopes)."""
    circuit, period = p[0], p[1]
    h = stop - t
    begin, first = x.copy(), slope.copy()
    step(t, x, h, 1, p)
    ode(stop, x, p, slope)
    w = h / 6.0
    middle = x.copy()
    for k in range(4):
        middle[k] = 0.5 * (begin[k] + x[k]) + 0.125 * h * (first[k] - slope[k])
    sample(sums, t, w, (begin[0], begin[1], begin[2], begin[3]), grid(t, circuit, period), circuit.omega)
    centre = t + 0.5 * h
    sample(
        sums,
        centre,
        4.0 * w,
        (middle[0], middle[1], middle[2], middle[3]),
        grid(centre, circuit, period),
        circuit.omega,
    )
    sample(sums, stop, w, (x[0], x[1], x[2], x[3]), grid(stop, circuit, period), circuit.omega)
