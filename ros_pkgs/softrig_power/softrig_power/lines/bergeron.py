r"""Lossy Bergeron sections and trapezoidal R-L branches in time steps, compiled; real modes or complex vectors.

A section of resistance R = r l between the terminals k and m, R/4, R/2, R/4 lumped, currents into the section at both
ends (H. W. Dommel, Digital computer solution of electromagnetic transients, IEEE Trans. PAS 88, 1969):

.. math::
    i_k(t) = u_k(t)/Z' + H_k(t - \tau), \qquad Z' = Z + R/4, \quad Z'' = Z - R/4 \\
    H_k(t - \tau) = -\frac{Z}{Z'^2} [u_m + Z'' i_m](t - \tau) - \frac{R/4}{Z'^2} [u_k + Z'' i_k](t - \tau)

and k, m swapped for H_m. Each terminal keeps the values that will arrive at it; a delay that is not whole steps is
interpolated with the cubic through four of them.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from softrig_core import Array, Complex, jit
from softrig_core.kit import dense

from .section import Section

# In steps. A shorter section has no room for the cubic through four samples.
LEAST_DELAY = 4


class Lines(NamedTuple):
    """Numbers of n sections for the compiled functions, arrays of shape (n,) unless stated; created by `lines`."""

    conductance: Array  # 1/Z'
    z_minus: Array  # Z''
    far: Array  # -Z/Z'^2, weight of what left the other end
    near: Array  # -(R/4)/Z'^2, weight of what left the same end
    newest: NDArray[np.int64]  # age in steps of the newest of the four samples that the cubic reads
    weights: Array  # (n, 4), of the cubic


def interpolation(delay: float) -> tuple[int, Array]:
    """Lagrange weights of a delay.

    Parameters
    ----------
    delay : float
        Steps, at least 2.

    Returns
    -------
    newest : int
        Age in steps of the newest sample used.
    weights : ndarray, shape (4,)
        Of the samples of age newest, newest + 1, newest + 2, newest + 3.
    """
    steps = int(delay)
    s = delay - steps  # the value lies between the ages `steps` and `whole + 1`
    return steps - 1, np.array(
        [
            -s * (s - 1.0) * (s - 2.0) / 6.0,
            (s + 1.0) * (s - 1.0) * (s - 2.0) / 2.0,
            -(s + 1.0) * s * (s - 2.0) / 2.0,
            (s + 1.0) * s * (s - 1.0) / 6.0,
        ]
    )


def lines(sections: Sequence[Section], step: float) -> Lines:
    """Prepare sections for stepping.

    Parameters
    ----------
    sections : sequence of Section
        One a mode and stretch.
    step : float
        s.

    Raises
    ------
    ValueError
        A section whose travel time is below `LEAST_DELAY` steps; the text gives the least length.
    """
    for s in sections:
        if s.tau < LEAST_DELAY * step * (1.0 - 1e-9):
            raise ValueError(
                f"a section of {s.length:g} km is passed in {s.tau / step:.3g} steps of {step:g} s: expected at least "
                f"{LEAST_DELAY}, which is {LEAST_DELAY * step * s.velocity:.4g} km"
            )
    results = [interpolation(s.tau / step) for s in sections]
    z_plus = np.array([s.z_plus for s in sections])
    return Lines(
        1.0 / z_plus,
        np.array([s.z_minus for s in sections]),
        -np.array([s.z for s in sections]) / z_plus**2,
        -0.25 * np.array([s.resistance for s in sections]) / z_plus**2,
        np.array([steps for steps, _ in results], dtype=np.int64),
        np.array([weights for _, weights in results]),
    )


def history_length(prepared: Lines) -> int:
    """Slots of the ring that `histories` and `store` need, a power of two."""
    return 1 << (int(np.max(prepared.newest)) + 4).bit_length()


def delay_factor(section: Section, omega: float, step: float) -> complex:
    """Return D(omega) of the interpolated delay, exp(-j omega tau) to order (omega step)^4."""
    newest, weights = interpolation(section.tau / step)
    return dense.total(w * cmath.exp(-1j * omega * step * (newest + k)) for k, w in enumerate(weights.tolist()))


def discrete_two_port(section: Section, omega: float, step: float) -> Complex:
    """Nodal admittance of the section as `histories` and `store` step it, in the sinusoidal steady state."""
    return section.bergeron_two_port(omega, delay_factor(section, omega, step))


def steady_history(prepared: Lines, voltages: Complex, currents: Complex, omega: float, step: float) -> Complex:
    """Fill the ring with the sinusoidal past.

    Parameters
    ----------
    voltages, currents : ndarray, shape (n, 2)
        Phasors at t = 0 of both ends, currents into the section.
    omega, step : float
        rad/s, s.

    Returns
    -------
    ndarray, shape (n, 2, history_length)
        Complex rotating values; slot k mod length holds t = k step, for the steps up to 0. The real part is
        the history of a single-phase or modal line, the whole one that of a space vector.
    """
    size = history_length(prepared)
    leaving = voltages + prepared.z_minus[:, None] * currents
    arriving = prepared.far[:, None] * leaving[:, ::-1] + prepared.near[:, None] * leaving
    ages = -np.arange(size) % size  # slot k was written at step -age
    return dense.times(arriving[:, :, None], dense.turn(-omega * step * ages))


@jit
def together(lines: Lines, ring: Any, k: int) -> int:
    """Return the number of steps from k on that `histories` and `store` can compute in one call, at least 1.

    What leaves an end within these steps arrives after them, and their slots of the ring are adjacent.
    """
    size = ring.shape[2]
    result = size - (k & (size - 1))
    for n in range(ring.shape[0]):
        result = min(result, lines.newest[n])
    return result


@jit
def histories(lines: Lines, ring: Any, k: int, out: Any) -> None:
    """Return H(t - tau) of every section and end at the steps k, k + 1, ..., before these are stored.

    Parameters
    ----------
    ring : ndarray, shape (n, 2, length)
        Real or complex, from `steady_history` or zeros.
    k : int
        Number of the first step, > 0.
    out : ndarray, shape (n, 2, steps)
        Takes the currents, A; at most `together` steps.
    """
    mask, steps = ring.shape[2] - 1, out.shape[2]
    for n in range(ring.shape[0]):
        w0, w1, w2, w3 = lines.weights[n, 0], lines.weights[n, 1], lines.weights[n, 2], lines.weights[n, 3]
        latest = k - lines.newest[n]
        for end in range(2):
            h = ring[n, end]
            a, b, c = h[(latest - 3) & mask], h[(latest - 2) & mask], h[(latest - 1) & mask]
            for j in range(steps):
                d = h[(latest + j) & mask]
                out[n, end, j] = w0 * d + w1 * c + w2 * b + w3 * a
                a, b, c = b, c, d


@jit
def store(lines: Lines, ring: Any, k: int, voltages: Any, history: Any, currents: Any) -> None:
    """End steps: terminal currents from the voltages, and the waves that arrive at the ends after the travel time.

    Parameters
    ----------
    lines, ring, k
        As of `histories`.
    voltages : ndarray, shape (n, 2, steps)
        V at both ends.
    history : ndarray, shape (n, 2, steps)
        From `histories`.
    currents : ndarray, shape (n, 2, steps)
        Takes i = u/Z' + H, A into the section.
    """
    slot = k & (ring.shape[2] - 1)
    for n in range(ring.shape[0]):
        g, z, far, near = lines.conductance[n], lines.z_minus[n], lines.far[n], lines.near[n]
        for j in range(voltages.shape[2]):
            currents[n, 0, j] = g * voltages[n, 0, j] + history[n, 0, j]
            currents[n, 1, j] = g * voltages[n, 1, j] + history[n, 1, j]
            leaving_k = voltages[n, 0, j] + z * currents[n, 0, j]
            leaving_m = voltages[n, 1, j] + z * currents[n, 1, j]
            ring[n, 0, slot + j] = far * leaving_m + near * leaving_k
            ring[n, 1, slot + j] = far * leaving_k + near * leaving_m


class Branch(NamedTuple):
    """Trapezoidal companion of R-L in series: i_n = g (u_n + u_(n-1) + (2L/step - R) i_(n-1)); made by `branch`."""

    conductance: float  # g = 1/(R + 2L/step)
    keep: float  # 2L/step - R


def branch(resistance: float, inductance: float, step: float) -> Branch:
    """Prepare an R-L branch (ohm, H) for steps in s."""
    x = 2.0 * inductance / step
    return Branch(1.0 / (resistance + x), x - resistance)


def branch_impedance(resistance: float, inductance: float, omega: float, step: float) -> complex:
    """Return the impedance of the stepped branch in the sinusoidal steady state, R + j L (2/step) tan(omega step/2)."""
    return complex(resistance, inductance * (2.0 / step) * math.tan(0.5 * omega * step))
