"""Voltage controllers of the rehabilitation robot: one law a joint, without a model of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal, Protocol, Self

from pydantic import model_validator
from softrig_core import (
    Block,
    BlockParams,
    Level,
    Port,
    command,
    executable,
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


class Law(Protocol):
    """Voltage of one motor."""

    STATE: ClassVar[dict[str, str]]  # names of what the law remembers, with units

    @property
    def state(self) -> Vector:
        """Values of `STATE`."""

    def start(self) -> None:
        """Forget everything."""

    def go_on(self, before: Any) -> None:
        """Take the place of the same law with other gains."""

    def __call__(self, q: float, qd: float, current: float, ref: float, ref_d: float, ref_dd: float, V: float) -> float:
        """Give the voltage for joint state, current and reference; V is the voltage of the last period."""


LAWS: dict[str, Any] = {"emvc": Emvc, "tsarc": Tsarc, "arsc": Arsc}


class VoltageControllerParams(BlockParams):
    """Which law, with the preset of each."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    law: Literal["emvc", "tsarc", "arsc"] = param("emvc", "control law: emvc, tsarc or arsc")
    v_max: float = param(24.0, "voltage limit", "V", gt=0.0, live=True)
    emvc: EmvcGains = EmvcGains()
    tsarc: TsarcGains = TsarcGains()
    arsc: ArscGains = ArscGains()
    use_applied: bool = param(True, "emvc goes on from the voltage that the plant says it applied, not from its own")
    loop_delay: bool = param(False, "emvc: warn as if voltages take effect one period late")
    robot: LinearRobot = LinearRobot()
    stale_after: int = param(
        20, "periods without a new reference after which it counts as lost", ge=1, le=1000000, live=True
    )
    reference_lost: Literal["safe", "hold"] = param(
        "safe", "then: safe, 0 V on both motors, or hold the last position with speed zero", live=True
    )

    @model_validator(mode="after")
    def _fits(self) -> Self:
        self.laws()
        return self

    def laws(self) -> list[Law]:
        """Make one law a joint."""
        gains: EmvcGains | TsarcGains | ArscGains = getattr(self, self.law)
        n = len(JOINTS)
        common = {"T": self.period, "v_max": self.v_max}
        return [LAWS[self.law](**gains.of_joint(self.law, i, n), **common) for i in range(n)]


