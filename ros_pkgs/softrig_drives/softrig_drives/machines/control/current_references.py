"""Currents for a torque: least current (MTPA), and field weakening up to MTPV within the voltage limit."""

from __future__ import annotations

import math

from softrig_core import jit

HALVINGS = 50  # halvings of an interval of cosines, down to the last bits


@jit
def mtpa(torque: float, k: float, L_d: float, L_q: float, psi_f: float) -> tuple[float, float]:
    """Return the least currents i_d, i_q (A) for a torque (N m) of at least zero, k = 3/2 p.

    ::

        i_d = 2 D i_q^2/(psi_f + y),  T = k i_q (psi_f + y)/2,  y = sqrt(psi_f^2 + 4 D^2 i_q^2),  D = L_d - L_q

    T is convex in i_q, so that Newton's method from above goes down to the root without a bound.
    """
    if torque <= 0.0:
        return 0.0, 0.0
    difference = L_d - L_q
    i_q = 1e300
    if psi_f > 0.0:
        i_q = torque / (k * psi_f)
    if difference != 0.0:
        i_q = min(i_q, math.sqrt(torque / (k * abs(difference))))
    y = psi_f
    for _ in range(20):
        y = math.sqrt(psi_f * psi_f + 4.0 * difference * difference * i_q * i_q)
        slope = 0.5 * k * (psi_f + y + 4.0 * difference * difference * i_q * i_q / y)
        change = (0.5 * k * i_q * (psi_f + y) - torque) / slope
        i_q -= change
        if abs(change) <= 1e-15 * i_q:
            break
    return 2.0 * difference * i_q * i_q / (psi_f + y), i_q


@jit
def currents(
    torque: float, psi_max: float, i_max: float, k: float, L_d: float, L_q: float, psi_f: float
) -> tuple[float, float, float]:
    """Return the least currents i_d, i_q (A) for a torque, and the torque (N m) that they make.

    The torque is cut to what |i| <= i_max and |psi| <= psi_max allow: at the least current for the torque (MTPA), where
    current circle and flux ellipse meet, or where the ellipse has the most torque (MTPV). On the ellipse, with
    psi = psi_max (c, s) and c^2 + s^2 = 1::

        T = k psi_max s (a psi_max c + b),  a = 1/L_q - 1/L_d,  b = psi_f/L_d

    which rises from c = 1 until c = 2 a psi_max/(b + sqrt(b^2 + 8 a^2 psi_max^2)), MTPV.

    Parameters
    ----------
    torque : float
        Reference, N m.
    psi_max : float
        Largest stator flux linkage, voltage over electrical speed, Wb.
    i_max : float
        Largest current, A.
    k : float
        3/2 p.
    L_d, L_q, psi_f : float
        Constants of the machine, H and Wb.

    References
    ----------
    S. Morimoto et al., Expansion of operating limits for permanent magnet motor by current vector control considering
    inverter capacity, IEEE Transactions on Industry Applications 26(5), 1990.
    """
    wanted = abs(torque)
    difference = L_d - L_q
    # the most torque of the current
    i_d = 0.0
    if difference != 0.0:
        i_d = 2.0 * difference * i_max * i_max / (
            psi_f + math.sqrt(psi_f * psi_f + 8.0 * difference * difference * i_max * i_max)
        )  # fmt: skip
    i_q = math.sqrt(i_max * i_max - i_d * i_d)
    psi_d, psi_q = psi_f + L_d * i_d, L_q * i_q
    most = k * (psi_d * i_q - psi_q * i_d)
    i_d, i_q = mtpa(min(wanted, most), k, L_d, L_q, psi_f)
    psi_d, psi_q = psi_f + L_d * i_d, L_q * i_q
    if psi_d * psi_d + psi_q * psi_q <= psi_max * psi_max:
        achieved = min(wanted, most)
        return (i_d, i_q, achieved) if torque >= 0.0 else (i_d, -i_q, -achieved)
    # the voltage is the limit: on the ellipse, from c = 1 to MTPV or to the circle
    a, b = 1.0 / L_q - 1.0 / L_d, psi_f / L_d
    least = 0.0
    if a != 0.0:
        least = 2.0 * a * psi_max / (b + math.sqrt(b * b + 8.0 * a * a * psi_max * psi_max))
    i_d, i_q = (psi_max * least - psi_f) / L_d, psi_max * math.sqrt(1.0 - least * least) / L_q
    if i_d * i_d + i_q * i_q > i_max * i_max:
        square, half = L_d * L_d - L_q * L_q, psi_f * L_d
        remaining = psi_f * psi_f + L_q * L_q * i_max * i_max - psi_max * psi_max
        root = half * half - square * remaining
        i_d = -remaining / (half + math.sqrt(root)) if root >= 0.0 and half + root > 0.0 else -i_max
        if i_d <= -i_max:  # the speed is too high for every current within the limit
            return -i_max, 0.0, 0.0
        least = min(max((psi_f + L_d * i_d) / psi_max, -1.0), 1.0)
    most = k * psi_max * math.sqrt(1.0 - least * least) * (a * psi_max * least + b)
    achieved = min(wanted, most)
    low, high = least, 1.0
    for _ in range(HALVINGS):
        c = 0.5 * (low + high)
        if k * psi_max * math.sqrt(1.0 - c * c) * (a * psi_max * c + b) >= achieved:
            low = c
        else:
            high = c
    i_d, i_q = (psi_max * low - psi_f) / L_d, psi_max * math.sqrt(1.0 - low * low) / L_q
    return (i_d, i_q, achieved) if torque >= 0.0 else (i_d, -i_q, -achieved)
