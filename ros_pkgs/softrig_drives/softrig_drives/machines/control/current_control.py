"""Current control in rotating coordinates, designed by its bandwidth (IMC), for machines of each kind."""

from __future__ import annotations

import math
from typing import NamedTuple

from softrig_core import BlockParams, param

from .modulation import SQRT3, Modulation, duties, linear_range

Pair = tuple[float, float]


class CurrentControlParams(BlockParams):
    """Bandwidth, modulation, and the assumed inverter."""

    period: float = param(1e-4, "sampling period T_s", "s", gt=0.0, le=0.1)
    current_bandwidth: float = param(
        1256.6370614, "bandwidth alpha_c of the current loop: a step is followed as 1 - exp(-alpha_c t)", "rad/s",
        gt=0.0, live=True,
    )  # fmt: skip
    modulation: Modulation = param("space_vector", "how voltages are converted to duty ratios", live=True)
    delay: int = param(1, "periods until duty ratios act; the angle is corrected for it", ge=0, le=1)


class Integrals(NamedTuple):
    """Integral parts of the voltage in rotating coordinates, V."""

    d: float = 0.0
    q: float = 0.0


class CurrentControl:
    """PI control of two axes, decoupled.

    ::

        u  = k_p (i_ref - i) + I + e,  k_p = alpha_c L,  k_i = alpha_c R
        I' = k_i (i_ref - i + (u_lim - u)/k_p)

    e is the motional voltage that the machine's model gives; u_lim is u, shortened to the largest voltage that the
    modulation can produce from the DC voltage. The closed loop of the model is alpha_c/(s + alpha_c) (internal model
    control).

    Parameters
    ----------
    p : CurrentControlParams
        Bandwidth, modulation, period.
    R : float
        Resistance, ohm.
    L : tuple of float
        Inductances of both axes, H.

    References
    ----------
    L. Harnefors, H.-P. Nee, Model-based current control of AC machines using the internal model control method, IEEE
    Transactions on Industry Applications 34(1), 1998.
    """

    def __init__(self, p: CurrentControlParams, R: float, L: Pair) -> None:
        self._k_d, self._k_q = p.current_bandwidth * L[0], p.current_bandwidth * L[1]
        self._i_d, self._i_q = p.period * R / L[0], p.period * R / L[1]  # k_i T_s/k_p
        self.reach = linear_range(p.modulation)  # largest phase voltage over the DC voltage
        self._modulation: Modulation = p.modulation
        self._ahead = (p.delay + 0.5) * p.period  # time until the middle of the period in which the voltage acts

    def __call__(
        self, x: Integrals, error: Pair, motional: Pair, angle: float, speed: float, u_dc: float
    ) -> tuple[Integrals, Pair, tuple[float, float, float]]:
        """Return the integrals, the voltage u_lim in rotating coordinates (V) and the duty ratios.

        Parameters
        ----------
        error, motional : tuple of float
            i_ref - i in A, and e in V.
        angle, speed : float
            Of the coordinates, rad and rad/s, electrical.
        u_dc : float
            V.
        """
        proportional = self._k_d * error[0], self._k_q * error[1]
        u_d, u_q = proportional[0] + x.d + motional[0], proportional[1] + x.q + motional[1]
        most = self.reach * max(u_dc, 0.0)
        size = math.sqrt(u_d * u_d + u_q * u_q)
        share = most / size if size > most else 1.0
        v_d, v_q = share * u_d, share * u_q
        x = Integrals(x.d + self._i_d * (proportional[0] + v_d - u_d), x.q + self._i_q * (proportional[1] + v_q - u_q))
        angle_ahead = angle + speed * self._ahead
        c, s = math.cos(angle_ahead), math.sin(angle_ahead)
        if u_dc <= 0.0:
            return x, (0.0, 0.0), (0.5, 0.5, 0.5)
        return x, (v_d, v_q), duties(c * v_d - s * v_q, s * v_d + c * v_q, u_dc, self._modulation)


def rotated(currents: tuple[float, ...], angle: float) -> Pair:
    """Return the currents (A) of phases a, b, c in coordinates at an angle (rad); their mean is left out."""
    a, b, c = currents
    alpha, beta = (2.0 * a - b - c) / 3.0, (b - c) / SQRT3
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * alpha + sin * beta, cos * beta - sin * alpha
