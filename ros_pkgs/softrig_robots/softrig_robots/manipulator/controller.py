"""Voltage controllers of the arm: one scalar law a joint, the same for all, without a model of the robot."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, Protocol, Self

from pydantic import model_validator
from softrig_core import Block, BlockParams, Port, command, executable, joint_state, param, reference, scalars

from ..joints import motor_names
from .adsmc import Adsmc, AdsmcGains
from .dsmc import Dsmc, DsmcGains
from .plant import JOINTS
from .smc import Smc, SmcGains

Vector = tuple[float, ...]


class Law(Protocol):
    """Voltage of one motor from the error of its joint."""

    s: float
    sigma: float
    f_hat: float

    def start(self) -> None:
        """Forget everything."""

    def go_on(self, before: Any) -> None:
        """Take the place of the same law with other gains."""

    def __call__(self, qdd_d: float, e: float, ed: float) -> float:
        """Give the voltage for the desired acceleration, the error and its rate (rad, s)."""


class VcsControllerParams(BlockParams):
    """Which law, with the published gains of each."""

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

    @model_validator(mode="after")
    def _fits(self) -> Self:
        self.laws()
        return self

    def laws(self) -> list[Law]:
        """Make one law a joint."""
        n = len(self.joints)
        common: dict[str, Any] = {"T": self.period, "v_max": self.v_max}
        if self.law == "smc":
            return [Smc(**self.smc.of_joint("smc", i, n), **common) for i in range(n)]
        common["printed_mu1"] = self.use_printed_mu1
        if self.law == "dsmc":
            return [Dsmc(**self.dsmc.of_joint("dsmc", i, n), **common) for i in range(n)]
        common["adapt_at_limit"] = self.adapt_at_limit
        return [Adsmc(**self.adsmc.of_joint("adsmc", i, n), **common) for i in range(n)]


class VcsController(Block[VcsControllerParams]):
    """Joint states and reference in, motor voltages out.

    Gains and limits may change while it runs, the law itself may not: another one would begin from nothing.
    """

    @classmethod
    def ports(cls, params: VcsControllerParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """One motor a joint."""
        joints = params.joints
        kinds = {"e": "rad", "s": "rad/s", "sigma": "rad/s^2", "fhat": "V/s"}
        state = {f"{kind}{i + 1}": unit for kind, unit in kinds.items() for i in range(len(joints))}
        return (
            joint_state("joint_states", "joint_states", joints, position="rad", velocity="rad/s"),
            reference("reference", "reference", joints, position="rad", velocity="rad/s", acceleration="rad/s^2"),
        ), (
            command("motor_command", "motor_command", motor_names(joints), "V"),
            scalars("controller_state", "controller_state", state),
        )

    def setup(self) -> None:
        """Make the laws."""
        self.laws = self.p.laws()
        self._n = len(self.laws)

    def change(self, params: VcsControllerParams) -> None:
        """Take other gains; each law goes on, as its docstring says."""
        before = self.laws
        super().change(params)
        for law, old in zip(self.laws, before, strict=True):
            law.go_on(old)

    def start(self) -> None:
        """Start every law anew."""
        for law in self.laws:
            law.start()

    def update(self, t: int, *, joint_states: Vector, reference: Vector) -> Mapping[str, Vector]:
        """Give the voltages."""
        n, laws = self._n, self.laws
        e = [reference[i] - joint_states[i] for i in range(n)]
        rate = [reference[i] - joint_states[i] for i in range(n, 2 * n)]
        voltages = [law(reference[2 * n + i], e[i], rate[i]) for i, law in enumerate(laws)]
        state = (*e, *[law.s for law in laws], *[law.sigma for law in laws], *[law.f_hat for law in laws])
        return {"motor_command": tuple(voltages), "controller_state": state}


main = executable(VcsController)
