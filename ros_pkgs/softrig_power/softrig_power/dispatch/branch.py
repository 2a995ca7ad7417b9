"""A proof by branch and bound on the outputs themselves: convex hulls of the costs, one balance row.

The relaxation of a box lo <= P <= hi replaces each unit's cost by a convex piecewise linear function below it. With one
balance row its optimum fills the pieces by rising slope, so that all units but one rest on corners, where the function
touches the cost: the gap of a box is the gap of one unit, and the box is split there. Identical units keep their order
P_j >= P_{j+1}, which narrows their boxes together. Depth first, from the two-stage answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from softrig_core import jit

from .units import NARROW, Array, Units

MEMORY = 30_000_000  # corners of all hulls on the stack


@dataclass(frozen=True)
class Proof:
    """What the search proved.

    Parameters
    ----------
    P : ndarray, shape (n,)
        Best dispatch, MW.
    cost, bound : float
        Its cost and the proven lower bound of every dispatch's, $/h.
    nodes : int
        Boxes looked at.
    """

    P: Array
    cost: float
    bound: float
    nodes: int


def branch_and_bound(units: Units, demand: float, P: Array, tol: float, max_nodes: int) -> Proof:
    """Prove that no dispatch costs less than the best found minus `tol`, or as much of it as the nodes allow.

    Parameters
    ----------
    demand : float
        MW, feasible.
    P : ndarray, shape (n,)
        A feasible dispatch to begin with, MW.
    tol : float
        $/h.
    max_nodes : int
        Most boxes; the bound of those left open counts.
    """
    order = units.order
    table, groups = np.ascontiguousarray(units.table[order]), units.groups[order]
    corners = 4 + max(len(units.valve_points(j)) for j in range(len(units)))
    start = units.sorted_copies(P)[order]
    depth = max(2, min(2000, MEMORY // (len(units) * corners)))
    cost, bound, nodes, found = _search(table, groups, float(demand), start, tol, max_nodes, corners, depth, NARROW)
    back = np.empty_like(found)
    back[order] = found
    return Proof(back, float(cost), float(min(bound, cost)), int(nodes))


@jit
def unit_cost(unit: Any, p: Any) -> Any:
    """Cost of one unit, equation (1), $/h: `unit` is its row of the table."""
    p_min, a, b, c, e, f = unit[0], unit[2], unit[3], unit[4], unit[5], unit[6]
    return a * p * p + b * p + c + abs(e * math.sin(f * (p_min - p)))


@jit
def chord_excess(unit: Any, x0: Any, x1: Any) -> Any:
    """Bound by how much the chord over [x0, x1], inside one arch, exceeds the cost in $/h.

    With g = F - chord, g'' = 2a - e f^2 |sin|. Where the ripple is weak, next to a valve point, g is convex: it stays
    positive if it begins so, and else falls at most to -max(g'') w^2/2 = -a w^2, w being the width of that stretch.
    Where the ripple is strong, g is concave and has no minimum inside. The ripple alone is above its chord, hence never
    more than that of the parabola, a h^2/4.
    """
    p_min, a, b, e, f = unit[0], unit[2], unit[3], unit[5], unit[6]
    h = x1 - x0
    whole = 0.25 * a * h * h
    strength = e * f * f
    if strength <= 2.0 * a:
        return whole
    weak = 2.0 * a / strength
    s0, s1 = abs(math.sin(f * (x0 - p_min))), abs(math.sin(f * (x1 - p_min)))
    sign = 1.0 if math.sin(f * (0.5 * (x0 + x1) - p_min)) >= 0.0 else -1.0
    chord = (unit_cost(unit, x1) - unit_cost(unit, x0)) / h
    falls = s0 < weak and b + 2.0 * a * x0 + sign * e * f * math.cos(f * (x0 - p_min)) < chord
    rises = s1 < weak and b + 2.0 * a * x1 + sign * e * f * math.cos(f * (x1 - p_min)) > chord
    if not (falls or rises):
        return 0.0
    w = math.asin(weak) / f
    return min(whole, a * w * w)


@jit
def _hull(unit: Any, lo: Any, hi: Any, narrow: Any, x: Any, y: Any) -> Any:
    """Write the corners of a convex function below the cost on [lo, hi] into x and y; give their number."""
    p_min, e, f = unit[0], unit[5], unit[6]
    x[0], y[0] = lo, unit_cost(unit, lo)
    if hi - lo <= narrow:
        # so narrow a box is one point: its cost can only be less by its width times the steepest slope
        y[0] -= (hi - lo) * (abs(unit[3]) + 2.0 * unit[2] * abs(hi) + e * f)
        return 1
    step = np.pi / f if e > 0.0 and f > 0.0 else 4.0 * (hi - lo)
    n = 1
    k = math.floor((lo - p_min) / step + 1e-9) + 1.0
    x0, y0 = lo, y[0]
    while x0 < hi:
        x1 = p_min + k * step
        k += 1.0
        if x1 > hi - narrow:
            x1 = hi
        y1 = unit_cost(unit, x1)
        low = chord_excess(unit, x0, x1)
        y[n - 1] = min(y[n - 1], y0 - low)  # the lower of the two chords that meet here
        while n > 2 and (y[n - 1] - y[n - 2]) * (x[n - 2] - x[n - 3]) <= (y[n - 2] - y[n - 3]) * (x[n - 1] - x[n - 2]):
            x[n - 2], y[n - 2] = x[n - 1], y[n - 1]
            n -= 1
        x[n], y[n] = x1, y1 - low
        n += 1
        while n > 2 and (y[n - 1] - y[n - 2]) * (x[n - 2] - x[n - 3]) <= (y[n - 2] - y[n - 3]) * (x[n - 1] - x[n - 2]):
            x[n - 2], y[n - 2] = x[n - 1], y[n - 1]
            n -= 1
        x0, y0 = x1, y1
    return n


@jit
def _value(x: Any, y: Any, n: Any, p: Any) -> Any:
    """Value of the piecewise linear function with n corners at p."""
    k = 0
    while k < n - 2 and x[k + 1] < p:
        k += 1
    return y[k] if n == 1 else y[k] + (y[k + 1] - y[k]) * (p - x[k]) / (x[k + 1] - x[k])


@jit
def _order(values: Any, count: Any, index: Any) -> Any:
    """Write into `index` the order of the first values by size: Shell's sort, for numbers nearly in order."""
    for i in range(count):
        index[i] = i
    step = count // 2
    while step > 0:
        for i in range(step, count):
            item = index[i]
            j = i
            while j >= step and values[index[j - step]] > values[item]:
                index[j] = index[j - step]
                j -= step
            index[j] = item
        step //= 2


