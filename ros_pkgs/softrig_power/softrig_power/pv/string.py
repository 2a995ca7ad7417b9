"""String of modules with bypass diodes: its characteristic as a table, its peaks, its point under a load."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from softrig_core import Array, jit
from softrig_core.kit.dense import total

from .module import STC, Cell, ModuleParams, cell

POINTS = 20001
HEADROOM = 1.0664  # the table ends at this multiple of the open-circuit voltage: 90 V for four modules at 25 deg C


class Peak(NamedTuple):
    """A local maximum of the power, or the minimum between two: V, A, W."""

    v: float
    i: float
    p: float


@dataclass(frozen=True)
class Characteristic:
    """Current over voltage on an even grid, falling; linear between the points.

    Parameters
    ----------
    v, i : ndarray
        V and A.
    """

    v: Array
    i: Array

    @cached_property
    def segments(self) -> tuple[Array, Array, float, float]:
        """The line i = a + b v of each segment: all a in A, all b in A/V; where the first begins, segments per V."""
        b = np.diff(self.i) / np.diff(self.v)
        low, high = float(self.v[0]), float(self.v[-1])
        return self.i[:-1] - b * self.v[:-1], b, low, float((self.v.size - 1) / (high - low))

    @cached_property
    def _width(self) -> float:
        return float(self.v[1] - self.v[0])

    def current(self, v: float) -> float:
        """Return the current in A; beyond the table the end segments are extrapolated."""
        a, b, low, _ = self.segments
        return _current(v, low, self._width, a, b)

    @cached_property
    def _extrema(self) -> tuple[list[Peak], list[Peak]]:
        p = self.v * self.i
        generating = (self.v[1:-1] > 0.0) & (self.i[1:-1] > 0.0)
        rise = np.diff(p)
        tops = np.flatnonzero((rise[:-1] > 0.0) & (rise[1:] <= 0.0) & generating) + 1
        dips = np.flatnonzero((rise[:-1] < 0.0) & (rise[1:] >= 0.0) & generating) + 1
        peaks, valleys = ([Peak(float(self.v[k]), float(self.i[k]), float(p[k])) for k in ks] for ks in (tops, dips))
        return peaks, valleys

    @property
    def peaks(self) -> list[Peak]:
        """Local maxima of the power, by rising voltage."""
        return self._extrema[0]

    @property
    def valleys(self) -> list[Peak]:
        """Minima of the power between the peaks, by rising voltage."""
        return self._extrema[1]

    @cached_property
    def gmpp(self) -> Peak:
        """The global maximum power point; zero in the dark."""
        return max(self.peaks, key=lambda peak: peak.p, default=Peak(0.0, 0.0, 0.0))

    @property
    def open_circuit(self) -> float:
        """Voltage in V at which the current is zero."""
        return float(np.interp(0.0, -self.i, self.v))

    def basin(self, v: float) -> int:
        """Return the index of the peak whose basin the voltage is in: 0 at the lowest voltage."""
        return sum(v > valley.v for valley in self.valleys)

    @property
    def global_basin(self) -> int:
        """Index of the basin of the global maximum."""
        return self.basin(self.gmpp.v)

    def under_load(self, R: Array) -> tuple[Array, Array]:
        """Return (v, i) under load resistances R in ohm."""
        lit = np.flatnonzero((self.v >= 0.0) & (self.i >= 0.0))
        if lit.size < 2:
            return np.zeros_like(R), np.zeros_like(R)
        v, i = self.v[lit], self.i[lit]
        with np.errstate(divide="ignore"):
            k = lit[0] + np.clip(np.searchsorted(v / i, R) - 1, 0, None)  # v/i rises along the table
        k = np.minimum(k, self.v.size - 2)
        slope = (self.i[k + 1] - self.i[k]) / (self.v[k + 1] - self.v[k])
        v = (self.i[k] - slope * self.v[k]) / (1.0 / R - slope)
        return v, v / R


@jit
def _current(v: float, low: float, width: float, a: Array, b: Array) -> float:
    k = min(max(int((v - low) / width), 0), b.size - 1)
    return a[k] + b[k] * v


@lru_cache(maxsize=64)
def characteristic(p: ModuleParams, irradiance: tuple[float, ...], temperature: tuple[float, ...]) -> Characteristic:
    """Tabulate a string in irradiance (W/m^2) and temperature (deg C) of each module.

    All modules carry the current I; the voltage is the sum of max(V_module(I), -V_f), which falls with I. It is solved
    for I at every voltage of the table by Newton's method from a coarse curve.
    """
    cells = [cell(p, g, t) for g, t in zip(irradiance, temperature, strict=True)]
    open_circuit = total(p.V_oc + p.K_V * (t - STC[1]) for t in temperature)
    v = np.linspace(-p.V_f * len(cells), HEADROOM * open_circuit, POINTS)
    # From this current on every bypass diode conducts.
    high = max(c.current(-p.V_f) for c in cells)
    low = -1.0
    while _voltage(cells, p.V_f, np.array([low]))[0] < v[-1]:
        low *= 2.0
    coarse = np.concatenate([np.linspace(low, 0.0, 200, endpoint=False), np.linspace(0.0, high, 2000)])
    i = np.interp(-v, -_voltage(cells, p.V_f, coarse)[0], coarse)
    below, above = np.full_like(i, low), np.full_like(i, high)
    junctions: list[Array | None] = [None] * len(cells)
    for _ in range(100):
        result, slope = _voltage(cells, p.V_f, i, junctions)
        error = result - v
        below, above = np.where(error > 0.0, i, below), np.where(error > 0.0, above, i)
        with np.errstate(divide="ignore", invalid="ignore"):
            newton = i - error / slope
        # Where a bypass diode begins to conduct the slope jumps, so a Newton step may leave the bracket, which is then
        # halved.
        better = np.where((newton >= below) & (newton <= above), newton, 0.5 * (below + above))
        # At the first voltage all bypass diodes conduct: the slope is zero there and no current follows from it.
        better[0] = high
        change, i = np.max(np.abs(better - i)), better
        if change < 1e-10:
            break
    return Characteristic(v, i)


def _voltage(
    cells: Sequence[Cell], V_f: float, i: Array, junctions: list[Array | None] | None = None
) -> tuple[Array, Array]:
    """Return the string's voltage and dV/dI; `junctions` carries the solution from one call to the next."""
    v, slope = np.zeros_like(i), np.zeros_like(i)
    for k, c in enumerate(cells):
        U, dI = c.junction(i, None if junctions is None else junctions[k])
        if junctions is not None:
            junctions[k] = U
        unbypassed = U - c.R_s * i
        conducts = unbypassed < -V_f
        v += np.where(conducts, -V_f, unbypassed)
        slope += np.where(conducts, 0.0, 1.0 / dI - c.R_s)
    return v, slope
