"""The faulted network in compiled steps, with the measurement chain; one function serves records and streams."""

from __future__ import annotations

import cmath
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, jit
from softrig_core.kit import dense

from ...lines.bergeron import histories, store, together
from ...lines.modal import CLARKE
from .measurement import Chain, chain, filter_steps, steady_filter
from .network import Network, line_history, network, steady
from .parameters import RigParams, phases

CHANNELS = 12  # u_S, i_S, u_R, i_R, three phases each
BLOCK = 64  # steps that are computed together, so that their values stay in the processor's nearest cache


class State(NamedTuple):
    """State of the network; arrays that the compiled step changes in place."""

    ring: Array  # (6, 2, n) histories of the sections
    source_current: Array  # (2, 3) terminal, mode
    source_voltage: Array  # (2, 3) across the impedance
    fault_current: Array  # (3,) phases
    phase: NDArray[np.int64]  # (3,) 0 not yet, 1 closed, 2 opened
    opened: Array  # (3,) s, when a phase opened; 0: it has not
    peak: Array  # (3,) A, largest |fault current| of each phase
    filters: Array  # (sections, 2, 12)
    late: Array  # (12, n) the newest filtered values, for terminals whose clock is late
    measured: Array  # (12,) what is sampled now, without noise


@jit
def advance(net: Network, chain: Chain, transform: Array, state: State, k: int, steps: int) -> None:
    """Move the network from step k by a number of steps.

    Parameters
    ----------
    net, chain : Network, Chain
    transform : ndarray, shape (3, 3)
        Clarke matrix.
    state : State
        Changed in place.
    k : int
        Step that the state belongs to.
    """
    first, last = k + 1, k + steps
    while first <= last:
        # While no wave has passed the shortest section, all steps are independent but for the source currents, the
        # fault and the filter. Each equation is then one loop over these steps, which the processor does in parallel.
        count = min(last + 1 - first, together(net.lines, state.ring, first), BLOCK)
        history, voltage, current = np.empty((6, 2, count)), np.empty((6, 2, count)), np.empty((6, 2, count))
        raw = np.empty((count, 12))
        histories(net.lines, state.ring, first, history)
        _sources(net, state, first, history, voltage)
        _fault_point(net, transform, state, first, history, voltage)
        store(net.lines, state.ring, first, voltage, history, current)
        _phases(transform, voltage, current, raw)
        filter_steps(chain.sos, state.filters, raw)
        _keep(raw, first, state.late)
        first += count
    mask = state.late.shape[1] - 1
    for channel in range(12):
        old = (last - chain.delay[channel // 6]) & mask
        state.measured[channel] = chain.ratio[channel // 3] * state.late[channel, old]


@jit
def _sources(net: Network, state: State, first: int, history: Array, voltage: Array) -> None:
    """Solve the nodes S and R: their voltages, and the currents and voltages of the source impedances."""
    g, sources = net.lines.conductance, np.zeros((2, 3))
    for j in range(history.shape[2]):
        for end in range(2):
            angle = net.omega * ((first + j) * net.step) + net.emf[end, 1]
            sources[end, 1] = net.emf[end, 0] * math.cos(angle)
            sources[end, 2] = net.emf[end, 0] * math.sin(angle)
            for mode in range(3):
                section = 3 * end + mode
                gs = net.source_conductance[mode]
                past = state.source_voltage[end, mode] + net.source_keep[mode] * state.source_current[end, mode]
                u = (gs * (sources[end, mode] + past) - history[section, end, j]) / (gs + g[section])
                across = sources[end, mode] - u
                state.source_current[end, mode] = gs * (across + past)
                state.source_voltage[end, mode] = across
                voltage[section, end, j] = u


@jit
def _fault_point(net: Network, transform: Array, state: State, first: int, history: Array, voltage: Array) -> None:
    """Solve the node F: its voltages without the fault, the currents of the fault, and its voltages with it."""
    g, steps = net.lines.conductance, history.shape[2]
    node, phase = np.empty((3, steps)), np.empty((3, steps))
    for mode in range(3):
        both = g[mode] + g[3 + mode]
        for j in range(steps):
            node[mode, j] = -(history[mode, 1, j] + history[3 + mode, 0, j]) / both
    for ph in range(3):
        a, b, c = transform[0, ph], transform[1, ph], transform[2, ph]
        for j in range(steps):
            phase[ph, j] = a * node[0, j] + b * node[1, j] + c * node[2, j]
    _fault(net, state, first, phase)
    for mode in range(3):
        both = g[mode] + g[3 + mode]
        a, b, c = transform[mode, 0], transform[mode, 1], transform[mode, 2]
        for j in range(steps):
            u = node[mode, j] - (a * phase[0, j] + b * phase[1, j] + c * phase[2, j]) / both
            voltage[mode, 1, j] = u
            voltage[3 + mode, 0, j] = u


@jit
def _closed(phase: NDArray[np.int64]) -> int:
    bits = 0
    for ph in range(3):
        if phase[ph] == 1:
            bits |= 1 << ph
    return bits


@jit
def _fault(net: Network, state: State, first: int, phase: Array) -> None:
    """Replace the open-circuit voltages of steps by the fault currents.

    All phases close at `on`; each opens at the first step after `off` whose current has changed its sign.

    Parameters
    ----------
    first : int
        Number of the first step.
    phase : ndarray, shape (3, steps)
        V; A afterwards.
    """
    steps = phase.shape[1]
    before = min(max(net.on - first, 0), steps)
    for ph in range(3):
        for j in range(before):
            phase[ph, j] = state.fault_current[ph]
        if before < steps and state.phase[ph] == 0:
            state.phase[ph] = 1
    bits = _closed(state.phase)
    for j in range(before, steps):
        n, a, b, c = first + j, phase[0, j], phase[1, j], phase[2, j]
        # A phase that opens changes the currents of the others in this step, so they are tested again.
        # Before `off` no phase opens.
        for _ in range(3 if n >= net.off else 0):
            changed = False
            for ph in range(3):
                i = net.closed[bits, ph, 0] * a + net.closed[bits, ph, 1] * b + net.closed[bits, ph, 2] * c
                if state.phase[ph] == 1 and i * state.fault_current[ph] <= 0.0:
                    state.phase[ph] = 2
                    state.opened[ph] = n * net.step
                    changed = True
            if not changed:
                break
            bits = _closed(state.phase)
        for ph in range(3):
            i = net.closed[bits, ph, 0] * a + net.closed[bits, ph, 1] * b + net.closed[bits, ph, 2] * c
            state.fault_current[ph] = i
            state.peak[ph] = max(state.peak[ph], abs(i))
            phase[ph, j] = i


@jit
def _phases(transform: Array, voltage: Array, current: Array, raw: Array) -> None:
    """Transform the modes at S and R to the channels of the instruments, shape (steps, 12)."""
    for end in range(2):
        for kind in range(2):
            modes = voltage if kind == 0 else current
            for ph in range(3):
                a, b, c = transform[0, ph], transform[1, ph], transform[2, ph]
                for j in range(raw.shape[0]):
                    # 0.0: a sum that begins with it has no negative zero.
                    raw[j, 6 * end + 3 * kind + ph] = (
                        0.0
                        + a * modes[3 * end, end, j]
                        + b * modes[3 * end + 1, end, j]
                        + c * modes[3 * end + 2, end, j]
                    )


@jit
def _keep(filtered: Array, first: int, late: Array) -> None:
    """Keep the newest filtered values, as many as a late clock needs."""
    steps, size = filtered.shape[0], late.shape[1]
    for j in range(max(steps - size, 0), steps):
        for channel in range(12):
            late[channel, (first + j) & (size - 1)] = filtered[j, channel]


@jit
def record(net: Network, chain: Chain, transform: Array, state: State, decimation: int, out: Array) -> None:
    """Write one row of `measured` and fault current a sample into `out`, shape (samples, 15), from step 0."""
    for row in range(out.shape[0]):
        if row > 0:
            advance(net, chain, transform, state, (row - 1) * decimation, decimation)
        out[row, :12] = state.measured
        out[row, 12:] = state.fault_current


class FaultedLine:
    """The simulated line from its steady state on.

    Attributes
    ----------
    state : State
    k : int
        Step of the state.
    """

    def __init__(self, p: RigParams) -> None:
        self.p = p
        self.net = network(p)
        self.chain = chain(p)
        self.steady = steady(p)
        self.reset()

    def reset(self) -> None:
        """Restore the steady state at t = 0, without a jump."""
        p, result = self.p, self.steady
        omega, step = p.source.omega, p.step
        self.k = 0
        emf = self.net.emf
        source_voltage = np.zeros((2, 3))
        source_current = np.zeros((2, 3))
        turn = math.sqrt(1.5) * np.array([0.0, 1.0, -1j])
        for end in range(2):
            modes = dense.times(cmath.rect(emf[end, 0], emf[end, 1]), [0.0, 1.0, -1j])
            source_voltage[end] = (modes - dense.times(result.u[2 * end], turn)).real
            source_current[end] = dense.times(result.source[end], turn).real
        a = dense.turn(-2.0 * math.pi / 3.0 * np.arange(3))
        phasors = np.concatenate([dense.times(x, a) for x in (result.u[0], result.i[0], result.u[2], result.i[1])])
        filters, filtered = steady_filter(self.chain.sos, phasors, omega, step)
        size = 1 << (int(np.max(self.chain.delay)) + 1).bit_length()
        ages = -np.arange(size) % size
        late = dense.times(filtered[:, None], dense.turn(-omega * step * ages)).real
        measured = dense.times(filtered, dense.turn(-omega * step * np.repeat(self.chain.delay, 6))).real
        self.prefault_rms = np.hypot(filtered.real, filtered.imag) / math.sqrt(2.0) * np.repeat(self.chain.ratio, 3)
        self.state = State(
            line_history(p, result, self.net.lines),
            source_current,
            source_voltage,
            np.zeros(3),
            np.array([0 if ph in phases(p.fault.type) else 2 for ph in range(3)]),
            np.zeros(3),
            np.zeros(3),
            filters,
            np.ascontiguousarray(late),
            measured * np.repeat(self.chain.ratio, 3),
        )

    def advance(self, steps: int) -> None:
        """Move by internal steps."""
        advance(self.net, self.chain, CLARKE, self.state, self.k, steps)
        self.k += steps

    def run(self, samples: int) -> Array:
        """Sample from t = 0 on: shape (samples, 15), the 12 channels and the fault currents; without noise."""
        self.reset()
        out = np.empty((samples, CHANNELS + 3))
        record(self.net, self.chain, CLARKE, self.state, self.p.decimation, out)
        self.k = (samples - 1) * self.p.decimation
        return out

    def noise_level(self) -> Array:
        """Return the standard deviation of the noise of each channel (V, A), shape (12,)."""
        snr = self.p.measurement.noise_snr_db
        return np.zeros(CHANNELS) if snr is None else self.prefault_rms * 10.0 ** (-snr / 20.0)

    def noise(self, rng: Any, samples: int) -> Array:
        """Draw the noise of a number of samples, shape (samples, 12); drawn one by one they are the same."""
        if self.p.measurement.noise_snr_db is None:
            return np.zeros((samples, CHANNELS))
        result: Array = self.noise_level() * rng.standard_normal((samples, CHANNELS))
        return result
