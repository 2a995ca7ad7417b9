"""Time steps of lines, sources, transformers and DC link, compiled.

Space vectors in the stationary frame, per unit. Each step solves the blocks {A}, {B}, {1, 2} and {3, 4} of the nodal
equations; the half lines decouple them. A converter voltage enters a step by its exact mean over the step, as the
trapezoidal rule of its R-L branch requires:

    L (i_n - i_(n-1))/h + R (i_n + i_(n-1))/2 = mean(v) - (u_n + u_(n-1))/2
    2 T v_dc dv_dc/dt = -Re(v_sh i_sh* + v12 i12* + v34 i34*), so v_dc^2 falls by h/T times the mean power
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Complex, jit

from ..lines.bergeron import Branch, Lines, branch, histories, lines, store
from .network import NetworkParams
from .pulses import fundamental, integral

A, BUS1, BUS2, BUS3, BUS4, B = range(6)
SOURCE_A, SOURCE_B, I12, I34, I_SH = range(5)  # branch currents
SH, SE12, SE34 = range(3)  # converters
AVERAGE, PULSE = 0, 1


class Circuit(NamedTuple):
    """Constants of a step; made by `circuit`."""

    step: float
    omega: float  # angular frequency of the sources
    source_a: complex  # phasors of the sources at t = 0
    source_b: complex
    source: Branch
    series: Branch
    shunt: Branch
    shunt_scale: float  # v_sh = shunt_scale v_dc S48
    series_scale: float  # v_se = series_scale v_dc S48
    dc_time: float


class State(NamedTuple):
    """Everything that has a past; arrays, changed in place by `advance`."""

    ring: Complex  # (4, 2, length) of the half lines
    u: Complex  # (6,) bus voltages
    i: Complex  # (5,) branch currents
    v_dc: NDArray[np.float64]  # (1,)


class Turning(NamedTuple):
    """Shunt and both series converters at the begin of a period; arrays of shape (3,).

    A series converter with sigma = 0 is bypassed (0 V).
    """

    sigma: NDArray[np.float64]  # conduction angle, rad
    angle: NDArray[np.float64]  # angle of the voltage, rad
    omega: NDArray[np.float64]  # speed of the angle, rad/s


class Rows(NamedTuple):
    """Trajectory of the circuit, one row a step; row 0 is the start."""

    bus: Complex  # (n + 1, 6), voltages at the end of the step
    current: Complex  # (n + 1, 5), of the branches, at the end
    converter: Complex  # (n + 1, 3), mean voltage over the step


def circuit(params: NetworkParams, step: float) -> tuple[Circuit, Lines]:
    """Prepare the steps.

    Parameters
    ----------
    step : float
        s.

    Raises
    ------
    ValueError
        A half line is passed in less than four steps.
    """
    p = params
    source_a, source_b = p.sources
    result = Circuit(
        step,
        p.omega,
        source_a,
        source_b,
        branch(*p.source_impedance, step),
        branch(p.r_se, p.x_se / p.omega, step),
        branch(p.r_sh, p.x_sh / p.omega, step),
        1.0 / fundamental(p.shunt_sigma),
        p.series_limit / fundamental(math.pi),
        p.dc_time,
    )
    return result, lines([p.half] * 4, step)


@jit
def _unit(angle: float) -> complex:
    return complex(math.cos(angle), math.sin(angle))


@jit
def mean_voltage(theta: float, turn: float, sigma: float, pulse: int) -> complex:
    """Mean of the converter voltage for V_dc = 1 while its angle goes from theta to theta + turn.

    Parameters
    ----------
    theta, turn : float
        rad; turn is not zero.
    sigma : float
        Conduction angle, rad.
    pulse : {0, 1}
        `AVERAGE`: the fundamental; `PULSE`: the 48-step waveform.
    """
    if pulse == PULSE:
        return (integral(theta + turn, sigma) - integral(theta, sigma)) * (1.0 / turn)
    middle = theta + 0.5 * turn
    return 2.0 / math.pi * math.sin(0.5 * sigma) * math.sin(0.5 * turn) / (0.5 * turn) * _unit(middle)


@jit
def advance(
    circuit: Circuit, lines: Lines, state: State, first: int, turning: Turning, pulse: int, tripped: bool, rows: Rows
) -> Any:
    """Run the steps of one control period.

    Parameters
    ----------
    circuit, lines, state
        From `circuit` and `steady.start`.
    first : int
        Number of steps taken before; step n ends at n h.
    pulse : {0, 1}
        Waveform.
    tripped : bool
        Shunt converter disconnected, DC link frozen.
    rows : Rows
        Output rows, one per step; their number is the number of steps.

    Returns
    -------
    ndarray, shape (3,)
        Mean power that each converter delivers over the period.
    """
    c, ring, u, i = circuit, state.ring, state.u, state.i
    sigma, angle, omega = turning
    bus, current, converter = rows
    steps = bus.shape[0] - 1
    # The lines are solved step by step: the converters need the voltages of each.
    history = np.empty((4, 2, 1), np.complex128)
    ends, leaving = np.empty_like(history), np.empty_like(history)
    power = np.zeros(3)
    v = np.zeros_like(converter[0])
    y = lines.conductance[0]
    g_s, g_se = c.source.conductance, c.series.conductance
    g_sh = 0.0 if tripped else c.shunt.conductance
    y1, y2, y3 = y + g_se + g_sh, y + g_se, y + g_se
    # Reciprocals are used, because plain and native code divide complex numbers in different ways.
    inv_ab, inv12, inv34 = 1.0 / (2.0 * y + g_s), 1.0 / (y1 * y2 - g_se * g_se), 1.0 / (y3 * y3 - g_se * g_se)
    bus[0, :] = u
    current[0, :] = i
    v_dc = state.v_dc[0]
    e = _unit(c.omega * c.step * first)
    e_a, e_b = c.source_a * e, c.source_b * e
    for n in range(steps):
        k = first + n + 1
        for m in range(3):
            turn = omega[m] * c.step
            scale = (c.shunt_scale if m == SH else c.series_scale) * v_dc
            if sigma[m] > 0.0 and not tripped:
                v[m] = scale * mean_voltage(angle[m] + n * turn, turn, sigma[m], pulse)
            else:
                v[m] = 0.0
        histories(lines, ring, k, history)
        e = _unit(c.omega * c.step * k)
        # companion currents of the branches, without the contribution of the new bus voltages
        j_a = g_s * (c.source_a * e + e_a - u[A] + c.source.keep * i[SOURCE_A])
        j_b = g_s * (c.source_b * e + e_b - u[B] + c.source.keep * i[SOURCE_B])
        e_a, e_b = c.source_a * e, c.source_b * e
        j12 = g_se * (2.0 * v[SE12] + u[BUS1] - u[BUS2] + c.series.keep * i[I12])
        j34 = g_se * (2.0 * v[SE34] + u[BUS3] - u[BUS4] + c.series.keep * i[I34])
        j_sh = g_sh * (2.0 * v[SH] - u[BUS1] + c.shunt.keep * i[I_SH])
        u[A] = inv_ab * (j_a - history[0, 0, 0] - history[1, 0, 0])
        u[B] = inv_ab * (j_b - history[2, 1, 0] - history[3, 1, 0])
        b1, b2 = j_sh - j12 - history[0, 1, 0], j12 - history[2, 0, 0]
        b3, b4 = -j34 - history[1, 1, 0], j34 - history[3, 0, 0]
        u[BUS1], u[BUS2] = inv12 * (y2 * b1 + g_se * b2), inv12 * (g_se * b1 + y1 * b2)
        u[BUS3], u[BUS4] = inv34 * (y3 * b3 + g_se * b4), inv34 * (g_se * b3 + y3 * b4)
        before12, before34, before_sh = i[I12], i[I34], i[I_SH]
        i[SOURCE_A], i[SOURCE_B] = j_a - g_s * u[A], j_b - g_s * u[B]
        i[I12] = j12 + g_se * (u[BUS1] - u[BUS2])
        i[I34] = j34 + g_se * (u[BUS3] - u[BUS4])
        i[I_SH] = j_sh - g_sh * u[BUS1]
        ends[0, 0, 0], ends[0, 1, 0] = u[A], u[BUS1]
        ends[1, 0, 0], ends[1, 1, 0] = u[A], u[BUS3]
        ends[2, 0, 0], ends[2, 1, 0] = u[BUS2], u[B]
        ends[3, 0, 0], ends[3, 1, 0] = u[BUS4], u[B]
        store(lines, ring, k, ends, history, leaving)
        p_sh = 0.5 * (v[SH] * (before_sh + i[I_SH]).conjugate()).real
        p12 = 0.5 * (v[SE12] * (before12 + i[I12]).conjugate()).real
        p34 = 0.5 * (v[SE34] * (before34 + i[I34]).conjugate()).real
        power[SH] += p_sh
        power[SE12] += p12
        power[SE34] += p34
        if not tripped:
            v_dc = math.sqrt(max(0.0, v_dc * v_dc - c.step / c.dc_time * (p_sh + p12 + p34)))
        bus[n + 1, :] = u
        current[n + 1, :] = i
        converter[n + 1, :] = v
    state.v_dc[0] = v_dc
    return power / steps


@jit
def moved(
    circuit: Circuit, lines: Lines, state: State, rows: Rows, first: int, turning: Turning, pulse: int, tripped: bool
) -> Any:
    """Run the steps of one control period from a state that stays unchanged; see `advance`.

    Parameters
    ----------
    rows : Rows
        Rows of the previous period; the new ones have the same number of steps.

    Returns
    -------
    State, Rows, ndarray
        The state after the period, its rows, and the mean power of each converter.
    """
    after = State(state.ring.copy(), state.u.copy(), state.i.copy(), state.v_dc.copy())
    new = Rows(np.zeros_like(rows.bus), np.zeros_like(rows.current), np.zeros_like(rows.converter))
    power = advance(circuit, lines, after, first, turning, pulse, tripped, new)
    return after, new, power
