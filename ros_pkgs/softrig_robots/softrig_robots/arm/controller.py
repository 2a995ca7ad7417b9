"""Model-based controllers for an arm: computed torque, PD with gravity, impedance."""

from __future__ import annotations

from typing import Any, Literal

from softrig_core import Block, Port, Values, command, joint_state, param, reference

from ..joints import PerJoint, require_positive, spread
from ..urdf import read_urdf
from .model import ArmParams, Vector, compile_arm


class ArmControllerParams(ArmParams):
    """The controller and its gains; the robot as the controller assumes it."""

    law: Literal["computed_torque", "pd_gravity", "impedance"] = param(
        "computed_torque", "computed torque, PD with compensation of gravity, or impedance of the tool"
    )
    kp: PerJoint = param(
        (100.0,), "position gain: 1/s^2 (computed torque), N m/rad (PD), a number or one a joint", live=True
    )
    kd: PerJoint = param((20.0,), "velocity gain: 1/s, N m s/rad; with impedance the damping of the joints", live=True)
    stiffness: float = param(500.0, "impedance: stiffness of the tool", "N/m", ge=0.0, live=True)
    damping: float = param(50.0, "impedance: damping of the tool", "N s/m", ge=0.0, live=True)

    def _check(self) -> None:
        for name in ("kp", "kd"):
            require_positive(name, spread(name, getattr(self, name), len(self.joints)), or_zero=True)


class ArmController(Block[ArmControllerParams]):
    r"""Joint torques for a trajectory q_d, with e = q_d - q.

    .. math::
        \tau &= M(q)\,(\ddot q_d + K_d \dot e + K_p e) + h(q, \dot q) + F(\dot q) && \text{computed torque} \\
        \tau &= g(q) + K_p e + K_d \dot e && \text{PD with gravity} \\
        \tau &= g(q) + J(q)^T (K\,(x_d - x) + D\,(\dot x_d - \dot x)) - K_d \dot q && \text{impedance}

    x is the position of the tool, x_d that of q_d, and K_d the damping of joint motions that do not move the tool.
    Where the model is the robot, computed torque leaves e'' + K_d e' + K_p e = 0.

    References
    ----------
    B. Siciliano, L. Sciavicco, L. Villani, G. Oriolo, Robotics: Modelling, Planning and Control, Springer 2009,
    sections 8.5.1, 8.5.2 and 9.2.
    """

    @classmethod
    def ports(cls, params: ArmControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Joint states and a trajectory in, one torque a joint out."""
        units, joints = params.units(), params.joints
        motion = {"position": units.position, "velocity": units.velocity}
        states = joint_state("joint_states", "joint_states", joints, **motion)
        wanted = reference("reference", "reference", joints, **motion, acceleration=units.acceleration)
        return (states, wanted), (command("joint_torques", "joint_torques", joints, units.effort),)

    def setup(self) -> None:
        """Compile the model, spread the gains."""
        p = self.p
        arm = compile_arm(read_urdf(p.urdf), p.tool, p.joints, p.edge_speed)
        self._inverse, self._tool = arm.inverse, arm.tool
        self._n, self._law = len(p.joints), p.law
        self._kp, self._kd = p.each("kp"), p.each("kd")
        self._model = (*p.each("armature"), p.payload)
        self._zeros = (0.0,) * self._n

    def update(self, x: Any, t: int, *, joint_states: Vector, reference: Vector) -> tuple[Any, Values]:
        """Compute the torques."""
        n = self._n
        q, v = joint_states[:n], joint_states[n:]
        q_d, v_d, a_d = reference[:n], reference[n : 2 * n], reference[2 * n :]
        if self._law == "computed_torque":
            a = [self._kp[k] * (q_d[k] - q[k]) + self._kd[k] * (v_d[k] - v[k]) + a_d[k] for k in range(n)]
            return x, {"joint_torques": tuple(self._inverse((*q, *v, *a, *self._model)))}
        gravity = self._inverse((*q, *self._zeros, *self._zeros, *self._model))
        if self._law == "pd_gravity":
            return x, {
                "joint_torques": tuple(
                    [gravity[k] + self._kp[k] * (q_d[k] - q[k]) + self._kd[k] * (v_d[k] - v[k]) for k in range(n)]
                )
            }
        p, now, wanted = self.p, self._tool(q), self._tool(q_d)
        pulls = []
        for axis in range(3):
            speed, target, row = 0.0, 0.0, 3 + axis * n
            for k in range(n):
                speed, target = speed + now[row + k] * v[k], target + wanted[row + k] * v_d[k]
            pulls.append(p.stiffness * (wanted[axis] - now[axis]) + p.damping * (target - speed))
        torques = [
            gravity[k]
            + now[3 + k] * pulls[0] + now[3 + n + k] * pulls[1] + now[3 + 2 * n + k] * pulls[2]
            - self._kd[k] * v[k]
            for k in range(n)
        ]  # fmt: skip
        return x, {"joint_torques": tuple(torques)}

    def refused(self, x: Any, t: int) -> tuple[Any, Values]:
        """Return no torque: the torque for a stale state could move the robot anywhere."""
        return x, {"joint_torques": self._zeros}
