"""How large alpha_hat may be: the sampled linearised robot under the expected-model voltage controller."""

from __future__ import annotations

from functools import lru_cache
from math import cos
from typing import Any, Literal

import numpy as np
from softrig_control.discretise import zero_order_hold
from softrig_core import Array, Params, param
from softrig_core.block.params import flatten

from ..joints import PerJoint, require_positive, spread
from .model import LOWER, UPPER, RehabMotors, Segments

GRAVITY = 9.81


class RobotDrift(Params):
    """Bounds of the drift of the motors."""

    resistance: float = param(0.0, "relative change of R at the end", "", gt=-1.0)
    constants: float = param(0.0, "relative change of K_m and K_b at the end", "", gt=-1.0)


class LinearRobot(Params):
    """Data besides the law on which the limit of alpha_hat depends; defaults: the published robot."""

    segments: Segments = Segments()
    motors: RehabMotors = RehabMotors()
    viscous: PerJoint = param((1.2,), "viscous friction sigma", "N m s/rad")
    torque_constant_side: Literal["motor", "joint"] = param("motor", "side of the gears on which K_m is meant")
    payload: float = param(0.0, "point mass at the foot", "kg", ge=0.0)
    drift: RobotDrift = RobotDrift()
    lower: PerJoint = param(LOWER, "lower ends of the range of motion", "rad")
    upper: PerJoint = param(UPPER, "upper ends of the range of motion", "rad")

    def _check(self) -> None:
        self.motors.table(2)
        spread("lower", self.lower, 2)
        spread("upper", self.upper, 2)
        require_positive("viscous", spread("viscous", self.viscous, 2), or_zero=True)

    def agreed(self) -> dict[str, Any]:
        """Return the quantities on which a plant and the nodes that judge its stability must agree."""
        per_joint = {f"rehab/motors.{name}": values for name, values in self.motors.table(2).items()}
        segments = {f"rehab/segments.{name}": value for name, value in flatten(self.segments).items()}
        return {
            **per_joint,
            **{k: tuple(v) for k, v in segments.items()},
            "rehab/viscous": spread("viscous", self.viscous, 2),
            "rehab/payload": self.payload,
            "rehab/torque_constant_side": self.torque_constant_side,
            "rehab/drift": (self.drift.resistance, self.drift.constants),
            "rehab/range": (spread("lower", self.lower, 2), spread("upper", self.upper, 2)),
        }


PUBLISHED = LinearRobot()


@lru_cache(maxsize=32)
def alpha_hat_limit(
    T: float, lam: float, delayed: bool, applied: bool = False, robot: LinearRobot = PUBLISHED
) -> float:
    """Largest alpha_hat, equal for both joints, with which a robot is stable everywhere in its range of motion.

    Parameters
    ----------
    T : float
        Sampling period, s.
    lam : float
        Rate lambda of the error, 1/s.
    delayed : bool
        Voltages take effect one period late.
    applied : bool
        With a delay: the control law continues from the voltage applied to the motor, not from the one it published.
    robot : LinearRobot
        The published one when absent.

    Returns
    -------
    float
        V s/rad; 0 when no value is stable.
    """

    def stable(alpha_hat: float) -> bool:
        return is_stable(T, (alpha_hat, alpha_hat), (lam, lam), delayed, applied, robot)

    low, high = 0.0, 64.0 * max(1.0, T / 1e-3)
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if stable(middle) else (low, middle)
    return low if low > 1e-3 else 0.0


def is_stable(
    T: float,
    alpha_hat: tuple[float, float],
    lam: tuple[float, float],
    delayed: bool,
    applied: bool,
    robot: LinearRobot = PUBLISHED,
) -> bool:
    """Describe whether a robot is stable everywhere in its range of motion, before and after its drift.

    Parameters
    ----------
    alpha_hat, lam : (float, float)
        Gains of hip (V s/rad) and knee (1/s); the others are those of `alpha_hat_limit`.
    """
    return all(_radius(A, B, alpha_hat, lam, delayed, applied) < 1.0 for A, B in _loops(T, robot))


@lru_cache(maxsize=32)
def _loops(T: float, robot: LinearRobot) -> list[tuple[Array, Array]]:
    """Sampled robots in 16 poses, without drift and with all of it."""
    ranges = zip(spread("lower", robot.lower, 2), spread("upper", robot.upper, 2), strict=True)
    angles = [np.linspace(low, high, 4) for low, high in ranges]
    ends = {(1.0, 1.0), (1.0 + robot.drift.resistance, 1.0 + robot.drift.constants)}
    return [_sampled(q1, q2, T, robot, *end) for end in sorted(ends) for q1 in angles[0] for q2 in angles[1]]


def _sampled(
    q1: float, q2: float, T: float, robot: LinearRobot, resistance: float, constants: float
) -> tuple[Array, Array]:
    """Return the sampled state (q, q', I) and input V of the robot around a pose at rest; R and constants are
    multiplied.
    """
    s = robot.segments
    motors = {k: np.array(v) for k, v in robot.motors.table(2).items()}
    (m1, m2), (l1, l2), (d1, d2), (i1, i2) = s.mass, s.length, s.center, s.inertia
    load = robot.payload
    r = motors["gear"]
    R = motors["resistance"] * resistance
    K_b = motors["back_emf_constant"] * constants / r
    K_m = motors["torque_constant"] * constants / (r if robot.torque_constant_side == "motor" else 1.0)
    shin = m2 * d2 + load * l2  # first moment of shank and payload
    coupling = shin * l1 * cos(q2)
    m22 = i2 + m2 * d2**2 + load * l2**2
    thigh = i1 + m1 * d1**2 + (m2 + load) * l1**2
    mass = np.array([[thigh + m22 + 2.0 * coupling, m22 + coupling], [m22 + coupling, m22]])
    inverse = np.linalg.inv(mass + np.diag(motors["inertia"] / r**2))
    shank = GRAVITY * shin * cos(q1 + q2)
    stiffness = np.array([[GRAVITY * (m1 * d1 + (m2 + load) * l1) * cos(q1) + shank, shank], [shank, shank]])
    A, B = np.zeros((6, 6)), np.zeros((6, 2))
    A[:2, 2:4] = np.eye(2)
    A[2:4, :2] = -inverse @ stiffness
    A[2:4, 2:4] = -inverse @ np.diag(motors["damping"] / r**2 + spread("viscous", robot.viscous, 2))
    A[2:4, 4:] = inverse @ np.diag(K_m)
    A[4:, 2:4] = -np.diag(K_b / motors["inductance"])
    A[4:, 4:] = -np.diag(R / motors["inductance"])
    B[4:] = np.diag(1.0 / motors["inductance"])
    Ad, Bd = zero_order_hold(A.tolist(), B.tolist(), T)
    return np.array(Ad), np.array(Bd)


def _radius(
    A: Array, B: Array, alpha_hat: tuple[float, float], lam: tuple[float, float], delayed: bool, applied: bool
) -> float:
    """Spectral radius of the loop; its state is (q, q', I) and the last voltages."""
    gain = np.diag(alpha_hat)
    C = -np.hstack([gain * lam, gain, np.zeros((2, 2))])  # V_k - V_(k-1) from the state
    identity, zero = np.eye(2), np.zeros((2, 2))
    if not delayed:
        loop = np.block([[A + B @ C, B], [C, identity]])
    elif not applied:
        loop = np.block([[A, B], [C, identity]])
    else:
        loop = np.block([[A, B, np.zeros((6, 2))], [C, zero, identity], [np.zeros((2, 6)), identity, zero]])
    return float(np.abs(np.linalg.eigvals(loop)).max())
