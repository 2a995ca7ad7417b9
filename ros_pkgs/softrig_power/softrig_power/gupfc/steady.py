"""Periodic steady state of the stepped circuit: the start of the plant in both waveforms.

The circuit is linear for a given DC voltage, so each harmonic of the converter voltages over one cycle has its own
phasors, exact for the discrete network (interpolated delay, trapezoidal branches); their sum is state and past.
"""

from __future__ import annotations

import cmath
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Complex
from softrig_core.kit import dense

from ..lines.bergeron import Lines, delay_factor, history_length
from .circuit import I12, I34, I_SH, PULSE, SOURCE_A, SOURCE_B, A, B, Circuit, State, mean_voltage
from .flow.power_flow import Solution
from .network import BUSES, HALVES, NetworkParams, admittance

# Rounds for the ripple of the DC voltage; each changes a thousandth of the previous change.
ROUNDS = 4


class Start(NamedTuple):
    """State at t = 0 and the past, rows at every step, the last at t = 0."""

    state: State
    bus: Complex  # (n + 1, 6)
    current: Complex  # (n + 1, 5)
    converter: Complex  # (n + 1, 3), mean voltages over the step that ends at the row
    power: NDArray[np.float64]  # (3,), mean power of the converters over that past


class Phasors:
    """Response of the discrete network to one frequency.

    Parameters
    ----------
    step : float
        s.
    omega : float
        rad/s, negative for vectors that turn backwards.
    """

    def __init__(self, params: NetworkParams, step: float, omega: float) -> None:
        z = cmath.exp(1j * omega * step)
        r, l = params.source_impedance  # noqa: E741
        # R-L branch with sampled voltages at its ends: I = y (U1 - U2); driven by the mean over the step: I = V/d
        branches = (r, l), (params.r_se, params.x_se / params.omega), (params.r_sh, params.x_sh / params.omega)
        d = [R * 0.5 * (z + 1.0) + L * (z - 1.0) / step for R, L in branches]
        self._d_se, self._d_sh = d[1], d[2]
        self._y_source, self._y_se, self._y_sh = (0.5 * (z + 1.0) / x for x in d)
        self._half = params.half.bergeron_two_port(omega, delay_factor(params.half, omega, step))
        self._nodes = admittance(self._half, self._y_source, self._y_se, self._y_sh)

    def __call__(self, e_a: complex, e_b: complex, v: Complex) -> tuple[Complex, Complex, Complex]:
        """Solve.

        Parameters
        ----------
        e_a, e_b : complex
            Sources (sampled).
        v : ndarray, shape (3,)
            Shunt, series 12, series 34; means over the step that begins at the sample.

        Returns
        -------
        bus : ndarray, shape (6,)
        branch : ndarray, shape (5,)
        line : ndarray, shape (4, 2)
            Currents into the half lines at their ends.
        """
        j_sh, j12, j34 = v[0] / self._d_sh, v[1] / self._d_se, v[2] / self._d_se
        source = np.array([self._y_source * e_a, j_sh - j12, j12, -j34, j34, self._y_source * e_b])
        u = dense.solve(self._nodes, source)
        i = np.empty(5, dtype=complex)
        i[SOURCE_A], i[SOURCE_B] = self._y_source * (e_a - u[A]), self._y_source * (e_b - u[B])
        i[I12], i[I34] = j12 + self._y_se * (u[1] - u[2]), j34 + self._y_se * (u[3] - u[4])
        i[I_SH] = j_sh - self._y_sh * u[1]
        index = {name: k for k, name in enumerate(BUSES)}
        line = dense.product(np.array([u[[index[k], index[m]]] for k, m in HALVES]), self._half.T)
        return u, i, line


