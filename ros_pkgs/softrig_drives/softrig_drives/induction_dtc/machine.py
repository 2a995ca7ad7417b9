"""Induction machine in inverse-Gamma form: constants and equations, written once as casadi expressions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from softrig_core import Params, param, rk4

from ..stator import inverse_gamma as inverse_gamma

if TYPE_CHECKING:
    import casadi as ca


class MachineConstants(Params):
    """The 2.2 kW, 400 V, 50 Hz, 5 A, 14.6 N m machine of the examples of motulator."""

    R_s: float = param(3.7, "stator resistance R_s", "ohm", gt=0.0)
    R_R: float = param(2.1, "rotor resistance R_R (inverse-Gamma)", "ohm", gt=0.0)
    L_sigma: float = param(0.021, "leakage inductance L_sigma (inverse-Gamma)", "H", gt=0.0)
    L_M: float = param(0.224, "magnetising inductance L_M (inverse-Gamma)", "H", gt=0.0)
    pole_pairs: int = param(2, "pole pairs p", ge=1, le=100)
    J: float = param(0.015, "inertia J of motor and load", "kg m^2", gt=0.0)
    B: float = param(0.0, "viscous friction B", "N m s/rad", ge=0.0)


STATES = 6  # psi_s alpha and beta, psi_R alpha and beta, omega, theta
INPUTS = 3
OUTPUTS = 4


def numbers(m: MachineConstants, h: float) -> tuple[float, ...]:
    """Return the constants in the order of `step_function`: R_s, R_R, 1/L_sigma, R_R/L_M, p, 1/J, B, h."""
    return (m.R_s, m.R_R, 1.0 / m.L_sigma, m.R_R / m.L_M, float(m.pole_pairs), 1.0 / m.J, m.B, h)


def electric(x: Sequence[Any], inv_L_sigma: Any, p: Any) -> tuple[Any, Any, Any]:
    """Return i_alpha, i_beta (A) and T_e (N m) of a state, of numbers or casadi expressions."""
    s_alpha, s_beta, r_alpha, r_beta = x[:4]
    i_alpha, i_beta = (s_alpha - r_alpha) * inv_L_sigma, (s_beta - r_beta) * inv_L_sigma
    return i_alpha, i_beta, 1.5 * p * (s_alpha * i_beta - s_beta * i_alpha)


def measured(x: Sequence[Any], inv_L_sigma: Any, p: Any) -> tuple[Any, Any, Any, Any]:
    """Return i_a, i_b, i_c (A) and T_e (N m) of a state."""
    i_alpha, i_beta, T_e = electric(x, inv_L_sigma, p)
    i_b = -0.5 * i_alpha + 0.75**0.5 * i_beta
    return i_alpha, i_b, 0.0 - i_alpha - i_b, T_e  # at rest 0, not -0


@lru_cache(maxsize=16)
def step_function(substeps: int = 1) -> ca.Function:
    """Return one Runge-Kutta step of order 4 per sub-step with the voltage and the load torque held.

    In the stator frame, amplitude-invariant space vectors, x = (psi_s, psi_R, omega, theta)::

        i_s       = (psi_s - psi_R)/L_sigma
        psi_s'    = u_s - R_s i_s
        psi_R'    = R_R i_s - (R_R/L_M - j p omega) psi_R
        T_e       = 3/2 p (psi_s_alpha i_s_beta - psi_s_beta i_s_alpha)
        J omega'  = T_e - T_L - B omega
        theta'    = omega

    Parameters
    ----------
    substeps : int
        Steps of size h in one call.

    Returns
    -------
    casadi.Function
        x (6: psi_s alpha, beta, psi_R alpha, beta in Wb, omega in rad/s, theta in rad), u (3: u_alpha, u_beta
        in V, T_L in N m), c (`numbers`) -> x after the steps, y (4: i_a, i_b, i_c in A, T_e in N m) there.
    """
    import casadi as ca

    x, u, c = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS), ca.SX.sym("c", 8)
    u_alpha, u_beta, T_L = ca.vertsplit(u)
    R_s, R_R, inv_L_sigma, R_R_by_L_M, p, inv_J, B, h = ca.vertsplit(c)

    def derivative(x: ca.SX) -> ca.SX:
        _, _, r_alpha, r_beta, omega, _ = states = ca.vertsplit(x)
        i_alpha, i_beta, T_e = electric(states, inv_L_sigma, p)
        return ca.vertcat(
            u_alpha - R_s * i_alpha,
            u_beta - R_s * i_beta,
            R_R * i_alpha - R_R_by_L_M * r_alpha - p * omega * r_beta,
            R_R * i_beta - R_R_by_L_M * r_beta + p * omega * r_alpha,
            (T_e - T_L - B * omega) * inv_J,
            omega,
        )

    after = rk4(derivative, x, h, substeps)
    y = ca.vertcat(*measured(ca.vertsplit(after), inv_L_sigma, p))
    return ca.Function("induction_machine", [x, u, c], [after, y])