class VoltageController(Block[VoltageControllerParams]):
    """Joint and motor states and a reference in, motor voltages out.

    Reads the topic ``reference``; remap it to ``regenerated`` behind an impedance law.

    A reference older than `stale_after` periods is lost: 0 V (SAFE) or its last position with speed and acceleration
    zero, as `reference_lost` says, until it comes again. Joint or motor states as old give 0 V. Messages that are
    refused are answered by the last voltages, after as many ticks by 0 V: what is refused shows no position to hold.

    Gains and limits may change while it runs, the law itself may not; `robot` is what a stability limit is told for,
    on which the nodes of a rig agree.
    """

    @classmethod
    def ports(cls, params: VoltageControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """The state has what the law remembers."""
        units = {"e": "rad", **LAWS[params.law].STATE}
        applied = (command("applied_voltage", "applied_voltage", JOINTS, "V"),)
        return (
            joint_state("joint_states", "joint_states", JOINTS, position="rad", velocity="rad/s"),
            joint_state("motor_states", "motor_states", JOINTS, effort="A"),
            reference("reference", "reference", JOINTS, position="rad", velocity="rad/s", acceleration="rad/s^2"),
            *(applied if params.use_applied else ()),
        ), (
            command("motor_command", "motor_command", JOINTS, "V"),
            scalars("controller_state", "controller_state",
                    {f"{name}_{joint}": unit for name, unit in units.items() for joint in JOINTS}),
        )  # fmt: skip

    @classmethod
    def agreed(cls, params: VoltageControllerParams) -> Mapping[str, Any]:
        """The robot whose stability limit is told; the other laws have none."""
        return params.robot.agreed() if params.law == "emvc" else {}

    def setup(self) -> None:
        """Make the laws."""
        self._laws = self.p.laws()
        self._stale = self.p.stale_after * to_ns(self.p.period)

    def change(self, params: VoltageControllerParams) -> None:
        """Take other gains; each law goes on, as its docstring says. Warn as at the start."""
        before = self._laws
        super().change(params)
        for law, old in zip(self._laws, before, strict=True):
            law.go_on(old)
        if params.law == "emvc":
            self._check_stability()

    def start(self) -> None:
        """Start every law anew, and warn of an expected-model law that cannot be stable."""
        for law in self._laws:
            law.start()
        self._sent: Vector = (0.0,) * len(JOINTS)
        self._refusals = 0
        self._said: Mapping[str, Vector] = {}
        if self.p.law == "emvc":
            self._check_stability()

    def _check_stability(self) -> None:
        p = self.p
        late = "one period of delay" if p.loop_delay else "no delay"
        gains = [p.emvc.of_joint("emvc", i, len(JOINTS)) for i in range(len(JOINTS))]
        (a1, a2), (l1, l2) = ([g[k] for g in gains] for k in ("alpha_hat", "lam"))
        if is_stable(p.period, (a1, a2), (l1, l2), p.loop_delay, p.use_applied, p.robot):
            return
        for joint, alpha_hat, lam in zip(JOINTS, (a1, a2), (l1, l2), strict=True):
            limit = alpha_hat_limit(p.period, lam, p.loop_delay, p.use_applied, p.robot)
            if alpha_hat > limit:
                text = (
                    f"alpha_hat = {alpha_hat:g} V s/rad of the {joint} is above the stability limit {limit:.3g} for "
                    f"T = {p.period:g} s, lambda = {lam:g} 1/s and {late}"
                )
                self.report(Level.WARN, f"stability {joint}", text)
        if not self.reports:
            self.report(Level.WARN, "stability", "alpha_hat and lambda of hip and knee together are unstable")

    def update(
        self, t: int, *, joint_states: Vector, motor_states: Vector, reference: Vector,
        applied_voltage: Vector | None = None,
    ) -> Mapping[str, Vector]:  # fmt: skip
        """Give the voltages."""
        self._refusals = 0
        q1, q2, v1, v2 = joint_states
        r1, r2, rv1, rv2, ra1, ra2 = reference
        lost = (self.age("reference") or 0) > self._stale
        if lost and self.p.reference_lost == "hold":
            self.report(Level.ERROR, "reference", f"{self._lost('reference')}: its position is held with speed zero")
            rv1 = rv2 = ra1 = ra2 = 0.0
            lost = False
        blind = [n for n in ("joint_states", "motor_states") if (self.age(n) or 0) > self._stale]
        if lost or blind:
            self.report(Level.ERROR, "SAFE", f"SAFE: {self._lost(*blind or ['reference'])}: 0 V")
            self._sent = (0.0,) * len(JOINTS)
            return self._say(r1 - q1, r2 - q2)
        last = self._sent if applied_voltage is None else applied_voltage
        first, second = self._laws
        self._sent = (
            first(q1, v1, motor_states[0], r1, rv1, ra1, last[0]),
            second(q2, v2, motor_states[1], r2, rv2, ra2, last[1]),
        )
        return self._say(r1 - q1, r2 - q2)

    def refused(self, t: int) -> Mapping[str, Vector] | None:
        """Give the last voltages, after `stale_after` ticks 0 V."""
        self._refusals += 1
        if self._refusals <= self.p.stale_after:
            return None
        self.report(Level.ERROR, "SAFE", f"SAFE: {self.p.stale_after} ticks of which something was refused: 0 V")
        self._sent = (0.0,) * len(JOINTS)
        return {**self._said, "motor_command": self._sent} if self._said else None

    def _lost(self, *names: str) -> str:
        return f"no new {' and '.join(names)} for more than {self.p.stale_after} periods"

    def _say(self, *errors: float) -> Mapping[str, Vector]:
        first, second = self._laws
        remembered = [x for pair in zip(first.state, second.state, strict=True) for x in pair]
        self._said = {"motor_command": self._sent, "controller_state": (*errors, *remembered)}
        return self._said


main = executable(VoltageController)
