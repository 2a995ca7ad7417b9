"""The switched model: six ideal switches, natural sampling of a triangular carrier, edges where they are."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from softrig_core import jit

from .averaged import add_signals
from .circuit import Circuit, Period, grid, grid_of, limited, phases, wanted
from .quality import PENDING, PLAIN, WINDOWS, sample, turn_over

if TYPE_CHECKING:
    from softrig_core import Array

    Three = tuple[float, float, float]
    Legs = tuple[Circuit, Period, float, float, float]


@jit
def slopes(i_a: float, i_b: float, i_c: float, v: float, g: Three, p: Legs) -> tuple[float, float, float, float]:
    """Equations by phase with the switches s_x (0 or 1) held, under the grid voltages g::

    L i_x' = -R i_x + v_gx - (s_x - mean s) v
    C v'   = sum s_x i_x - v/R_L
    """
    circuit, period, s_a, s_b, s_c = p
    mean = (s_a + s_b + s_c) / 3.0
    return (
        (-circuit.R * i_a + g[0] - (s_a - mean) * v) / circuit.L,
        (-circuit.R * i_b + g[1] - (s_b - mean) * v) / circuit.L,
        (-circuit.R * i_c + g[2] - (s_c - mean) * v) / circuit.L,
        (s_a * i_a + s_b * i_b + s_c * i_c - v / period.load) / circuit.C,
    )


@jit
def modulation(t: float, v: float, circuit: Circuit, period: Period, injection: bool) -> Three:
    """Return m_x = 2 v_rx/v for the measured v: the paper's correction factor, from its (13)."""
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
    legs = x[:3].copy()
    # The command has jumped at the begin of the period, so a leg may have to switch without crossing the carrier.
    compare(t, x[3], legs, circuit, period, frequency, half, injection)
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
                settle(sums, t, x, p)
                turn_over(sums, complete)
            if t >= corner:
                half += 1.0
                compare(t, x[3], legs, circuit, period, frequency, half, injection)
        if trace.shape[0] > 0:
            trace[j, 0], trace[j, 1], trace[j, 2], trace[j, 4] = x[0], x[1], x[2], x[3]
            trace[j, 3] = grid(end, circuit, period)[0]
    settle(sums, t, x, p)
    return x[3]


@jit
def settle(sums: Array, t: float, x: Array, p: tuple[Circuit, Period]) -> None:
    """Add the remaining contribution of the newest instant."""
    if sums[PLAIN, PENDING] > 0.0:
        add_signals(sums, t, sums[PLAIN, PENDING], x, p)
    sums[PLAIN, PENDING] = 0.0


@jit
def compare(
    t: float, v: float, legs: Array, circuit: Circuit, period: Period, frequency: float, half: float, injection: bool
) -> None:
    """Set the legs by comparison with the carrier; if both are equal within rounding, by the next instant."""
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
    angle = circuit.omega * t
    sin_cos = math.sin(angle), math.cos(angle)
    g = grid_of(angle, sin_cos[0], sin_cos[1], period)
    slope = slopes(x[0], x[1], x[2], x[3], g, p)
    bend = (legs[0] * slope[0] + legs[1] * slope[1] + legs[2] * slope[2] - slope[3] / period.load) / circuit.C
    v, rate = x[3], slope[3]
    sign = 1.0 if half % 2.0 == 0.0 else -1.0  # sign of m - carrier in front of the edge
    waiting = 1.0 if sign > 0.0 else 0.0  # state of a leg whose edge is still ahead
    steep = 4.0 * frequency
    tau, leg = stop, -1
    # An earlier edge may show up at most once a leg.
    for _ in range(4):
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
        piece(t, tau, x, slope, p, sin_cos, g, sums)
    return tau, leg


@jit
def piece(
    t: float,
    stop: float,
    x: Array,
    first: tuple[float, float, float, float],
    p: Legs,
    sin_cos: tuple[float, float],
    g: Three,
    sums: Array,
) -> None:
    """Integrate one step between two edges, and add to the sums by Simpson's rule (middle from values and slopes).

    The step is that of Runge-Kutta, as `rk4_loop` takes it; `first`, `sin_cos` and `g` are slopes, sine and cosine of
    omega t, and grid voltages at t.
    """
    circuit, period = p[0], p[1]
    h = stop - t
    a, b, c, v = x[0], x[1], x[2], x[3]
    ends, middles, half = h / 6.0, h / 3.0, 0.5 * h
    angle = circuit.omega * (t + half)
    s_1, c_1 = math.sin(angle), math.cos(angle)
    between = grid_of(angle, s_1, c_1, period)
    k = first
    a_1, b_1, j_1, v_1 = a + ends * k[0], b + ends * k[1], c + ends * k[2], v + ends * k[3]
    for _ in range(2):
        k = slopes(a + half * k[0], b + half * k[1], c + half * k[2], v + half * k[3], between, p)
        a_1, b_1, j_1, v_1 = a_1 + middles * k[0], b_1 + middles * k[1], j_1 + middles * k[2], v_1 + middles * k[3]
    late = grid(t + h, circuit, period)
    k = slopes(a + h * k[0], b + h * k[1], c + h * k[2], v + h * k[3], late, p)
    a_1, b_1, j_1, v_1 = a_1 + ends * k[0], b_1 + ends * k[1], j_1 + ends * k[2], v_1 + ends * k[3]
    if t + h != stop:
        late = grid(stop, circuit, period)
    last = slopes(a_1, b_1, j_1, v_1, late, p)
    w, e = h / 6.0, 0.125 * h
    middle = (
        0.5 * (a + a_1) + e * (first[0] - last[0]),
        0.5 * (b + b_1) + e * (first[1] - last[1]),
        0.5 * (c + j_1) + e * (first[2] - last[2]),
        0.5 * (v + v_1) + e * (first[3] - last[3]),
    )
    sample(sums, sin_cos[0], sin_cos[1], sums[PLAIN, PENDING] + w, (a, b, c, v), g)
    sample(sums, s_1, c_1, 4.0 * w, middle, between)
    # The end of this piece is the begin of the next one, which adds its weight to this.
    sums[PLAIN, PENDING] = w
    x[0], x[1], x[2], x[3] = a_1, b_1, j_1, v_1
