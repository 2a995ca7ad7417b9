"""Rigid-body dynamics of any URDF as a node (pinocchio): matrices, torques and poses for a stream of joint states."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Self

from pydantic import model_validator
from softrig_core import Block, BlockParams, Marker, Port, array, executable, joint_state, param, pose, reference

from .joints import PerJoint, require_positive, spread
from .urdf import read_urdf, root_link

Vector = tuple[float, ...]


class RobotDynamicsParams(BlockParams):
    """Which robot; the 3-link arm when nothing is given."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=100.0)
    urdf: str = param("package://softrig_robots/urdf/manipulator.urdf", "file or package:// URI of the robot")
    joints: tuple[str, ...] = param(("joint1", "joint2", "joint3"), "joint names in the URDF's order", min_length=1)
    tool: str = param("tool", "frame whose pose and Jacobian are given")
    armature: PerJoint = param((0.0,), "rotor inertias J_m/r^2 as seen at the joints", "kg m^2")

    @model_validator(mode="after")
    def _fits(self) -> Self:
        from .rigid_body import check_robot

        require_positive("armature", spread("armature", self.armature, len(self.joints)), or_zero=True)
        check_robot(self.urdf, self.tool, self.joints)
        return self


class State(NamedTuple):
    """Positions of the newest query, rad."""

    q: Vector


class RobotDynamics(Block[RobotDynamicsParams]):
    """Answers a joint state with everything a model-based law or a check of one needs.

    Notation of pinocchio: M(q) a + nle(q, v) = tau. The Jacobian is that of the tool with axes of the base
    (linear rows first). The inverse dynamics take their acceleration from `reference`, zero without one. A query that
    was refused gets no answer.
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

        from .rigid_body import frame_id, load_model

        self._np, self._pin = np, pin
        self._urdf = read_urdf(self.p.urdf)
        self._root = root_link(self._urdf)
        self._model = load_model(self._urdf)
        self._model.armature = np.array(spread("armature", self.p.armature, self._model.nv))
        self._data = self._model.createData()
        self._tool = frame_id(self._model, self.p.tool)

    def first(self) -> State:
        """Stand at zero."""
        return State((0.0,) * self._model.nq)

    def update(
        self, x: State, t: int, *, joint_query: Vector, reference: Vector | None
    ) -> tuple[State, Mapping[str, Vector]]:
        """Answer the query (q, v, tau)."""
        pin, model, data, n = self._pin, self._model, self._data, self._model.nv
        state = self._np.array(joint_query)
        q, v, tau = state[:n], state[n : 2 * n], state[2 * n :]
        a = self._np.zeros(n) if reference is None else self._np.array(reference)
        forward = pin.aba(model, data, q, v, tau).tolist()
        pin.computeAllTerms(model, data, q, v)  # fills the upper half of M only
        upper = data.M
        mass = self._np.triu(upper) + self._np.triu(upper, 1).T
        pin.updateFramePlacements(model, data)
        tool = data.oMf[self._tool]
        jacobian = pin.getFrameJacobian(model, data, self._tool, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        return State(joint_query[:n]), {
            "mass_matrix": tuple(mass.ravel().tolist()),
            "bias": tuple(data.nle.tolist()),
            "gravity": tuple(pin.computeGeneralizedGravity(model, data, q).tolist()),
            "forward_dynamics": tuple(forward),
            "inverse_dynamics": tuple((pin.rnea(model, data, q, v, a)).tolist()),
            "jacobian": tuple(jacobian.ravel().tolist()),
            "tool_pose": (*tool.translation.tolist(), *pin.Quaternion(tool.rotation).coeffs().tolist()),
        }

    def refused(self, x: State, t: int) -> tuple[State, Mapping[str, Vector]]:
        """Stay silent: the last answer under a new stamp would pass for that to this query."""
        return x, {}

    def latched(self) -> Mapping[str, str]:
        """Give the text for late joiners: the URDF under the name that every viewer expects."""
        return {"robot_description": self._urdf}

    def markers(self, x: State) -> tuple[Marker, ...]:
        """Draw the robot at the newest query: its links as lines, joints and tool as balls."""
        pin, model, data = self._pin, self._model, self._data
        pin.framesForwardKinematics(model, data, self._np.array(x.q))
        places = [tuple(data.oMi[i].translation.tolist()) for i in range(model.njoints)]
        tool = tuple(data.oMf[self._tool].translation.tolist())
        lines = [(places[model.parents[i]], places[i]) for i in range(1, model.njoints)]
        lines.append((places[model.frames[self._tool].parentJoint], tool))
        return (
            Marker(self._root, "links", "line_list", tuple(end for line in lines for end in line), 0.05),
            Marker(self._root, "joints", "sphere_list", (*places[1:], tool), 0.1, (0.9, 0.4, 0.1, 1.0)),
        )


main = executable(RobotDynamics)
