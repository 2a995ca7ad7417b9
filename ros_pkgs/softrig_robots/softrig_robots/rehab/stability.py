"""How large alpha_hat may be: the sampled linearised robot under the expected-model voltage controller."""

from __future__ import annotations

from functools import lru_cache
from math import cos

import numpy as np
from numpy.typing import NDArray
from softrig_control.discretise import zero_order_hold

from .model import LOWER, UPPER, RehabMotors, Segments
from .plant import JointFriction

Array = NDArray[np.float64]
GRAVITY = 9.81


@lru_cache(maxsize=32)
def alpha_hat_limit(T: float, lam: float, delayed: bool, applied: bool = False) -> float:
    """Largest alpha_hat with which the published robot is stable everywhere in its range of motion.

    Parameters
    ----------
    T : float
        Sampling period, s.
    lam : float
        Rate lambda of the error, 1/s.
    delayed : bool
        Voltages take effect one period late.
    applied : bool
        With a delay: the law goes on from the voltage that the motor got, not from the one it sent.

    Returns
    -------
    float
        V s/rad; 0 when no value is stable.
    """
    angles = [np.linspace(low, high, 4) for low, high in zip(LOWER, UPPER, strict=True)]
    loops = [_sampled(q1, q2, T) for q1 in angles[0] for q2 in angles[1]]

    def stable(alpha_hat: float) -> bool:
        return all(_radius(A, B, alpha_hat, lam, delayed, applied) < 1.0 for A, B in loops)

    low, high = 0.0, 64.0 * max(1.0, T / 1e-3)
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low if low > 1e-3 else 0.0


def _sampled(q1: float, q2: float, T: float) -> tuple[Array, Array]:
    """State (q, q', I) and input V of the robot around a pose at rest, sampled."""
    s = Segments()
    motors = {k: v[0] for k, v in RehabMotors().table(2).items()}
    (m1, m2), (l1, _), (d1, d2), (i1, i2) = s.mass, s.length, s.center, s.inertia
    r = motors["gear"]
    viscous = JointFriction().viscous[0]
    coupling = m2 * l1 * d2 * cos(q2)
    m22 = i2 + m2 * d2**2
    mass = np.array([[i1 + m1 * d1**2 + m2 * l1**2 + m22 + 2.0 * coupling, m22 + coupling], [m22 + coupling, m22]])
    inverse = np.linalg.inv(mass + np.eye(2) * motors["inertia"] / r**2)
    shank = GRAVITY * m2 * d2 * cos(q1 + q2)
    stiffness = np.array([[GRAVITY * (m1 * d1 + m2 * l1) * cos(q1) + shank, shank], [shank, shank]])
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2] = -inverse @ stiffness
    A[2:4, 2:4] = -inverse * (motors["damping"] / r**2 + viscous)
    A[2:4, 4:] = inverse * motors["torque_constant"] / r
    A[4:, 2:4] = -np.eye(2) * motors["back_emf_constant"] / r / motors["inductance"]
    A[4:, 4:] = -np.eye(2) * motors["resistance"] / motors["inductance"]
    B[4:] = np.eye(2) / motors["inductance"]
    Ad, Bd = zero_order_hold(A.tolist(), B.tolist(), T)
    return np.array(Ad), np.array(Bd)


def _radius(A: Array, B: Array, alpha_hat: float, lam: float, delayed: bool, applied: bool) -> float:
    """Spectral radius of the loop; its state is (q, q', I) and the last voltages."""
    C = -alpha_hat * np.hstack([lam * np.eye(2), np.eye(2), np.zeros((2, 2))])  # V_k - V_(k-1) from the state
    one, zero = np.eye(2), np.zeros((2, 2))
    if not delayed:
        loop = np.block([[A + B @ C, B], [C, one]])
    elif not applied:
        loop = np.block([[A, B], [C, one]])
    else:
        loop = np.block([[A, B, np.zeros((6, 2))], [C, zero, one], [np.zeros((2, 6)), one, zero]])
    return float(np.abs(np.linalg.eigvals(loop)).max())
