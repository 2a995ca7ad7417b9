"""The electrically driven hip and knee robot with the patient's leg in it: equations (1)-(4) of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from math import radians
from typing import Any, ClassVar, Literal, NamedTuple

from softrig_core import Level, Params, Values, command, joint_state, param, to_ns, to_s, wrench

from ..driven_robot import DrivenRobot, DrivenRobotParams, Friction, Vector
from ..joints import PerJoint, require_positive, spread
from .force import clip_force
from .model import JOINTS, LOWER, UPPER, RehabMotors, Segments, rehab_urdf
from .patient import FOOT, PATIENT_FORCE
from .prom import PromReference
from .stability import LinearRobot, RobotDrift

START = tuple(q + radians(10.0) for q in PromReference().update((), 0)[1]["reference"][:2])


class JointFriction(Params):
    """Stribeck friction of each joint; see `softrig_robots.driven_robot.Friction`."""

    coulomb: PerJoint = param((0.8,), "Coulomb friction F_c", "N m")
    static: PerJoint = param((0.9,), "static friction F_s", "N m")
    viscous: PerJoint = param((1.2,), "viscous friction sigma", "N m s/rad")
    stribeck_speed: float = param(0.1, "Stribeck speed v_s, at which static friction fades", "rad/s", gt=0.0)
    edge_speed: float = param(0.01, "speed v_0 that smooths the change of sign", "rad/s", gt=0.0)


class TorqueWindow(Params):
    """A constant disturbance torque d for some time."""

    torque: PerJoint = param((2.0,), "torque on each joint", "N m", live=True)
    begin: float = param(35.0, "time at which it begins", "s", ge=0.0, live=True)
    end: float = param(45.0, "time at which it ends", "s", ge=0.0, live=True)

    def _check(self) -> None:
        if self.begin > self.end:
            raise ValueError(
                f"disturbance.begin = {self.begin:g} s and disturbance.end = {self.end:g} s: expected begin <= end"
            )


class Drift(Params):
    """Motor parameters that change linearly over a run."""

    resistance: float = param(0.0, "relative change of R at the end", "", gt=-1.0)
    constants: float = param(0.0, "relative change of K_m and K_b at the end", "", gt=-1.0)
    duration: float = param(60.0, "duration of the change; the values stay constant afterwards", "s", gt=0.0)


class RehabParams(DrivenRobotParams):
    """Published robot in experiment R1; the README lists the values that the paper does not print."""

    v_max: float = param(24.0, "voltage limit V_max of each motor", "V", gt=0.0, live=True)
    # not live: the stability of a law depends on it, see `RehabPlant.agreed`
    payload: float = param(0.0, "point mass at the foot", "kg", ge=0.0)
    segments: Segments = Segments()
    motors: RehabMotors = RehabMotors()
    friction: JointFriction = JointFriction()
    torque_constant_side: Literal["motor", "joint"] = param(
        "motor",
        "side of the gears on which K_m is meant: motor (as the paper's currents have it) or joint (consistent)",
    )
    position: PerJoint = param(START, "q(0); default 10 degrees above the reference", "rad")
    velocity: PerJoint = param((0.0,), "velocity at t = 0", "rad/s")
    disturbance: TorqueWindow = TorqueWindow()
    drift: Drift = Drift()
    lower: PerJoint = param(LOWER, "lower ends of the range of motion", "rad")
    upper: PerJoint = param(UPPER, "upper ends of the range of motion", "rad")
    rom_margin: float = param(
        radians(5.0), "a joint further outside its range stops the robot", "rad", ge=0.0, live=True
    )
    rom_speed: float = param(radians(60.0), "a joint faster than this stops the robot", "rad/s", gt=0.0, live=True)
    startup: float = param(3.0, "time after the first voltage without a check of the speed", "s", ge=0.0)
    start_outside: bool = param(False, "allow q(0) outside the range of motion; a joint is checked once it is inside")
    force_limit: float = param(200.0, "a larger force at the foot is limited to this", "N", gt=0.0, live=True)

    def _check(self) -> None:
        n = len(JOINTS)
        self.motors.table(n)
        for name in ("coulomb", "static", "viscous"):
            values = spread(f"friction.{name}", getattr(self.friction, name), n)
            require_positive(f"friction.{name}", values, or_zero=True)
        spread("disturbance.torque", self.disturbance.torque, n)
        spread("velocity", self.velocity, n)
        q = spread("position", self.position, n)
        low, high = spread("lower", self.lower, n), spread("upper", self.upper, n)
        for i, joint in enumerate(JOINTS):
            if low[i] >= high[i]:
                raise ValueError(f"lower = {list(self.lower)} and upper = {list(self.upper)}: expected lower < upper")
            if not self.start_outside and not low[i] <= q[i] <= high[i]:
                raise ValueError(
                    f"position of the {joint} = {q[i]:g} rad is outside its range {low[i]:g} to "
                    f"{high[i]:g} rad (start_outside allows it)"
                )


class State(NamedTuple):
    """The state of `DrivenRobot`, the foot force (N) and voltages (V) of the previous period, and monitored events.

    The monitored events are the joints that have been inside their range, and whether the robot was stopped. Two times
    (ns) follow: when control began, and when the previous period began. If nodes are started by hand, the plant may
    have run alone for long before control began.
    """

    q: Vector
    v: Vector
    i: Vector
    saturated: tuple[int, ...]
    force: Vector
    applied: Vector
    entered: tuple[bool, ...]
    safe: bool = False
    live: int | None = None
    since: int | None = None


class RehabPlant(DrivenRobot[RehabParams]):
    """Motor voltages and the patient's force in; joint states, motor states and applied voltages out.

    The force acts at the foot with the sign of the left side of (1): positive J^T F_e opposes positive motion.
    A joint outside its range of motion or too fast stops the robot: 0 V until the next start.
    """

    TRIPS: ClassVar[frozenset[str]] = frozenset({"safe"})
    TIP = FOOT
    INPUTS = (
        command("motor_command", "motor_command", JOINTS, "V"),
        wrench(PATIENT_FORCE, PATIENT_FORCE, FOOT, held=True),
    )
    OUTPUTS = (
        joint_state("joint_states", "joint_states", JOINTS, position="rad", velocity="rad/s", effort="N m"),
        joint_state("motor_states", "motor_states", JOINTS, effort="A"),
        command("applied_voltage", "applied_voltage", JOINTS, "V"),
    )

    @classmethod
    def agreed(cls, params: RehabParams) -> Mapping[str, Any]:
        """Return the quantities on which the stability of a controller depends."""
        p, drift = params, RobotDrift(resistance=params.drift.resistance, constants=params.drift.constants)
        robot = LinearRobot(
            segments=p.segments,
            motors=p.motors,
            viscous=p.friction.viscous,
            payload=p.payload,
            torque_constant_side=p.torque_constant_side,
            lower=p.lower,
            upper=p.upper,
            drift=drift,
        )
        return robot.agreed()

    def joints(self) -> tuple[str, ...]:
        """Hip and knee."""
        return JOINTS

    @classmethod
    def robot(cls, params: RehabParams) -> str:
        """Write the URDF."""
        return rehab_urdf(params.segments, spread("lower", params.lower, 2), spread("upper", params.upper, 2))

    def initial(self) -> tuple[Vector, Vector]:
        """Return q(0) and its rate."""
        return spread("position", self.p.position, self.n), spread("velocity", self.p.velocity, self.n)

    def friction(self) -> Friction:
        """Return the friction at the joints."""
        f = self.p.friction
        coulomb, static, viscous = (
            spread(f"friction.{k}", getattr(f, k), self.n) for k in ("coulomb", "static", "viscous")
        )
        return Friction(coulomb, static, viscous, f.stribeck_speed, f.edge_speed)

    def setup(self) -> None:
        """Prepare disturbance, drift and limits."""
        super().setup()
        p = self.p
        none = (0.0,) * self.n
        self._undisturbed, self._disturbed = (none, none), (none, spread("d", p.disturbance.torque, self.n))
        self._begin, self._end = to_ns(p.disturbance.begin), to_ns(p.disturbance.end)
        self._drifts = p.drift.resistance != 0.0 or p.drift.constants != 0.0
        low, high = spread("lower", p.lower, self.n), spread("upper", p.upper, self.n)
        self._low = tuple(q - p.rom_margin for q in low)
        self._high = tuple(q + p.rom_margin for q in high)
        self._startup = to_ns(p.startup)

    def torque_constants(self, table: Mapping[str, Vector]) -> Vector:
        """Return the torque constants on the joint side of the gears, N m/A."""
        if self.p.torque_constant_side == "joint":
            return table["torque_constant"]
        return super().torque_constants(table)

    def first(self) -> State:
        """Return the initial state of the leg and report inconsistencies of the motor table."""
        table = self._table
        shaft = [k * r for k, r in zip(self.torque_constants(table), table["gear"], strict=True)]
        ratios = [k / b for k, b in zip(shaft, table["back_emf_constant"], strict=True)]
        if any(abs(ratio - 1.0) > 0.2 for ratio in ratios):
            text = (
                f"K_m/K_b = {[float(f'{x:.4g}') for x in ratios]} at the motor shaft, where SI units need 1: these "
                "motors give more mechanical than electrical power"
            )
            self.report(Level.WARN, "torque_constant", text)
        none = (0.0,) * self.n
        q, v = self.initial()
        return State(q, v, none, (0,) * self.n, self.nowhere, none, (False,) * self.n)

    def loads(self, t: int) -> tuple[Vector, Vector]:
        """Return the disturbance torques; no voltage drop."""
        return self._disturbed if self._begin <= t < self._end else self._undisturbed

    def drifted(self, t: int | None) -> Vector:
        """Return the numbers of the compiled step of the period that begins at t, None before the first."""
        if t is None or not self._drifts:
            return self._plant
        done = min(1.0, to_s(t) / self.p.drift.duration)
        return self.motors(1.0 + done * self.p.drift.resistance, 1.0 + done * self.p.drift.constants)[1]

    def advance(self, x: State, t: int, *, motor_command: Vector, patient_force: Vector | None = None) -> State:
        """Move with the clipped voltages and the force held."""
        live = t if x.live is None and any(motor_command) else x.live
        entered, safe = self._watch(x, t, live)
        force = clip_force(self, patient_force, self.p.force_limit)
        saturated, applied = (x.saturated, (0.0,) * self.n) if safe else self.clip(x.saturated, motor_command)
        q, v, i = self.move(x, t, applied, force, self.drifted(t))
        return State(q, v, i, saturated, force, applied, entered, safe, live, t)

    def _watch(self, x: State, t: int, live: int | None) -> tuple[tuple[bool, ...], bool]:
        """Return which joints have been inside their range, and whether one is where or as fast as it must not be."""
        safe = x.safe
        started = live is not None and t >= live + self._startup
        in_range = [low <= q <= high for low, q, high in zip(self._low, x.q, self._high, strict=True)]
        entered = tuple(now or once for now, once in zip(in_range, x.entered, strict=True))
        for i, joint in enumerate(JOINTS):
            left_range = not in_range[i] and entered[i]
            if not safe and (left_range or (started and abs(x.v[i]) > self.p.rom_speed)):
                reason = f"{joint} at {x.v[i]:.4g} rad/s, limit {self.p.rom_speed:.4g} rad/s"
                if left_range:
                    reason = f"{joint} at {x.q[i]:.4g} rad, range {self._low[i]:.4g} to {self._high[i]:.4g} rad"
                safe = True
                self.report(Level.ERROR, "safe", f"SAFE from t = {to_s(t):.9g} s, motors at 0 V: {reason}")
        return entered, safe

    def outputs(self, x: State, t: int) -> Values:
        """Return joint states with the torques after the gears, currents, and the voltages of the last period."""
        return {
            "joint_states": (*x.q, *x.v, *self.gear_torques(x, t, x.force, self.drifted(x.since))),
            "motor_states": x.i,
            "applied_voltage": x.applied,
        }
