"""The operating point at which plant and controllers of a rig start, each from its own power flow."""

from __future__ import annotations

import cmath
import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from softrig_core import BlockParams, param
from softrig_core.block.params import flatten

from . import steady
from .circuit import BUS1, BUS2, BUS4, I12, I34, I_SH, PULSE, SE12, SE34, SH, circuit
from .flow.power_flow import Diverged, PowerFlow, References, Solution
from .measurement import Weights
from .network import NetworkParams

ROUNDS = 6
TOLERANCE = 1e-7  # pu
CYCLE = 48  # control periods
PAST = 60  # cycles, 1 s


class DeviceParams(BlockParams):
    """Parameters shared by the nodes of the device: network, step, measurement, and initial references."""

    period: float = param(1.0 / 2880.0, "control period T_c, a 48th of a cycle", "s", ge=1e-5, le=0.01)
    substeps: int = param(16, "steps of the circuit in a control period", ge=1, le=1000)
    waveform: Literal["average", "pulse"] = param("average", "converter voltages: fundamentals, or the 48 steps")
    network: NetworkParams = NetworkParams()
    initial: References = References()

    def _check(self) -> None:
        circuit(self.network, self.step)
        cycle = 1.0 / (self.network.frequency * self.period)
        if self.waveform == "pulse" and abs(cycle - CYCLE) > 1e-6:
            raise ValueError(f"waveform = pulse: a cycle has {cycle:.6g} control periods, expected {CYCLE}")
        _flow(self.network, self.initial)

    def agreed(self) -> dict[str, Any]:
        """Return the quantities on which all nodes of the device must agree, to start in one steady state."""
        network = {f"gupfc/network.{name}": value for name, value in flatten(self.network).items()}
        initial = {f"gupfc/initial.{name}": value for name, value in flatten(self.initial).items()}
        return {**network, **initial, "gupfc/waveform": self.waveform, "gupfc/substeps": self.substeps}

    @property
    def step(self) -> float:
        """Step of the circuit, s."""
        return self.period / self.substeps

    @property
    def pulse(self) -> int:
        """Waveform in the form for the compiled functions."""
        return PULSE if self.waveform == "pulse" else 0


@dataclass(frozen=True)
class OperatingPoint:
    """Steady state at t = 0, pu.

    Parameters
    ----------
    v_sh, v12, v34 : complex
        Fundamentals of the converter voltages.
    u1, u2, u4, i_sh, i12, i34 : complex
        Measured vectors, mean over a cycle.
    start : Start
        State and past of the circuit.
    cycle : dict of str to ndarray
        Measured vectors by name at the control periods of the cycle before t = 0; one value where only the
        fundamental is there.
    """

    v_sh: complex
    v12: complex
    v34: complex
    u1: complex
    u2: complex
    u4: complex
    i_sh: complex
    i12: complex
    i34: complex
    start: steady.Start
    cycle: dict[str, NDArray[np.complex128]]

    @property
    def v_dc(self) -> float:
        """Mean of the DC voltage."""
        return abs(self.v_sh)

    def past(self, u: str, i: str) -> Iterator[tuple[complex, complex]]:
        """Yield a measured voltage and current of the last cycles before t = 0, in which loops and filters settle.

        Empty if there is only the fundamental: loops and filters are then settled at its phasors.
        """
        if self.cycle[u].size == CYCLE:
            for _ in range(PAST):
                yield from zip(self.cycle[u].tolist(), self.cycle[i].tolist(), strict=True)


def conduction(magnitude: float, v_dc: float, limit: float) -> float:
    """Conduction angle of a series converter in rad, 2 asin(|v|/(limit v_dc)), at most pi.

    Parameters
    ----------
    magnitude, v_dc : float
        Wanted voltage and DC voltage, pu.
    limit : float
        Series voltage at 180 deg and nominal DC voltage, pu.
    """
    return 2.0 * math.asin(min(1.0, magnitude / (limit * v_dc)))


def operating_point(params: DeviceParams) -> OperatingPoint:
    """Find the steady state of the stepped circuit in which the measurements equal the references.

    The power flow gives the fundamentals; measured over a control period the 47th and 49th leave a trace (1e-3 pu), the
    discrete network differs a little from the exact one (1e-4 pu) and harmonics have losses of their own. The
    differences are added to the references of the power flow until the results agree.
    """
    return _operating_point(params.network, params.initial, params.period, params.substeps, params.pulse)


@functools.lru_cache(maxsize=8)
def _operating_point(
    network: NetworkParams, references: References, period: float, substeps: int, pulse: int
) -> OperatingPoint:
    step = period / substeps
    prepared, lines = circuit(network, step)
    weights = Weights(network.omega, step, substeps)
    samples = CYCLE * substeps if pulse else substeps
    wanted = np.array([references.p1, references.q1, references.p2, references.q2, references.v, 0.0])
    asked = wanted.copy()
    for _ in range(ROUNDS):
        p1, q1, p2, q2, v, surplus = asked.tolist()
        flow = _flow(network, References(p1=p1, q1=q1, p2=p2, q2=q2, v=v), surplus)
        sigma = np.array(
            [
                network.shunt_sigma,
                *(conduction(abs(x), abs(flow.v_sh), network.series_limit) for x in (flow.v12, flow.v34)),
            ]
        )
        angle = np.array([cmath.phase(x) for x in (flow.v_sh, flow.v12, flow.v34)])
        start = steady.start(network, prepared, lines, flow, sigma, angle, pulse, samples)
        u1, u2, u4 = (weights.phasor(start.bus[:, k]) for k in (BUS1, BUS2, BUS4))
        i_sh, i12, i34 = (weights.phasor(start.current[:, k]) for k in (I_SH, I12, I34))
        s1, s2 = u2 * i12.conjugate(), u4 * i34.conjugate()
        result = np.array([s1.real, s1.imag, s2.real, s2.imag, abs(u1), start.power[[SH, SE12, SE34]].sum()])
        if np.abs(result - wanted).max() < TOLERANCE:
            break
        asked += wanted - result
    columns = {
        "u1": start.bus[:, BUS1],
        "u2": start.bus[:, BUS2],
        "u4": start.bus[:, BUS4],
        "i_sh": start.current[:, I_SH],
        "i12": start.current[:, I12],
        "i34": start.current[:, I34],
    }
    cycle = {name: np.roll(weights.record(x), 1) for name, x in columns.items()}  # the value at t = 0 is also the first
    return OperatingPoint(flow.v_sh, flow.v12, flow.v34, u1, u2, u4, i_sh, i12, i34, start, cycle)


@functools.lru_cache(maxsize=64)  # each node of a rig checks the same references
def _flow(network: NetworkParams, references: References, surplus: float = 0.0) -> Solution:
    """Solve the power flow with the loss of the shunt transformer supplied by the converter.

    Raises
    ------
    ValueError
        There is no operating point with these references, or it needs more series voltage than is available.
    """
    result = PowerFlow(network, converter_loss=True).solve(references, surplus=surplus)
    if isinstance(result, Diverged):
        raise ValueError(
            f"initial: the power flow has no solution for these references, mismatch {result.mismatch:.3g} pu after "
            f"{result.iterations} iterations"
        )
    limit = network.series_limit * abs(result.v_sh)
    for name, v in (("V12", result.v12), ("V34", result.v34)):
        if abs(v) > limit:
            raise ValueError(f"initial: these references need {name} = {abs(v):.4g} pu, the limit is {limit:.4g} pu")
    return result
