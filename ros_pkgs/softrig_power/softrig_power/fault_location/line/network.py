"""Source - line - fault - line - source: the numbers of the stepped network and its sinusoidal steady state."""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np
from softrig_core import Array, Complex
from softrig_core.kit import dense

from ...lines.bergeron import Lines, branch, branch_impedance, discrete_two_port, lines, steady_history
from ...lines.modal import CLARKE
from .parameters import FaultParams, RigParams, grounded, phases

LEAST_RESISTANCE = 1e-3  # ohm: least resistance of a faulted phase, and of the star point to ground
S, R = 0, 1  # terminals


class Network(NamedTuple):
    """Constants of the compiled step; modes are 0, alpha, beta, sections are S-F of the three modes, then F-R."""

    lines: Lines
    source_conductance: Array  # (3,) modes
    source_keep: Array  # (3,)
    emf: Array  # (2, 2): terminal, amplitude of the modes (V) and angle (rad)
    omega: float
    step: float
    closed: Array  # (8, 3, 3): fault currents from the open-circuit phase voltages, for each set of closed phases
    on: int  # first step with the fault
    off: int  # first step at which phases may open


class Steady(NamedTuple):
    """Phasors of the steady state before the fault, positive sequence, phase a, amplitudes; times cos(omega t)."""

    u: Complex  # (3,): S, F, R
    i: Complex  # (2,): into the line at S and at R
    source: Complex  # (2,): current out of each source


def network(p: RigParams) -> Network:
    """Prepare the network for stepping.

    Raises
    ------
    ValueError
        A section is too short for the step.
    """
    src, h = p.source, p.step
    x, remaining = p.fault.x_km, p.line.length - p.fault.x_km
    sections = [
        mode.part(length) for length in (x, remaining) for mode in (p.line.ground, p.line.aerial, p.line.aerial)
    ]
    zero = branch(src.r0, src.x0 / src.omega, h)
    positive = branch(src.r1, src.x1 / src.omega, h)
    prepared = lines(sections, h)
    amplitude = src.voltage  # sqrt(2/3) of a phase times sqrt(3/2) of the Clarke modes
    return Network(
        prepared,
        np.array([b.conductance for b in (zero, positive, positive)]),
        np.array([b.keep for b in (zero, positive, positive)]),
        np.array([[amplitude, src.angle_s], [amplitude, src.angle_r]]),
        src.omega,
        h,
        _fault_admittances(prepared, p.fault),
        math.ceil(p.fault.t_on / h - 1e-6) if p.fault.type != "none" else 2**62,
        math.ceil(p.fault.t_off / h - 1e-6),
    )


def _fault_admittances(prepared: Lines, fault: FaultParams) -> Array:
    """Solve the fault branch behind the Thevenin resistance of the two line ends, for each set of closed phases."""
    open_circuit = 1.0 / (prepared.conductance[:3] + prepared.conductance[3:])
    thevenin = dense.product(CLARKE.T * open_circuit, CLARKE)
    resistance = max(fault.rf_ohm, LEAST_RESISTANCE)
    result = np.zeros((8, 3, 3))
    for bits in range(1, 8):
        closed = [phase for phase in phases(fault.type) if bits >> phase & 1]
        if len(closed) != bits.bit_count() or (len(closed) == 1 and not grounded(fault.type)):
            # Phases outside the fault never close, and a single phase of a floating star carries no current.
            continue
        n = len(closed)
        z = np.zeros((n + 1, n + 1))  # matrix of the phases and the star point: u0 = (thevenin + R) i + u_star
        z[:n, :n] = thevenin[np.ix_(closed, closed)] + resistance * np.eye(n)
        z[:n, n], z[n, :n] = 1.0, 1.0
        z[n, n] = -1.0 / LEAST_RESISTANCE if grounded(fault.type) else 0.0
        result[bits][np.ix_(closed, closed)] = dense.solve(z, np.eye(n + 1, n))[:n]
    return result


def steady(p: RigParams) -> Steady:
    """Solve the sinusoidal steady state of the discretised network, positive sequence."""
    src, h = p.source, p.step
    ports = [
        discrete_two_port(p.line.aerial.part(length), src.omega, h)
        for length in (p.fault.x_km, p.line.length - p.fault.x_km)
    ]
    y = np.zeros((3, 3), dtype=complex)
    y[:2, :2] += ports[0]
    y[1:, 1:] += ports[1]
    admittance = 1.0 / branch_impedance(src.r1, src.x1 / src.omega, src.omega, h)
    y[0, 0] += admittance
    y[2, 2] += admittance
    peak = src.voltage * math.sqrt(2.0 / 3.0)
    emf = [cmath.rect(peak, angle) for angle in (src.angle_s, src.angle_r)]
    u = dense.solve(y, [admittance * emf[S], 0.0, admittance * emf[R]])
    i = np.array([dense.product(ports[0], u[:2])[0], dense.product(ports[1], u[1:])[1]])
    return Steady(u, i, np.array([admittance * (e - v) for e, v in zip(emf, u[[0, 2]].tolist(), strict=True)]))


def to_modes(phasor: complex) -> Complex:
    """Return the Clarke modes of a positive-sequence phasor of phase a: (0, sqrt(3/2) U, -j sqrt(3/2) U)."""
    modes: Complex = np.array([0.0, phasor, -1j * phasor], dtype=np.complex128)
    modes *= math.sqrt(1.5)
    return modes


def line_history(p: RigParams, result: Steady, prepared: Lines) -> Array:
    """Fill the histories of all six sections with the steady state up to t = 0."""
    two = [
        discrete_two_port(p.line.aerial.part(length), p.source.omega, p.step)
        for length in (p.fault.x_km, p.line.length - p.fault.x_km)
    ]
    u = np.stack([to_modes(v) for v in result.u])  # (node, mode)
    currents = [dense.product(two[0], result.u[:2]), dense.product(two[1], result.u[1:])]
    voltages = np.concatenate([u[:2].T, u[1:].T])  # (section and mode, end)
    flows = np.concatenate([np.stack([to_modes(c) for c in pair]).T for pair in currents])
    return np.ascontiguousarray(steady_history(prepared, voltages, flows, p.source.omega, p.step).real)
