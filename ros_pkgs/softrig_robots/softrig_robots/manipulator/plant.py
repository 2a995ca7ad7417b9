"""The electrically driven 3-link arm, or any arm given as URDF.

Equations (1)-(3) of the paper; the disturbance d is a voltage drop in front of the armature.
"""

from __future__ import annotations

from typing import Self

from pydantic import model_validator
from softrig_core import Params, Port, command, executable, joint_state, param, to_ns

from ..driven_robot import DrivenRobot, DrivenRobotParams, Vector
from ..joints import PerJoint, motor_names, spread
from ..urdf import read_urdf
from .model import Links, manipulator_urdf

JOINTS = ("joint1", "joint2", "joint3")


class VoltageStep(Params):
    """A step of the disturbance voltage d, a drop in front of the armature."""

    amplitude: PerJoint = param((2.0,), "size; one number for all joints or one a joint", "V", live=True)
    time: float = param(6.0, "when it begins", "s", ge=0.0, live=True)


class ManipulatorParams(DrivenRobotParams):
    """Published arm and experiment; `urdf` and `joints` bring another arm."""

    joints: tuple[str, ...] = param(JOINTS, "joint names, from the base on", min_length=1)
    urdf: str = param("", "file or package:// URI of another arm, with a frame `tool`; empty: built from `links`")
    links: Links = Links()
    position: PerJoint = param((0.0,), "q(0)", "rad")
    velocity: PerJoint = param((0.0,), "velocity at t = 0", "rad/s")
    disturbance: VoltageStep = VoltageStep()

    @model_validator(mode="after")
    def _fits(self) -> Self:
        n = len(self.joints)
        self.motors.table(n)
        for name, values in (
            ("position", self.position),
            ("velocity", self.velocity),
            ("disturbance.amplitude", self.disturbance.amplitude),
        ):
            spread(name, values, n)
        if self.urdf:
            from ..rigid_body import check_robot

            check_robot(self.urdf, "tool", self.joints)
        elif len(self.links.mass) != n:
            raise ValueError(f"joints = {list(self.joints)} for {len(self.links.mass)} links, expected one a link")
        return self


class ManipulatorPlant(DrivenRobot[ManipulatorParams]):
    """Motor voltages in, joint and motor states out."""

    @classmethod
    def ports(cls, params: ManipulatorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One motor a joint."""
        motors = motor_names(params.joints)
        return (command("motor_command", "motor_command", motors, "V", also=params.joints),), (
            joint_state("joint_states", "joint_states", params.joints, position="rad", velocity="rad/s", effort="N m"),
            joint_state("motor_states", "motor_states", motors, position="rad", velocity="rad/s", effort="A"),
        )

    def joints(self) -> tuple[str, ...]:
        """Those of the parameters."""
        return self.p.joints

    @classmethod
    def robot(cls, params: ManipulatorParams) -> str:
        """Read or write the URDF."""
        return read_urdf(params.urdf) if params.urdf else manipulator_urdf(params.links, params.joints)

    def initial(self) -> tuple[Vector, Vector]:
        """Give q(0) and its rate."""
        return spread("position", self.p.position, self.n), spread("velocity", self.p.velocity, self.n)

    def setup(self) -> None:
        """Prepare the disturbance."""
        super().setup()
        none = (0.0,) * self.n
        self._before = (none, none)
        self._after = (spread("disturbance.amplitude", self.p.disturbance.amplitude, self.n), none)
        self._time = to_ns(self.p.disturbance.time)

    def loads(self, t: int) -> tuple[Vector, Vector]:
        """Give the disturbance voltages; no load torque."""
        return self._before if t < self._time else self._after


main = executable(ManipulatorPlant)
