"""The units themselves: they follow their set points, within limits and ramps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from softrig_core import BlockParams, Plant, Port, Values, command, joint_state, param, scalars, state_type

from .units import Units, UnitTable


class FleetParams(UnitTable, BlockParams):
    """Units and how fast they move."""

    period: float = param(1.0, "sampling period", "s", gt=0.0, le=86400.0)
    ramp: float = param(
        0.0, "fastest change of a unit's output; 0: none, as in the paper", "MW/s", ge=0.0, le=1e6, live=True
    )


class UnitFleet(Plant[FleetParams]):
    """Thermal units that start at their lower limits and go to their set points.

    Outputs: output (MW) and marginal cost dF/dP ($/MWh) of each unit, the mean of both sides at a valve point; sum of
    outputs and of costs.
    """

    DRAWN_BY = "softrig_power.dispatch.drawing:Fleet"

    @classmethod
    def agreed(cls, params: FleetParams) -> Mapping[str, Any]:
        """The units."""
        return Units.read(params.unit_table).agreed()

    @classmethod
    def ports(cls, params: FleetParams) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
        """Declare one channel per unit."""
        units = Units.read(params.unit_table)
        setpoints = command(
            "setpoints", "dispatch/setpoints", units.ids, "MW", sporadic=True, safe=tuple(units.p_min.tolist())
        )
        state = joint_state("state", "fleet/state", units.ids, position="MW", effort="$/MWh")
        return (setpoints,), (state, scalars("total", "fleet/total", {"output": "MW", "cost": "$/h"}))

    def setup(self) -> None:
        """Read the table."""
        self._units = Units.read(self.p.unit_table)

    def first(self) -> Any:
        """Return all units at their lower limits; the state is the output P (MW) of each."""
        return state_type(("P", self._units.ids))(*self._units.p_min.tolist())

    def outputs(self, x: Any, t: int) -> Values:
        """Return outputs, marginal costs and sums."""
        units, P = self._units, np.array(x)
        left, right = units.slopes(P)
        slope = np.where(np.isinf(left), right, np.where(np.isinf(right), left, 0.5 * (left + right)))
        slope = np.where(np.isfinite(slope), slope, 0.0)  # a fixed unit has none
        return {"state": (*x, *slope.tolist()), "total": (float(P.sum()), units.total(P))}

    def advance(self, x: Any, t: int, *, setpoints: tuple[float, ...]) -> Any:
        """Move towards the set points."""
        P, wanted = np.array(x), np.clip(setpoints, self._units.p_min, self._units.p_max)
        reach = self.p.ramp * self.p.period if self.p.ramp else np.inf
        return x._make((P + np.clip(wanted - P, -reach, reach)).tolist())
