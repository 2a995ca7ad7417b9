"""Further conditions of a dispatch besides limits and demand: network losses, ramps of the units, reserve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from softrig_core import Array, resource
from softrig_core.errors import closest

from .table_file import LOSSES, TableError, read_rows
from .units import Units

CONSTANT = "b00_MW"
LINEAR = "b0"


@dataclass(frozen=True, eq=False)
class Losses:
    """Losses by B coefficients: P_L = P'BP + B0'P + B00, in MW.

    Parameters
    ----------
    B : ndarray, shape (n, n)
        1/MW; symmetric.
    B0 : ndarray, shape (n,)
    B00 : float
        MW.
    """

    B: Array
    B0: Array
    B00: float = 0.0

    @classmethod
    def none(cls, n: int) -> Losses:
        """Return those of a network without any."""
        return cls(np.zeros((n, n)), np.zeros(n))

    @classmethod
    def read(cls, source: str, ids: tuple[str, ...]) -> Losses:
        """Read a CSV table: a row a unit with ``unit``, a column named as each unit (B, 1/MW), optionally ``b0`` and,
        in its first row, ``b00_MW``.

        Raises
        ------
        TableError
            Number or names of the units differ, or a value is not a number.
        """
        path = resource(source)
        columns, rows = read_rows(path)
        names = tuple(row.values.get("unit", "") for row in rows)
        if names != ids:
            raise TableError(f"{path.name}: losses of the units {', '.join(names)}, expected {', '.join(ids)}")
        known = ("unit", *ids, LINEAR, CONSTANT)
        for column in columns:
            if column not in known:
                raise TableError(f"{path.name}: {column} is not a column of {LOSSES.title}{closest(column, known)}")
        for row in rows[1:]:
            if row.values.get(CONSTANT):
                raise TableError(f"{row.source}: {CONSTANT} belongs into the first row")
        B = np.array([[row.number(name) for name in ids] for row in rows])
        B0 = np.array([row.number(LINEAR, 0.0) for row in rows])
        return cls(0.5 * (B + B.T), B0, rows[0].number(CONSTANT, 0.0))

    def of(self, P: Array) -> float:
        """Losses of a dispatch, MW."""
        return float(np.sum(P * np.sum(self.B * P, axis=1)) + np.sum(self.B0 * P) + self.B00)

    def slopes(self, P: Array) -> Array:
        """Incremental losses dP_L/dP of each unit, shape (n,)."""
        return np.asarray(2.0 * np.sum(self.B * P, axis=1) + self.B0)


@dataclass(frozen=True, eq=False)
class Conditions:
    """Optimality conditions at one dispatch.

    Parameters
    ----------
    low, high : ndarray, shape (n,)
        Window of each unit, MW: its limits, narrowed by its ramps.
    reserve : float
        Spinning reserve asked for, MW.
    ready : ndarray, shape (n,)
        Largest reserve of each unit, MW; it gives min(ready, P_max - P).
    """

    low: Array
    high: Array
    losses: Losses
    reserve: float
    ready: Array

    @classmethod
    def of(
        cls, units: Units, losses: Losses | None = None, reserve: float = 0.0, now: Array | None = None
    ) -> Conditions:
        """Create conditions from ramps and readiness of the units' table; `now`: outputs, the table's when absent."""
        outputs = units.now if now is None else now
        low, high = units.p_min.copy(), units.p_max.copy()
        known = np.isfinite(outputs)
        low = np.where(known, np.maximum(low, outputs - units.ramp_down), low)
        high = np.where(known, np.minimum(high, outputs + units.ramp_up), high)
        return cls(low, high, losses or Losses.none(len(units)), reserve, units.ready)

    def spinning(self, units: Units, P: Array) -> float:
        """Reserve that a dispatch leaves, MW."""
        return float(np.sum(np.minimum(self.ready, units.p_max - P)))

    def infeasible(self, units: Units, demand: float) -> str:
        """Describe why no dispatch can meet the demand; empty if none of the sums forbids it."""
        for name, low, high in zip(units.ids, self.low.tolist(), self.high.tolist(), strict=True):
            if low > high:
                return f"infeasible: unit {name} is so far outside its limits that its ramps do not lead into them"
        least, most = (float(P.sum()) - self.losses.of(P) for P in (self.low, self.high))
        if np.max(self.losses.slopes(self.high)) >= 1.0:
            return "infeasible: an incremental loss of 1 or more: the B coefficients are not those of these units"
        if not least - 1e-6 <= demand <= most + 1e-6:
            return (
                f"infeasible: demand {demand:g} MW, but within limits and ramps, less losses, the units give "
                f"{least:g} to {most:g} MW"
            )
        left = self.spinning(units, self.low)
        if left < self.reserve:
            return f"infeasible: reserve {self.reserve:g} MW, but the units have {left:g} MW at their lowest outputs"
        return ""
