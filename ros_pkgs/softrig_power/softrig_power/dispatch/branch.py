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

from .conditions import Conditions, Losses
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


def branch_and_bound(
    units: Units, demand: float, P: Array, tol: float, max_nodes: int, conditions: Conditions | None = None
) -> Proof:
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
    conditions : Conditions, optional
        Losses, ramps and reserve; P need not meet them then.
    """
    order = units.order
    table, groups = np.ascontiguousarray(units.table[order]), units.groups[order]
    given = conditions or Conditions(units.p_min, units.p_max, Losses.none(len(units)), 0.0, units.p_max - units.p_min)
    if conditions is not None:  # units that are alike differ in ramps and losses
        groups = np.arange(len(units))
    losses = given.losses
    rest = (given.low[order], given.high[order], np.ascontiguousarray(losses.B[np.ix_(order, order)]), losses.B0[order],
            float(losses.B00), float(given.reserve), given.ready[order], conditions is not None)  # fmt: skip
    corners = 4 + max(len(units.valve_points(j)) for j in range(len(units)))
    start = (units.sorted_copies(P) if conditions is None else P)[order]
    depth = max(2, min(2000, MEMORY // (len(units) * corners)))
    cost, bound, nodes, found = _search(
        table, groups, float(demand), start, tol, max_nodes, corners, depth, NARROW, rest
    )
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
def _fill(
    lower: Any, rest: Any, more_rest: Any, pieces: Any, slope: Any, width: Any, owner: Any, weight: Any, priced: Any,
    by_slope: Any, beyond: Any, multiplier: Any, P: Any,
) -> Any:  # fmt: skip
    """Fill pieces by rising slope, per weighted MW, to the balance's lower side, on to its upper where it saves."""
    for i in range(pieces):
        priced[i] = (slope[i] + multiplier * beyond[i]) / weight[owner[i]]
    _order(priced, pieces, by_slope)
    for q in range(pieces):
        i = by_slope[q]
        left = rest if priced[i] >= 0.0 else more_rest
        if left <= 0.0:
            break
        share = weight[owner[i]]
        more = min(left, share * width[i])
        lower += priced[i] * more
        P[owner[i]] += more / share
        rest -= more
        more_rest -= more
    return lower, rest


@jit
def _tangent(demand: Any, B: Any, B0: Any, B00: Any, centre: Any, half: Any, weight: Any) -> Any:
    """Write the weights of the balance of a box; give the least and largest weighted sum that may balance."""
    n = centre.shape[0]
    target, off = demand + B00, 0.0
    for j in range(n):
        row = 0.0
        for i in range(n):
            row += B[j, i] * centre[i]
            off += abs(B[j, i]) * half[i] * half[j]
        weight[j] = 1.0 - 2.0 * row - B0[j]
        target -= row * centre[j]  # P_L at the centre less what its slope says of it: -c'Bc + B00
    return target - off, target + off


@jit
def _surplus(P: Any, demand: Any, conditions: Any) -> Any:
    """Sum of the outputs less losses and demand, MW."""
    _, _, B, B0, B00, _, _, _ = conditions
    n = P.shape[0]
    found = -demand - B00
    for j in range(n):
        row = 0.0
        for i in range(n):
            row += B[j, i] * P[i]
        found += P[j] * (1.0 - row - B0[j])
    return found


@jit
def _meets(P: Any, table: Any, demand: Any, conditions: Any) -> Any:
    """Whether a dispatch meets all conditions."""
    low, high, _, _, _, reserve, ready, _ = conditions
    left = 0.0
    for j in range(P.shape[0]):
        if P[j] < low[j] - 1e-9 or P[j] > high[j] + 1e-9:
            return False
        left += min(ready[j], table[j, 1] - P[j])
    return abs(_surplus(P, demand, conditions)) <= 1e-7 and left >= reserve - 1e-7


@jit
def _mended(P: Any, table: Any, demand: Any, conditions: Any) -> Any:
    """Put a nearly balanced dispatch onto the balance by one unit; its cost, infinite when no unit can.

    The unit is the one with which it costs least; P is changed in place.
    """
    low, high, B, B0, _, _, _, _ = conditions
    n = P.shape[0]
    cheapest, unit, output = np.inf, -1, 0.0
    for j in range(n):
        before = P[j]
        for _ in range(20):
            row = 0.0
            for i in range(n):
                row += B[j, i] * P[i]
            change = -_surplus(P, demand, conditions) / (1.0 - 2.0 * row - B0[j])
            P[j] += change
            if abs(change) < 1e-12:
                break
        if low[j] <= P[j] <= high[j] and _meets(P, table, demand, conditions):
            cost = 0.0
            for i in range(n):
                cost += unit_cost(table[i], P[i])
            if cost < cheapest:
                cheapest, unit, output = cost, j, P[j]
        P[j] = before
    if unit >= 0:
        P[unit] = output
    return cheapest


