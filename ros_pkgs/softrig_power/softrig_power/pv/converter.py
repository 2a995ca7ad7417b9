"""Buck-boost converter between the string and a resistive load: averaged and switched model, steady state."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Params, jit, param, rk4_loop

from .module import Array
from .string import Characteristic


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
    r"""Give the steady resistance in ohm that the source sees under the duty d, continuous conduction.

    .. math:: R_{in} = (R_L (1 - d)^2 + r) / d^2
    """
    return (p.R_L * (1.0 - d) ** 2 + p.r) / d**2


def steady_state(p: ConverterParams, source: Characteristic, d: float) -> Circuit:
    """Give the steady state of the averaged model under the duty d."""
    (v,), (i,) = source.under_load(seen_resistance(p, np.array([d])))
    i_L = float(i) / d
    return Circuit(float(v), i_L, (1.0 - d) * i_L * p.R_L)


class BuckBoostMatching:
    """The converter's ideal law, all that a tracker may know of it: R = R_L (1 - d)^2 / d^2."""

    def load(self, command: float, seen: float) -> float:
        """Give R_L in ohm from the duty and the resistance seen."""
        return seen * (command / (1.0 - command)) ** 2

    def command(self, seen: float, load: float) -> float:
        """Give the duty."""
        return 1.0 / (1.0 + math.sqrt(seen / load))


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
        found = np.array(x)
        _advance(0.0, found, h, n, (*source.segments, per_C, d_C, d_L, e_L, r_L, e_o, g_o))
        return Circuit(*found.tolist())


@jit
def _slopes(t: float, x: Array, p: Any, dx: Array) -> None:
    a, b, low, scale, per_C, d_C, d_L, e_L, r_L, e_o, g_o = p
    v, i, o = x[0], x[1], x[2]
    k = min(int((v - low) * scale), a.size - 1)
    dx[0] = (a[k] + b[k] * v) * per_C - d_C * i
    dx[1] = d_L * v - e_L * o - r_L * i
    dx[2] = e_o * i - g_o * o


@jit
def _limits(x: Array, p: Any) -> None:
    """Diode and bypass diodes: i_L >= 0, v >= the first voltage of the characteristic."""
    x[0], x[1] = max(x[0], p[2]), max(x[1], 0.0)


_advance = rk4_loop(_slopes, _limits)
