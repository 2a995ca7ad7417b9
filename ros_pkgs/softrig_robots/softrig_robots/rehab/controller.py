"""Voltage controllers of the rehabilitation robot: one law a joint, without a model of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple, Protocol

from softrig_core import (
    Block,
    BlockParams,
    Level,
    Port,
    Values,
    command,
    joint_state,
    param,
    reference,
    scalars,
    to_ns,
)

from .arsc import Arsc, ArscGains
from .emvc import Emvc, EmvcGains
from .model import JOINTS
from .stability import LinearRobot, alpha_hat_limit, is_stable
from .tsarc import Tsarc, TsarcGains

Vector = tuple[float, ...]
NOTHING = (0.0,) * len(JOINTS)  # V


class Law(Protocol):
    """Voltage of one motor; its x is a row of numbers that stays when the gains change."""

    UNITS: ClassVar[dict[str, str]]  # units of those first fields of x that are shown

    def first(self) -> Any:
        """Return the state without a past."""

    def __call__(
        self, x: Any, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float
    ) -> tuple[Any, float]:
        """Return x and voltage for joint state, current and reference; V is the voltage of the last period."""


LAWS: dict[str, Any] = {"emvc": Emvc, "tsarc": Tsarc, "arsc": Arsc}


class VoltageControllerParams(BlockParams):
    """Parameters of the controller: the selected law, and the preset of each law."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    law: Literal["emvc", "tsarc", "arsc"] = param("emvc", "control law: emvc, tsarc or arsc")
    v_max: float = param(24.0, "voltage limit", "V", gt=0.0, live=True)
    emvc: EmvcGains = EmvcGains()
    tsarc: TsarcGains = TsarcGains()
    arsc: ArscGains = ArscGains()
    use_applied: bool = param(
        True, "emvc continues from the voltage that the plant reports as applied, not from its own"
    )
    loop_delay: bool = param(False, "emvc: warn as if voltages take effect one period late")
    robot: LinearRobot = LinearRobot()
    stale_after: int = param(
        20, "periods without a new reference after which it counts as lost", ge=1, le=1000000, live=True
    )
    reference_lost: Literal["safe", "hold"] = param(
        "safe", "then: safe, 0 V on both motors, or hold the last position with speed zero", live=True
    )

    def _check(self) -> None:
        self.laws()

    def laws(self) -> list[Law]:
        """Create one law a joint."""
        gains: EmvcGains | TsarcGains | ArscGains = getattr(self, self.law)
        n = len(JOINTS)
        return [LAWS[self.law](gains.of_joint(self.law, i, n), T=self.period, v_max=self.v_max) for i in range(n)]


class State(NamedTuple):
    """State of each joint's law, last voltages (V), last errors (rad), and the number of refused ticks in a row."""

    laws: tuple[Any, ...]
    sent: Vector = NOTHING
    errors: Vector | None = None
    refusals: int = 0


Answer = tuple[State, Mapping[str, Vector]]


