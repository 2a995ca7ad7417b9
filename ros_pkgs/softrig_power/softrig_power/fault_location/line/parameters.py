"""The line, its sources and the fault, as parameters with units and bounds."""

from __future__ import annotations

import math
from typing import Literal

from softrig_core import Params, param

from ...lines.bergeron import LEAST_DELAY
from ...lines.section import Section

FaultType = Literal["AG", "BG", "CG", "AB", "BC", "CA", "ABG", "BCG", "CAG", "ABC", "ABCG", "none"]
Profile = Literal["raw1m", "raw100k", "raw20k", "m100k", "m20k", "m10k", "m4k"]

RATES: dict[str, int] = {
    "raw1m": 1_000_000,
    "raw100k": 100_000,
    "raw20k": 20_000,
    "m100k": 100_000,
    "m20k": 20_000,
    "m10k": 10_000,
    "m4k": 4_000,
}
"""Samples a second of each profile; those in m have a Butterworth low-pass at a fifth of it, those in raw none."""


def phases(fault: str) -> tuple[int, ...]:
    """Return the phases that a fault type names: 0, 1, 2 for a, b, c."""
    return () if fault == "none" else tuple("ABC".index(letter) for letter in fault.removesuffix("G"))


def grounded(fault: str) -> bool:
    """Return whether the star point of the fault is connected to ground."""
    return fault.endswith("G")


class LineParams(Params):
    """Constants of the transposed line per kilometre, and its length (Table I)."""

    length: float = param(120.0, "length L", "km", gt=0.0, le=3000.0)
    r1: float = param(0.0275, "positive-sequence resistance; 0: lossless", "ohm/km", ge=0.0, le=100.0)
    l1: float = param(1.00268e-3, "positive-sequence inductance", "H/km", gt=0.0, le=1.0)
    c1: float = param(0.013e-6, "positive-sequence capacitance", "F/km", gt=0.0, le=1e-3)

    @property
    def aerial(self) -> Section:
        """The whole line for an aerial mode."""
        return Section(self.r1, self.l1, self.c1, self.length)


class FullLineParams(LineParams):
    """With the zero sequence, which only the simulated line has."""

    r0: float = param(0.275, "zero-sequence resistance; Table I prints 0.0275, equal to r1", "ohm/km", ge=0.0, le=100.0)
    l0: float = param(3.26798e-3, "zero-sequence inductance", "H/km", gt=0.0, le=1.0)
    c0: float = param(0.0085e-6, "zero-sequence capacitance", "F/km", gt=0.0, le=1e-3)

    @property
    def ground(self) -> Section:
        """The whole line for the ground mode."""
        return Section(self.r0, self.l0, self.c0, self.length)


class SourceParams(Params):
    """The two equal sources behind the line."""

    voltage: float = param(400e3, "line-to-line rms of the source voltages", "V", gt=0.0, le=2e6)
    frequency: float = param(50.0, "frequency", "Hz", gt=0.0, le=1000.0)
    angle_s: float = param(0.0, "angle of source S, phase a", "rad", ge=-math.pi, le=math.pi)
    angle_r: float = param(math.radians(-10.0), "angle of source R, phase a", "rad", ge=-math.pi, le=math.pi)
    r1: float = param(1.31, "positive-sequence resistance", "ohm", ge=0.0, le=1e4)
    x1: float = param(15.0, "positive-sequence reactance at `frequency`", "ohm", gt=0.0, le=1e4)
    r0: float = param(2.33, "zero-sequence resistance", "ohm", ge=0.0, le=1e4)
    x0: float = param(26.6, "zero-sequence reactance at `frequency`", "ohm", gt=0.0, le=1e4)

    @property
    def omega(self) -> float:
        """Angular frequency, rad/s."""
        return 2.0 * math.pi * self.frequency


class FaultParams(Params):
    """The fault: its kind, place and time."""

    type: FaultType = param("AG", "faulted phases, with G connected to ground; none: no fault")
    x_km: float = param(50.0, "distance of the fault from bus S", "km", gt=0.0, le=3000.0)
    rf_ohm: float = param(
        0.0,
        "resistance of each faulted phase to the star point, at least 1 mohm acts",
        "ohm",
        ge=0.0,
        le=1e6,
        live=True,
    )
    t_on: float = param(0.020, "all phases close", "s", gt=0.0, le=3600.0, live=True)
    t_off: float = param(
        0.040, "each phase opens at its next current zero after this", "s", gt=0.0, le=3600.0, live=True
    )

    def _check(self) -> None:
        if self.t_off <= self.t_on:
            raise ValueError(f"t_off = {self.t_off:g} s is not after t_on = {self.t_on:g} s")


class RatioParams(Params):
    """Relative ratio errors of the transformers."""

    u_s: float = param(0.0, "voltage at S", ge=-0.5, le=0.5)
    i_s: float = param(0.0, "current at S", ge=-0.5, le=0.5)
    u_r: float = param(0.0, "voltage at R", ge=-0.5, le=0.5)
    i_r: float = param(0.0, "current at R", ge=-0.5, le=0.5)


class MeasurementParams(Params):
    """Instrument transformers, anti-alias filter, sampling."""

    profile: Profile = param("m20k", "sampling rate; m: low-pass of order 4 at a fifth of it, raw: none")
    noise_snr_db: float | None = param(
        None, "white noise, dB below the rms of each pre-fault channel; absent: none", "dB", ge=-20.0, le=300.0
    )
    seed: int = param(0, "of the noise, added to the seed of the run", ge=0, le=2**31 - 1)
    shift_us_r: float = param(0.0, "how late the clock of R samples, whole internal steps", "us", ge=-1000.0, le=1000.0)
    ratio_err: RatioParams = RatioParams()


class RigParams(Params):
    """Line, sources, fault, measurement: all that decides a record."""

    line: FullLineParams = FullLineParams()
    source: SourceParams = SourceParams()
    fault: FaultParams = FaultParams()
    measurement: MeasurementParams = MeasurementParams()
    duration: float = param(0.060, "length of the record", "s", gt=0.0, le=60.0)
    step: float = param(1e-6, "internal step", "s", ge=1e-8, le=1e-3)

    @property
    def decimation(self) -> int:
        """Internal steps a sample."""
        return round(1.0 / (RATES[self.measurement.profile] * self.step))

    @property
    def samples(self) -> int:
        """Samples of a record."""
        return round(self.duration * RATES[self.measurement.profile])

    @property
    def shift(self) -> int:
        """Return the delay of the samples of R, steps."""
        return round(self.measurement.shift_us_r * 1e-6 / self.step)

    def _check(self) -> None:
        rate, line, x = RATES[self.measurement.profile], self.line, self.fault.x_km
        if abs(1.0 / (rate * self.step) - self.decimation) > 1e-6 or self.decimation < 1:
            raise ValueError(
                f"step = {self.step:g} s does not divide the sampling period {1.0 / rate:g} s of "
                f"{self.measurement.profile}"
            )
        if abs(self.measurement.shift_us_r * 1e-6 / self.step - self.shift) > 1e-6:
            raise ValueError(f"shift_us_r = {self.measurement.shift_us_r:g} us is not whole steps of {self.step:g} s")
        least = LEAST_DELAY * self.step * max(line.aerial.velocity, line.ground.velocity)
        if not least <= x <= line.length - least:
            raise ValueError(
                f"fault.x_km = {x:g} km: expected {least:.4g} to {line.length - least:.4g} km of a line of "
                f"{line.length:g} km, so that waves need {LEAST_DELAY} steps or more for each section"
            )
