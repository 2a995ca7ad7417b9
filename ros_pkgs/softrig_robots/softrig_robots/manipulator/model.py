"""The 3-link arm's tables and its URDF.

The paper gives kinematics and motors. The link table is the one that its authors are understood to use for their
articulated robot; it could not be verified against a printed source.
"""

from __future__ import annotations

from math import cos, pi, sin

from softrig_control.hardware import hardware_tag
from softrig_core import Params, param

from ..urdf import Link, Vector, check_inertia, robot_urdf


class Links(Params):
    """Denavit-Hartenberg parameters (standard, distal) and inertias of a serial revolute arm.

    Frame i sits at the end of link i. Joint i turns about z of frame i - 1.
    """

    d: tuple[float, ...] = param((0.28, 0.0, 0.0), "link offsets d_i", "m", each=(-100.0, 100.0))
    a: tuple[float, ...] = param((0.0, 0.76, 0.93), "link lengths a_i", "m", each=(-100.0, 100.0))
    alpha: tuple[float, ...] = param((pi / 2.0, 0.0, 0.0), "link twists alpha_i", "rad", each=(-7.0, 7.0))
    alpha_0: float = param(
        0.0,
        "twist in front of joint 1; with pi/2 an arm with parallel joints moves in a vertical plane",
        "rad",
        ge=-7.0,
        le=7.0,
    )
    mass: tuple[float, ...] = param((19.0, 18.18, 10.99), "masses m_i", "kg", min_length=1, each=(0.0, 1e5))
    center: tuple[float, ...] = param(
        (0.0, -0.22, 0.0, -0.51, 0.0, 0.0, -0.67, 0.0, 0.0),
        "centres of mass in frame i: x, y, z link after link",
        "m",
        each=(-100.0, 100.0),
    )
    inertia: tuple[float, ...] = param(
        (0.34, 0.36, 0.31, 0.18, 1.32, 1.31, 0.07, 0.92, 0.93),
        "Ixx, Iyy, Izz about the centre of mass in axes of frame i, link after link",
        "kg m^2",
        each=(0.0, 1e7),
    )

    def _check(self) -> None:
        n = len(self.mass)
        for name, size in (("d", n), ("a", n), ("alpha", n), ("center", 3 * n), ("inertia", 3 * n)):
            values = getattr(self, name)
            if len(values) != size:
                raise ValueError(f"links.{name} has {len(values)} values, expected {size} for {n} links")
        for i in range(n):
            check_inertia(
                f"links.mass[{i}]", self.mass[i], f"links.inertia of link {i + 1}", self.inertia[3 * i : 3 * i + 3]
            )


def manipulator_urdf(table: Links | None = None, joints: tuple[str, ...] = ("joint1", "joint2", "joint3")) -> str:
    """Write the arm as URDF.

    In URDF a link's frame is that of its own joint, z along the joint's axis: frame i - 1 of the table turned by
    q_i. Frame i is then a fixed translation (a, 0, d) and a turn alpha about x away.

    Parameters
    ----------
    table : Links, optional
        The published arm when absent.
    joints : tuple of str
        Joint names.
    """
    table = Links() if table is None else table
    links = []
    origin: Vector = (0.0, 0.0, 0.0)
    twist = table.alpha_0
    for i, joint in enumerate(joints):
        x, y, z = table.center[3 * i : 3 * i + 3]
        alpha = table.alpha[i]
        tip = (table.a[i], 0.0, table.d[i])
        ixx, iyy, izz = table.inertia[3 * i : 3 * i + 3]
        links.append(
            Link(
                name=f"link{i + 1}",
                joint=joint,
                origin=origin,
                rotation=(twist, 0.0, 0.0),
                axis=(0.0, 0.0, 1.0),
                limits=(-2.0 * pi, 2.0 * pi),
                mass=table.mass[i],
                center=(tip[0] + x, cos(alpha) * y - sin(alpha) * z, tip[2] + sin(alpha) * y + cos(alpha) * z),
                turn=(alpha, 0.0, 0.0),
                inertia=(ixx, iyy, izz),
                tip=tip,
            )
        )
        origin, twist = tip, alpha
    hardware = hardware_tag("manipulator", joints, "/joint_states", "/motor_command")
    return robot_urdf("manipulator", links, "tool", origin, (twist, 0.0, 0.0), hardware)
