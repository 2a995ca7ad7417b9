"""The electrically driven 3-link arm, or any arm described by a URDF.

Equations (1)-(3) of the paper; the disturbance d is a voltage drop in front of the armature.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from softrig_core import Level, Params, Port, command, joint_state, param, to_ns

from ..driven_robot import LARGEST_STEP, DrivenRobot, DrivenRobotParams, Friction, Vector
from ..joints import PerJoint, motor_names, spread
from ..urdf import read_urdf
from .model import Links, manipulator_urdf

if TYPE_CHECKING:
    from ..urdf_file import Joint

JOINTS = ("joint1", "joint2", "joint3")


class VoltageStep(Params):
    """A step of the disturbance voltage d, a drop in front of the armature."""

    amplitude: PerJoint = param((2.0,), "voltage; one number for all joints, or one per joint", "V", live=True)
    time: float = param(6.0, "time at which it begins", "s", ge=0.0, live=True)


class ManipulatorParams(DrivenRobotParams):
    """Published arm and experiment; `urdf` and `joints` select another arm."""

    joints: tuple[str, ...] = param(JOINTS, "joint names, beginning at the base", min_length=1)
    urdf: str = param("", "file or package:// URI of another arm, with a frame `tool`; empty: built from `links`")
    links: Links = Links()
    position: PerJoint = param((0.0,), "q(0)", "rad")
    velocity: PerJoint = param((0.0,), "velocity at t = 0", "rad/s")
    edge_speed: float = param(
        0.05, "speed that smooths the change of sign of the URDF's Coulomb friction", "rad/s", gt=0.0
    )
    limits: Literal["report", "act"] = param(
        "report",
        "limits of the URDF: `report` when they are passed, or let them `act`: inelastic end stops at lower and upper, "
        "drives whose torque saturates at effort",
    )
    disturbance: VoltageStep = VoltageStep()

    def _check(self) -> None:
        n = len(self.joints)
        self.motors.table(n)
        for name, values in (
            ("position", self.position),
            ("velocity", self.velocity),
            ("disturbance.amplitude", self.disturbance.amplitude),
        ):
            spread(name, values, n)
        if self.urdf:
            self._check_urdf()
        elif self.limits == "act":
            raise ValueError("limits: act needs a robot with limits: give its file as urdf")
        elif len(self.links.mass) != n:
            raise ValueError(f"joints = {list(self.joints)} for {len(self.links.mass)} links, expected one a link")

    def _check_urdf(self) -> None:
        """Refuse a robot that does not match the parameters or cannot be simulated with this step."""
        from ..rigid_body import check_robot, fastest_rubbing
        from ..urdf_file import read_robot

        motors = self.motors.table(len(self.joints))
        armature = [J / r**2 for J, r in zip(motors["inertia"], motors["gear"], strict=True)]
        model = check_robot(self.urdf, "tool", self.joints, armature)
        joints = read_robot(read_urdf(self.urdf)).joints
        rubbing = [joints[name].damping + joints[name].friction / self.edge_speed for name in self.joints]
        fastest = fastest_rubbing(model, self.start("position"), rubbing)
        least = math.ceil(self.period * fastest / LARGEST_STEP)
        if self.substeps < least:
            raise ValueError(
                f"substeps = {self.substeps}: expected at least {least} for damping and friction of {self.urdf}, which "
                f"slow joints down at up to {fastest:.4g} 1/s; a higher edge_speed makes friction less steep"
            )
        if self.limits == "act":
            for name, q in zip(self.joints, self.start("position"), strict=True):
                joint = joints[name]
                if not joint.lower <= q <= joint.upper or joint.effort == 0.0:
                    raise ValueError(
                        f"limits: act needs joint {name} within its limits and an effort above 0: it begins at {q:g} "
                        f"and {self.urdf} has {joint.lower:g} to {joint.upper:g} and effort {joint.effort:g}"
                    )

    def start(self, name: Literal["position", "velocity"]) -> Vector:
        """Return q(0) or its rate, for mimic joints by their constraint.

        Raises
        ------
        ValueError
            The value of a mimic joint contradicts its constraint.
        """
        configured: Vector = getattr(self, name)
        values = list(spread(name, configured, len(self.joints)))
        if not self.urdf:
            return tuple(values)
        from ..rigid_body import ties

        for follower, leader, multiplier, offset in ties(read_urdf(self.urdf), self.joints):
            wanted = multiplier * values[leader] + (offset if name == "position" else 0.0)
            if len(configured) > 1 and abs(values[follower] - wanted) > 1e-9 * max(1.0, abs(wanted)):
                raise ValueError(
                    f"{name} = {list(configured)}: {self.joints[follower]} mimics {self.joints[leader]} and begins at "
                    f"{wanted:g}; give that, or one value for all joints that follow no other"
                )
            values[follower] = wanted
        return tuple(values)


class ManipulatorPlant(DrivenRobot[ManipulatorParams]):
    """Motor voltages in, joint and motor states out."""

    @classmethod
    def ports(cls, params: ManipulatorParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one motor per joint."""
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
        """Return q(0) and its rate."""
        return self.p.start("position"), self.p.start("velocity")

    def friction(self) -> Friction:
        """Return the friction of the URDF."""
        if not self._joints:
            return super().friction()
        coulomb = tuple(joint.friction for joint in self._joints)
        return Friction(coulomb, coulomb, tuple(joint.damping for joint in self._joints), 1.0, self.p.edge_speed)

    def stops(self) -> bool:
        """Return whether the limits of the URDF act."""
        return bool(self._joints) and self.p.limits == "act"

    def setup(self) -> None:
        """Read the URDF, and prepare the disturbance."""
        self._joints: tuple[Joint, ...] = ()
        self._notes: tuple[str, ...] = ()
        if self.p.urdf:
            from ..urdf_file import read_robot

            robot = read_robot(read_urdf(self.p.urdf), self.p.urdf)
            self._joints, self._notes = tuple(robot.joints[name] for name in self.p.joints), robot.notes
        super().setup()
        none = (0.0,) * self.n
        self._before = (none, none)
        self._after = (spread("disturbance.amplitude", self.p.disturbance.amplitude, self.n), none)
        self._time = to_ns(self.p.disturbance.time)

    def loads(self, t: int) -> tuple[Vector, Vector]:
        """Return the disturbance voltages; no load torque."""
        return self._before if t < self._time else self._after

    def outputs(self, x: Any, t: int) -> Mapping[str, Vector]:
        """Return joint and motor states; efforts are the torques of the drives, within the limits if these act."""
        result = super().outputs(x, t)
        if not self.stops():
            return result
        n, states = self.n, result["joint_states"]
        efforts = (min(max(f, -j.effort), j.effort) for f, j in zip(states[2 * n :], self._joints, strict=True))
        return {"joint_states": (*states[: 2 * n], *efforts), "motor_states": result["motor_states"]}

    def first(self) -> Any:
        """Report items of the URDF without effect, and begin."""
        for note in self._notes:
            self.report(Level.WARN, note, note)
        return super().first()

    def advance(self, x: Any, t: int, *, motor_command: Vector) -> Any:
        """Move, and report limits of the URDF that are passed."""
        x = super().advance(x, t, motor_command=motor_command)
        if self._joints:
            self._watch(x)
        return x

    def _watch(self, x: Any) -> None:
        """Report each limit that is passed, once a joint and kind."""
        for name, joint, q, v, i, k in zip(
            self.p.joints, self._joints, x.q, x.v, x.i, self.torque_per_ampere, strict=True
        ):
            if not joint.lower <= q <= joint.upper:
                self._passed(name, "position", q, joint.lower, joint.upper)
            if not -joint.velocity <= v <= joint.velocity:
                self._passed(name, "velocity", v, -joint.velocity, joint.velocity)
            if not -joint.effort <= k * i <= joint.effort:
                self._passed(name, "effort", k * i, -joint.effort, joint.effort)

    def _passed(self, joint: str, kind: str, value: float, lower: float, upper: float) -> None:
        self.report(
            Level.WARN,
            f"{kind} limit of {joint}",
            f"{joint}: {kind} {value:.4g} is outside of {lower:g} to {upper:g}, the limits of {self.p.urdf}",
        )