@jit
def _search(
    table: Any, groups: Any, demand: Any, start: Any, tol: Any, max_nodes: Any, corners: Any, depth: Any, narrow: Any
) -> Any:
    n = table.shape[0]
    lo, hi = np.empty((depth, n)), np.empty((depth, n))
    x, y = np.empty((depth, n, corners)), np.empty((depth, n, corners))
    count = np.empty((depth, n), np.int64)
    bound = np.empty(depth)  # of the parent
    slope, width, owner = np.empty(n * corners), np.empty(n * corners), np.empty(n * corners, np.int64)
    by_slope = np.empty(n * corners, np.int64)
    P, best = np.empty(n), np.empty(n)
    upper = 0.0
    for j in range(n):
        best[j] = start[j]
        upper += unit_cost(table[j], start[j])
        lo[0, j], hi[0, j] = table[j, 0], table[j, 1]
        count[0, j] = _hull(table[j], lo[0, j], hi[0, j], narrow, x[0, j], y[0, j])
    bound[0] = -np.inf
    closed = np.inf  # least bound of the boxes that are done with
    top, nodes = 1, 0
    while top > 0 and nodes < max_nodes:
        t = top - 1
        if bound[t] >= upper - tol:
            closed = min(closed, bound[t])
            top -= 1
            continue
        nodes += 1
        # the relaxation: all units at their lower ends, then the pieces by rising slope
        pieces, lower, filled, room = 0, 0.0, 0.0, 0.0
        for j in range(n):
            P[j] = x[t, j, 0]
            lower += y[t, j, 0]
            filled += P[j]
            room += x[t, j, count[t, j] - 1]
            for i in range(count[t, j] - 1):
                width[pieces] = x[t, j, i + 1] - x[t, j, i]
                slope[pieces] = (y[t, j, i + 1] - y[t, j, i]) / width[pieces]
                owner[pieces] = j
                pieces += 1
        # a box narrower than `narrow` counts as its lower end: as much may be missing a unit
        if filled > demand + 1e-9 or room < demand - n * narrow:
            top -= 1
            continue
        rest = demand - filled
        _order(slope, pieces, by_slope)
        for q in range(pieces):
            i = by_slope[q]
            if rest <= 0.0:
                break
            more = min(rest, width[i])
            lower += slope[i] * more
            P[owner[i]] += more
            rest -= more
        if lower >= upper - tol:
            closed = min(closed, lower)
            top -= 1
            continue
        cost, gap, split = 0.0, -1.0, -1
        for j in range(n):
            here = unit_cost(table[j], P[j])
            cost += here
            missing = here - _value(x[t, j], y[t, j], count[t, j], P[j])
            if missing > gap and hi[t, j] - lo[t, j] > 4.0 * narrow:
                gap, split = missing, j
        if cost < upper and rest <= 1e-9:
            upper = cost
            for j in range(n):
                best[j] = P[j]
        if lower >= upper - tol or split < 0 or top >= depth - 1:
            closed = min(closed, lower)
            top -= 1
            continue
        at = P[split]
        if min(at - lo[t, split], hi[t, split] - at) <= 2.0 * narrow:
            at = 0.5 * (lo[t, split] + hi[t, split])
        s = top
        for j in range(n):
            lo[s, j], hi[s, j], count[s, j] = lo[t, j], hi[t, j], count[t, j]
            for i in range(count[t, j]):
                x[s, j, i], y[s, j, i] = x[t, j, i], y[t, j, i]
        hi[t, split], lo[s, split] = at, at
        bound[t] = bound[s] = lower
        count[t, split] = _hull(table[split], lo[t, split], at, narrow, x[t, split], y[t, split])
        count[s, split] = _hull(table[split], at, hi[s, split], narrow, x[s, split], y[s, split])
        # identical units stand in falling order: what is below is at most, what is above at least this
        j = split + 1
        while j < n and groups[j] == groups[split] and hi[t, j] > at:
            hi[t, j] = at
            if lo[t, j] > at:
                bound[t] = np.inf
            count[t, j] = _hull(table[j], min(lo[t, j], at), at, narrow, x[t, j], y[t, j])
            j += 1
        j = split - 1
        while j >= 0 and groups[j] == groups[split] and lo[s, j] < at:
            lo[s, j] = at
            if hi[s, j] < at:
                bound[s] = np.inf
            count[s, j] = _hull(table[j], at, max(hi[s, j], at), narrow, x[s, j], y[s, j])
            j -= 1
        top += 1
    for t in range(top):
        closed = min(closed, bound[t])
    return upper, closed, nodes, best
