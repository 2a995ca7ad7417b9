"""The paper's method: a MILP over chords (stage 1), then an NLP inside the arches it chose (stage 2)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import highspy
import numpy as np
from softrig_core import Array

from .units import Units, balanced, cost_of


@dataclass(frozen=True)
class MilpResult:
    """Result of stage 1.

    Parameters
    ----------
    P : ndarray, shape (n,)
        MW.
    objective : float
        Cost of the chords at P, $/h: not the cost of the dispatch.
    bound : float
        Proven lower bound of the objective, $/h.
    binaries, nodes : int
        Size of the model and of the search.
    optimal : bool
        Whether the solver closed its gap in the time it had.
    """

    P: Array
    objective: float
    bound: float
    binaries: int
    nodes: int
    optimal: bool


class NoDispatch(RuntimeError):
    """The solver ended without any dispatch; the text gives the reason."""


def breakpoints(units: Units, nseg: int) -> list[Array]:
    """Cut each arch into equal segments; every valve point and both limits are among the ends.

    Parameters
    ----------
    nseg : int
        Segments of a whole arch; a partial one has in proportion, at least one. A unit without ripple has nseg over
        its whole range.

    Returns
    -------
    list of n ndarrays
        Ends of the segments in MW; one point for a fixed unit.
    """
    result = []
    for j in range(len(units)):
        ends = units.valve_points(j)
        _, _, _, _, _, e, f = units.table[j]
        arch = np.pi / f if e > 0.0 and f > 0.0 else np.inf
        points = [ends[:1]]
        for x0, x1 in pairwise(ends):
            count = nseg if arch == np.inf else max(1, round(nseg * (x1 - x0) / arch))
            points.append(np.linspace(x0, x1, count + 1)[1:])
        result.append(np.concatenate(points))
    return result


def milp(
    units: Units,
    demand: float,
    points: Sequence[Array],
    lowered: Sequence[Array] | None = None,
    *,
    gap: float = 1e-9,
    gap_abs: float = 1e-6,
    time_limit: float = np.inf,
    start: Array | None = None,
) -> MilpResult:
    """Solve the piecewise linear problem, in the shifted form of equations (4) to (9).

    One binary z_k and one continuous 0 <= w_k <= (x_k - x_{k-1}) z_k a segment, sum_k z_k = 1,
    P = sum_k (x_{k-1} z_k + w_k), cost sum_k (y_{k-1} z_k + m_k w_k); sum over all n units P_j = D (the print sums
    its (3) and (12) to m), no product with z in (14) and one with z in (13).

    Parameters
    ----------
    points : n ndarrays
        Ends of the segments of each unit, MW.
    lowered : n ndarrays, optional
        By how much each unit's chords are lowered, $/h, so that the model underestimates the cost.
    gap, gap_abs : float
        Relative and absolute gap at which the solver stops.
    time_limit : float
        s.
    start : ndarray, optional
        A dispatch to begin with.

    Raises
    ------
    NoDispatch
        Nothing found.
    """
    n, x0, x1, unit = len(units), [], [], []
    for j, ends in enumerate(points):
        x0 += list(ends[:-1]) if len(ends) > 1 else [ends[0]]
        x1 += list(ends[1:]) if len(ends) > 1 else [ends[0]]
        unit += [j] * max(1, len(ends) - 1)
    left, right, owner = np.array(x0), np.array(x1), np.array(unit)
    rows = units.table[owner]
    low = (
        np.concatenate([np.broadcast_to(d, max(1, len(p) - 1)) for p, d in zip(points, lowered, strict=True)])
        if lowered is not None
        else np.zeros(len(left))
    )
    y0, y1 = cost_of(rows, left) - low, cost_of(rows, right) - low
    width = right - left
    slope = np.divide(y1 - y0, width, out=np.zeros_like(width), where=width > 0.0)
    segments = len(left)
    z, w = np.arange(segments), np.arange(segments, 2 * segments)
    # rows: balance; one segment a unit; w_k - width z_k <= 0
    index = np.concatenate(
        [
            np.column_stack([np.zeros(segments), 1 + owner, 1 + n + z]).ravel(),
            np.column_stack([np.zeros(segments), 1 + n + z]).ravel(),
        ]
    ).astype(np.int32)
    value = np.concatenate([np.column_stack([left, np.ones(segments), -width]).ravel(), np.ones(2 * segments)])
    lp = highspy.HighsLp()
    lp.num_col_, lp.num_row_ = 2 * segments, 1 + n + segments
    lp.col_cost_ = np.concatenate([y0, slope])
    lp.col_lower_ = np.zeros(2 * segments)
    lp.col_upper_ = np.concatenate([np.ones(segments), width])
    lp.row_lower_ = np.concatenate([[demand], np.ones(n), np.full(segments, -highspy.kHighsInf)])
    lp.row_upper_ = np.concatenate([[demand], np.ones(n), np.zeros(segments)])
    lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
    lp.a_matrix_.start_ = np.concatenate([3 * np.arange(segments), 3 * segments + 2 * np.arange(segments + 1)])
    lp.a_matrix_.index_, lp.a_matrix_.value_ = index, value
    lp.integrality_ = [highspy.HighsVarType.kInteger] * segments + [highspy.HighsVarType.kContinuous] * segments
    solver: Any = highspy.Highs()  # type: ignore[no-untyped-call]
    for option, setting in (
        ("output_flag", False),
        # One thread and a fixed seed, so that a run repeats.
        ("threads", 1),
        ("random_seed", 0),
        ("mip_rel_gap", gap),
        ("mip_abs_gap", gap_abs),
        ("mip_feasibility_tolerance", 1e-9),
        ("primal_feasibility_tolerance", 1e-9),
        ("time_limit", min(time_limit, 1e9)),
    ):
        solver.setOptionValue(option, setting)
    solver.passModel(lp)
    if start is not None:
        solution = highspy.HighsSolution()
        solution.col_value = _as_columns(start, points, segments)
        solver.setSolution(solution)
    solver.run()
    info, status = solver.getInfo(), solver.getModelStatus()
    if info.primal_solution_status != highspy.SolutionStatus.kSolutionStatusFeasible:
        raise NoDispatch(f"the MILP ended without a dispatch: {solver.modelStatusToString(status)}")
    columns = np.array(solver.getSolution().col_value)
    chosen = np.round(columns[z])
    P = np.bincount(owner, left * chosen + np.minimum(columns[w], width * chosen), n).astype(np.float64)
    return MilpResult(
        P,
        info.objective_function_value,
        info.mip_dual_bound,
        segments,
        max(0, info.mip_node_count),
        status == highspy.HighsModelStatus.kOptimal,
    )


def _as_columns(P: Array, points: Sequence[Array], segments: int) -> list[float]:
    """Write a dispatch in the columns of the MILP."""
    z, w, offset = np.zeros(segments), np.zeros(segments), 0
    for p, ends in zip(P, points, strict=True):
        k = max(0, min(int(np.searchsorted(ends, p, "right")) - 1, len(ends) - 2))
        z[offset + k], w[offset + k] = 1.0, p - ends[k]
        offset += max(1, len(ends) - 1)
    return [*z, *w]


def arch_bounds(units: Units, P: Array) -> tuple[Array, Array]:
    """Return the ends of the arch of each output; a valve point belongs to the arch above it. Shapes (n,), MW."""
    low, high = units.p_min.copy(), units.p_max.copy()
    for j, p in enumerate(P):
        ends = units.valve_points(j)
        if len(ends) > 1:
            # A valve point may take the arch on either side; with the upper one all cases here end at their optimum.
            k = max(0, min(int(np.searchsorted(ends, p + 1e-7, "right")) - 1, len(ends) - 2))
            low[j], high[j] = ends[k], ends[k + 1]
    return low, high


def nlp(units: Units, demand: float, P: Array) -> tuple[Array, bool]:
    """Solve the smooth problem inside the arches of a dispatch, from that dispatch, by ipopt.

    Inside an arch |sin| has one sign, so that the cost is smooth; the kinks are the arches' ends and therefore bounds.

    Returns
    -------
    (ndarray of shape (n,), bool)
        The better of `P` and the dispatch found, both corrected to the balance, and whether ipopt succeeded.
    """
    import casadi as ca

    low, high = arch_bounds(units, P)
    p_min, _, a, b, c, e, f = units.table.T
    sign = np.sign(np.sin(f * ((low + high) / 2.0 - p_min)))
    x = ca.SX.sym("P", len(units))
    cost = ca.sum1(a * x**2 + b * x + c + sign * e * ca.sin(f * (x - p_min)))
    problem: dict[str, ca.SX] = {"x": x, "f": cost, "g": ca.sum1(x)}
    options: dict[str, Any] = {
        "ipopt.tol": 1e-10,
        "ipopt.bound_relax_factor": 0.0,
        "ipopt.print_level": 0,
        "print_time": False,
        "ipopt.sb": "yes",
        "ipopt.honor_original_bounds": "yes",
    }
    solver = ca.nlpsol("arches", "ipopt", problem, options)
    before = balanced(units, P, demand)
    try:
        result = solver(x0=np.clip(P, low, high), lbx=low, ubx=high, lbg=demand, ubg=demand)
        succeeded = bool(solver.stats()["success"])
        after = np.array(result["x"]).reshape(-1)
    # casadi raises RuntimeError for every failure.
    except RuntimeError:
        return before, False
    if not succeeded or not np.isfinite(after).all():
        return before, False
    # ipopt ends a tolerance inside its bounds, so an output beside a valve point or limit is put onto it.
    for ends in (low, high):
        after = np.where(np.abs(after - ends) < 1e-5, ends, after)
    after = balanced(units, after, demand)
    return (after if units.total(after) <= units.total(before) else before), True
