"""The motor's constants and equations, used by the plant and by the Kalman filter."""

from __future__ import annotations

from softrig_control.discretise import Matrix
from softrig_core import Params, param


class MotorConstants(Params):
    """Constants of the motor, Table I of the paper.

    Kt and Ke differ in the paper, so the model loses 70 % of the converted power; kept as published.
    """

    R: float = param(0.4, "armature resistance R", "ohm", gt=0.0)
    L: float = param(2.7, "armature inductance L", "H", gt=0.0)
    J: float = param(0.0004, "inertia J", "kg m^2", gt=0.0)
    b: float = param(0.0022, "viscous friction b (printed as K_b)", "N m s/rad", ge=0.0)
    Kt: float = param(0.015, "torque constant Kt", "N m/A", gt=0.0)
    Ke: float = param(0.05, "back-EMF constant Ke", "V s/rad", gt=0.0)


class SensorConstants(Params):
    """Encoder of the rig."""

    counts_per_rev: int = param(
        1496, "encoder counts per shaft revolution (11 pulses x 4 x gear 34)", ge=1, le=100000000
    )


def state_space(p: MotorConstants) -> tuple[Matrix, Matrix]:
    """Equations of motion as x' = A x + B u with x = (theta, w, i) and u = (v, TL); paper eqs (8), (9).

    ::

        theta' = w
        w'     = (-b w + Kt i - TL)/J
        i'     = (v - R i - Ke w)/L
    """
    a = ((0.0, 1.0, 0.0), (0.0, -p.b / p.J, p.Kt / p.J), (0.0, -p.Ke / p.L, -p.R / p.L))
    b = ((0.0, 0.0), (0.0, -1.0 / p.J), (1.0 / p.L, 0.0))
    return a, b
