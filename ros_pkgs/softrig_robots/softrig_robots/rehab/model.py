"""The rehabilitation robot's tables and its URDF.

q = 0 is the leg hanging straight down; hip flexion swings it forward (+x), the knee bends with negative angles.
"""

from __future__ import annotations

from math import cos, radians, sin

from softrig_control.hardware import hardware_tag
from softrig_core import Params, param

from ..driven_robot import Motors
from ..joints import PerJoint, require_positive
from ..urdf import Link, check_inertia, robot_urdf

JOINTS = ("hip", "knee")
LOWER = (radians(-30.0), radians(-90.0))
UPPER = (radians(120.0), 0.0)
HIP_HEIGHT = 1.0  # m; only a viewer sees it


class Segments(Params):
    """Thigh and shank with foot, each two numbers."""

    mass: tuple[float, float] = param((5.5, 5.0), "masses m_i", "kg", each=(0.0, 1e4))
    length: tuple[float, float] = param((0.5, 0.45), "lengths l_i", "m", each=(0.0, 100.0))
    center: tuple[float, float] = param(
        (0.45, 0.40), "distances d_i from the joint to the centre of mass", "m", each=(0.0, 100.0)
    )
    inertia: tuple[float, float] = param(
        (0.25, 0.20), "moments of inertia I_i about the centre of mass", "kg m^2", each=(0.0, 1e6)
    )

    def _check(self) -> None:
        require_positive("segments.length", self.length)
        require_positive("segments.center", self.center, or_zero=True)
        for i in range(2):
            check_inertia(f"segments.mass[{i}]", self.mass[i], f"segments.inertia[{i}] as a rod", rod(self.inertia[i]))


class RehabMotors(Motors):
    """Table I of the paper; rotor inertia and damping are not printed there."""

    resistance: PerJoint = param((4.0,), "armature resistance R", "Ohm")
    inductance: PerJoint = param((2.5e-3,), "armature inductance L", "H")
    torque_constant: PerJoint = param((4.32,), "torque constant K_m", "N m/A")
    back_emf_constant: PerJoint = param((0.287,), "back-emf constant K_b", "V s/rad")
    gear: PerJoint = param((1.0 / 16.0,), "gear coefficient r: joint speed over motor speed", "")


def rod(inertia: float) -> tuple[float, float, float]:
    """Principal moments of a slender segment along z; in the plane of motion only the first two matter."""
    return (inertia, inertia, 0.1 * inertia)


def rehab_urdf(
    segments: Segments | None = None, lower: tuple[float, ...] = LOWER, upper: tuple[float, ...] = UPPER
) -> str:
    """Write the leg as URDF: joints turn about -y, z is up, the last frame is called ``foot``.

    Parameters
    ----------
    segments : Segments, optional
        The published leg when absent.
    lower, upper : tuple of 2 floats
        Range of motion, rad.
    """
    segments = Segments() if segments is None else segments
    links = []
    origin = (0.0, 0.0, HIP_HEIGHT)
    for i, (joint, name) in enumerate(zip(JOINTS, ("thigh", "shank"), strict=True)):
        tip = (0.0, 0.0, -segments.length[i])
        links.append(
            Link(
                name=name,
                joint=joint,
                origin=origin,
                rotation=(0.0, 0.0, 0.0),
                axis=(0.0, -1.0, 0.0),
                limits=(lower[i], upper[i]),
                mass=segments.mass[i],
                center=(0.0, 0.0, -segments.center[i]),
                turn=(0.0, 0.0, 0.0),
                inertia=rod(segments.inertia[i]),
                tip=tip,
            )
        )
        origin = tip
    hardware = hardware_tag("rehab_leg", JOINTS, "/joint_states", "/motor_command")
    return robot_urdf("rehab_leg", links, "foot", origin, hardware=hardware)


def foot_jacobian(q1: float, q2: float, l1: float, l2: float) -> tuple[float, float, float, float]:
    """Return dx/dq1, dx/dq2, dz/dq1, dz/dq2 of the foot (x forward, z up), m/rad."""
    x2, z2 = l2 * cos(q1 + q2), l2 * sin(q1 + q2)
    return l1 * cos(q1) + x2, x2, l1 * sin(q1) + z2, z2
