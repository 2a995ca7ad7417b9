"""The double-circuit line and the three converters: published constants, per-unit values, nodal equations."""

from __future__ import annotations

import cmath
import math
from functools import cached_property

import numpy as np
from softrig_core import Complex, Params, param

from ..lines.section import Section

BUSES = ("A", "1", "2", "3", "4", "B")
HALVES = (("A", "1"), ("A", "3"), ("2", "B"), ("4", "B"))
"""Ends of the four half lines; circuit 1 is A-1=2-B, circuit 2 is A-3=4-B, the series converters sit at the =."""


class NetworkParams(Params):
    """Data of Abasi et al. (2020), Table 1; positive sequence only.

    Per unit: `power_base` and `voltage_base` (line to line, rms); 1 pu of voltage and current are peak phase values, so
    that P + jQ = u conj(i) of space vectors.
    """

    frequency: float = param(60.0, "nominal frequency", "Hz", ge=10.0, le=500.0)
    power_base: float = param(100e6, "base of the powers", "VA", ge=1e3, le=1e11)
    voltage_base: float = param(230e3, "base of the voltages, line to line", "V", ge=100.0, le=2e6)
    r1: float = param(0.02546, "line resistance r1 a km", "ohm", ge=0.0, le=10.0)
    l1: float = param(0.9337e-3, "line inductance l1 a km", "H", gt=0.0, le=0.1)
    c1: float = param(12.74e-9, "line capacitance c1 a km", "F", gt=0.0, le=1e-5)
    half_length: float = param(200.0, "length of each half of the line", "km", gt=0.0, le=2000.0)
    source_r: float = param(0.8716, "resistance of either source", "ohm", ge=0.0, le=1e3)
    source_l: float = param(25.76e-3, "inductance of either source", "H", gt=0.0, le=10.0)
    source1_voltage: float = param(1.0, "source 1, behind bus B", "pu", gt=0.0, le=2.0)
    source1_angle: float = param(math.radians(-20.8), "angle of source 1", "rad", ge=-math.pi, le=math.pi)
    source2_voltage: float = param(1.0, "source 2, behind bus A", "pu", gt=0.0, le=2.0)
    source2_angle: float = param(math.radians(9.2), "angle of source 2", "rad", ge=-math.pi, le=math.pi)
    r_sh: float = param(0.05 / 30.0, "resistance of the shunt transformer", "pu", ge=0.0, le=1.0)
    x_sh: float = param(0.05, "leakage reactance of the shunt transformer", "pu", gt=0.0, le=1.0)
    r_se: float = param(0.00625 / 30.0, "resistance of each series transformer", "pu", ge=0.0, le=1.0)
    x_se: float = param(0.00625, "leakage reactance of each series transformer", "pu", gt=0.0, le=1.0)
    series_limit: float = param(0.25, "series voltage at sigma = 180 deg and nominal DC voltage", "pu", gt=0.0, le=1.0)
    shunt_sigma: float = param(math.radians(172.5), "conduction angle sigma of the shunt", "rad", gt=0.1, le=math.pi)
    dc_voltage: float = param(16070.0, "nominal DC voltage", "V", gt=0.0, le=1e6)
    dc_time: float = param(0.01, "stored energy of the DC link over the power base, T", "s", ge=1e-4, le=1.0)

    def _check(self) -> None:
        if self.source1_angle == self.source2_angle and self.source1_voltage == self.source2_voltage:
            raise ValueError("both sources are equal, so the line carries no power and no flow can be set")

    @property
    def omega(self) -> float:
        """Nominal angular frequency, rad/s."""
        return 2.0 * math.pi * self.frequency

    @property
    def impedance_base(self) -> float:
        """Base impedance, ohm."""
        return self.voltage_base**2 / self.power_base

    @property
    def half(self) -> Section:
        """Half of one circuit in per unit: r in pu/km, l in pu s/km, c in s/(pu km)."""
        z = self.impedance_base
        return Section(self.r1 / z, self.l1 / z, self.c1 * z, self.half_length)

    @property
    def source_impedance(self) -> tuple[float, float]:
        """R (pu) and L (pu s) of either source."""
        return self.source_r / self.impedance_base, self.source_l / self.impedance_base

    @property
    def sources(self) -> tuple[complex, complex]:
        """Phasors of source 2 (behind bus A) and source 1 (behind bus B), pu."""
        return (
            cmath.rect(self.source2_voltage, self.source2_angle),
            cmath.rect(self.source1_voltage, self.source1_angle),
        )

    @property
    def z_sh(self) -> complex:
        """Impedance of the shunt transformer, pu."""
        return complex(self.r_sh, self.x_sh)

    @property
    def z_se(self) -> complex:
        """Impedance of each series transformer, pu."""
        return complex(self.r_se, self.x_se)


def admittance(half: Complex, source: complex, series: complex, shunt: complex = 0.0) -> Complex:
    """Nodal admittance matrix of the buses A, 1, 2, 3, 4, B.

    Parameters
    ----------
    half : ndarray, shape (2, 2)
        Two-port of a half line, pu.
    source, series, shunt : complex
        Admittances of a source (to ground), of a series transformer (1-2, 3-4) and of the shunt transformer (at 1), pu.

    Returns
    -------
    ndarray, shape (6, 6)
    """
    index = {bus: k for k, bus in enumerate(BUSES)}
    Y = np.zeros((6, 6), dtype=complex)
    for k, m in HALVES:
        Y[np.ix_((index[k], index[m]), (index[k], index[m]))] += half
    for k, m in (("1", "2"), ("3", "4")):
        Y[np.ix_((index[k], index[m]), (index[k], index[m]))] += series * np.array([[1.0, -1.0], [-1.0, 1.0]])
    Y[index["A"], index["A"]] += source
    Y[index["B"], index["B"]] += source
    Y[index["1"], index["1"]] += shunt
    return Y


class Network:
    """Fundamental-frequency network of the power flow, the lines as exact two-ports."""

    def __init__(self, params: NetworkParams) -> None:
        self.params = params

    @cached_property
    def admittance(self) -> Complex:
        """Nodal admittance, pu, with sources and series transformers, without the shunt transformer; shape (6, 6)."""
        p = self.params
        r, l = p.source_impedance  # noqa: E741
        return admittance(p.half.exact_two_port(p.omega), 1.0 / complex(r, p.omega * l), 1.0 / p.z_se)

    @cached_property
    def injection(self) -> Complex:
        """Norton currents of the sources at the buses, pu; shape (6,)."""
        p = self.params
        r, l = p.source_impedance  # noqa: E741
        result = np.zeros(6, dtype=complex)
        result[0], result[5] = (e / complex(r, p.omega * l) for e in p.sources)
        return result