@jit
def _search(
    table: Any, groups: Any, demand: Any, start: Any, tol: Any, max_nodes: Any, corners: Any, depth: Any, narrow: Any,
    conditions: Any,
) -> Any:  # fmt: skip
    """Search; with conditions the balance of a box is its tangent at the centre, between what it can be wrong by.

    sum P - P_L(P) = D gives sum w_j P_j = D' + e with w = 1 - dP_L/dP at the centre of the box and
    abs(e) <= sum abs(B_ij) r_i r_j of its half widths r: of second order, it goes as boxes shrink. Reserve enters by a
    multiplier.
    """
    n = table.shape[0]
    box_low, box_high, B, B0, B00, reserve, ready, conditioned = conditions
    weight, centre, half = np.ones(n), np.empty(n), np.empty(n)
    beyond = np.zeros(2 * n * corners)
    lo, hi = np.empty((depth, n)), np.empty((depth, n))
    x, y = np.empty((depth, n, corners)), np.empty((depth, n, corners))
    count = np.empty((depth, n), np.int64)
    bound = np.empty(depth)  # of the parent
    pieces = 2 * n * corners
    slope, width, owner = np.empty(pieces), np.empty(pieces), np.empty(pieces, np.int64)
    by_slope, priced = np.empty(pieces, np.int64), np.empty(pieces)
    P, best = np.empty(n), np.empty(n)
    upper = 0.0
    for j in range(n):
        best[j] = start[j]
        upper += unit_cost(table[j], start[j])
        lo[0, j], hi[0, j] = box_low[j], box_high[j]
        count[0, j] = _hull(table[j], lo[0, j], hi[0, j], narrow, x[0, j], y[0, j])
    if conditioned and not _meets(start, table, demand, conditions):
        upper = np.inf
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
        low_target, high_target = demand, demand
        if conditioned:
            spare = 0.0
            for j in range(n):
                centre[j], half[j] = 0.5 * (lo[t, j] + hi[t, j]), 0.5 * (hi[t, j] - lo[t, j])
                spare += min(ready[j], table[j, 1] - lo[t, j])
            if spare < reserve - 1e-9:
                top -= 1
                continue
            low_target, high_target = _tangent(demand, B, B0, B00, centre, half, weight)
        # the relaxation: all units at their lower ends, then the pieces by rising slope
        pieces, lower, filled, room = 0, 0.0, 0.0, 0.0
        for j in range(n):
            P[j] = x[t, j, 0]
            lower += y[t, j, 0]
            filled += weight[j] * P[j]
            room += weight[j] * x[t, j, count[t, j] - 1]
            knee = table[j, 1] - ready[j]
            for i in range(count[t, j] - 1):
                whole = x[t, j, i + 1] - x[t, j, i]
                rise = (y[t, j, i + 1] - y[t, j, i]) / whole
                cut = knee - x[t, j, i]
                if reserve > 0.0 and 0.0 < cut < whole:  # beyond the knee a unit gives less reserve
                    width[pieces], slope[pieces], owner[pieces], beyond[pieces] = cut, rise, j, 0.0
                    pieces += 1
                    width[pieces], slope[pieces], owner[pieces], beyond[pieces] = whole - cut, rise, j, 1.0
                else:
                    width[pieces], slope[pieces], owner[pieces] = whole, rise, j
                    beyond[pieces] = 1.0 if reserve > 0.0 and cut <= 0.0 else 0.0
                pieces += 1
        # a box narrower than `narrow` counts as its lower end: as much may be missing a unit
        if filled > high_target + 1e-9 or room < low_target - n * narrow:
            top -= 1
            continue
        base = lower
        lower, rest = _fill(base, low_target - filled, high_target - filled, pieces, slope, width, owner, weight,
                            priced, by_slope, beyond, 0.0, P)  # fmt: skip
        if reserve > 0.0 and lower < upper - tol:
            multiplier, least, enough = 0.0, 0.0, -1.0
            for _ in range(40):  # the dual function of the reserve is concave: its best multiplier by bisection
                short = reserve
                for j in range(n):
                    short -= min(ready[j], table[j, 1] - P[j])
                if short > 0.0:
                    least = multiplier
                    multiplier = max(1.0, 2.0 * multiplier) if enough < 0.0 else 0.5 * (least + enough)
                elif multiplier == 0.0:
                    break
                else:
                    enough = multiplier
                    multiplier = 0.5 * (least + enough)
                offset = base + multiplier * reserve
                for j in range(n):
                    P[j] = x[t, j, 0]
                    offset -= multiplier * min(ready[j], table[j, 1] - P[j])
                dual, rest = _fill(offset, low_target - filled, high_target - filled, pieces, slope, width, owner,
                                   weight, priced, by_slope, beyond, multiplier, P)  # fmt: skip
                lower = max(lower, dual)
                if lower >= upper - tol:
                    break
        if lower >= upper - tol:
            closed = min(closed, lower)
            top -= 1
            continue
        cost, gap, split = 0.0, -1.0, -1
        for j in range(n):
            here = unit_cost(table[j], P[j])
            cost += here
            missing = here - _value(x[t, j], y[t, j], count[t, j], P[j])
            if conditioned:  # what the tangent and the reserve can be wrong by goes with the width, too
                for i in range(n):
                    missing += 10.0 * abs(B[i, j]) * half[i] * half[j]
                if reserve > 0.0:
                    missing += 1e-3 * half[j]
            if missing > gap and hi[t, j] - lo[t, j] > 4.0 * narrow:
                gap, split = missing, j
        if conditioned:
            cost = _mended(P, table, demand, conditions)
            rest = 0.0
        if cost < upper and rest <= 1e-9:
            upper = cost
            for j in range(n):
                best[j] = P[j]
        if lower >= upper - tol or split < 0 or top >= depth - 1:
            closed = min(closed, lower)
            top -= 1
            continue
        at = min(max(P[split], lo[t, split]), hi[t, split])
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
