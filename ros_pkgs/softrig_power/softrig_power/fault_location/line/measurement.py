"""Measurement chain: anti-alias filter at the internal step, ratio errors, a terminal whose clock is late."""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, Complex, jit
from softrig_core.kit import dense

from .parameters import RATES, RigParams

ORDER = 4
CUTOFF = 0.2  # share of the sampling rate


class Chain(NamedTuple):
    """Numbers of the chain for the compiled step."""

    sos: Array  # (sections, 5): b0, b1, b2, a1, a2; no sections for the raw profiles
    ratio: Array  # (4,) of u_S, i_S, u_R, i_R
    delay: NDArray[np.int64]  # (2,) steps by which the samples of S and R are old


def chain(p: RigParams) -> Chain:
    """Prepare the chain; a clock of R that is early is one of S that is late."""
    m = p.measurement
    sos = butterworth(CUTOFF * RATES[m.profile] * p.step) if m.profile.startswith("m") else np.empty((0, 5))
    ratio = 1.0 + np.array([m.ratio_err.u_s, m.ratio_err.i_s, m.ratio_err.u_r, m.ratio_err.i_r])
    return Chain(sos, ratio, np.array([max(0, -p.shift), max(0, p.shift)], dtype=np.int64))


def butterworth(cutoff: float) -> Array:
    """Design the low-pass of order 4 by the bilinear transform, prewarped.

    Parameters
    ----------
    cutoff : float
        Frequency at which it has 3 dB, in steps^-1, below 0.5.

    Returns
    -------
    ndarray, shape (2, 5)
        b0, b1, b2, a1, a2 of each section.
    """
    k = math.tan(math.pi * cutoff)
    rows = []
    for pole in range(ORDER // 2):
        damping = 2.0 * math.cos(math.pi * (2 * pole + 1) / (2 * ORDER))  # 1/Q of the pole pair
        scale = 1.0 / (1.0 + damping * k + k * k)
        b0 = k * k * scale
        rows.append([b0, 2.0 * b0, b0, 2.0 * (k * k - 1.0) * scale, (1.0 - damping * k + k * k) * scale])
    return np.array(rows)


@jit
def filter_steps(sos: Array, state: Array, x: Array) -> None:
    """Filter samples of every channel in place, second-order sections in transposed direct form II.

    Parameters
    ----------
    sos : ndarray, shape (sections, 5)
    state : ndarray, shape (sections, 2, channels)
    x : ndarray, shape (steps, channels)
    """
    for s in range(sos.shape[0]):
        b0, b1, b2, a1, a2 = sos[s, 0], sos[s, 1], sos[s, 2], sos[s, 3], sos[s, 4]
        for j in range(x.shape[0]):
            # The channels are innermost, so that the processor filters several of them with one instruction.
            for channel in range(x.shape[1]):
                v = x[j, channel]
                y = b0 * v + state[s, 0, channel]
                state[s, 0, channel] = b1 * v - a1 * y + state[s, 1, channel]
                state[s, 1, channel] = b2 * v - a2 * y
                x[j, channel] = y


def steady_filter(sos: Array, phasors: Complex, omega: float, step: float) -> tuple[Array, Complex]:
    """Return the filter's state after t = 0 and its output phasors for sinusoidal inputs.

    Parameters
    ----------
    phasors : ndarray, shape (channels,)

    Returns
    -------
    state : ndarray, shape (sections, 2, channels)
    filtered : ndarray, shape (channels,)
    """
    back = cmath.exp(-1j * omega * step)
    state = np.zeros((sos.shape[0], 2, phasors.size))
    v = phasors.astype(complex)
    for s, (b0, b1, b2, a1, a2) in enumerate(sos):
        y = dense.times(v, (b0 + b1 * back + b2 * back * back) / (1.0 + a1 * back + a2 * back * back))
        second = b2 * v - a2 * y  # after t = 0, used at the next step
        state[s, 0] = (b1 * v - a1 * y + dense.times(second, back)).real
        state[s, 1] = second.real
        v = y
    return state, v