class VoltageController(Block[VoltageControllerParams]):
    """Joint and motor states and a reference in, motor voltages out.

    It subscribes to the topic ``reference``; remap it to ``regenerated`` if there is an impedance node.

    A reference older than `stale_after` periods is lost. The controller then sets 0 V (SAFE) or holds the last position
    with speed and acceleration zero, depending on `reference_lost`, until a new reference arrives. If joint or motor
    states are as old, it sets 0 V. If a message is rejected, it repeats the last voltages. After `stale_after` such
    ticks it sets 0 V, because without valid states it cannot hold a position.

    Gains and limits may change during a run; the control law may not. The stability limit is reported for `robot`,
    which must equal the plant of the rig.
    """

    @classmethod
    def ports(cls, params: VoltageControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare a state output with the controller's memory."""
        units = {"e": "rad", **LAWS[params.law].UNITS}
        applied = (command("applied_voltage", "applied_voltage", JOINTS, "V"),)
        return (
            joint_state("joint_states", "joint_states", JOINTS, position="rad", velocity="rad/s"),
            joint_state("motor_states", "motor_states", JOINTS, effort="A"),
            reference("reference", "reference", JOINTS, position="rad", velocity="rad/s", acceleration="rad/s^2"),
            *(applied if params.use_applied else ()),
        ), (
            command("motor_command", "motor_command", JOINTS, "V"),
            scalars(
                "controller_state",
                "controller_state",
                {f"{name}_{joint}": unit for name, unit in units.items() for joint in JOINTS},
            ),
        )

    @classmethod
    def agreed(cls, params: VoltageControllerParams) -> Mapping[str, Any]:
        """Return the robot whose stability limit is reported; the other controllers have none."""
        return params.robot.agreed() if params.law == "emvc" else {}

    def setup(self) -> None:
        """Create the laws."""
        self._laws = self.p.laws()
        self._shown = len(self._laws[0].UNITS)
        self._stale = self.p.stale_after * to_ns(self.p.period)

    def first(self) -> State:
        """Return controllers without a past, and warn of an expected-model controller that cannot be stable."""
        self._check_stability()
        return State(tuple(law.first() for law in self._laws))

    def go_on(self, x: State, before: VoltageControllerParams) -> State:
        """Continue with other gains and warn as at the start; each control law's docstring describes its state."""
        self._check_stability()
        return x

    def _check_stability(self) -> None:
        p = self.p
        if p.law != "emvc":
            return
        late = "one period of delay" if p.loop_delay else "no delay"
        gains = [p.emvc.of_joint("emvc", i, len(JOINTS)) for i in range(len(JOINTS))]
        (a1, a2), (l1, l2) = ([getattr(g, k) for g in gains] for k in ("alpha_hat", "lam"))
        if is_stable(p.period, (a1, a2), (l1, l2), p.loop_delay, p.use_applied, p.robot):
            return
        together = True
        for joint, alpha_hat, lam in zip(JOINTS, (a1, a2), (l1, l2), strict=True):
            limit = alpha_hat_limit(p.period, lam, p.loop_delay, p.use_applied, p.robot)
            if alpha_hat > limit:
                text = (
                    f"alpha_hat = {alpha_hat:g} V s/rad of the {joint} is above the stability limit {limit:.3g} for "
                    f"T = {p.period:g} s, lambda = {lam:g} 1/s and {late}"
                )
                self.report(Level.WARN, f"stability {joint}", text)
                together = False
        if together:
            self.report(Level.WARN, "stability", "alpha_hat and lambda of hip and knee together are unstable")

    def update(
        self,
        x: State,
        t: int,
        *,
        joint_states: Vector,
        motor_states: Vector,
        reference: Vector,
        applied_voltage: Vector | None = None,
    ) -> Answer:
        """Return the voltages."""
        q1, q2, v1, v2 = joint_states
        r1, r2, rv1, rv2, ra1, ra2 = reference
        lost = (self.age("reference") or 0) > self._stale
        if lost and self.p.reference_lost == "hold":
            self.report(Level.ERROR, "reference", f"{self._lost('reference')}: its position is held with speed zero")
            rv1 = rv2 = ra1 = ra2 = 0.0
            lost = False
        still = (self.age("joint_states") or 0) > self._stale
        dead = (self.age("motor_states") or 0) > self._stale
        if lost or still or dead:
            blind = [n for n, is_so in (("joint_states", still), ("motor_states", dead)) if is_so]
            self.report(Level.ERROR, "SAFE", f"SAFE: {self._lost(*blind or ['reference'])}: 0 V")
            return self._answer(x.laws, NOTHING, (r1 - q1, r2 - q2))
        V1, V2 = x.sent if applied_voltage is None else applied_voltage
        first, second = self._laws
        x1, u1 = first(x.laws[0], q1, v1, motor_states[0], r1, rv1, ra1, V1)
        x2, u2 = second(x.laws[1], q2, v2, motor_states[1], r2, rv2, ra2, V2)
        return self._answer((x1, x2), (u1, u2), (r1 - q1, r2 - q2))

    def refused(self, x: State, t: int) -> tuple[State, Values | None]:
        """Return the last voltages, after `stale_after` ticks 0 V."""
        refusals = x.refusals + 1
        if refusals <= self.p.stale_after:
            return x._replace(refusals=refusals), None
        self.report(Level.ERROR, "SAFE", f"SAFE: {self.p.stale_after} ticks with a rejected input: 0 V")
        if x.errors is None:
            return x._replace(refusals=refusals), None
        return self._answer(x.laws, NOTHING, x.errors, refusals)

    def _lost(self, *names: str) -> str:
        return f"no new {' and '.join(names)} for more than {self.p.stale_after} periods"

    def _answer(self, laws: tuple[Any, Any], sent: Vector, errors: Vector, refusals: int = 0) -> Answer:
        first, second = laws
        shown = [v for k in range(self._shown) for v in (first[k], second[k])]
        return State(laws, sent, errors, refusals), {"motor_command": sent, "controller_state": (*errors, *shown)}
