"""Which arm, and its equations as compiled functions."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from softrig_core import BlockParams, Compiled, param, rk4

from ..joints import JointUnits, PerJoint, joint_units, require_positive, spread
from ..urdf import read_urdf
from ..urdf_file import read_robot

Vector = tuple[float, ...]


class ArmParams(BlockParams):
    """The robot."""

    period: float = param(0.001, "sampling period", "s", gt=0.0, le=1.0)
    urdf: str = param("package://softrig_robots/urdf/two_link.urdf", "file or package:// URI of the robot")
    joints: tuple[str, ...] = param(("shoulder", "elbow"), "joint names in the URDF's order", min_length=1)
    tool: str = param("tool", "frame of payload, force and impedance")
    armature: PerJoint = param((0.0,), "rotor inertias as seen at the joints", "kg m^2")
    payload: float = param(0.0, "point mass at the tool frame", "kg", ge=0.0, live=True)
    edge_speed: float = param(
        0.05, "speed that smooths the change of sign of the URDF's Coulomb friction", "rad/s", gt=0.0
    )

    def _check(self) -> None:
        from ..rigid_body import check_robot, ties

        armature = spread("armature", self.armature, len(self.joints))
        require_positive("armature", armature, or_zero=True)
        check_robot(self.urdf, self.tool, self.joints, armature)
        if ties(read_urdf(self.urdf), self.joints):
            raise ValueError(f"{self.urdf} has joints that mimic others: expected one drive a joint")

    def units(self) -> JointUnits:
        """Return the units of the joints, by their kinds in the URDF."""
        known = read_robot(read_urdf(self.urdf)).joints
        return joint_units(self.joints, [name for name, joint in known.items() if joint.is_linear])

    def each(self, name: str) -> Vector:
        """Return a parameter with one value a joint."""
        return spread(name, getattr(self, name), len(self.joints))


class Arm:
    """The functions of an arm; all of them take armature (n) and payload last.

    Attributes
    ----------
    step : Compiled
        (q, v, tau, F, h, armature, payload) to (q, v) one Runge-Kutta step of h (s) later; F (N) pushes on the tool.
    inverse : Compiled
        (q, v, a, armature, payload) to the torques of M(q) a + h(q, v) + friction.
    tool : Compiled
        q to the position of the tool (m, 3) and its Jacobian (3 n, row by row).
    """

    def __init__(self, step: Compiled, inverse: Compiled, tool: Compiled) -> None:
        self.step, self.inverse, self.tool = step, inverse, tool


@lru_cache(maxsize=16)
def compile_arm(urdf: str, tool: str, joints: Sequence[str], edge_speed: float) -> Arm:
    """Compile the functions of a robot; see `Arm`."""
    import casadi as ca

    from ..rigid_body import SymbolicRobot, load_model
    from ..urdf_file import read_robot

    model = load_model(urdf)
    robot, result = SymbolicRobot(model, tool), read_robot(urdf).joints
    n = robot.n
    viscous = ca.DM([result[name].damping for name in joints])
    coulomb = ca.DM([result[name].friction for name in joints])
    q, v, u, force = ca.SX.sym("q", n), ca.SX.sym("v", n), ca.SX.sym("u", n), ca.SX.sym("F", 3)
    armature, payload = ca.SX.sym("armature", n), ca.SX.sym("payload")
    rubbing = viscous * v + coulomb * ca.tanh(v / edge_speed)
    position = robot.tool_position(q)
    jacobian = ca.jacobian(position, q)
    acceleration = robot.forward_dynamics(q, v, u - rubbing + jacobian.T @ force, armature, payload)
    ode = ca.Function("ode", [q, v, u, force, armature, payload], [ca.vertcat(v, acceleration)])
    inputs = [ca.MX.sym("u", n), ca.MX.sym("F", 3), ca.MX.sym("armature", n), ca.MX.sym("payload")]
    x, h = ca.MX.sym("x", 2 * n), ca.MX.sym("h")
    later = rk4(lambda x: ode(x[:n], x[n:], *inputs), x, h)
    step = ca.Function("arm_step", [x, inputs[0], inputs[1], h, *inputs[2:]], [later])
    torque = robot.inverse_dynamics(q, v, u, armature, payload) + rubbing
    inverse = ca.Function("arm_inverse", [q, v, u, armature, payload], [ca.densify(torque)])
    tip = ca.Function("arm_tool", [q], [ca.densify(ca.vertcat(position, ca.reshape(jacobian.T, 3 * n, 1)))])
    return Arm(Compiled(step), Compiled(inverse), Compiled(tip))
