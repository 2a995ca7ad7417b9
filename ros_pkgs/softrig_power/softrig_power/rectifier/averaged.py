"""Averaged models: the converter makes the wanted voltage, within its limit, without switching."""

from __future__ import annotations

import math

from softrig_core.model.jit import jit

from .circuit import Circuit, Period, grid, limited, phases, wanted


@jit
def derivative_dq(
    t: float, i_d: float, i_q: float, v: float, circuit: Circuit, period: Period
) -> tuple[float, float, float]:
    """Equations in the frame of the grid voltage::

        L i_d' = -R i_d + omega L i_q + v_gd - v_rd
        L i_q' = -R i_q - omega L i_d + v_gq - v_rq
        C v'   = 1.5 (v_rd i_d + v_rq i_q)/v - v/R_L

    The DC current is that of the power balance: the paper's (4), (8), (12) lack the angle between current and voltage.
    """
    v_rd, v_rq = wanted(t, circuit, period)
    v_rd, v_rq = limited(v_rd, v_rq, v, period.reach)
    sixth = 6.0 * circuit.omega * t
    v_gd = period.amplitude + period.fifth * math.cos(sixth)
    v_gq = -period.fifth * math.sin(sixth)
    wl = circuit.omega * circuit.L
    d = (-circuit.R * i_d + wl * i_q + v_gd - v_rd) / circuit.L
    q = (-circuit.R * i_q - wl * i_d + v_gq - v_rq) / circuit.L
    return d, q, (1.5 * (v_rd * i_d + v_rq * i_q) / v - v / period.load) / circuit.C


@jit
def step_dq(
    t: float, h: float, i_d: float, i_q: float, v: float, circuit: Circuit, period: Period
) -> tuple[float, float, float]:
    """One Runge-Kutta step of order 4."""
    a1, b1, c1 = derivative_dq(t, i_d, i_q, v, circuit, period)
    k = 0.5 * h
    a2, b2, c2 = derivative_dq(t + k, i_d + k * a1, i_q + k * b1, v + k * c1, circuit, period)
    a3, b3, c3 = derivative_dq(t + k, i_d + k * a2, i_q + k * b2, v + k * c2, circuit, period)
    a4, b4, c4 = derivative_dq(t + h, i_d + h * a3, i_q + h * b3, v + h * c3, circuit, period)
    w = h / 6.0
    return (
        i_d + w * (a1 + 2.0 * (a2 + a3) + a4),
        i_q + w * (b1 + 2.0 * (b2 + b3) + b4),
        v + w * (c1 + 2.0 * (c2 + c3) + c4),
    )


@jit
def derivative_abc(
    t: float, i_a: float, i_b: float, i_c: float, v: float, circuit: Circuit, period: Period
) -> tuple[float, float, float, float]:
    """Equations by phase (paper eqs (15) to (17)); v_rx = m_x v/2 less the common mode::

    L i_x' = -R i_x + v_gx - v_rx
    C v'   = sum s_x i_x - v/R_L,  s_x = (1 + m_x)/2
    """
    v_rd, v_rq = wanted(t, circuit, period)
    v_a, v_b, v_c = phases(v_rd, v_rq, circuit.omega * t)
    size = math.sqrt((v_a * v_a + v_b * v_b + v_c * v_c) * 2.0 / 3.0)
    largest = period.reach * 0.5 * v
    scale = largest / size if size > largest else 1.0
    m_a, m_b, m_c = 2.0 * scale * v_a / v, 2.0 * scale * v_b / v, 2.0 * scale * v_c / v
    mean = (m_a + m_b + m_c) / 3.0
    g_a, g_b, g_c = grid(t, circuit, period)
    a = (-circuit.R * i_a + g_a - (m_a - mean) * 0.5 * v) / circuit.L
    b = (-circuit.R * i_b + g_b - (m_b - mean) * 0.5 * v) / circuit.L
    c = (-circuit.R * i_c + g_c - (m_c - mean) * 0.5 * v) / circuit.L
    link = 0.5 * ((1.0 + m_a) * i_a + (1.0 + m_b) * i_b + (1.0 + m_c) * i_c)
    return a, b, c, (link - v / period.load) / circuit.C


@jit
def step_abc(
    t: float, h: float, i_a: float, i_b: float, i_c: float, v: float, circuit: Circuit, period: Period
) -> tuple[float, float, float, float]:
    """One Runge-Kutta step of order 4."""
    a1, b1, c1, d1 = derivative_abc(t, i_a, i_b, i_c, v, circuit, period)
    k = 0.5 * h
    a2, b2, c2, d2 = derivative_abc(t + k, i_a + k * a1, i_b + k * b1, i_c + k * c1, v + k * d1, circuit, period)
    a3, b3, c3, d3 = derivative_abc(t + k, i_a + k * a2, i_b + k * b2, i_c + k * c2, v + k * d2, circuit, period)
    a4, b4, c4, d4 = derivative_abc(t + h, i_a + h * a3, i_b + h * b3, i_c + h * c3, v + h * d3, circuit, period)
    w = h / 6.0
    return (
        i_a + w * (a1 + 2.0 * (a2 + a3) + a4),
        i_b + w * (b1 + 2.0 * (b2 + b3) + b4),
        i_c + w * (c1 + 2.0 * (c2 + c3) + c4),
        v + w * (d1 + 2.0 * (d2 + d3) + d4),
    )
