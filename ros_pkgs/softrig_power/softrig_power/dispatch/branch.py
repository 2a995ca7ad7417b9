"""A proof by branch and bound on the outputs themselves: convex hulls of the costs, one balance row.

The relaxation of a box lo <= P <= hi replaces each unit's cost by a convex piecewise linear function below it. With one
balance row its optimum fills the pieces by rising slope, so that all units but one rest on corners, where the function
touches the cost: the gap of a box is the gap of one unit, and the box is split there. Identical units keep their order
P_j >= P_{j+1}, which narrows their boxes together. Depth first, from the two-stage answer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from softrig_core import Array, jit

from .conditions import Conditions, Losses
from .units import NARROW, Units

# The most corners of all hulls on the stack, which bounds its memory for many units.
MEMORY = 30_000_000


@dataclass(frozen=True)
class Proof:
    """Result of a branch-and-bound search: the bounds it has proved.

    Parameters
    ----------
    P : ndarray, shape (n,)
        Best dispatch, MW.
    cost, bound : float
        Its cost and the proven lower bound of every dispatch's, $/h.
    nodes : int
        Number of boxes examined.
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
        Largest number of boxes; the bound includes the boxes that are still open.
    conditions : Conditions, optional
        Losses, ramps and reserve; P need not meet them.
    """
    order, n = units.order, len(units)
    groups = units.groups[order]
    active = conditions or Conditions(units.p_min, units.p_max, Losses.none(n), 0.0, units.p_max - units.p_min)
    # Identical units differ in ramps and losses, so their order may not be fixed.
    if conditions is not None:
        groups = np.arange(n)
    losses = active.losses
    problem = Problem(
        np.ascontiguousarray(units.table[order]),
        groups,
        float(demand),
        tol,
        NARROW,
        active.low[order],
        active.high[order],
        np.ascontiguousarray(losses.B[np.ix_(order, order)]),
        losses.B0[order],
        float(losses.B00),
        float(active.reserve),
        active.ready[order],
        conditions is not None,
    )
    corners = 4 + max(len(units.valve_points(j)) for j in range(n))
    start = (units.sorted_copies(P) if conditions is None else P)[order]
    depth = max(2, min(2000, MEMORY // (n * corners)))
    cost, bound, nodes, result = _search(problem, start, max_nodes, depth, corners)
    back = np.empty_like(result)
    back[order] = result
    return Proof(back, float(cost), float(min(bound, cost)), int(nodes))


class Problem(NamedTuple):
    """Constraints of a dispatch, and its distance from the optimum (`tol`, $/h); arrays in the order of the search."""

    table: Array
    groups: Any
    demand: float
    tol: float
    narrow: float  # MW; so narrow a box is one point
    low: Array
    high: Array
    B: Array
    B0: Array
    B00: float
    reserve: float
    ready: Array
    conditioned: bool  # losses, ramps or reserve


class Boxes(NamedTuple):
    """The stack of boxes: limits, corners of the hull of each unit and their number, bound of the parent."""

    lo: Array
    hi: Array
    x: Array
    y: Array
    count: Any
    bound: Array


class Relaxed(NamedTuple):
    """The relaxation of one box: middle and half width of each unit, its weight in the balance, its output.

    For the pieces of all hulls: slope, width, unit, whether the unit gives less reserve there, slope with the price of
    the reserve, and the order by this slope.
    """

    centre: Array
    half: Array
    weight: Array
    P: Array
    slope: Array
    width: Array
    owner: Any
    beyond: Array
    priced: Array
    by_slope: Any


@jit
def unit_cost(unit: Any, p: Any) -> Any:
    """Cost of one unit, equation (1), $/h: `unit` is its row of the table."""
    p_min, a, b, c, e, f = unit[0], unit[2], unit[3], unit[4], unit[5], unit[6]
    return a * p * p + b * p + c + abs(e * math.sin(f * (p_min - p)))


@jit
def chord_excess(unit: Any, x0: Any, x1: Any) -> Any:
    """Bound by how much the chord over [x0, x1], inside one arch, exceeds the cost in $/h.

    With g = F - chord, g'' = 2a - e f^2 |sin|. Where the ripple is weak, next to a valve point, g is convex: if it
    begins positive it stays positive; otherwise it falls at most to -max(g'') w^2/2 = -a w^2, w being the width of that
    stretch. Where the ripple is strong, g is concave and has no minimum inside. The ripple alone is above its chord,
    hence never more than that of the parabola, a h^2/4.
    """
    p_min, a, b, e, f = unit[0], unit[2], unit[3], unit[5], unit[6]
    h = x1 - x0
    quadratic = 0.25 * a * h * h
    strength = e * f * f
    if strength <= 2.0 * a:
        return quadratic
    weak = 2.0 * a / strength
    s0, s1 = abs(math.sin(f * (x0 - p_min))), abs(math.sin(f * (x1 - p_min)))
    sign = 1.0 if math.sin(f * (0.5 * (x0 + x1) - p_min)) >= 0.0 else -1.0
    chord = (unit_cost(unit, x1) - unit_cost(unit, x0)) / h
    falls = s0 < weak and b + 2.0 * a * x0 + sign * e * f * math.cos(f * (x0 - p_min)) < chord
    rises = s1 < weak and b + 2.0 * a * x1 + sign * e * f * math.cos(f * (x1 - p_min)) > chord
    if not (falls or rises):
        return 0.0
    w = math.asin(weak) / f
    return min(quadratic, a * w * w)


@jit
def _hull(unit: Any, lo: Any, hi: Any, narrow: Any, x: Any, y: Any) -> Any:
    """Write the corners of a convex function below the cost on [lo, hi] into x and y; return their number."""
    p_min, e, f = unit[0], unit[5], unit[6]
    x[0], y[0] = lo, unit_cost(unit, lo)
    if hi - lo <= narrow:
        # A box this narrow is one point; within it the cost is less by at most its width times the steepest slope.
        y[0] -= (hi - lo) * (abs(unit[3]) + 2.0 * unit[2] * abs(hi) + e * f)
        return 1
    step = np.pi / f if e > 0.0 and f > 0.0 else 4.0 * (hi - lo)
    n = 1
    # A lower end that is a valve point up to rounding belongs to the arch above it.
    k = math.floor((lo - p_min) / step + 1e-9) + 1.0
    x0, y0 = lo, y[0]
    while x0 < hi:
        x1 = p_min + k * step
        k += 1.0
        # A last piece narrower than a point would have a slope made of rounding.
        if x1 > hi - narrow:
            x1 = hi
        y1 = unit_cost(unit, x1)
        low = chord_excess(unit, x0, x1)
        # Two chords meet here, and the function must stay below both.
        y[n - 1] = min(y[n - 1], y0 - low)
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
def _fill(relaxed: Relaxed, lack: Any, lower: Any, multiplier: Any) -> Any:
    """Fill pieces by rising slope, per weighted MW, to the balance's lower side, on to its upper where it saves.

    `lack` has what both sides lack and the number of pieces. Returns the cost and what the lower side still lacks.
    """
    remaining, more_rest, pieces = lack
    _, _, weight, P, slope, width, owner, beyond, priced, by_slope = relaxed
    for i in range(pieces):
        priced[i] = (slope[i] + multiplier * beyond[i]) / weight[owner[i]]
    _order(priced, pieces, by_slope)
    for q in range(pieces):
        i = by_slope[q]
        left = remaining if priced[i] >= 0.0 else more_rest
        if left <= 0.0:
            break
        share = weight[owner[i]]
        more = min(left, share * width[i])
        lower += priced[i] * more
        P[owner[i]] += more / share
        remaining -= more
        more_rest -= more
    return lower, remaining


@jit
def _tangent(problem: Problem, relaxed: Relaxed) -> Any:
    """Write the weights of the balance of a box; return the least and largest weighted sum that may balance.

    sum P - P_L(P) = D gives sum w_j P_j = D' + e with w = 1 - dP_L/dP at the centre of the box and
    abs(e) <= sum abs(B_ij) r_i r_j of its half widths r: of second order, it goes as boxes shrink.
    """
    B, centre, half = problem.B, relaxed.centre, relaxed.half
    n = centre.shape[0]
    target, off = problem.demand + problem.B00, 0.0
    for j in range(n):
        row = 0.0
        for i in range(n):
            row += B[j, i] * centre[i]
            off += abs(B[j, i]) * half[i] * half[j]
        relaxed.weight[j] = 1.0 - 2.0 * row - problem.B0[j]
        # The losses at the centre less their linear part: -c'Bc + B00.
        target -= row * centre[j]
    return target - off, target + off


@jit
def _surplus(problem: Problem, P: Any) -> Any:
    """Sum of the outputs less losses and demand, MW."""
    B, B0, n = problem.B, problem.B0, P.shape[0]
    result = -problem.demand - problem.B00
    for j in range(n):
        row = 0.0
        for i in range(n):
            row += B[j, i] * P[i]
        result += P[j] * (1.0 - row - B0[j])
    return result


@jit
def _meets(problem: Problem, P: Any) -> Any:
    """Return whether a dispatch meets all conditions."""
    table, low, high, ready, left = problem.table, problem.low, problem.high, problem.ready, 0.0
    for j in range(P.shape[0]):
        if P[j] < low[j] - 1e-9 or P[j] > high[j] + 1e-9:
            return False
        left += min(ready[j], table[j, 1] - P[j])
    return abs(_surplus(problem, P)) <= 1e-7 and left >= problem.reserve - 1e-7


@jit
def _mended(problem: Problem, P: Any) -> Any:
    """Move a nearly balanced dispatch onto the balance by one unit; return its cost, infinite if no unit can.

    The unit is the one with which it costs least; P is changed in place.
    """
    table, low, high, B, B0, n = problem.table, problem.low, problem.high, problem.B, problem.B0, P.shape[0]
    cheapest, unit, output = np.inf, -1, 0.0
    for j in range(n):
        before = P[j]
        for _ in range(20):
            row = 0.0
            for i in range(n):
                row += B[j, i] * P[i]
            change = -_surplus(problem, P) / (1.0 - 2.0 * row - B0[j])
            P[j] += change
            if abs(change) < 1e-12:
                break
        if low[j] <= P[j] <= high[j] and _meets(problem, P):
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
def _room(n: Any, depth: Any, corners: Any) -> Any:
    """Allocate `depth` boxes and the relaxation of one; without conditions all weights stay one."""
    lo, hi = np.empty((depth, n)), np.empty((depth, n))
    x, y = np.empty((depth, n, corners)), np.empty((depth, n, corners))
    boxes = Boxes(lo, hi, x, y, np.empty((depth, n), np.int64), np.empty(depth))
    pieces = 2 * n * corners
    slope, width, beyond, priced = np.empty(pieces), np.empty(pieces), np.empty(pieces), np.empty(pieces)
    owner, by_slope = np.empty(pieces, np.int64), np.empty(pieces, np.int64)
    centre, half, weight, P = np.empty(n), np.empty(n), np.ones(n), np.empty(n)
    return boxes, Relaxed(centre, half, weight, P, slope, width, owner, beyond, priced, by_slope)


@jit
def _begin(problem: Problem, start: Any, boxes: Boxes) -> Any:
    """Push the whole box onto the stack; return the cost of the initial dispatch, infinite if it is not feasible."""
    table, low, high, cost = problem.table, problem.low, problem.high, 0.0
    boxes.bound[0] = -np.inf
    for j in range(start.shape[0]):
        cost += unit_cost(table[j], start[j])
        boxes.lo[0, j], boxes.hi[0, j] = low[j], high[j]
        boxes.count[0, j] = _hull(table[j], low[j], high[j], problem.narrow, boxes.x[0, j], boxes.y[0, j])
    return np.inf if problem.conditioned and not _meets(problem, start) else cost


@jit
def _cut(problem: Problem, boxes: Boxes, t: Any, relaxed: Relaxed) -> Any:
    """Set all units to their lower ends; return the cost of that, the balance of both ends, the number of pieces."""
    x, y = boxes.x[t], boxes.y[t]
    _, _, weight, P, slope, width, owner, beyond, _, _ = relaxed
    table, ready, reserve, count = problem.table, problem.ready, problem.reserve, boxes.count[t]
    pieces, lower, filled, room = 0, 0.0, 0.0, 0.0
    for j in range(P.shape[0]):
        P[j] = x[j, 0]
        lower += y[j, 0]
        last = count[j] - 1
        filled += weight[j] * x[j, 0]
        room += weight[j] * x[j, last]
        knee = table[j, 1] - ready[j]
        for i in range(last):
            length = x[j, i + 1] - x[j, i]
            rise = (y[j, i + 1] - y[j, i]) / length
            cut = knee - x[j, i]
            # Beyond the knee each MW of output takes a MW from the reserve, so the piece is cut there.
            if reserve > 0.0 and 0.0 < cut < length:
                width[pieces], slope[pieces], owner[pieces], beyond[pieces] = cut, rise, j, 0.0
                pieces += 1
                width[pieces], slope[pieces], owner[pieces], beyond[pieces] = length - cut, rise, j, 1.0
            else:
                width[pieces], slope[pieces], owner[pieces] = length, rise, j
                beyond[pieces] = 1.0 if reserve > 0.0 and cut <= 0.0 else 0.0
            pieces += 1
    return lower, filled, room, pieces


@jit
def _relax(problem: Problem, boxes: Boxes, t: Any, relaxed: Relaxed, enough: Any) -> Any:
    """Return the least cost of the relaxation of a box, infinite if it is infeasible, and the error of the balance.

    The outputs of the units are written into `relaxed`. With a reserve, the bound is raised until it reaches `enough`.
    """
    n = relaxed.P.shape[0]
    least, most = problem.demand, problem.demand
    if problem.conditioned:
        table, ready, lows, highs, spare = problem.table, problem.ready, boxes.lo[t], boxes.hi[t], 0.0
        for j in range(n):
            lo, hi = lows[j], highs[j]
            relaxed.centre[j], relaxed.half[j] = 0.5 * (lo + hi), 0.5 * (hi - lo)
            spare += min(ready[j], table[j, 1] - lo)
        if spare < problem.reserve - 1e-9:
            return np.inf, 0.0
        least, most = _tangent(problem, relaxed)
    base, filled, room, pieces = _cut(problem, boxes, t, relaxed)
    # A box narrower than `narrow` counts as its lower end, so each unit may lack as much.
    if filled > most + 1e-9 or room < least - n * problem.narrow:
        return np.inf, 0.0
    lack = (least - filled, most - filled, pieces)
    lower, remaining = _fill(relaxed, lack, base, 0.0)
    if problem.reserve > 0.0 and lower < enough:
        return _reserved(problem, boxes.x[t], relaxed, lack, base, (lower, remaining), enough)
    return lower, remaining


@jit
def _reserved(problem: Problem, x: Any, relaxed: Relaxed, lack: Any, base: Any, value: Any, enough: Any) -> Any:
    """Raise a bound by a price of the reserve: its dual function is concave, its best multiplier by bisection."""
    lower, remaining = value
    table, ready, P, n = problem.table, problem.ready, relaxed.P, relaxed.P.shape[0]
    multiplier, least, most = 0.0, 0.0, -1.0
    for _ in range(40):
        short = problem.reserve
        for j in range(n):
            short -= min(ready[j], table[j, 1] - P[j])
        if short > 0.0:
            least = multiplier
            multiplier = max(1.0, 2.0 * multiplier) if most < 0.0 else 0.5 * (least + most)
        elif multiplier == 0.0:
            break
        else:
            most = multiplier
            multiplier = 0.5 * (least + most)
        offset = base + multiplier * problem.reserve
        for j in range(n):
            P[j] = x[j, 0]
            offset -= multiplier * min(ready[j], table[j, 1] - P[j])
        dual, remaining = _fill(relaxed, lack, offset, multiplier)
        lower = max(lower, dual)
        if lower >= enough:
            break
    return lower, remaining


@jit
def _widest(problem: Problem, boxes: Boxes, t: Any, relaxed: Relaxed) -> Any:
    """Return the cost of the relaxation's outputs and the unit whose gap is the widest, -1 when all are narrow."""
    table, B, P, half, n = problem.table, problem.B, relaxed.P, relaxed.half, relaxed.P.shape[0]
    lo, hi, x, y, count = boxes.lo[t], boxes.hi[t], boxes.x[t], boxes.y[t], boxes.count[t]
    cost, gap, split = 0.0, -1.0, -1
    for j in range(n):
        exact = unit_cost(table[j], P[j])
        cost += exact
        missing = exact - _value(x[j], y[j], count[j], P[j])
        # The errors of the tangent and of the reserve shrink with the width, so wide units are split for them too.
        if problem.conditioned:
            for i in range(n):
                missing += 10.0 * abs(B[i, j]) * half[i] * half[j]
            if problem.reserve > 0.0:
                missing += 1e-3 * half[j]
        if missing > gap and hi[j] - lo[j] > 4.0 * problem.narrow:
            gap, split = missing, j
    return cost, split