def start(
    params: NetworkParams,
    circuit: Circuit,
    lines: Lines,
    flow: Solution,
    sigma: NDArray[np.float64],
    angle: NDArray[np.float64],
    pulse: int,
    samples: int,
) -> Start:
    """Return the state at t = 0 as if the converters had turned with the sources for ever.

    Parameters
    ----------
    circuit, lines
        From `circuit.circuit`.
    flow : Solution
        The magnitude of its V_sh is the mean of the DC voltage.
    sigma, angle : ndarray, shape (3,)
        Conduction angle and angle at t = 0 of the converters, rad.
    pulse : {0, 1}
        Waveform; with pulses a cycle must be a whole number of steps.
    samples : int
        Length of the past that is also returned, steps.
    """
    h, omega = circuit.step, circuit.omega
    # Steps of a cycle; if it is not a whole number, only the fundamental matters.
    steps = round(2.0 * np.pi / (omega * h))
    turn = omega * h
    scale = np.array([circuit.shunt_scale, circuit.series_scale, circuit.series_scale])
    v_dc = np.full(steps, abs(flow.v_sh))
    past = max(samples + 1, history_length(lines))
    k = np.arange(-past, 1)
    if pulse == PULSE:
        shape = np.array(
            [
                [mean_voltage(a + n * turn, turn, s, pulse) for a, s in zip(angle, sigma, strict=True)]
                for n in range(steps)
            ]
        )
        rounds = ROUNDS
    else:
        first = np.array([mean_voltage(a, turn, s, pulse) for a, s in zip(angle, sigma, strict=True)])
        rounds = 1
    network: dict[int, Phasors] = {}
    for _ in range(rounds):
        if pulse == PULSE:
            spectrum = np.fft.fft(scale * shape * v_dc[:, None], axis=0) / steps
            orders = [n for n in range(steps) if n == 1 or np.abs(spectrum[n]).max() > 1e-13]
        else:
            spectrum, orders = {1: scale * first * v_dc[0]}, [1]  # type: ignore[assignment]
        signed = [n if n <= steps // 2 else n - steps for n in orders]
        results = []  # results of each order: buses, branches, lines, converters
        for n, order in zip(orders, signed, strict=True):
            if n not in network:
                network[n] = Phasors(params, h, order * omega)
            e = (circuit.source_a, circuit.source_b) if n == 1 else (0j, 0j)
            results.append(np.concatenate([np.ravel(x) for x in (*network[n](*e, spectrum[n]), spectrum[n])]))
        speeds = turn * np.array(signed)
        states = dense.product(dense.turn(np.outer(k, speeds)), np.array(results))
        bus, current, mean = states[:, :6], states[:, 6:11], states[:, 19:]
        line = states[:, 11:19].reshape(-1, 4, 2)
        if pulse == PULSE:
            i = np.array(results)[:, 6:11][:, [I_SH, I12, I34]]
            between = dense.times(0.5 * (1.0 + dense.turn(speeds))[:, None], i)
            mean_current = dense.product(dense.turn(np.outer(np.arange(steps), speeds)), between)
            power = dense.times(scale * shape * v_dc[:, None], mean_current.conj()).real.sum(axis=1)
            fall = np.cumsum(power - power.mean()) * h / circuit.dc_time
            square = abs(flow.v_sh) ** 2 - np.concatenate([[0.0], fall[:-1]])
            v_dc = np.sqrt(square - square.mean() + abs(flow.v_sh) ** 2)
    rows = slice(past - samples, None)
    converter = mean[past - samples - 1 : -1]
    between = 0.5 * (current[rows][1:] + current[rows][:-1])[:, [I_SH, I12, I34]]
    delivered = dense.times(converter[1:], between.conj()).real.mean(axis=0)
    return Start(_state(lines, bus, current, line, float(v_dc[0])), bus[rows], current[rows], converter, delivered)


def _state(lines: Lines, bus: Complex, current: Complex, line: Complex, v_dc: float) -> State:
    """Fill the rings of the half lines as `lines.bergeron.store` would have."""
    size = history_length(lines)
    index = {name: k for k, name in enumerate(BUSES)}
    ring = np.zeros((4, 2, size), dtype=complex)
    for age in range(size):
        u = np.array([bus[-1 - age][[index[a], index[b]]] for a, b in HALVES])
        leaving = u + lines.z_minus[:, None] * line[-1 - age]
        ring[:, :, -age % size] = lines.far[:, None] * leaving[:, ::-1] + lines.near[:, None] * leaving
    return State(ring, bus[-1].copy(), current[-1].copy(), np.array([v_dc]))
