"""Buck-boost converter between the string and a resistive load: averaged and switched model, steady state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, Params, jit, param
from softrig_core.kit.newest import once_for_objects

from .string import Characteristic

Line = tuple[float, float, float]  # part of a characteristic: its number, current at no voltage (A), slope (S)


class ConverterParams(Params):
    """Values of the paper; load and series resistance chosen to put the pattern 1 maximum at a duty of 0.55."""

    L: float = param(1e-3, "inductance", "H", gt=0.0)
    C_i: float = param(470e-6, "input capacitance", "F", gt=0.0)
    C_o: float = param(220e-6, "output capacitance", "F", gt=0.0)
    f_sw: float = param(50e3, "switching frequency", "Hz", gt=0.0)
    R_L: float = param(35.0, "load resistance", "ohm", gt=0.0, live=True)
    r: float = param(0.25, "all losses, as a resistance in series with the inductor", "ohm", ge=0.0)


class Circuit(NamedTuple):
    """Voltage of the input capacitor, inductor current, magnitude of the output voltage (V, A, V)."""

    v: float
    i_L: float  # noqa: N815
    v_o: float


def seen_resistance(p: ConverterParams, d: Array) -> Array:
    r"""Return the steady resistance in ohm that the source sees under the duty d, continuous conduction.

    .. math:: R_{in} = (R_L (1 - d)^2 + r) / d^2
    """
    return (p.R_L * (1.0 - d) ** 2 + p.r) / d**2


@once_for_objects  # each run of a study begins with it
def steady_state(p: ConverterParams, source: Characteristic, d: float) -> Circuit:
    """Return the steady state of the averaged model under the duty d."""
    (v,), (i,) = source.under_load(seen_resistance(p, np.array([d])))
    i_L = float(i) / d
    return Circuit(float(v), i_L, (1.0 - d) * i_L * p.R_L)


class BuckBoostMatching:
    """The converter's ideal equation, which is all that a tracker may use of it: R = R_L (1 - d)^2 / d^2."""

    def load(self, command: float, resistance: float) -> float:
        """Return R_L in ohm from the duty and the resistance seen."""
        return resistance * (command / (1.0 - command)) ** 2

    def command(self, resistance: float, load: float) -> float:
        """Return the duty."""
        return 1.0 / (1.0 + math.sqrt(resistance / load))


class Converter:
    r"""Averaged converter; a duty of 1 or 0 gives the two circuits of the switched one.

    .. math::
        C_i \dot v &= i_{pv}(v) - d\, i_L \\
        L \dot i_L &= d\, v - (1 - d) v_o - r\, i_L, \quad i_L \ge 0 \\
        C_o \dot v_o &= (1 - d) i_L - v_o / R_L

    The diode keeps i_L from turning negative, the bypass diodes keep v from falling below -n V_f. Both limits hold in
    the stages of a step too: put into effect only at its end they would leave an error of first order in the step.
    """

    def __init__(self, p: ConverterParams) -> None:
        self.p = p

    def step(self, x: Sequence[float], source: Characteristic, d: float, h: float, n: int) -> Circuit:
        """Advance by n steps of the classical Runge-Kutta method of h seconds each under the duty d."""
        p = self.p
        per_C, d_C = 1.0 / p.C_i, d / p.C_i
        d_L, e_L, r_L = d / p.L, (1.0 - d) / p.L, p.r / p.L
        e_o, g_o = (1.0 - d) / p.C_o, 1.0 / (p.R_L * p.C_o)
        v, i_L, v_o = x
        return Circuit(*_advance(v, i_L, v_o, h, n, (*source.segments, per_C, d_C, d_L, e_L, r_L, e_o, g_o)))


@jit
def _advance(v: float, i: float, o: float, h: float, n: int, p: Any) -> tuple[float, float, float]:
    """Advance; `low`, 0.0: the limits of the diodes. All in numbers, which native code keeps in registers."""
    low, half, third, sixth = p[2], 0.5 * h, h / 3.0, h / 6.0
    line = (-1.0, 0.0, 0.0)
    for _ in range(n):
        dv, di, do, line = _slopes(v, i, o, line, p)
        v_1, i_1, o_1 = v + sixth * dv, i + sixth * di, o + sixth * do
        for k in range(3):
            ahead = h if k == 2 else half
            at_v, at_i = max(v + ahead * dv, low), max(i + ahead * di, 0.0)
            dv, di, do, line = _slopes(at_v, at_i, o + ahead * do, line, p)
            weight = sixth if k == 2 else third
            v_1, i_1, o_1 = v_1 + weight * dv, i_1 + weight * di, o_1 + weight * do
        v, i, o = max(v_1, low), max(i_1, 0.0), o_1
    return v, i, o


@jit
def _slopes(v: float, i: float, o: float, line: Line, p: Any) -> tuple[float, float, float, Line]:
    """Return the derivatives; find a line of the characteristic only if the voltage has left the previous one."""
    a, b, low, scale, per_C, d_C, d_L, e_L, r_L, e_o, g_o = p
    k, at_0, slope = line
    position = (v - low) * scale
    # Between two stages the voltage mostly stays on its segment, so the line is looked up only where it leaves it.
    if not k <= position < k + 1.0:
        number = min(int(position), a.size - 1)
        k, at_0, slope = float(number), a[number], b[number]
    dv = (at_0 + slope * v) * per_C - d_C * i
    return dv, d_L * v - e_L * o - r_L * i, e_o * i - g_o * o, (k, at_0, slope)
