"""The cost model: thermal units whose cost has rectified-sine ripples (valve points), and tables of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import field_validator
from softrig_core import Array, Params, ScenarioError, param, resource
from softrig_core.errors import closest

from .table_file import UNITS, TableError, read_rows

COLUMNS = (
    "p_min_MW",
    "p_max_MW",
    "a_usd_per_MW2h",
    "b_usd_per_MWh",
    "c_usd_per_h",
    "e_usd_per_h",
    "f_rad_per_MW",
)
MORE = ("p_now_MW", "ramp_up_MW", "ramp_down_MW", "reserve_MW")  # columns that a table may have
# In MW. A last arch shorter than this comes of rounding and is part of the one before.
NARROW = 1e-6
BALANCE = 1e-6  # MW; how far the sum may be from the demand


@dataclass(frozen=True, eq=False)
class Units:
    """Thermal units with the cost of equation (1).

    F_j(P) = a_j P^2 + b_j P + c_j + |e_j sin(f_j (P_j,min - P))|

    Parameters
    ----------
    ids : tuple of str
        Name of each unit, n of them, all different.
    table : ndarray, shape (n, 7)
        p_min (MW), p_max (MW), a ($/MW^2 h), b ($/MWh), c ($/h), e ($/h), f (rad/MW).
    more : ndarray, shape (n, 4), optional
        `MORE`: present output, ramps up and down until the next dispatch, largest reserve, all MW; NaN if not given.

    Raises
    ------
    TableError
        No unit, a name twice, a number that is not finite, p_min > p_max, or negative a, e or f.

    References
    ----------
    H. Sharifzadeh, "Solving Economic Load Dispatch by a New Hybrid Optimization Method", 2020, equation (1).
    """

    ids: tuple[str, ...]
    table: Array
    more: Array | None = None

    def agreed(self) -> dict[str, object]:
        """Return the quantities on which the units and their dispatcher must agree: limits and costs."""
        rows = zip(self.ids, self.table.tolist(), strict=True)
        return {"dispatch/units": self.ids} | {f"dispatch/unit {name}": tuple(row) for name, row in rows}

    def __post_init__(self) -> None:
        table = np.array(self.table, dtype=float)
        if table.ndim != 2 or table.shape[0] == 0 or table.shape[1] != len(COLUMNS):
            raise TableError(f"a table of shape {table.shape}: expected one row or more of {', '.join(COLUMNS)}")
        if len(self.ids) != table.shape[0]:
            raise TableError(f"{len(self.ids)} names for {table.shape[0]} rows")
        seen: set[str] = set()
        for name, row in zip(self.ids, table, strict=True):
            if name in seen:
                raise TableError(f"unit {name}: its name occurs twice")
            seen.add(name)
            for column, value in zip(COLUMNS, row, strict=True):
                if not np.isfinite(value):
                    raise TableError(f"unit {name}, column {column}: {value}, expected a finite number")
                if value < 0.0 and column[0] in "aef":
                    raise TableError(f"unit {name}, column {column}: {value:g}, expected at least 0")
            if row[0] > row[1]:
                raise TableError(f"unit {name}: p_min_MW {row[0]:g} is above p_max_MW {row[1]:g}")
        table.setflags(write=False)
        object.__setattr__(self, "table", table)

    @classmethod
    def read(cls, source: str) -> Units:
        """Read a CSV table with a head: ``unit`` and `COLUMNS`, one row a unit.

        Parameters
        ----------
        source : str
            A file name, a ``package://`` URI, or the name of a table that comes with the package (``units_13``);
            ``25*units_40`` has each of its units 25 times, the copies named ``1_2``, ``1_3``, ...

        Raises
        ------
        TableError
            A column is missing, unknown or refused (see `table_file.UNITS`), or a row is wrong; names it.
        """
        copies, star, table = source.partition("*")
        if star and copies.isdecimal() and int(copies) > 0:
            return cls.read(table).times(int(copies))
        if "/" not in source and not source.endswith(".csv"):
            source = f"package://softrig_power/dispatch/tables/{source}.csv"
        path = resource(source)
        columns, result = read_rows(path)
        missing = [c for c in ("unit", *COLUMNS) if c not in columns]
        if missing:
            near = closest(missing[0], [c for c in columns if c not in UNITS.table])
            raise TableError(f"{path.name}: no column {', '.join(missing)}{near}")
        try:
            UNITS.check(columns, path.name)
        except ScenarioError as error:
            raise TableError(str(error)) from None
        ids, rows, more = [], [], []
        for row in result:
            ids.append(row.values["unit"])
            rows.append([row.number(column) for column in COLUMNS])
            more.append([row.number(column, np.nan) for column in MORE])
            for column, value in zip(MORE, more[-1], strict=True):
                if value < 0.0:
                    raise TableError(f"{row.source}, column {column}: {value:g}, expected at least 0")
                if column.startswith("ramp") and np.isfinite(value) and not np.isfinite(more[-1][0]):
                    raise TableError(f"{row.source}: {column} needs p_now_MW, from which it counts")
        if not rows:
            raise TableError(f"{path.name}: no unit in it")
        return cls(tuple(ids), np.array(rows), np.array(more) if np.isfinite(more).any() else None)

    def times(self, n: int) -> Units:
        """Return n copies of each unit, the whole table n times; names of the copies end in ``_2`` to ``_n``."""
        ids = self.ids + tuple(f"{name}_{k}" for k in range(2, n + 1) for name in self.ids)
        return Units(ids, np.tile(self.table, (n, 1)), None if self.more is None else np.tile(self.more, (n, 1)))

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def p_min(self) -> Array:
        """Lower limits, MW, shape (n,)."""
        return self.table[:, 0]

    @property
    def p_max(self) -> Array:
        """Upper limits, MW, shape (n,)."""
        return self.table[:, 1]

    def _more(self, column: int, absent: float) -> Array:
        if self.more is None:
            return np.full(len(self), absent)
        return np.where(np.isnan(self.more[:, column]), absent, self.more[:, column])

    @property
    def now(self) -> Array:
        """Present outputs, MW; NaN if the table does not have them."""
        return self._more(0, np.nan)

    @property
    def ramp_up(self) -> Array:
        """Largest rise to the next dispatch, MW; infinite if the table has none."""
        return self._more(1, np.inf)

    @property
    def ramp_down(self) -> Array:
        """Largest fall to the next dispatch, MW; infinite if the table has none."""
        return self._more(2, np.inf)

    @property
    def ready(self) -> Array:
        """Largest reserve of a unit, MW; its whole range if the table has none."""
        return np.minimum(self._more(3, np.inf), self.p_max - self.p_min)

    def cost(self, P: ArrayLike) -> Array:
        """Cost of each unit, equation (1).

        Parameters
        ----------
        P : array_like, shape (..., n)
            MW.

        Returns
        -------
        ndarray, shape (..., n)
            $/h.
        """
        return cost_of(self.table, P)

    def total(self, P: ArrayLike) -> float:
        """Cost of all units together, $/h."""
        return float(self.cost(P).sum())

    def slopes(self, P: ArrayLike) -> tuple[Array, Array]:
        """One-sided derivatives of each unit's cost.

        Returns
        -------
        (left, right) : ndarrays, shape (n,)
            $/MWh; at a valve point they differ by 2 e f, at a limit the outward one is infinite.
        """
        P = np.asarray(P, dtype=float)
        p_min, p_max, a, b, _, e, f = self.table.T
        smooth = 2.0 * a * P + b
        phase = f * (P - p_min)
        near = np.abs(phase - np.pi * np.round(phase / np.pi)) < 1e-6
        ripple = e * f * np.cos(phase) * np.sign(np.sin(phase))
        left = np.where(near, smooth - e * f, smooth + ripple)
        right = np.where(near, smooth + e * f, smooth + ripple)
        return np.where(p_min + NARROW >= P, -np.inf, left), np.where(p_max - NARROW <= P, np.inf, right)

    def valve_points(self, j: int) -> Array:
        """Ends of the arches of unit j, limits included: P_min + k pi/f, MW, shape (arches + 1,)."""
        p_min, p_max, _, _, _, e, f = self.table[j]
        if e <= 0.0 or f <= 0.0:
            inner = np.empty(0)
        else:
            inner = p_min + np.arange(1, int((p_max - p_min) * f / np.pi) + 2) * np.pi / f
            inner = inner[inner < p_max - NARROW]
        return np.array([p_min, *inner, p_max]) if p_max > p_min else np.array([p_min])

    @cached_property
    def order(self) -> NDArray[np.intp]:
        """An order of the units that depends on their numbers alone, identical ones side by side, shape (n,)."""
        return np.lexsort(self.table.T[::-1])

    @cached_property
    def groups(self) -> NDArray[np.int64]:
        """Number of the group of identical units each one belongs to, shape (n,)."""
        return np.unique(self.table, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)

    def sorted_copies(self, P: Array) -> Array:
        """Return identical units their outputs in falling order, the first of them the largest."""
        P = P.copy()
        for group in range(int(np.max(self.groups)) + 1):
            members = np.flatnonzero(self.groups == group)
            P[members] = np.sort(P[members])[::-1]
        return P


class UnitTable(Params):
    """The units of a block; a table that cannot be read is refused with the parameters."""

    unit_table: str = param(
        "units_13",
        "table of the units: a name of this package's, a file or a package:// URI; 25*units_40: each unit 25 times",
    )

    @field_validator("unit_table")
    @classmethod
    def _readable(cls, source: str) -> str:
        Units.read(source)
        return source


def cost_of(rows: Array, P: ArrayLike) -> Array:
    """Cost by equation (1), $/h, of rows of a table (one, or as many as the last axis of P) at P in MW."""
    P = np.asarray(P, dtype=float)
    p_min, _, a, b, c, e, f = rows.T
    return a * P * P + b * P + c + np.abs(e * np.sin(f * (p_min - P)))


def infeasible(units: Units, demand: float) -> str:
    """Describe why no dispatch can meet a demand in MW; empty when one can."""
    low, high = float(units.p_min.sum()), float(units.p_max.sum())
    if low - BALANCE <= demand <= high + BALANCE:
        return ""
    return f"infeasible: demand {demand:g} MW, but the units give {low:g} to {high:g} MW"


def balanced(units: Units, dispatch: ArrayLike, demand: float) -> Array:
    """Move a dispatch exactly within the limits and onto the balance, changing as few units as little as possible.

    Parameters
    ----------
    dispatch : array_like, shape (n,)
        MW, nearly feasible.

    Returns
    -------
    ndarray, shape (n,)
        The rest goes to the unit that costs least to move there.
    """
    P = np.clip(np.asarray(dispatch, dtype=float), units.p_min, units.p_max)
    for _ in range(len(units)):
        remaining = demand - float(P.sum())
        if abs(remaining) <= 1e-9 * max(1.0, abs(demand)):
            break
        moved = np.clip(P + remaining, units.p_min, units.p_max)
        full = np.abs(moved - P - remaining) <= 1e-12
        reach = np.where(full, units.cost(moved) - units.cost(P), np.inf)
        j = int(np.argmin(reach)) if full.any() else int(np.argmax(np.abs(moved - P)))
        P[j] = moved[j]
    return P


def marginal_cost(units: Units, P: Array) -> tuple[float, float]:
    """Return the system's price: the saving of one MW less and the cost of one MW more, $/MWh.

    The dual of the balance row of the problem inside the arches. The two are equal where a unit rests on a smooth
    part of its cost; where all units rest on valve points or limits, every price between them supports the dispatch.
    """
    left, right = units.slopes(P)
    return float(np.max(left)), float(np.min(right))
