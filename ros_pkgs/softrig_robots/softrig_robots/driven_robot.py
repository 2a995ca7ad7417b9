r"""A robot whose joints are driven through gears by DC motors: equations, compiled step, plant block.

.. math::
    (M(q) + J_m r^{-2}) \ddot q + H(q, \dot q) + B_m r^{-2} \dot q + F_f(\dot q) + J(q)^T F_e + \tau_d
        &= K_m r^{-1} I \\
    L \dot I + R I + K_b r^{-1} \dot q &= V - d
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from softrig_core import BlockParams, Compiled, Level, Params, Plant, RunError, param, rk4, to_ns, to_s
from typing_extensions import TypeVar

from .joints import PerJoint, require_positive, spread

if TYPE_CHECKING:
    import casadi as ca
    from softrig_core import Scene

    from .urdf_file import Joint

Vector = tuple[float, ...]
LARGEST_STEP = 2.5  # in the armature's time constants; from 2.785 on RK4 does not decay


class Motors(Params):
    """DC motors and gears; one number for all joints or one a joint."""

    resistance: PerJoint = param((1.26,), "armature resistance R", "Ohm")
    inductance: PerJoint = param((0.001,), "armature inductance L", "H")
    inertia: PerJoint = param((2e-4,), "rotor inertia J_m", "kg m^2")
    damping: PerJoint = param((1e-3,), "rotor damping B_m", "N m s/rad")
    torque_constant: PerJoint = param((0.26,), "torque constant K_m", "N m/A")
    back_emf_constant: PerJoint = param((0.26,), "back-emf constant K_b", "V s/rad")
    gear: PerJoint = param((0.01,), "gear coefficient r: joint speed over motor speed", "")

    def _check(self) -> None:
        for name in ("resistance", "inductance", "torque_constant", "back_emf_constant", "gear"):
            require_positive(f"motors.{name}", getattr(self, name))
        for name in ("inertia", "damping"):
            require_positive(f"motors.{name}", getattr(self, name), or_zero=True)

    def table(self, joints: int) -> dict[str, Vector]:
        """Return every parameter with one value a joint.

        Raises
        ------
        ValueError
            A parameter has neither one value nor one a joint.
        """
        return {name: spread(f"motors.{name}", getattr(self, name), joints) for name in type(self).model_fields}


class DrivenRobotParams(BlockParams):
    """Parameters of every voltage-driven robot."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    substeps: int = param(2, "Runge-Kutta steps per period", ge=1, le=100)
    v_max: float = param(40.0, "voltage limit V_max of each motor", "V", gt=0.0, live=True)
    payload: float = param(0.0, "point mass at the tool frame", "kg", ge=0.0, live=True)
    speed_limit: float = param(100.0, "joint speed above which the run ends", "rad/s", gt=0.0, live=True)
    motors: Motors = Motors()

    def _check(self) -> None:
        """Refuse a step for which the armature's pole R/L is unstable, which would end as an excessive speed."""
        fastest = max(self.motors.resistance) / min(self.motors.inductance)
        least = math.ceil(self.period * fastest / LARGEST_STEP)
        if self.substeps < least:
            raise ValueError(
                f"substeps = {self.substeps}: expected at least {least}, so that a step of the integration is not "
                f"beyond {LARGEST_STEP:g} L/R, with R/L up to {fastest:g} 1/s"
            )


class Friction(NamedTuple):
    r"""Friction at the joints, N m.

    .. math::
        F_f = [F_c + (F_s - F_c) e^{-(\dot q/v_s)^2}] \tanh(\dot q/v_0) + \sigma \dot q
    """

    coulomb: Vector
    static: Vector
    viscous: Vector
    stribeck_speed: float
    edge_speed: float


P = TypeVar("P", bound=DrivenRobotParams, default=DrivenRobotParams)


class State(NamedTuple):
    """Positions q (rad), velocities v (rad/s) and currents i (A) a joint; ticks of each motor at its limit."""

    q: Vector
    v: Vector
    i: Vector
    saturated: tuple[int, ...]


