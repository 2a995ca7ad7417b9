"""Base of the motor's speed controllers: ports, set point, checks."""

from __future__ import annotations

from typing import Any

from softrig_core import Block, BlockParams, Level, Values, param
from typing_extensions import TypeVar


class SpeedControlParams(BlockParams):
    """Set point and its range."""

    set_point: float = param(10.0, "speed reference until one arrives on motor/reference", "rad/s", live=True)
    reference_limit: float = param(
        21.8, "largest speed whose current the rig's sensor can measure", "rad/s", gt=0.0, live=True
    )

    def _check(self) -> None:
        if abs(self.set_point) > self.reference_limit:
            raise ValueError(
                f"set_point = {self.set_point:g} rad/s: beyond reference_limit = {self.reference_limit:g} rad/s"
            )


P = TypeVar("P", bound=SpeedControlParams, default=SpeedControlParams)


class SpeedControl(Block[P]):
    """Base of the speed controllers.

    A law stores the reference that it follows in its state, as r, and calls `reference` for that of the present tick.
    If an input is refused, the command of this tick is 0 V, and the state of the law stays. A changed `set_point` is in
    force until a reference arrives. A smaller `reference_limit` does not change the present reference.
    """

    def go_on(self, x: Any, before: P) -> Any:
        """Follow another set point."""
        return x if self.p.set_point == before.set_point else x._replace(r=self.p.set_point)

    def reference(self, r: float, message: tuple[float, ...] | None) -> float:
        """Return the reference to follow, r being the one so far: the newest in range."""
        if message is None or message[0] == r:
            return r
        new = message[0]
        if abs(new) > self.p.reference_limit:
            self.report(
                Level.WARN,
                "reference_range",
                f"reference {new:g} rad/s is beyond {self.p.reference_limit:g} rad/s; {r:g} rad/s is kept",
            )
            return r
        return new

    def refused(self, x: Any, t: int) -> tuple[Any, Values]:
        """Return 0 V and report the error."""
        self.report(Level.ERROR, "refused", "measurement or reference was refused; command 0 V")
        return x, {port.name: (0.0,) * port.size for port in self.ports(self.p)[1]}
