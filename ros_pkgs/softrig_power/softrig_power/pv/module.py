"""Photovoltaic module: the single-diode equations."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from softrig_core import Array, Params, jit, param


@jit
def _exp(x: Array, out: Array) -> Array:
    for k in range(x.size):
        out[k] = math.exp(x[k])
    return out


@jit
def _log1p(x: Array, out: Array) -> Array:
    for k in range(x.size):
        out[k] = math.log1p(x[k])
    return out


BOLTZMANN = 1.380649e-23  # J/K
CHARGE = 1.602176634e-19  # C
KELVIN = 273.15
STC = (1000.0, 25.0)  # W/m^2, deg C


class ModuleParams(Params):
    """MSX-60: data sheet values, and a, R_s, R_p fitted to the published powers."""

    V_oc: float = param(21.1, "open-circuit voltage at STC", "V", gt=0.0)
    I_sc: float = param(3.8, "short-circuit current at STC", "A", gt=0.0)
    N_s: int = param(36, "cells in series", ge=1, le=10000)
    K_I: float = param(2.47e-3, "temperature coefficient of the short-circuit current", "A/K")
    K_V: float = param(-0.080, "temperature coefficient of the open-circuit voltage", "V/K")
    a: float = param(1.30, "ideality factor of the diode", gt=0.5, lt=2.5)
    R_s: float = param(0.235, "series resistance", "ohm", ge=0.0)
    R_p: float = param(643.0, "parallel resistance", "ohm", gt=0.0)
    V_f: float = param(0.8, "forward voltage of the bypass diode", "V", ge=0.0)


class Cell(NamedTuple):
    r"""Single-diode equation of a module under given conditions.

    .. math::
        I = I_{ph} - I_0 \left( e^{U / a V_t} - 1 \right) - U / R_p, \quad U = V + R_s I       \quad (1)

    Parameters
    ----------
    I_ph, I_0 : float
        Photocurrent and saturation current in A.
    aV_t : float
        Ideality factor times thermal voltage of all cells, V.
    R_s, R_p : float
        Resistances in ohm.
    """

    I_ph: float
    I_0: float
    aV_t: float  # noqa: N815
    R_s: float
    R_p: float

    def current(self, V: float) -> float:
        """Return the current in A at the voltage V."""
        low, high = -1e3, self.I_ph + self.I_0 + max(-V, 0.0) / self.R_p
        while high - low > 1e-14 * max(1.0, -low):
            I = 0.5 * (low + high)  # noqa: E741
            # The two are neighbouring floats: a large current has no finer numbers than these.
            if not low < I < high:
                break
            U = V + self.R_s * I
            if self.I_ph - self.I_0 * math.expm1(U / self.aV_t) - U / self.R_p > I:
                low = I
            else:
                high = I
        return high

    def start(self, I: Array) -> Array:  # noqa: E741
        """Return an upper bound of the junction voltage U, from which Newton's method converges monotonically."""
        c = self.I_ph - I
        # numpy's own logarithm differs from CPU to CPU, hence the loop over the C library's.
        diode = self.aV_t * _log1p(np.maximum(c, 0.0) / self.I_0, np.empty_like(I))
        return np.minimum(np.where(c > 0.0, diode, math.inf), (c + self.I_0) * self.R_p)

    def junction(self, I: Array, U: Array | None = None) -> tuple[Array, Array]:  # noqa: E741
        """Solve for the junction voltage.

        Parameters
        ----------
        I : ndarray
            Current in A.
        U : ndarray, optional
            First guess.

        Returns
        -------
        U, dI/dU : ndarray
            V and A/V.
        """
        top = self.start(I)
        U = top if U is None else np.minimum(U, top)
        for _ in range(100):
            diode = self.I_0 * _exp(U / self.aV_t, np.empty_like(I))
            slope = -diode / self.aV_t - 1.0 / self.R_p
            step = (I - (self.I_ph - diode + self.I_0 - U / self.R_p)) / slope
            U = np.minimum(U + step, top)
            if np.max(np.abs(step), initial=0.0) < 1e-11:
                break
        return U, slope


def cell(p: ModuleParams, irradiance: float, temperature: float) -> Cell:
    r"""Return the equation of a module in irradiance G (W/m^2) and cell temperature (deg C).

    .. math::
        I_{ph} &= (I_{sc} + K_I \Delta T)\, G / 1000                                              \quad (2) \\
        I_0 &= \frac{I_{sc} + K_I \Delta T}{\exp((V_{oc} + K_V \Delta T) / (a V_t)) - 1}            \quad (3) \\
        V_t &= N_s k T / q, \quad \Delta T = T - 298.15\,\mathrm{K}                                \quad (4)

    The paper prints minus in (2); the data sheet's K_I is positive and (3) has plus, so plus is meant.
    """
    T = temperature + KELVIN
    dT = temperature - STC[1]
    aV_t = p.a * p.N_s * BOLTZMANN * T / CHARGE
    I_sc = p.I_sc + p.K_I * dT
    I_0 = I_sc / math.expm1((p.V_oc + p.K_V * dT) / aV_t)
    return Cell(I_sc * irradiance / STC[0], I_0, aV_t, p.R_s, p.R_p)