class DrivenRobot(Plant[P]):
    """Rigid robot, gears and armature circuits, fourth-order Runge-Kutta with the inputs held.

    A subclass defines the robot, its initial state and its loads.

    Payload, disturbances and limits may change while it runs, and the state continues. Construction parameters may not
    change.
    """

    STALE_PERIODS: ClassVar[int] = 20  # at 1 kHz a late wake-up of the controller's host is not yet a lost controller
    TIP: ClassVar[str] = "tool"  # frame of the payload and of the outside force

    @classmethod
    def robot(cls, params: Any) -> str:
        """Return the URDF text of the robot with these parameters."""
        raise NotImplementedError

    def initial(self) -> tuple[Vector, Vector]:
        """Return positions (rad) and velocities (rad/s) at t = 0; currents start at zero."""
        raise NotImplementedError

    def joints(self) -> tuple[str, ...]:
        """Return the names of the joints."""
        raise NotImplementedError

    def friction(self) -> Friction:
        """Return the friction at the joints in addition to that of the rotors."""
        none = (0.0,) * self.n
        return Friction(none, none, none, 1.0, 1.0)

    def stops(self) -> bool:
        """Return whether the limits of the URDF act: end stops, and drives that saturate at the efforts."""
        return False

    def loads(self, t: int) -> tuple[Vector, Vector]:
        """Return voltage drops d (V) and load torques tau_d (N m) of the sub-step that begins at t (ns)."""
        raise NotImplementedError

    @classmethod
    def scene(cls, params: Any) -> Scene:
        """Return URDF and frames of the links."""
        from .scene import RobotScene

        return RobotScene(cls.robot(params), cls.TIP)

    def latched(self) -> Mapping[str, str]:
        """Return the text for late joiners: the URDF under the name that every viewer expects."""
        return {"robot_description": self.robot(self.p)}

    def torque_constants(self, table: Mapping[str, Vector]) -> Vector:
        """Return the torque constants on the joint side of the gears, K_m/r, N m/A."""
        return tuple(K / r for K, r in zip(table["torque_constant"], table["gear"], strict=True))

    def setup(self) -> None:
        """Compile the robot and refer the motors to the joint side of the gears."""
        self._step, self._torque, self.n = compile_robot(self.robot(self.p), self.TIP, self.stops())
        self._table = table = self.p.motors.table(self.n)
        self._gear = table["gear"]
        self._inertia = tuple(J / r**2 for J, r in zip(table["inertia"], self._gear, strict=True))
        self._damping = tuple(B / r**2 for B, r in zip(table["damping"], self._gear, strict=True))
        self._friction = self.friction()
        self.torque_per_ampere, self._plant = self.motors(1.0, 1.0)
        self._h = self.p.period / self.p.substeps
        period = to_ns(self.p.period)
        self._begins = [k * period // self.p.substeps for k in range(self.p.substeps)]
        self.nowhere = (0.0, 0.0, 0.0)

    def motors(self, resistance: float, constants: float) -> tuple[Vector, Vector]:
        """Return K_m/r (N m/A), and all numbers of the compiled step, with R, K_m and K_b at these multiples."""
        table = self._table
        torque_per_ampere = tuple(constants * K for K in self.torque_constants(table))
        return torque_per_ampere, (
            *(resistance * R for R in table["resistance"]),
            *table["inductance"],
            *torque_per_ampere,
            *(constants * K / g for K, g in zip(table["back_emf_constant"], self._gear, strict=True)),
            *self._inertia,
            *self._damping,
            *self._friction.coulomb,
            *self._friction.static,
            *self._friction.viscous,
            self._friction.stribeck_speed,
            self._friction.edge_speed,
            self.p.payload,
        )

    def first(self) -> Any:
        """Return the initial state of the robot with zero current."""
        q, v = self.initial()
        return State(q, v, (0.0,) * self.n, (0,) * self.n)

    def clip(self, saturated: tuple[int, ...], command: Vector) -> tuple[tuple[int, ...], Vector]:
        """Limit the voltages and count the ticks on which each was at its limit.

        A controller that keeps the limit itself sends exactly the limit: that is saturation too.
        """
        top = self.p.v_max
        if max(command) < top and min(command) > -top:
            return saturated, command
        saturated = tuple(k + (abs(v) >= top) for k, v in zip(saturated, command, strict=True))
        seconds = [round(k * self.p.period, 9) for k in saturated]
        self.report(
            Level.WARN, "saturation", f"motor voltages at their limit of {top:g} V for {seconds} s (motor after motor)"
        )
        return saturated, tuple(min(max(v, -top), top) for v in command)

    def move(self, x: Any, t: int, voltages: Vector, force: Vector, plant: Vector) -> tuple[Vector, Vector, Vector]:
        """Integrate over one period.

        Parameters
        ----------
        x : named tuple
            As `State`.
        t : int
            Begin, ns.
        voltages : tuple of float
            At the motors, V.
        force : tuple of 3 floats
            With which the tool pushes on its surroundings, base frame, N.
        plant : tuple of float
            As of `motors`.

        Returns
        -------
        q, v, i : tuple of float
            rad, rad/s, A.

        Raises
        ------
        RunError
            The state is no longer finite, or a joint is faster than the speed limit.
        """
        flat, n = (*x.q, *x.v, *x.i), self.n
        for begin in self._begins:
            drop, torque = self.loads(t + begin)
            inputs = [v - d for v, d in zip(voltages, drop, strict=True)]
            flat = self._step((*flat, *inputs, *torque, *force, *plant, self._h))
        speeds = flat[n : 2 * n]
        limit = self.p.speed_limit
        # written so that NaN fails it, at any place of the state
        if not (max(speeds) <= limit and min(speeds) >= -limit and all(math.isfinite(v) for v in flat)):
            raise RunError(
                f"joint speeds {[float(f'{v:.6g}') for v in speeds]} rad/s, limit {limit:g}: integration "
                f"stopped at t = {to_s(t):.9g} s, last positions {list(x.q)} rad"
            )
        return flat[:n], speeds, flat[2 * n :]

    def gear_torques(self, x: Any, t: int, force: Vector, plant: Vector) -> Vector:
        """Return the torques of the gears on the links, T_r = K_m I/r - (J_m q'' + B_m q')/r^2, N m."""
        _, torque = self.loads(t)
        return self._torque((*x.q, *x.v, *x.i, *torque, *force, *plant))

    def advance(self, x: Any, t: int, *, motor_command: Vector) -> Any:
        """Move with the clipped voltages and no force at the tool."""
        saturated, voltages = self.clip(x.saturated, motor_command)
        return State(*self.move(x, t, voltages, self.nowhere, self._plant), saturated)

    def outputs(self, x: Any, t: int) -> Mapping[str, Vector]:
        """Return joint and motor states; efforts are the motors' torques on the joint side, K_m I/r, and currents."""
        q, v, i, _ = x
        gear = self._gear
        torques = [k * a for k, a in zip(self.torque_per_ampere, i, strict=True)]
        motors = (*(a / r for a, r in zip((*q, *v), gear * 2, strict=True)), *i)
        return {"joint_states": (*q, *v, *torques), "motor_states": motors}


@lru_cache(maxsize=16)
def compile_robot(urdf: str, tip: str, stops: bool = False) -> tuple[Compiled, Compiled, int]:
    """Compile a robot.

    Motor, friction and payload numbers are arguments of the compiled functions, so that only another URDF needs
    another compilation.

    Parameters
    ----------
    urdf : str
        URDF text.
    tip : str
        Frame of the payload and of the force F_e.
    stops : bool
        The limits of the URDF act: inelastic end stops, and drives whose torque is limited.

    Returns
    -------
    step : Compiled
        (x, V - d, tau_d, F_e, motors, h) to the state x = (q, v, I) one Runge-Kutta step of h (s) later.
    torque : Compiled
        (x, tau_d, F_e, motors) to the torques T_r behind the gears.
    joints : int
    """
    import casadi as ca

    from .rigid_body import SymbolicRobot, load_model, ties
    from .urdf_file import read_robot

    model = load_model(urdf)
    names = list(model.names)[1:]
    robot = SymbolicRobot(model, tip, ties(urdf, names))
    n = robot.n
    limits = [read_robot(urdf).joints[name] for name in names] if stops else []
    x, inputs, load, force = ca.SX.sym("x", 3 * n), ca.SX.sym("V", n), ca.SX.sym("tau_d", n), ca.SX.sym("F_e", 3)
    plant = ca.SX.sym("plant", 9 * n + 3)
    efforts = ca.DM([joint.effort for joint in limits])
    derivative, transmitted = _equations(robot, x, inputs, load, force, plant, efforts)
    ode = ca.Function("ode", [x, inputs, load, force, plant], [derivative])
    symbols = [ca.MX.sym("V", n), ca.MX.sym("tau_d", n), ca.MX.sym("F_e", 3), ca.MX.sym("plant", 9 * n + 3)]
    now, h = ca.MX.sym("x", 3 * n), ca.MX.sym("h")
    later = rk4(lambda x: ode(x, *symbols), now, h)
    if limits:
        ends = ca.Function("end_stops", [x, plant], [_end_stops(robot, x, plant, limits)])
        later = ends(later, symbols[-1])
    step = ca.Function("robot_step", [now, *symbols, h], [later])
    torque = ca.Function("gear_torque", [x, load, force, plant], [transmitted])
    return Compiled(step), Compiled(torque), n


def _equations(
    robot: Any, x: ca.SX, inputs: ca.SX, load: ca.SX, force: ca.SX, plant: ca.SX, efforts: ca.DM
) -> tuple[ca.SX, ca.SX]:
    """Return the right-hand side of the state equation, and the torques after the gears; efforts: limits, empty
    for none.
    """
    import casadi as ca

    n = robot.n
    q, v, current = x[:n], x[n : 2 * n], x[2 * n :]
    R, L, torque_constant, back_emf, inertia, damping, *joint = (plant[i * n : (i + 1) * n] for i in range(9))
    coulomb, static, viscous = joint
    stribeck, edge, payload = plant[9 * n], plant[9 * n + 1], plant[9 * n + 2]
    rubbing = (coulomb + (static - coulomb) * ca.exp(-((v / stribeck) ** 2))) * ca.tanh(v / edge) + viscous * v
    motor = torque_constant * current
    if efforts.numel():
        motor = ca.fmax(ca.fmin(motor, efforts), -efforts)
    pushed = ca.jacobian(robot.tool_position(q), q).T @ force
    acceleration = robot.forward_dynamics(q, v, motor - damping * v - rubbing - pushed - load, inertia, payload)
    transmitted = motor - inertia * acceleration - damping * v
    return ca.vertcat(v, acceleration, (inputs - R * current - back_emf * v) / L), transmitted


def _end_stops(robot: Any, x: ca.SX, plant: ca.SX, limits: Sequence[Joint]) -> ca.SX:
    """Return the state after impacts on the end stops, joint by joint, repeated if an impact moves a joint into a stop.

    Impacts are inelastic: an impulse along joint i stops this joint, and the mass matrix determines the response of the
    robot. Positions are returned to the stop in the same way, so that mimic joints stay consistent.
    """
    import casadi as ca

    n = robot.n
    q, v, remaining = x[:n], x[n : 2 * n], x[2 * n :]
    torque = ca.SX.sym("tau", n)
    still = robot.forward_dynamics(q, ca.SX.zeros(n), torque, plant[4 * n : 5 * n], plant[9 * n + 2])
    yielding = ca.jacobian(still, torque)  # M^-1, of mimic joints within their constraint
    ended = [i for i, joint in enumerate(limits) if not (math.isinf(joint.lower) and math.isinf(joint.upper))]
    for i in ended * 2:
        along = yielding[:, i] / yielding[i, i]
        back = ca.fmax(ca.fmin(q[i], limits[i].upper), limits[i].lower) - q[i]
        q = q + along * back
        v = v - along * ca.if_else(back * v[i] < 0, v[i], 0)
    return ca.vertcat(q, v, remaining)
