"""A demand that changes in steps."""

from __future__ import annotations

from collections.abc import Mapping

from pydantic import model_validator
from softrig_core import Block, BlockParams, executable, param, scalars, to_ns


class DemandParams(BlockParams):
    """Demands and when they begin."""

    period: float = param(1.0, "sampling period", "s", gt=0.0, le=86400.0)
    demands: tuple[float, ...] = param(
        (1800.0,), "total outputs asked for, one after the other", "MW", min_length=1, each=(0.0, 1e6), live=True
    )
    times: tuple[float, ...] = param((), "when each but the first begins", "s", each=(0.0, 1e9), live=True)

    @model_validator(mode="after")
    def _rising(self) -> DemandParams:
        if len(self.times) != len(self.demands) - 1:
            raise ValueError(f"{len(self.times)} times for {len(self.demands)} demands: expected one less")
        if list(self.times) != sorted(set(self.times)) or min(self.times, default=1.0) <= 0.0:
            raise ValueError(f"times {list(self.times)}: expected rising and positive")
        return self


class DemandSource(Block[DemandParams]):
    """Demand of the system, in steps."""

    OUTPUTS = (scalars("demand", "dispatch/demand", {"demand_MW": "MW"}),)

    def setup(self) -> None:
        """Instants in ns."""
        self._times = [to_ns(s) for s in self.p.times]

    def update(self, x: tuple[()], t: int) -> tuple[tuple[()], Mapping[str, tuple[float, ...]]]:
        """Give the demand of now."""
        return x, {"demand": (self.p.demands[sum(t >= at for at in self._times)],)}


main = executable(DemandSource)
