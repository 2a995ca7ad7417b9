"""The induction machine in inverse-Gamma form, in stator coordinates."""

from __future__ import annotations

from typing import Any

import numpy as np
from softrig_core import Array, Params, jit, param


class InductionConstants(Params):
    """The 2.2 kW, 400 V, 50 Hz, 5 A, 14.6 N m machine of the examples of motulator.

    `softrig_drives.stator.inverse_gamma` turns a T equivalent circuit into these constants.
    """

    R_s: float = param(3.7, "stator resistance R_s", "ohm", gt=0.0, le=1e4)
    R_R: float = param(2.1, "rotor resistance R_R (inverse-Gamma)", "ohm", gt=0.0, le=1e4)
    L_sigma: float = param(0.021, "leakage inductance L_sigma (inverse-Gamma)", "H", gt=0.0, le=100.0)
    L_M: float = param(0.224, "magnetising inductance L_M (inverse-Gamma)", "H", gt=0.0, le=1e3)
    pole_pairs: int = param(2, "pole pairs p", ge=1, le=1000)

    def numbers(self, r_on: float) -> Array:
        """Return the constants in the order of `rates`; the resistance includes that of the inverter."""
        return np.array([self.R_s + r_on, self.R_R, 1.0 / self.L_sigma, self.R_R / self.L_M, float(self.pole_pairs)])


@jit
def outputs_of(
    s_alpha: float, s_beta: float, r_alpha: float, r_beta: float, _: float, m: Any
) -> tuple[float, float, float]:
    """Return i_alpha, i_beta (A) and the torque T = 3/2 p (psi_s x i_s), N m."""
    i_alpha, i_beta = (s_alpha - r_alpha) * m[2], (s_beta - r_beta) * m[2]
    return i_alpha, i_beta, 1.5 * m[4] * (s_alpha * i_beta - s_beta * i_alpha)


@jit
def rates(
    s_alpha: float, s_beta: float, r_alpha: float, r_beta: float, _: float, omega: float, u_alpha: float, u_beta: float,
    m: Any
) -> tuple[float, float, float, float, float, float, float]:  # fmt: skip
    """Return the rates of the flux linkages of stator and rotor (V), T (N m), i_alpha and i_beta (A).

    ::

        i_s    = (psi_s - psi_R)/L_sigma
        psi_s' = u_s - R_s i_s
        psi_R' = R_R i_s - (R_R/L_M - j p omega) psi_R
    """
    i_alpha, i_beta = (s_alpha - r_alpha) * m[2], (s_beta - r_beta) * m[2]
    w = m[4] * omega
    return (
        u_alpha - m[0] * i_alpha, u_beta - m[0] * i_beta, m[1] * i_alpha - m[3] * r_alpha - w * r_beta,
        m[1] * i_beta - m[3] * r_beta + w * r_alpha, 1.5 * m[4] * (s_alpha * i_beta - s_beta * i_alpha), i_alpha, i_beta
    )  # fmt: skip
