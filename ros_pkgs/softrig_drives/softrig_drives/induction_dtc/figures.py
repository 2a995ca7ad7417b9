"""Figures of the experiment from sampled signals; `metrics` and `monitor` share them.

A flux is a complex array alpha + j beta in Wb.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vectors = NDArray[np.complex128]


def slope(t: Array, psi: Vectors) -> complex:
    """Give the slope (per s) of the least-squares line through each component, as alpha + j beta."""
    centred = t - t.mean()
    return complex((centred * (psi - psi.mean())).sum() / (centred**2).sum())


def last_revolution(psi: Vectors) -> Vectors | None:
    """Cut a vector that turns around the origin to its last 360 degrees; None when it has turned less."""
    angle = np.unwrap(np.angle(psi))
    before = np.flatnonzero(np.abs(angle - angle[-1]) >= 2.0 * np.pi)
    return psi[before[-1] + 1 :] if before.size else None


def circle(psi: Vectors) -> tuple[complex, float]:
    """Fit a circle.

    ::

        |psi|^2 = 2 Re(conj(centre) psi) + radius^2 - |centre|^2          least squares (Kasa)

    Returns
    -------
    centre : complex
    radius : float
    """
    columns = np.column_stack((2.0 * psi.real, 2.0 * psi.imag, np.ones(psi.size)))
    (alpha, beta, rest), *_ = np.linalg.lstsq(columns, np.abs(psi) ** 2, rcond=None)
    return complex(alpha, beta), float(np.sqrt(rest + alpha**2 + beta**2))


def leg_transitions(switches: Array) -> int:
    """Count the changes of all legs; `switches` has shape (n, 3)."""
    return int(np.count_nonzero(np.diff(switches, axis=0)))


def device_frequency(switches: Array, duration: float) -> float:
    """Mean switching frequency of the six devices in Hz: leg transitions / 6 / duration."""
    return leg_transitions(switches) / 6.0 / duration