@jit
def _split(problem: Problem, boxes: Boxes, t: Any, split: Any, cut: Any, lower: Any) -> None:
    """Split box t where the relaxation puts a unit: the lower part stays in t, the upper part is pushed onto
    the stack.
    """
    lo, hi, x, y, count, bound = boxes
    table, groups, narrow, n = problem.table, problem.groups, problem.narrow, lo.shape[1]
    cut = min(max(cut, lo[t, split]), hi[t, split])
    # A split at an end would leave the box as it was and never end.
    if min(cut - lo[t, split], hi[t, split] - cut) <= 2.0 * narrow:
        cut = 0.5 * (lo[t, split] + hi[t, split])
    s = t + 1
    for j in range(n):
        lo[s, j], hi[s, j], count[s, j] = lo[t, j], hi[t, j], count[t, j]
        for i in range(count[t, j]):
            x[s, j, i], y[s, j, i] = x[t, j, i], y[t, j, i]
    bound[t] = bound[s] = lower
    # Identical units are in falling order. In the half below, this unit and those after it are at most `cut`; in the
    # half above, this unit and those before it are at least `cut`.
    j = split
    while j < n and groups[j] == groups[split] and hi[t, j] > cut:
        hi[t, j] = cut
        if lo[t, j] > cut:
            bound[t] = np.inf
        count[t, j] = _hull(table[j], min(lo[t, j], cut), cut, narrow, x[t, j], y[t, j])
        j += 1
    j = split
    while j >= 0 and groups[j] == groups[split] and lo[s, j] < cut:
        lo[s, j] = cut
        if hi[s, j] < cut:
            bound[s] = np.inf
        count[s, j] = _hull(table[j], cut, max(hi[s, j], cut), narrow, x[s, j], y[s, j])
        j -= 1


