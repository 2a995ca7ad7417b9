"""Rigid-body dynamics of any URDF as a node (pinocchio): matrices, torques and poses for a stream of joint states."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

from softrig_core import Block, BlockParams, Level, Marker, Port, Values, array, joint_state, param, pose, reference

from .joints import PerJoint, require_positive, spread
from .urdf import read_urdf, root_link

Vector = tuple[float, ...]


class RobotDynamicsParams(BlockParams):
    """The robot; by default the 3-link arm."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    urdf: str = param("package://softrig_robots/urdf/manipulator.urdf", "file or package:// URI of the robot")
    joints: tuple[str, ...] = param(
        ("joint1", "joint2", "joint3"),
        "joint names in the URDF's order; without those that mimic another",
        min_length=1,
    )
    tool: str = param("tool", "frame whose pose and Jacobian are given")
    armature: PerJoint = param((0.0,), "rotor inertias J_m/r^2 as seen at the joints", "kg m^2")
    edge_speed: float = param(
        0.05, "speed that smooths the change of sign of the URDF's Coulomb friction", "rad/s", gt=0.0
    )

    def _check(self) -> None:
        from .rigid_body import check_robot

        armature = spread("armature", self.armature, len(self.joints))
        require_positive("armature", armature, or_zero=True)
        check_robot(self.urdf, self.tool, self.joints, armature, mimic=True)


class State(NamedTuple):
    """Positions of the newest query, rad."""

    q: Vector


