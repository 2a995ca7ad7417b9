"""The arm as a plant: joint torques in, joint states out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from softrig_core import Plant, Port, RunError, Scene, Values, command, joint_state, param, to_s, wrench

from ..joints import PerJoint, spread
from ..urdf import read_urdf
from .model import ArmParams, Vector, compile_arm

FORCE = wrench("tool_force", "tool_force", held=True)
NO_FORCE = (0.0, 0.0, 0.0)


class ArmPlantParams(ArmParams):
    """The robot, where it begins, and the steps of the integration."""

    substeps: int = param(2, "Runge-Kutta steps per period", ge=1, le=100)
    position: PerJoint = param((0.0,), "q(0)", "rad")
    velocity: PerJoint = param((0.0,), "velocity at t = 0", "rad/s")
    torque_limit: PerJoint = param((1e6,), "largest torque of each drive", "N m")
    speed_limit: float = param(100.0, "joint speed above which the run ends", "rad/s", gt=0.0, live=True)

    def _check(self) -> None:
        for name in ("position", "velocity", "torque_limit"):
            spread(name, getattr(self, name), len(self.joints))


class State(NamedTuple):
    """Positions (rad), velocities (rad/s), torques of the period before (N m)."""

    q: Vector
    v: Vector
    torque: Vector


class ArmPlant(Plant[ArmPlantParams]):
    """M(q) q'' + h(q, q') + friction = tau + J(q)^T F, tau limited, held for one period."""

    @classmethod
    def ports(cls, params: ArmPlantParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one torque per joint, and a force on the tool in the base frame."""
        units, joints = params.units(), params.joints
        states = joint_state(
            "joint_states",
            "joint_states",
            joints,
            position=units.position,
            velocity=units.velocity,
            effort=units.effort,
        )
        return (command("joint_torques", "joint_torques", joints, units.effort), FORCE), (states,)

    @classmethod
    def scene(cls, params: ArmPlantParams) -> Scene:
        """Return URDF and frames of the links."""
        from ..scene import RobotScene

        return RobotScene(read_urdf(params.urdf), params.tool)

    def latched(self) -> Mapping[str, str]:
        """Return the text for late joiners: the URDF under the name that every viewer expects."""
        return {"robot_description": self._urdf}

    def setup(self) -> None:
        """Compile the robot."""
        p = self.p
        self._urdf = read_urdf(p.urdf)
        self._step = compile_arm(self._urdf, p.tool, p.joints, p.edge_speed).step
        self._n = len(p.joints)
        self._most = p.each("torque_limit")
        self._last = (p.period / p.substeps, *p.each("armature"), p.payload)

    def first(self) -> State:
        """Return the initial state from the parameters."""
        p = self.p
        return State(p.each("position"), p.each("velocity"), (0.0,) * self._n)

    def outputs(self, x: State, t: int) -> Values:
        """Return positions, velocities, and the torques that were applied."""
        return {"joint_states": (*x.q, *x.v, *x.torque)}

    def advance(self, x: State, t: int, *, joint_torques: Vector, tool_force: Vector | None) -> State:
        """Move by one period."""
        n = self._n
        torque = tuple([min(max(u, -m), m) for u, m in zip(joint_torques, self._most, strict=True)])
        force = NO_FORCE if tool_force is None else tool_force[:3]
        flat = (*x.q, *x.v)
        for _ in range(self.p.substeps):
            flat = self._step((*flat, *torque, *force, *self._last))
        q, v, limit = flat[:n], flat[n:], self.p.speed_limit
        if not (max(v) <= limit and min(v) >= -limit and all(math.isfinite(y) for y in flat)):
            raise RunError(
                f"joint speeds {[float(f'{s:.6g}') for s in v]} rad/s, limit {limit:g}: integration "
                f"stopped at t = {to_s(t):.9g} s, last positions {list(x.q)} rad"
            )
        return State(q, v, torque)