@jit
def _search(problem: Problem, start: Any, max_nodes: Any, depth: Any, corners: Any) -> Any:
    """Search; with conditions the balance of a box is its tangent (`_tangent`), reserve enters by a multiplier."""
    boxes, relaxed = _room(start.shape[0], depth, corners)
    upper, best = _begin(problem, start, boxes), start.copy()
    # The proof is as good as the least bound of all boxes that are closed or left open.
    closed = np.inf
    top, nodes = 1, 0
    while top > 0 and nodes < max_nodes:
        top -= 1
        bound = boxes.bound[top]
        if bound < upper - problem.tol:
            nodes += 1
            bound, remaining = _relax(problem, boxes, top, relaxed, upper - problem.tol)
        if bound >= upper - problem.tol:
            closed = min(closed, bound)
            continue
        cost, split = _widest(problem, boxes, top, relaxed)
        if problem.conditioned:
            cost, remaining = _mended(problem, relaxed.P), 0.0
        if cost < upper and remaining <= 1e-9:
            upper = cost
            best[:] = relaxed.P
        # A box that cannot be split, or for which the stack has no room, is closed with the bound that it has.
        if bound >= upper - problem.tol or split < 0 or top + 2 >= depth:
            closed = min(closed, bound)
            continue
        _split(problem, boxes, top, split, relaxed.P[split], bound)
        top += 2
    for t in range(top):
        closed = min(closed, boxes.bound[t])
    return upper, closed, nodes, best
