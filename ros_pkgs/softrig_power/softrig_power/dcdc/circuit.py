"""The switched circuit of a buck or a boost converter, one period at a time."""

from __future__ import annotations

from typing import Any

from softrig_core import jit

# Halvings of a step after which the current at its end is zero to the last bits.
CUTS = 60


@jit
def inductance(i: float, m: Any) -> float:
    """Return L(i) = L_sat + (L - L_sat)/(1 + (i/i_sat)^2), H."""
    if m[3] <= 0.0:
        return m[1]
    ratio = i / m[3]
    return m[2] + (m[1] - m[2]) / (1.0 + ratio * ratio)


@jit
def output(i: float, v: float, fed: float, load: float, m: Any) -> float:
    """Return the output voltage, V, of the capacitor and its series resistance; `fed`: share of i that reaches it."""
    return (v + m[7] * (fed * i - load)) / (1.0 + m[7] * m[8])


@jit
def rates(i: float, v: float, source: float, feeds: bool, on: bool, load: float, m: Any) -> tuple[float, float]:
    """Return the rates of the inductor's current (A/s) and of the capacitor's voltage (V/s).

    ::

        buck   on:  L i' = U - (R_L + R_on) i - v_o     off: L i' = -V_d - R_L i - v_o
        boost  on:  L i' = U - (R_L + R_on) i           off: L i' = U - V_d - R_L i - v_o
        C v' = i_C,  v_o = v + R_C i_C,  i_C = i (boost, on: 0) - v_o/R - I
    """
    fed = 1.0 if feeds else 0.0
    v_o = output(i, v, fed, load, m)
    di = (source - (m[4] + (m[5] if on else 0.0)) * i - (0.0 if on else m[6]) - fed * v_o) / inductance(i, m)
    return di, (fed * i - m[8] * v_o - load) / m[0]


@jit
def step(
    i: float, v: float, h: float, source: float, feeds: bool, on: bool, load: float, m: Any
) -> tuple[float, float]:
    """Move by one Runge-Kutta step of order 4."""
    a1, b1 = rates(i, v, source, feeds, on, load, m)
    a2, b2 = rates(i + 0.5 * h * a1, v + 0.5 * h * b1, source, feeds, on, load, m)
    a3, b3 = rates(i + 0.5 * h * a2, v + 0.5 * h * b2, source, feeds, on, load, m)
    a4, b4 = rates(i + h * a3, v + h * b3, source, feeds, on, load, m)
    return i + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4), v + h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)


@jit
def advance(
    i: float, v: float, duty: float, U: float, load: float, boost: bool, synchronous: bool, period: float,
    largest: float, m: Any
) -> tuple[float, float, float]:  # fmt: skip
    """Move by one period: on for duty times the period, then off until the current is zero, then idle.

    Returns
    -------
    tuple of float
        Current (A), voltage of the capacitor (V), mean current over the period (A, trapezoidal).
    """
    charge, t = 0.0, 0.0
    for interval in range(2):
        on = interval == 0
        end = duty * period if on else period
        feeds = not boost or not on
        source = U if (boost or on) else 0.0
        while t < end * (1.0 - 1e-15):
            h = min(largest, end - t)
            blocked = source - m[6] <= output(0.0, v, 0.0, load, m)  # the diode does not conduct
            if not on and not synchronous and i <= 0.0 and blocked:
                _, v = step(0.0, v, h, 0.0, False, True, load, m)  # the capacitor alone feeds the load
                i, t = 0.0, t + h
                continue
            next_i, next_v = step(i, v, h, source, feeds, on, load, m)
            if not on and not synchronous and next_i < 0.0:
                low, high = 0.0, h
                for _ in range(CUTS):
                    middle = 0.5 * (low + high)
                    if step(i, v, middle, source, feeds, on, load, m)[0] > 0.0:
                        low = middle
                    else:
                        high = middle
                h = high
                next_v = step(i, v, h, source, feeds, on, load, m)[1]
                next_i = 0.0
            charge = charge + 0.5 * h * (i + next_i)
            i, v, t = next_i, next_v, t + h
    return i, v, charge / period
