r"""Voltage of four three-level bridges behind phase-shifting transformers, and its spectrum.

Bridge k at the phase angle :math:`\theta`, with :math:`\beta = (\pi - \sigma)/2` (the quasi-48-pulse GTO scheme of the
48-pulse STATCOM, which the pulse function of Abasi et al. (2020) describes):

.. math::
    Q_1 = [(\theta - \beta) \bmod 2\pi < \sigma], \quad Q_4 = [(\theta - \beta - \pi) \bmod 2\pi < \sigma], \quad
    Q_3 = \overline{Q_1}, \quad Q_2 = \overline{Q_4}

The phase voltage is :math:`\tfrac12 V_{dc} (Q_1 - Q_4)`; the phases a, b, c lag each other by a third of a turn and
make the space vector :math:`s_6(\theta)`. The transformers turn it and add the bridges:

.. math::
    S_{48}(\theta) = \frac14 \sum_k e^{j\varphi_k} s_6(\theta - \varphi_k), \qquad
    \varphi = 7.5°, -7.5°, -22.5°, -37.5°

The remaining harmonics have the orders 1 + 24 m (positive: with the fundamental, negative: against it) of amplitude
:math:`\frac{2}{\pi} V_{dc} \sin(n\sigma/2)/n`. The 23rd and 25th are made small by sigma = 172.5 deg alone; (19) to
(24) and (28) to (30) of the paper describe eight six-pulse bridges, where they are absent.

Angles here are those of the fundamental as a space vector: S48 has the fundamental
:math:`\frac{2}{\pi} \sin(\sigma/2) e^{j\theta}`; the phase angle of the pulse function is a quarter turn ahead of it.
"""

from __future__ import annotations

import cmath
import math

import numpy as np
from softrig_core import Array, jit
from softrig_core.kit import dense

SHIFTS = tuple(math.radians(d) for d in (7.5, -7.5, -22.5, -37.5))  # phi of the four bridges
THIRD = 2.0 * math.pi / 3.0
TURN = 2.0 * math.pi
SWITCHES = ("q1", "q2", "q3", "q4")

# one term a bridge and phase: what is subtracted from the angle, and the direction of its contribution
_TERMS = [
    (shift + phase * THIRD - 0.5 * math.pi, cmath.rect(0.25 * 2.0 / 3.0 * 0.5, shift + phase * THIRD))
    for shift in SHIFTS
    for phase in range(3)
]
_LAGS = tuple(lag for lag, _ in _TERMS)
_REAL = tuple(w.real for _, w in _TERMS)
_IMAG = tuple(w.imag for _, w in _TERMS)


def gates(theta: float, sigma: float) -> Array:
    """States of the switches of all bridges.

    Parameters
    ----------
    theta : float
        Angle of the fundamental space vector, rad.
    sigma : float
        Conduction angle, rad.

    Returns
    -------
    ndarray, shape (4, 12)
        Bridge by phase (a, b, c) and switch (Q1, Q2, Q3, Q4); 1 conducts.
    """
    beta = 0.5 * (math.pi - sigma)
    phase = np.array([[(theta - lag) for lag in _LAGS[3 * k : 3 * k + 3]] for k in range(4)])
    q1 = np.mod(phase - beta, TURN) < sigma
    q4 = np.mod(phase - beta - math.pi, TURN) < sigma
    return np.stack([q1, ~q4, ~q1, q4], axis=-1).reshape(4, 12).astype(float)


def vector(theta: float, sigma: float) -> complex:
    """Space vector S48 of the 48-step voltage for V_dc = 1, a sample of it.

    Parameters
    ----------
    theta : float
        Angle of the fundamental, rad.
    sigma : float
        Conduction angle, rad.
    """
    states = gates(theta, sigma).reshape(12, 4)
    return complex(*dense.product([_REAL, _IMAG], states[:, 0] - states[:, 3]).tolist())


def fundamental(sigma: float) -> float:
    """Amplitude of the fundamental for V_dc = 1: (2/pi) sin(sigma/2)."""
    return 2.0 / math.pi * math.sin(0.5 * sigma)


@jit
def _area(x: float, sigma: float) -> float:
    """Integral of the level Q1 - Q4 from 0 to the phase angle x; it has period 2 pi and values from 0 to sigma."""
    x = x % TURN
    beta = 0.5 * (math.pi - sigma)
    if x < beta:
        return 0.0
    if x < beta + sigma:
        return x - beta
    if x < math.pi + beta:
        return sigma
    if x < math.pi + beta + sigma:
        return sigma - (x - math.pi - beta)
    return 0.0


@jit
def integral(theta: float, sigma: float) -> complex:
    """Return the exact integral of S48 over its angle up to theta; its differences over the angle are exact means.

    Parameters
    ----------
    theta : float
        Angle of the fundamental, rad.
    sigma : float
        Conduction angle, rad.
    """
    real = 0.0
    imag = 0.0
    for k in range(12):
        area = _area(theta - _LAGS[k], sigma)
        real += _REAL[k] * area
        imag += _IMAG[k] * area
    return complex(real, imag)


def harmonics(sigma: float, highest: int) -> dict[int, float]:
    """Spectrum of S48 in closed form.

    Parameters
    ----------
    sigma : float
        Conduction angle, rad.
    highest : int
        Largest order.

    Returns
    -------
    dict of int to float
        Order n (negative: turns against the fundamental) to amplitude for V_dc = 1, (2/pi) |sin(n sigma/2)/n|.
    """
    orders = [n for m in range(1, highest // 24 + 2) for n in (1 - 24 * m, 1 + 24 * m) if abs(n) <= highest]
    return {n: 2.0 / math.pi * abs(math.sin(0.5 * n * sigma) / n) for n in (1, *orders)}


def distortion(sigma: float, highest: int = 0) -> float:
    """Total harmonic distortion of S48 in % of the fundamental.

    Parameters
    ----------
    sigma : float
        Conduction angle, rad.
    highest : int
        Largest order that counts; 0: all of them, from the exact rms value of the waveform.
    """
    first = fundamental(sigma)
    if highest:
        square = dense.total(a * a for n, a in harmonics(sigma, highest).items() if n != 1)
    else:
        square = _mean_square(sigma) - first * first
    return 100.0 * math.sqrt(max(0.0, square)) / first


def _mean_square(sigma: float) -> float:
    """Return the mean of |S48|^2 over a turn; the vector is constant between its edges."""
    beta = 0.5 * (math.pi - sigma)
    corners = (beta, beta + sigma, beta + math.pi, beta + math.pi + sigma)
    edges = sorted({(lag + corner) % TURN for lag in _LAGS for corner in corners})
    widths = np.diff([*edges, edges[0] + TURN])
    middle = np.array(edges) + 0.5 * widths
    pieces = (w * abs(vector(m, sigma)) ** 2 for w, m in zip(widths, middle, strict=True) if w > 1e-12)
    return float(dense.total(pieces) / TURN)
