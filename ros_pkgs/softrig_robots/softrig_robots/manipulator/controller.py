"""Voltage controllers of the arm: one scalar law a joint, the same for all, without a model of the robot."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple, Protocol

from softrig_core import Block, BlockParams, Port, Values, command, joint_state, param, reference, scalars

from ..joints import JointGains, motor_names
from .adsmc import Adsmc, AdsmcGains
from .dsmc import Dsmc, DsmcGains
from .plant import JOINTS
from .smc import Smc, SmcGains

Vector = tuple[float, ...]


class Law(Protocol):
    """Voltage of one motor from the error of its joint; its x has the fields s, sigma and f_hat."""

    def first(self) -> Any:
        """Return the state without a past."""

    def go_on(self, x: Any) -> Any:
        """Return the state with which these gains follow others."""

    def __call__(self, x: Any, qdd_d: float, e: float, ed: float) -> tuple[Any, float]:
        """Return the state after, and the voltage for the desired acceleration, the error and its rate (rad, s)."""


LAWS: dict[str, Any] = {"adsmc": Adsmc, "dsmc": Dsmc, "smc": Smc}


class State(NamedTuple):
    """State of the control law of each joint."""

    laws: tuple[Any, ...]


class VcsControllerParams(BlockParams):
    """Parameters of the controller: the selected law, and the published gains of each law."""

    period: float = param(0.001, "sampling period T", "s", gt=0.0, le=100.0)
    joints: tuple[str, ...] = param(JOINTS, "joint names", min_length=1)
    law: Literal["adsmc", "dsmc", "smc"] = param("adsmc", "control law: adsmc, dsmc or smc")
    v_max: float = param(40.0, "voltage limit", "V", gt=0.0, live=True)
    adsmc: AdsmcGains = AdsmcGains()
    dsmc: DsmcGains = DsmcGains()
    smc: SmcGains = SmcGains()
    use_printed_mu1: bool = param(False, "mu_1 = a_1 + b_2 as printed, instead of a_1 + b_1")
    adapt_at_limit: bool = param(
        False, "adsmc: let f-hat wind up while the voltage is limited, as published", live=True
    )

    def _check(self) -> None:
        self.laws()

    def laws(self) -> list[Law]:
        """Create one law a joint."""
        n = len(self.joints)
        common: dict[str, Any] = {"T": self.period, "v_max": self.v_max}
        if self.law != "smc":
            common["printed_mu1"] = self.use_printed_mu1
        if self.law == "adsmc":
            common["adapt_at_limit"] = self.adapt_at_limit
        gains: JointGains = getattr(self, self.law)
        return [LAWS[self.law](gains.of_joint(self.law, i, n), **common) for i in range(n)]


class VcsController(Block[VcsControllerParams]):
    """Joint states and reference in, motor voltages out.

    Gains and limits may change while it runs. The law may not, because another one would have no state to continue
    from.
    """

    @classmethod
    def ports(cls, params: VcsControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one motor per joint."""
        joints = params.joints
        units = {"e": "rad", "s": "rad/s", "sigma": "rad/s^2", "fhat": "V/s"}
        state = {f"{name}{i + 1}": unit for name, unit in units.items() for i in range(len(joints))}
        return (
            joint_state("joint_states", "joint_states", joints, position="rad", velocity="rad/s"),
            reference("reference", "reference", joints, position="rad", velocity="rad/s", acceleration="rad/s^2"),
        ), (
            command("motor_command", "motor_command", motor_names(joints), "V"),
            scalars("controller_state", "controller_state", state),
        )

    def setup(self) -> None:
        """Create the laws."""
        self.laws = self.p.laws()
        self._n = len(self.laws)

    def first(self) -> State:
        """Return controllers without a past."""
        return State(tuple(law.first() for law in self.laws))

    def go_on(self, x: State, before: VcsControllerParams) -> State:
        """Continue with other gains; the docstring of each control law describes how its state continues."""
        return State(tuple(law.go_on(inner) for law, inner in zip(self.laws, x.laws, strict=True)))

    def update(self, x: State, t: int, *, joint_states: Vector, reference: Vector) -> tuple[State, Values]:
        """Return the voltages."""
        n = self._n
        e = [reference[i] - joint_states[i] for i in range(n)]
        rate = [reference[i] - joint_states[i] for i in range(n, 2 * n)]
        results = [
            law(inner, reference[2 * n + i], e[i], rate[i])
            for i, (law, inner) in enumerate(zip(self.laws, x.laws, strict=True))
        ]
        laws, voltages = zip(*results, strict=True)
        state = (
            *e,
            *[inner.s for inner in laws],
            *[inner.sigma for inner in laws],
            *[inner.f_hat for inner in laws],
        )
        return State(laws), {"motor_command": voltages, "controller_state": state}
