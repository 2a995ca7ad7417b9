"""Averaged models: the converter makes the commanded voltage, within its limit, without switching."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from softrig_core import jit, rk4_loop

from .circuit import Circuit, Period, grid, grid_of, limited, phases, phases_of, wanted
from .quality import PLAIN, WINDOWS, sample, turn_over

if TYPE_CHECKING:
    from softrig_core import Array


@jit
def slopes_dq(
    t: float, i_d: float, i_q: float, v: float, circuit: Circuit, period: Period
) -> tuple[float, float, float]:
    """Equations in the frame of the grid voltage, x = (i_d, i_q, v)::

        L i_d' = -R i_d + omega L i_q + v_gd - v_rd
        L i_q' = -R i_q - omega L i_d + v_gq - v_rq
        C v'   = 1.5 (v_rd i_d + v_rq i_q)/v - v/R_L
        v_gd   = V_g - a5 cos(6 omega t),  v_gq = a5 sin(6 omega t)

    The fifth harmonic is a negative sequence: sin(5 x) = sin(6 x) cos(x) - cos(6 x) sin(x). The DC current is that of
    the power balance: the paper's (4), (8), (12) lack the angle between current and voltage.
    """
    v_rd, v_rq = wanted(t, circuit, period)
    v_rd, v_rq = limited(v_rd, v_rq, v, period.reach)
    v_gd, v_gq = period.amplitude, 0.0
    if period.fifth != 0.0:
        sixth = 6.0 * circuit.omega * t
        v_gd -= period.fifth * math.cos(sixth)
        v_gq = period.fifth * math.sin(sixth)
    wl = circuit.omega * circuit.L
    return (
        (-circuit.R * i_d + wl * i_q + v_gd - v_rd) / circuit.L,
        (-circuit.R * i_q - wl * i_d + v_gq - v_rq) / circuit.L,
        (1.5 * (v_rd * i_d + v_rq * i_q) / v - v / period.load) / circuit.C,
    )


@jit
def ode_abc(t: float, x: Array, p: tuple[Circuit, Period], dx: Array) -> None:
    """Equations by phase (paper eqs (15) to (17)), x = (i_a, i_b, i_c, v); v_rx = m_x v/2 less the common mode::

    L i_x' = -R i_x + v_gx - v_rx
    C v'   = sum s_x i_x - v/R_L,  s_x = (1 + m_x)/2
    """
    circuit, period = p
    i_a, i_b, i_c, v = x[0], x[1], x[2], x[3]
    v_rd, v_rq = wanted(t, circuit, period)
    v_a, v_b, v_c = phases(v_rd, v_rq, circuit.omega * t)
    size = math.sqrt((v_a * v_a + v_b * v_b + v_c * v_c) * 2.0 / 3.0)
    largest = period.reach * 0.5 * v
    scale = largest / size if size > largest else 1.0
    m_a, m_b, m_c = 2.0 * scale * v_a / v, 2.0 * scale * v_b / v, 2.0 * scale * v_c / v
    mean = (m_a + m_b + m_c) / 3.0
    g_a, g_b, g_c = grid(t, circuit, period)
    dx[0] = (-circuit.R * i_a + g_a - (m_a - mean) * 0.5 * v) / circuit.L
    dx[1] = (-circuit.R * i_b + g_b - (m_b - mean) * 0.5 * v) / circuit.L
    dx[2] = (-circuit.R * i_c + g_c - (m_c - mean) * 0.5 * v) / circuit.L
    link = 0.5 * ((1.0 + m_a) * i_a + (1.0 + m_b) * i_b + (1.0 + m_c) * i_c)
    dx[3] = (link - v / period.load) / circuit.C


@jit
def step_dq(t: float, x: Array, h: float, circuit: Circuit, period: Period) -> None:
    """Compute one Runge-Kutta step for `rk4_loop`, on numbers: allocating arrays would take longer than the step."""
    a, b, c = x[0], x[1], x[2]
    ends, middles, half = h / 6.0, h / 3.0, 0.5 * h
    k, m, n = slopes_dq(t, a, b, c, circuit, period)
    x[0], x[1], x[2] = x[0] + ends * k, x[1] + ends * m, x[2] + ends * n
    k, m, n = slopes_dq(t + half, a + half * k, b + half * m, c + half * n, circuit, period)
    x[0], x[1], x[2] = x[0] + middles * k, x[1] + middles * m, x[2] + middles * n
    k, m, n = slopes_dq(t + half, a + half * k, b + half * m, c + half * n, circuit, period)
    x[0], x[1], x[2] = x[0] + middles * k, x[1] + middles * m, x[2] + middles * n
    k, m, n = slopes_dq(t + h, a + h * k, b + h * m, c + h * n, circuit, period)
    x[0], x[1], x[2] = x[0] + ends * k, x[1] + ends * m, x[2] + ends * n


step_abc = rk4_loop(ode_abc)


@jit
def read(t: float, x: Array, circuit: Circuit) -> tuple[float, float, float, float]:
    """Return i_a, i_b, i_c, v of either state."""
    if x.size == 3:
        i_a, i_b, i_c = phases(x[0], x[1], circuit.omega * t)
        return i_a, i_b, i_c, x[2]
    return x[0], x[1], x[2], x[3]


@jit
def add_signals(sums: Array, t: float, weight: float, x: Array, p: tuple[Circuit, Period]) -> None:
    """Add the signals of a state at t to the sums."""
    circuit, period = p
    angle = circuit.omega * t
    s, c = math.sin(angle), math.cos(angle)
    g = grid_of(angle, s, c, period)
    if x.size == 3:
        i_a, i_b, i_c = phases_of(x[0], x[1], s, c)
        sample(sums, s, c, weight, (i_a, i_b, i_c, x[2]), g)
    else:
        sample(sums, s, c, weight, (x[0], x[1], x[2], x[3]), g)


def walk(step: Callable[..., None]) -> Callable[..., float]:
    """Create the native loop over one period from a function that moves a state over a piece of it.

    Parameters
    ----------
    step : callable
        `jit` function (t, stop, x, p): moves the state x in place from t to stop (s).

    Returns
    -------
    callable
        `jit` function (x, steps, window, p, sums, complete, trace), which gives the DC voltage at the end (V):

        - x, (3,) or (4,) ndarray: (i_d, i_q, v) or (i_a, i_b, i_c, v), changed in place
        - steps, int: of equal length
        - window, float: length of a power-quality window, s; windows begin at multiples of it
        - p: (Circuit, Period)
        - sums, complete, ndarray: see `quality`; by the trapezoidal rule, exact for whole cycles of smooth signals
        - trace, (steps, 5) ndarray: gets i_a, i_b, i_c, v_ga, v at the end of each step, when it has rows
    """

    @jit
    def advance(
        x: Array, steps: int, window: float, p: tuple[Circuit, Period], sums: Array, complete: Array, trace: Array
    ) -> float:
        circuit, period = p
        h = period.length / steps
        waiting = 0.0  # weight of the newest instant that is not in the sums yet
        for j in range(steps):
            t, end = period.start + j * h, period.start + (j + 1) * h
            while t < end:
                border = (sums[PLAIN, WINDOWS] + 1.0) * window
                stop = min(end, border)
                half = 0.5 * (stop - t)
                # One call adds the end of a piece and the begin of the next.
                add_signals(sums, t, waiting + half, x, p)
                step(t, stop, x, p)
                waiting = half
                if stop >= border:
                    add_signals(sums, stop, waiting, x, p)
                    turn_over(sums, complete)
                    waiting = 0.0
                t = stop
            if trace.shape[0] > 0:
                i_a, i_b, i_c, v = read(end, x, circuit)
                trace[j, 0], trace[j, 1], trace[j, 2], trace[j, 4] = i_a, i_b, i_c, v
                trace[j, 3] = grid(end, circuit, period)[0]
        if waiting > 0.0:
            add_signals(sums, period.start + steps * h, waiting, x, p)
        return x[x.size - 1]

    return advance


@jit
def switching(t: float, stop: float, x: Array, p: tuple[Circuit, Period]) -> None:
    """Integrate either averaged model over one Runge-Kutta step."""
    if x.size == 3:
        step_dq(t, x, stop - t, p[0], p[1])
    else:
        step_abc(t, x, stop - t, 1, p)


advance = walk(switching)
