"""Rigid-body dynamics as casadi expressions, for any robot that pinocchio reads from URDF.

The PyPI build of pinocchio has no casadi bindings. Articulated-body algorithm and notation: R. Featherstone,
"Rigid Body Dynamics Algorithms", 2008, chapter 7; spatial vectors are (linear, angular) as in pinocchio.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from .urdf import for_pinocchio, read_urdf
from .urdf_file import read_robot


def load_model(urdf: str, mimic: bool = False) -> pin.Model:
    """Read a robot whose joints all have one degree of freedom.

    Parameters
    ----------
    urdf : str
        URDF text.
    mimic : bool
        True: mimic joints have no coordinate of their own. False: all joints have one.

    Raises
    ------
    ValueError
        Not a URDF, something in it that is refused (see `urdf_file.URDF`), or no moving joint.
    """
    read_robot(urdf)
    model = pin.buildModelFromXML(for_pinocchio(urdf), mimic)
    if model.njoints < 2:
        raise ValueError("the URDF has no moving joint")
    return model


def check_robot(
    urdf: str, frame: str, joints: tuple[str, ...], armature: Sequence[float], mimic: bool = False
) -> pin.Model:
    """Refuse a robot that does not fit its parameters.

    Parameters
    ----------
    urdf : str
        File or package:// URI.
    frame : str
        Link frame that it must have.
    joints : tuple of str
        Joint names that it must have, in this order.
    armature : sequence of float, one a joint
        Rotor inertias at the joints, kg m^2.
    mimic : bool
        True: `joints` are those that follow no other.

    Returns
    -------
    pinocchio.Model
        With the rotor inertias.

    Raises
    ------
    ValueError
        The message describes the defect of the URDF, or what it has instead.
    """
    text = read_urdf(urdf)
    robot = read_robot(text, urdf)
    model = load_model(text, mimic)
    frame_id(model, frame)
    names = tuple(name for name in list(model.names)[1:] if not (mimic and robot.joints[name].mimic))
    if names != joints:
        raise ValueError(f"joints = {list(joints)}, but {urdf} has {list(names)}")
    heaviest = np.max([_inertias(model, k) for k in range(4)], axis=0)
    for name, inertia, rotor in zip(joints, heaviest, armature, strict=True):
        if not inertia + rotor > 0.0:
            raise ValueError(f"{urdf}: joint {name} moves no mass: give a link behind it one, or its motor an inertia")
    model.armature = np.array(armature, dtype=float)
    return model


def _inertias(model: pin.Model, k: int) -> NDArray[np.float64]:
    """Diagonal of the mass matrix at the k-th of some fixed positions."""
    q = np.array([0.7 * k * (i + 1) for i in range(model.nq)])
    return np.array(np.diag(np.reshape(pin.crba(model, model.createData(), q), (model.nv, model.nv))))


def fastest_rubbing(model: pin.Model, q: Sequence[float], rubbing: Sequence[float]) -> float:
    """Return the fastest rate at which viscous friction slows a robot down, 1/s.

    Parameters
    ----------
    model : pinocchio.Model
        With rotor inertias.
    q : sequence of float
        Positions, rad.
    rubbing : sequence of float
        Friction of each joint, N m s/rad.
    """
    n = model.nv
    M = np.reshape(pin.crba(model, model.createData(), np.array(q)), (n, n))  # for one joint the result is a vector
    M = np.triu(M) + np.triu(M, 1).T
    return float(np.max(np.abs(np.linalg.eigvals(np.linalg.solve(M, np.diag(rubbing))))))


def ties(urdf: str, names: Sequence[str]) -> list[tuple[int, int, float, float]]:
    """Return the mimic joints: index, index of the joint that is followed, multiplier and offset.

    Parameters
    ----------
    urdf : str
        URDF text.
    names : sequence of str
        Moving joints in pinocchio's order, from which the indices count.
    """
    order = {name: k for k, name in enumerate(names)}
    result = ((name, joint.mimic) for name, joint in read_robot(urdf).joints.items())
    return [(order[n], order[m.joint], m.multiplier, m.offset) for n, m in result if m is not None]


def frame_id(model: pin.Model, frame: str) -> int:
    """Return pinocchio's number of a link frame.

    Raises
    ------
    ValueError
        There is none; lists the frames.
    """
    if model.existFrame(frame, pin.FrameType.BODY):  # a joint may have the name of a link
        return int(model.getFrameId(frame, pin.FrameType.BODY))
    if not model.existFrame(frame):
        raise ValueError(f"the robot has no frame {frame!r}; it has {', '.join(f.name for f in model.frames)}")
    return int(model.getFrameId(frame))


class SymbolicRobot:
    """Joint-space dynamics of a robot with symbolic coordinates.

    Parameters
    ----------
    model : pinocchio.Model
        From `load_model`.
    tool : str
        Frame in which a payload sits and on which a force acts.
    tied : sequence of tuples
        Mimic joints, from `ties`.
    """

    def __init__(self, model: pin.Model, tool: str, tied: Sequence[tuple[int, int, float, float]] = ()) -> None:
        self.n = model.nv
        self._tied = tied
        self._parents = [model.parents[i] for i in range(model.njoints)]
        self._placements = [_pair(model.jointPlacements[i]) for i in range(model.njoints)]
        self._bodies = [ca.DM(model.inertias[i].matrix()) for i in range(model.njoints)]
        frame = model.frames[frame_id(model, tool)]
        self._tool = (int(frame.parentJoint), *_pair(frame.placement))
        self._gravity = ca.DM(model.gravity.linear)
        data = model.createData()
        pin.computeJointJacobians(model, data, pin.neutral(model))
        self._axes = [ca.DM.zeros(6)]
        for i in range(1, model.njoints):
            # for a single joint pinocchio returns a vector
            jacobian = np.reshape(pin.getJointJacobian(model, data, i, pin.ReferenceFrame.LOCAL), (6, model.nv))
            self._axes.append(ca.DM(np.round(jacobian[:, i - 1], 12)))

    def forward_dynamics(self, q: ca.SX, v: ca.SX, tau: ca.SX, armature: ca.SX, payload: ca.SX) -> ca.SX:
        """Accelerations from torques.

        Mimic joints are a constraint K q'' = 0 with a torque K^T lambda (Gauss's principle).

        Parameters
        ----------
        q, v, tau : SX of shape (n,)
            Positions, velocities, joint torques.
        armature : SX of shape (n,)
            Rotor inertias as seen at the joints, kg m^2.
        payload : SX
            Point mass at the tool frame, kg.

        Returns
        -------
        SX of shape (n,)
        """
        free = self._tree_dynamics(q, v, tau, armature, payload)
        if not self._tied:
            return free
        K = ca.SX(len(self._tied), self.n)
        for row, (follower, leader, multiplier, _) in enumerate(self._tied):
            K[row, follower], K[row, leader] = 1.0, -multiplier
        torque = ca.SX.sym("tau", self.n)
        yielding = ca.jacobian(self._tree_dynamics(q, v, torque, armature, payload), torque) @ K.T  # M^-1 K^T
        return free - yielding @ ca.solve(K @ yielding, K @ free)

    def _motion(self, q: ca.SX, v: ca.SX, payload: ca.SX) -> tuple[list[ca.SX], ...]:
        """Transforms from the parents, inertias, and the accelerations and forces that the velocities cause."""
        count = len(self._parents)
        x: list[ca.SX] = [ca.SX.eye(6)] * count
        twist, drift, bias = ([ca.SX.zeros(6)] * count for _ in range(3))
        inertia = [ca.SX(body) for body in self._bodies]
        holder, _, offset = self._tool
        inertia[holder] = inertia[holder] + _point_inertia(payload, offset)
        for i in range(1, count):
            axis = self._axes[i]
            x[i] = _motion_transform(*self._joint(i, q[i - 1]))
            twist[i] = x[i] @ twist[self._parents[i]] + axis * v[i - 1]
            drift[i] = _cross_motion(twist[i]) @ (axis * v[i - 1])
            bias[i] = _cross_force(twist[i]) @ (inertia[i] @ twist[i])
        return x, inertia, drift, bias

    def _tree_dynamics(self, q: ca.SX, v: ca.SX, tau: ca.SX, armature: ca.SX, payload: ca.SX) -> ca.SX:
        """Accelerations of the tree by the articulated-body algorithm."""
        x, inertia, drift, bias = self._motion(q, v, payload)
        count = len(x)
        force: list[ca.SX] = [ca.SX(6, 1)] * count
        weight: list[ca.SX] = [ca.SX(1)] * count
        torque: list[ca.SX] = [ca.SX(1)] * count
        for i in reversed(range(1, count)):
            axis = self._axes[i]
            force[i] = inertia[i] @ axis
            weight[i] = axis.T @ force[i] + armature[i - 1]
            torque[i] = tau[i - 1] - axis.T @ bias[i]
            articulated = inertia[i] - force[i] @ force[i].T / weight[i]
            pushed = bias[i] + articulated @ drift[i] + force[i] * (torque[i] / weight[i])
            parent = self._parents[i]
            inertia[parent] = inertia[parent] + x[i].T @ articulated @ x[i]
            bias[parent] = bias[parent] + x[i].T @ pushed
        acceleration: list[ca.SX] = [ca.SX(ca.vertcat(-self._gravity, ca.DM.zeros(3)))] * count
        result: list[ca.SX] = []
        for i in range(1, count):
            carried = x[i] @ acceleration[self._parents[i]] + drift[i]
            result.append((torque[i] - force[i].T @ carried) / weight[i])
            acceleration[i] = carried + self._axes[i] * result[-1]
        return ca.vertcat(*result)

    def inverse_dynamics(self, q: ca.SX, v: ca.SX, a: ca.SX, armature: ca.SX, payload: ca.SX) -> ca.SX:
        """Torques for accelerations by the recursive Newton-Euler algorithm; arguments as in `forward_dynamics`."""
        x, inertia, drift, bias = self._motion(q, v, payload)
        count = len(x)
        acceleration: list[ca.SX] = [ca.SX(ca.vertcat(-self._gravity, ca.DM.zeros(3)))] * count
        force: list[ca.SX] = [ca.SX.zeros(6)] * count
        for i in range(1, count):
            acceleration[i] = x[i] @ acceleration[self._parents[i]] + self._axes[i] * a[i - 1] + drift[i]
            force[i] = inertia[i] @ acceleration[i] + bias[i]
        torque: list[ca.SX] = [ca.SX(1)] * count
        for i in reversed(range(1, count)):
            torque[i] = self._axes[i].T @ force[i] + armature[i - 1] * a[i - 1]
            force[self._parents[i]] = force[self._parents[i]] + x[i].T @ force[i]
        return ca.vertcat(*torque[1:])

    def tool_position(self, q: ca.SX) -> ca.SX:
        """Place of the tool frame in the base frame, m."""
        holder, _, offset = self._tool
        point = ca.SX(offset)
        i = holder
        while i > 0:
            rotation, shift = self._joint(i, q[i - 1])
            point = rotation @ point + shift
            i = self._parents[i]
        return point

    def _joint(self, i: int, q: ca.SX) -> tuple[ca.SX, ca.SX]:
        """Rotation and translation from the frame of joint `i` to that of its parent."""
        rotation, shift = self._placements[i]
        axis = self._axes[i]
        slide, turn = axis[:3], axis[3:]
        cross = ca.skew(turn)
        turned = ca.DM.eye(3) + ca.sin(q) * cross + (1 - ca.cos(q)) * (cross @ cross)  # Rodrigues
        return rotation @ ca.SX(turned), shift + rotation @ (slide * q)


def _pair(placement: pin.SE3) -> tuple[ca.DM, ca.DM]:
    # rotations by multiples of a quarter turn get exact zeros, which casadi then leaves out
    rotation = np.where(np.abs(placement.rotation) < 1e-15, 0.0, placement.rotation)
    return ca.sparsify(ca.DM(rotation)), ca.DM(placement.translation)


def _motion_transform(rotation: ca.SX, shift: ca.SX) -> ca.SX:
    """Return the matrix that transforms a twist of the parent to the child's frame; its transpose transforms a
    wrench back.
    """
    back = rotation.T
    return ca.blockcat([[back, -back @ ca.skew(shift)], [ca.SX(3, 3), back]])


def _cross_motion(twist: ca.SX) -> ca.SX:
    linear, angular = ca.skew(twist[:3]), ca.skew(twist[3:])
    return ca.blockcat([[angular, linear], [ca.SX(3, 3), angular]])


def _cross_force(twist: ca.SX) -> ca.SX:
    return -_cross_motion(twist).T


def _point_inertia(mass: ca.SX, offset: ca.DM) -> ca.SX:
    cross = ca.skew(offset)
    return mass * ca.blockcat([[ca.DM.eye(3), -cross], [cross, -cross @ cross]])
