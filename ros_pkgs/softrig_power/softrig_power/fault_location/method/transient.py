"""The two classic baselines: phasors of one cycle, and the first arrivals of the travelling waves."""

from __future__ import annotations

import cmath
import math

import numpy as np
from softrig_core.kit import dense

from ..records.record import RecordError, Status
from .objective import Objective

QUIET = 20.0  # times the largest step of the quiet part make an arrival


def phasor(work: Objective, mode: int) -> float:
    r"""Two-end phasor method on the last whole cycle that the window allows.

    .. math::
        x = \mathrm{Re} \frac1\gamma \mathrm{artanh} \frac{U_R \cosh \gamma L - Z_c I_R \sinh \gamma L - U_S}
            {U_R \sinh \gamma L - Z_c I_R \cosh \gamma L - Z_c I_S}

    Returns
    -------
    float
        km, clipped to the line.
    """
    rate, omega = work.record.rate, 2.0 * math.pi * work.p.frequency
    cycle = round(rate / work.p.frequency)
    last = work.first + work.count - 1
    if last + 1 < cycle:
        raise RecordError(Status.TOO_SHORT, f"too short: a cycle of {cycle} samples does not end at the window's end")
    stretch = np.arange(last + 1 - cycle, last + 1)
    turned = work.ends(mode)[:, stretch] * dense.turn(-omega / rate * stretch)
    u_s, i_s, u_r, i_r = (2.0 / cycle * turned.sum(axis=1)).tolist()
    gamma, zc = work.section.propagation(omega), work.section.characteristic_impedance(omega)
    ch, sh = cmath.cosh(gamma * work.section.length), cmath.sinh(gamma * work.section.length)
    a = u_r * ch - zc * i_r * sh - u_s
    b = u_r * sh - zc * i_r * ch - zc * i_s
    x = (cmath.atanh(a / b) / gamma).real
    return min(max(x, 0.0), work.section.length)


def travelling_wave(work: Objective, mode: int) -> float:
    """Double-ended arrival times: x = (L + v (t_S - t_R))/2, km, clipped to the line; whole samples."""
    arrivals = [_arrival(work, mode, row) for row in (0, 2)]
    x = 0.5 * (work.section.length + work.section.velocity * (arrivals[0] - arrivals[1]) / work.record.rate)
    return min(max(x, 0.0), work.section.length)


def _arrival(work: Objective, mode: int, row: int) -> int:
    """Return the first sample with an outstanding second difference; the first half of the samples is the baseline."""
    bends = np.abs(np.diff(work.ends(mode)[row, : work.first + work.count], 2))
    quiet = float(bends[: work.first // 2].max())
    outliers = np.flatnonzero(bends > QUIET * quiet)
    if not outliers.size:
        raise RecordError(Status.NO_FAULT, "no_fault: no wave front arrives in the window")
    return int(outliers[0]) + 2
