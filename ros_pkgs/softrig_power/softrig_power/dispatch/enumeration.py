"""Kink enumeration: exact if at most one unit rests off its valve points and limits. An independent check."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, jit

from .branch import unit_cost
from .certify import InfeasibleError
from .units import NARROW, Units, infeasible


class TooManyError(ValueError):
    """There are more combinations than can be enumerated; the text has their number."""


class Levels(NamedTuple):
    """Units in order; the number of valve points of each, their powers (MW) and costs ($/h)."""

    table: Array
    groups: Any
    sizes: Any
    powers: Array
    costs: Array


def enumerate_kinks(units: Units, demand: float, most: int = 50_000_000) -> Array:
    """Try every choice of the one free unit and every multiset of levels of the others.

    Parameters
    ----------
    demand : float
        MW.
    most : int
        Most combinations.

    Returns
    -------
    ndarray, shape (n,)
        The cheapest dispatch of this form, MW.

    Raises
    ------
    InfeasibleError
        The demand is beyond the limits, or no such dispatch meets it.
    TooManyError
    """
    why = infeasible(units, demand)
    if why:
        raise InfeasibleError(why)
    order = units.order
    table, groups = np.ascontiguousarray(units.table[order]), units.groups[order]
    results = [units.valve_points(j) for j in order]
    sizes = np.array([len(p) for p in results], dtype=np.int64)
    powers = np.zeros((len(units), int(np.max(sizes))))
    for row, ends in zip(powers, results, strict=True):
        row[: len(ends)] = ends
    costs = np.array([[unit_cost(t, p) for p in row] for t, row in zip(table, powers, strict=True)])
    levels = Levels(table, groups, sizes, powers, costs)
    best, least, tried = np.zeros(len(units)), np.inf, 0
    for free in range(len(units)):
        # An identical unit as the free one is the same problem again.
        if free and groups[free] == groups[free - 1]:
            continue
        cost, count = _enumerate(levels, free, demand, least, best, most - tried)
        least, tried = min(least, cost), tried + count
        if tried >= most:
            raise TooManyError(f"more than {most} combinations of valve points; expected at most about 13 units")
    if not np.isfinite(least):
        raise InfeasibleError(f"no dispatch of {demand:g} MW has all units except one on valve points")
    back = np.empty_like(best)
    back[order] = best
    return back


@jit
def _enumerate(fleet: Levels, free: Any, demand: Any, least: Any, best: Any, most: Any) -> Any:
    """Count through the levels of all units but `free` like an odometer, skipping those that cannot meet the demand."""
    table, groups, sizes, levels, costs = fleet
    m = table.shape[0] - 1
    others = np.empty(m, np.int64)
    for k in range(m):
        others[k] = k if k < free else k + 1
    # The least and most that the units from i on can add.
    low, high = np.zeros(m + 1), np.zeros(m + 1)
    for i in range(m - 1, -1, -1):
        low[i] = low[i + 1] + table[others[i], 0]
        high[i] = high[i + 1] + table[others[i], 1]
    pick = np.zeros(m, np.int64)
    power, cost = np.zeros(m + 1), np.zeros(m + 1)
    i, count, result = 0, 0, np.inf
    pick[0] = 0
    while i >= 0:
        if i == m:
            count += 1
            remaining = demand - power[m]
            if table[free, 0] - NARROW <= remaining <= table[free, 1] + NARROW:
                remaining = min(max(remaining, table[free, 0]), table[free, 1])
                total = cost[m] + unit_cost(table[free], remaining)
                if total < least:
                    least = result = total
                    for k in range(m):
                        best[others[k]] = levels[others[k], pick[k]]
                    best[free] = remaining
            if count >= most:
                return result, count
            i -= 1
            pick[i] += 1
            continue
        j = others[i]
        # Identical units are in falling order, so that the same multiset is counted once.
        last = sizes[j]
        if i > 0 and groups[others[i - 1]] == groups[j]:
            last = min(last, pick[i - 1] + 1)
        if pick[i] >= last:
            i -= 1
            if i >= 0:
                pick[i] += 1
            continue
        power[i + 1], cost[i + 1] = power[i] + levels[j, pick[i]], cost[i] + costs[j, pick[i]]
        remaining = demand - power[i + 1]
        if remaining < low[i + 1] + table[free, 0] - NARROW or remaining > high[i + 1] + table[free, 1] + NARROW:
            pick[i] += 1
            continue
        i += 1
        if i < m:
            pick[i] = 0
    return result, count
