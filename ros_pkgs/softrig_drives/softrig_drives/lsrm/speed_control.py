"""Base of the three speed controllers."""

from __future__ import annotations

from typing import ClassVar

from softrig_core import Block, BlockParams, Port, param
from typing_extensions import TypeVar

from .ports import FORCE_CMD, REFERENCE, SPEED


class SpeedControlParams(BlockParams):
    """Rate and range of the force command."""

    period: float = param(1e-3, "sampling period Ts", "s", gt=0.0, le=0.1)
    F_max: float = param(40.0, "largest force command, G I_max^2/2", "N", gt=0.0, le=1e4, live=True)


P = TypeVar("P", bound=SpeedControlParams, default=SpeedControlParams)


class SpeedControl(Block[P]):
    """Base of the speed controllers: speed and reference in, force out.

    If a measurement or reference is refused, the law's state stays and the force is held for one period.
    """

    INPUTS: ClassVar[tuple[Port, ...]] = (SPEED, REFERENCE)
    OUTPUTS: ClassVar[tuple[Port, ...]] = (FORCE_CMD,)

    def clip(self, force: float) -> float:
        """Return the force within plus and minus F_max."""
        F_max: float = self.p.F_max
        return min(max(force, -F_max), F_max)