class RobotDynamics(Block[RobotDynamicsParams]):
    """Answers a joint state with everything a model-based law or a check of one needs.

    Notation of pinocchio: M(q) a + bias(q, v) = tau. The bias has damping and friction of the URDF in it. If joints
    mimic others, all quantities are those of the joints that follow no other: a gripper's two fingers are one joint.
    The Jacobian is that of the tool with axes of the base (linear rows first). The inverse dynamics use the
    acceleration of `reference`, or zero without one. A refused query gets no answer.
    """

    @classmethod
    def ports(cls, params: RobotDynamicsParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Vectors and matrices of the number of joints."""
        joints = params.joints
        n = len(joints)
        return (
            joint_state("joint_query", "joint_query", joints, position="rad", velocity="rad/s", effort="N m"),
            reference("reference", "reference", joints, acceleration="rad/s^2", held=True),
        ), (
            array("mass_matrix", "mass_matrix", {"row": n, "column": n}, "kg m^2", sporadic=True),
            array("bias", "bias", {"joint": n}, "N m", sporadic=True),
            array("gravity", "gravity", {"joint": n}, "N m", sporadic=True),
            array("forward_dynamics", "forward_dynamics", {"joint": n}, "rad/s^2", sporadic=True),
            array("inverse_dynamics", "inverse_dynamics", {"joint": n}, "N m", sporadic=True),
            array(
                "jacobian", "jacobian", {"row": 6, "column": n}, ("m/rad",) * (3 * n) + ("",) * (3 * n), sporadic=True
            ),
            pose("tool_pose", "tool_pose", root_link(read_urdf(params.urdf)), sporadic=True),
        )

    def setup(self) -> None:
        """Load the model."""
        import numpy as np
        import pinocchio as pin
        from softrig_core.kit.dense import solve

        from .rigid_body import check_robot, frame_id
        from .urdf_file import read_robot

        p = self.p
        self._np, self._pin, self._solve = np, pin, solve
        self._urdf = read_urdf(p.urdf)
        self._root = root_link(self._urdf)
        robot = read_robot(self._urdf, p.urdf)
        self._notes = robot.notes
        moved = [(j.mimic.joint, j.mimic.multiplier, j) if j.mimic else (n, 1.0, j) for n, j in robot.joints.items()]
        self._rubbing = [
            (p.joints.index(name), along, j.damping, j.friction) for name, along, j in moved if j.damping or j.friction
        ]
        self._model = check_robot(p.urdf, p.tool, p.joints, spread("armature", p.armature, len(p.joints)), mimic=True)
        self._data = self._model.createData()
        self._tool = frame_id(self._model, p.tool)

    def first(self) -> State:
        """Return the zero state, and report parts of the URDF that have no effect."""
        for note in self._notes:
            self.report(Level.WARN, note, note)
        return State((0.0,) * self._model.nq)

    def update(self, x: State, t: int, *, joint_query: Vector, reference: Vector | None) -> tuple[State, Values]:
        """Answer the query (q, v, tau)."""
        np, pin, model, data, n = self._np, self._pin, self._model, self._data, self._model.nv
        state = np.array(joint_query)
        q, v, tau = state[:n], state[n : 2 * n], state[2 * n :]
        a = np.zeros(n) if reference is None else np.array(reference)
        rubbing = self._rub(v)
        if model.mimicking_joints:  # pinocchio has neither algorithm for them
            forward, upper, nle = None, pin.crba(model, data, q), pin.nonLinearEffects(model, data, q, v).copy()
            jacobian = pin.computeFrameJacobian(model, data, q, self._tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        else:
            forward = pin.aba(model, data, q, v, tau - rubbing)
            pin.computeAllTerms(model, data, q, v)
            upper, nle = data.M, data.nle
            jacobian = pin.getFrameJacobian(model, data, self._tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        upper = np.reshape(upper, (n, n))  # pinocchio fills the upper half only, and returns a vector for one joint
        mass = np.triu(upper) + np.triu(upper, 1).T
        bias = nle + rubbing
        if forward is None:
            forward = self._solve(mass, tau - bias)
        pin.framesForwardKinematics(model, data, q)
        tool = data.oMf[self._tool]
        return State(joint_query[:n]), {
            "mass_matrix": tuple(mass.ravel().tolist()),
            "bias": tuple(bias.tolist()),
            "gravity": tuple(pin.computeGeneralizedGravity(model, data, q).tolist()),
            "forward_dynamics": tuple(np.ravel(forward).tolist()),
            "inverse_dynamics": tuple((pin.rnea(model, data, q, v, a) + rubbing).tolist()),
            "jacobian": tuple(jacobian.ravel().tolist()),
            "tool_pose": (*tool.translation.tolist(), *pin.Quaternion(tool.rotation).coeffs().tolist()),
        }

    def _rub(self, v: Any) -> Any:
        """Return damping and friction of the URDF, N m, as seen at the joints that follow no other."""
        torque = self._np.zeros(len(v))
        for k, along, damping, friction in self._rubbing:
            speed = along * float(v[k])
            torque[k] += along * (damping * speed + friction * math.tanh(speed / self.p.edge_speed))
        return torque

    def refused(self, x: State, t: int) -> tuple[State, Values]:
        """Stay silent: the last answer under a new stamp would pass for that to this query."""
        return x, {}

    def latched(self) -> Mapping[str, str]:
        """Return the text for late joiners: the URDF under the name that every viewer expects."""
        return {"robot_description": self._urdf}

    def markers(self, x: State) -> tuple[Marker, ...]:
        """Draw the robot at the newest query: its links as lines, joints and tool as balls."""
        pin, model, data = self._pin, self._model, self._data
        pin.framesForwardKinematics(model, data, self._np.array(x.q))
        positions = [tuple(data.oMi[i].translation.tolist()) for i in range(model.njoints)]
        tool = tuple(data.oMf[self._tool].translation.tolist())
        lines = [(positions[model.parents[i]], positions[i]) for i in range(1, model.njoints)]
        lines.append((positions[model.frames[self._tool].parentJoint], tool))
        return (
            Marker(self._root, "links", "line_list", tuple(end for line in lines for end in line), 0.05),
            Marker(self._root, "joints", "sphere_list", (*positions[1:], tool), 0.1, (0.9, 0.4, 0.1, 1.0)),
        )
