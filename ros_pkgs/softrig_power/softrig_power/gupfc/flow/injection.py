r"""Powers that a GUPFC injects at its buses, the corrected equations of Abasi et al. (2020).

With the Norton current :math:`I_{12} = V_{12}/Z_{12}`, :math:`S_1 = -V_1 I_{12}^*`, :math:`S_2 = V_2 I_{12}^*` and
:math:`\theta_k = \alpha_k - \alpha_{12}`:

.. math::
    P_1 &= \frac{V_1 V_{12}}{|Z|^2} (X \sin\theta_1 - R \cos\theta_1), &
    Q_1 &= -\frac{V_1 V_{12}}{|Z|^2} (X \cos\theta_1 + R \sin\theta_1) \\
    P_2 &= \frac{V_2 V_{12}}{|Z|^2} (-X \sin\theta_2 + R \cos\theta_2), &
    Q_2 &= \frac{V_2 V_{12}}{|Z|^2} (X \cos\theta_2 + R \sin\theta_2) \\
    P_{12} &= P_1 + P_2 + \frac{R}{|Z|^2} V_{12}^2 + \frac{2R}{|Z|^2} \Re[(V_1 - V_2) V_{12}^*]

Printed as (7-a) to (10-a) with R sin in place of R cos, as (13) with the loss subtracted and without the cross term,
and as (14) without the term in :math:`V_1^2`. All functions take and give per unit and are analytic in their arguments,
so that complex steps differentiate them exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np


def series_power(v: Any, alpha: Any, e: Any, f: Any, z: complex, side: int) -> tuple[Any, Any]:
    """P and Q that a series converter injects at one of its buses, (7) to (10) corrected.

    Parameters
    ----------
    v, alpha : float
        Magnitude and angle (rad) of the bus voltage.
    e, f : float
        Real and imaginary part of the converter voltage: V12 cos(theta) = e cos(alpha) + f sin(alpha), so that nothing
        is singular at zero voltage.
    z : complex
        Impedance of the series transformer.
    side : {-1, 1}
        -1 at the bus that the current leaves (1, 3), 1 at the one it reaches (2, 4).
    """
    R, X = z.real, z.imag
    cos, sin = e * np.cos(alpha) + f * np.sin(alpha), e * np.sin(alpha) - f * np.cos(alpha)
    scale = side * v / (R * R + X * X)
    return scale * (R * cos - X * sin), scale * (X * cos + R * sin)


def converter_power(v1: Any, a1: Any, v2: Any, a2: Any, e: Any, f: Any, z: complex) -> Any:
    """Active power that a series converter delivers, (13) corrected.

    Parameters
    ----------
    v1, a1, v2, a2 : float
        Magnitude and angle (rad) of the voltages of its two buses.
    e, f : float
        Real and imaginary part of its voltage.
    z : complex
        Impedance of the series transformer.
    """
    p1, _ = series_power(v1, a1, e, f, z, -1)
    p2, _ = series_power(v2, a2, e, f, z, 1)
    g = z.real / (z.real**2 + z.imag**2)
    cross = e * (v1 * np.cos(a1) - v2 * np.cos(a2)) + f * (v1 * np.sin(a1) - v2 * np.sin(a2))
    return p1 + p2 + g * (e * e + f * f) + 2.0 * g * cross
